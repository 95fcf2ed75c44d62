"""Follow objects through videos: poses, figures, and an annotated video."""

import math
import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from posefilter.cli.checkpoints import check_once, methods_of
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended, finite, say, show_table, warn
from posefilter.cli.doubts import say_commonest, say_doubt
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.cli.plain import resolve
from posefilter.cli.predict import check_depth_scale, parse_distortion, read_intrinsics
from posefilter.cli.results import write_json
from posefilter.cli.shapes import load_shape, open_shapes
from posefilter.cli.track_log import POSES, TrackLog, check_unused
from posefilter.data.readers.registry import open_meshes, open_whole
from posefilter.data.sequences import FolderVideo, Scene, SceneVideo, Video, VideoFrame, list_scenes
from posefilter.errors import Stopped, UserError, naming
from posefilter.estimator import Estimator
from posefilter.figures.detections import Drawn, draw_detections
from posefilter.figures.overlay import Shape
from posefilter.figures.recording import check_viewer
from posefilter.figures.track_recording import Seen, TrackRecorder
from posefilter.figures.video import VideoWriter
from posefilter.meshes.ycb import number_objects
from posefilter.metrics.bop_results import write_poses_csv
from posefilter.progress import bars
from posefilter.tracking.motion import ConstantVelocity
from posefilter.tracking.records import compute_figures, describe_row, make_row, write_rows
from posefilter.tracking.settings import FilterSettings, TrackerSettings
from posefilter.tracking.track import TrackResult
from posefilter.tracking.track_loss import STATUSES
from posefilter.tracking.tracker import Tracker

_MOST_IN_GIF = 3000  # frames: some 1.5 GB until they are written
_DEPTH_SCALE = 10000  # units of depth images in a meter, as YCB-Video's


def track(job: Job) -> None:
    """Write poses.csv, poses.jsonl, tracks.csv, metrics.json, and a video of each scene.

    What was tracked before a frame that cannot be read, or before Ctrl-C, is written, too; and
    what was before a SIGKILL is in the files of `TrackLog`.

    Raises:
        UserError: A frame cannot be read, and `on_error` is not "skip".
    """
    cfg, folder = job.cfg, job.folder
    check_unused(folder)
    if cfg.save_rerun:
        check_viewer()
    settle(cfg.threads, cfg.seed)
    threads = torch.get_num_threads()
    settings = make_settings(cfg.tracker)
    estimator = Estimator(methods_of(cfg.checkpoint, changes(cfg)))
    check_once(estimator.objects)
    videos, native = open_videos(cfg, estimator.objects)
    longest = max(map(len, videos))
    if cfg.save_video == "gif" and longest > _MOST_IN_GIF:
        raise UserError(
            f"save_video=gif: {longest} frames do not fit into memory (at most {_MOST_IN_GIF}); "
            "choose save_video=mp4, or a stride="
        )
    store = open_shapes(cfg, estimator.objects)
    shapes = {model.name: load_shape(store, model) for model in estimator.object_models}
    folder.mkdir(parents=True, exist_ok=True)
    log = TrackLog(folder, native)
    broken: UserError | KeyboardInterrupt | Stopped | None = None
    files: dict[str, Path] = {"poses": folder / POSES, "lines": folder / "poses.jsonl"}
    for video in videos:
        name = "video" if len(videos) == 1 else f"video_{video.name.replace('/', '_')}"
        writer = VideoWriter(folder / name, cfg.save_video, float(cfg.fps))
        view = folder / f"{name.replace('video', 'view', 1)}.rrd" if cfg.save_rerun else None
        recorder = TrackRecorder(view, shapes)
        try:
            follow(video, estimator, settings, cfg, writer, recorder, shapes, threads, log)
        except (UserError, KeyboardInterrupt, Stopped) as error:
            broken = error
        if view is not None:
            files[view.stem] = view
        if writer.path.is_file():  # some frame of it was read
            files[name] = writer.path
        if broken is not None:
            break
    log.close()
    rows = log.rows
    if not rows:
        raise broken or UserError("no frame could be read; leave on_error=skip out to see why")
    for name in estimator.objects:
        results = [row.result for row in rows if row.result.object == name]
        if not any(one.is_tracked for one in results):
            doubts = [warning for one in results for warning in one.warnings]
            where = "is tracked in no frame"
            say_commonest(name, where, doubts, len(results), "frames", cfg.console)
    write_rows(folder, [finite(describe_row(row)) for row in rows])
    write_poses_csv(folder / POSES, log.list_poses(rows))
    metrics = {
        model.name: compute_figures(own, model)
        for model in estimator.object_models
        if (own := [row for row in rows if row.result.object == model.name])
    }
    write_json(folder / "metrics.json", metrics)
    log.remove()
    files |= {"tracks": folder / "tracks.csv", "metrics": folder / "metrics.json"}
    for name, figures in metrics.items():
        show_table(cfg.console, name, list_figures(figures))
    following = [f"rerun {shlex.quote(str(f))}" for f in files.values() if f.suffix == ".rrd"]
    ended(cfg.console, "tracked", files, following, metrics=metrics)
    if isinstance(broken, UserError):
        count = len({(row.video, row.frame) for row in rows})
        raise UserError(f"{broken}; the {count} frames before it are in {folder}") from broken
    if broken is not None:
        raise broken


def follow(
    video: Video,
    estimator: Estimator,
    settings: TrackerSettings,
    cfg: DictConfig,
    writer: VideoWriter,
    recorder: TrackRecorder,
    shapes: dict[str, Shape],
    threads: int,
    log: TrackLog,
) -> None:
    """Track the objects through one video, write its pictures, and log its rows as they come."""
    shown = estimator.objects if video.objects is None else video.objects
    methods = [method for method in estimator.methods if method.object_model.name in shown]
    tracker = Tracker(Estimator(methods), settings, cfg.seed, threads)
    say(cfg.console, "video", f"{video.name}: {len(video)} frames", video=video.name)
    for name in video.several:
        sentence = (
            f"{video.name}: frames show several of {name}; one is tracked, and compared with the "
            "first that is listed"
        )
        warn(cfg.console, sentence, video=video.name, object=name)
    numbers = number_objects(estimator.objects) | video.ids
    doubted: set[str] = set()  # objects whose size was said to be wrong, and why frames are blank
    watch = bars(shown=cfg.console != JSON, transient=True)
    with closing(tracker), writer, recorder, watch as bar:
        task, room = bar.add_task(video.name, total=len(video)), 0
        for frame in read_frames(video, tracker, cfg):
            start = time.perf_counter()
            results = tracker.update_all(frame.rgb, frame.depth, frame.intrinsics)
            seconds = time.perf_counter() - start
            room = room or measure_room(frame, results, shapes)
            writer.add(draw_frame(frame, results, shapes), room)
            recorder.add(frame.rgb, frame.depth, frame.intrinsics, list_seen(results))
            rows = []
            for result in results:
                ids = (video.scene_id, frame.im_id, numbers[result.object])
                truth = frame.truth.get(result.object)
                image = f"frame {frame.name}"
                say_doubt(result, image, doubted, cfg.console, frame=frame.name)
                rows.append(make_row(video.name, frame.name, ids, result, seconds, truth))
            log.add(rows)
            bar.advance(task)


def read_frames(video: Video, tracker: Tracker, cfg: DictConfig) -> Iterator[VideoFrame]:
    """Yield the frames that can be tracked in.

    Raises:
        UserError: One cannot be, and `on_error` is not "skip": then a warning names it.
    """
    skip = "skip" in (cfg.on_error, OmegaConf.select(cfg, "data.on_error"))
    for index in range(len(video)):
        try:
            frame = video.read(index)
            if frame is None:  # the dataset cannot show it
                continue
            with naming(f"frame {frame.name}"):
                tracker.check(frame.rgb, frame.depth, frame.intrinsics)
        except UserError as error:
            if not skip:
                raise UserError(f"{error}; on_error=skip leaves such frames out") from error
            warn(cfg.console, f"left out: {error}", skipped=str(error))
        else:
            yield frame


def draw_frame(
    frame: VideoFrame, results: Sequence[TrackResult], shapes: dict[str, Shape]
) -> np.ndarray:
    """Draw the objects that are tracked; the legend names those that are lost, too."""
    tracked = [one for one in results if one.is_tracked]
    drawn = [Drawn(f"{one.object}: {one.status}", one.pose, shapes[one.object]) for one in tracked]
    lost = [one.object for one in results if not one.is_tracked]
    caption = f"lost: {', '.join(lost)}" if lost else ""
    return draw_detections(frame.rgb, frame.intrinsics, drawn, caption=caption)


def measure_room(
    frame: VideoFrame, results: Sequence[TrackResult], shapes: dict[str, Shape]
) -> int:
    """Return the height of a picture with the longest legend: the photograph keeps its size."""
    longest = max(STATUSES, key=len)
    names = [one.object for one in results]
    drawn = [Drawn(f"{name}: {longest}", np.eye(4), shapes[name]) for name in names]
    lost = f"lost: {', '.join(names)}"
    black = np.zeros_like(frame.rgb)
    return max(
        len(draw_detections(black, frame.intrinsics, drawn[:count], caption=caption))
        for count, caption in ((len(drawn), ""), (len(drawn), lost), (0, lost))
    )


def list_seen(results: Sequence[TrackResult]) -> list[Seen]:
    """Return the objects of a frame as the 3-D view takes them."""
    seen = []
    for one in results:
        pose = one.pose if one.is_tracked else None
        center = one.object_model.center.cpu().double().numpy()
        presence = float("nan") if one.presence is None else float(one.presence)
        seen.append(Seen(one.object, pose, center, presence))
    return seen


def make_settings(node: DictConfig) -> TrackerSettings:
    """Return the settings of the section `tracker`.

    Raises UserError where one is no number of its kind.
    """
    plain: Any = resolve(node)
    for name in ("motion", "follow", "probe", "search"):
        if not isinstance(plain[name], dict):
            raise UserError(
                f"tracker.{name}={plain[name]}: must be a section; leave it out for the default"
            )
    try:
        plain["motion"] = ConstantVelocity(**plain["motion"])
        for name in ("follow", "probe", "search"):
            plain[name] = FilterSettings(**plain[name])
        return TrackerSettings(**plain)
    except TypeError as error:
        raise UserError(f"tracker: {error}") from error


def open_videos(cfg: DictConfig, objects: Sequence[str]) -> tuple[Sequence[Video], Any]:
    """Return the videos that the settings name, and the frames of their objects (by class).

    Raises UserError where there are no frames, or no objects in them.
    """
    data = cfg.get("data")
    if cfg.frames:
        camera = read_intrinsics(cfg.intrinsics, cfg.distortion is not None)
        scale = float(cfg.depth_scale or _DEPTH_SCALE)
        lens = None if cfg.distortion is None else parse_distortion(cfg.distortion)
        folder = Path(str(cfg.frames))
        skip = cfg.on_error == "skip"
        video = FolderVideo(folder, camera.K, scale, cfg.stride, lens, camera.size, skip)
        if cfg.depth_scale is None and not video.holds_meters:
            check_depth_scale(camera, scale, f"intrinsics={cfg.intrinsics}")
        return [video], lambda _: np.eye(4)
    names = list(objects)
    options = resolve(data.options) or {}
    asked = (data.meshes, data.mesh_scale, data.source, names)
    meshes = open_meshes(*asked, options.get("mesh_frame"))
    reader = open_whole(data.source, data.root, names, meshes, data.on_error, **options)
    scenes = list_scenes(reader)
    if cfg.scene is not None:
        known, scenes = scenes, [one for one in scenes if _is_meant(one, cfg.scene)]
        if not scenes:
            some = ", ".join(one.name for one in known[:5]) + (", ..." if len(known) > 5 else "")
            raise UserError(f"scene={cfg.scene}: {data.root} has no such scene; it has {some}")
    videos = [SceneVideo(reader, one, names, cfg.stride) for one in scenes]
    shown = [video for video in videos if video.objects]
    if not shown:
        there = ", ".join(reader.objects[:5]) + (", ..." if len(reader.objects) > 5 else "")
        raise UserError(
            f"data.root={data.root}: none of the objects is annotated there ({', '.join(names)}); "
            f"its own are {there}"
        )
    return shown, reader.native_from_mesh


def _is_meant(scene: Scene, asked: Any) -> bool:
    """Tell whether a scene is meant: by its name, its place's, or its number."""
    group, name = scene.group, str(asked)
    same = group.isdigit() and name.isdigit() and int(group) == int(name)
    return same or name in (group, scene.name)


def list_figures(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table that is printed."""
    out = [("frames", str(figures["frames"])), ("lost", str(figures["lost"]))]
    if "add" in figures:
        out += [
            ("ADD AUC", f"{figures['add']['auc']:.1f}"),
            ("ADD-S AUC", f"{figures['add_s']['auc']:.1f}"),
            ("false tracks", str(figures["false_tracks"])),
        ]
        if math.isfinite(figures["jitter_mm"]):  # two frames in a row were tracked
            jitter = f"{figures['jitter_mm']:.1f} mm, {figures['jitter_deg']:.2f} degrees"
            out.append(("jitter", jitter))
    if figures["frames_per_second"] is not None:
        out.append(("its part of a frame", f"{1000 * figures['seconds_tracked']:.0f} ms"))
    return out
