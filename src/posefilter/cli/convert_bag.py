"""Find objects in the images of a ROS 2 bag, and write detections into another bag."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from omegaconf import DictConfig

from posefilter.cli.checkpoints import check_once, methods_of
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended, say, warn
from posefilter.cli.doubts import say_commonest, say_doubt
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.cli.predict import read_costs
from posefilter.confidence.blank import find_blank
from posefilter.errors import Stopped, UserError
from posefilter.estimator import Estimator
from posefilter.progress import bars
from posefilter.result import Result
from posefilter.ros.bags import BagFrame, BagReader, BagWriter, Topics
from posefilter.ros.detections import list_shown, make_detections
from posefilter.ros.messages import stamp_of
from posefilter.tracking.tracker import Tracker


def convert_bag(job: Job) -> None:
    """Write a Detection3DArray for each color image that has depth.

    Raises:
        UserError: The bag cannot be read, or not one of its images has depth and a camera; or an
            image cannot be used, and `on_error` is not "skip": those before it are written.
    """
    cfg = job.cfg
    out = Path(str(cfg.out))
    if out.exists():
        raise UserError(f"out={out}: already exists; choose another")
    topics = Topics(str(cfg.color), str(cfg.depth), str(cfg.camera_info))
    limit, units = float(cfg.max_time_difference), float(cfg.depth_scale)
    skip = cfg.on_error == "skip"
    with BagReader(Path(str(cfg.bag)), topics, limit, cfg.rectify, units, skip) as reader:
        settle(cfg.threads, cfg.seed)
        methods = methods_of(cfg.checkpoint, changes(cfg))
        estimator = Estimator(methods, costs=read_costs(cfg))
        check_once(estimator.objects)
        find = choose_finder(estimator, cfg.track, cfg.seed)
        tally = Tally(dict.fromkeys(estimator.objects, 0))
        with BagWriter(out, str(cfg.detections)) as writer:
            if cfg.copy_messages:
                writer.add_connections(reader.reader.connections)  # first: it may be refused
            without = ", without the messages of the bag" if cfg.copy_messages else ""
            kept = "the {} images before it are in {}" + without
            try:
                write_detections(reader, writer, find, tally, cfg)
                if cfg.copy_messages:
                    kept = "all {} images and a part of the bag's messages are in {}"
                    writer.copy(reader.messages())
            except (UserError, KeyboardInterrupt, Stopped) as error:
                kept = kept.format(writer.count, out)
                if writer.count and isinstance(error, UserError):
                    raise UserError(f"{error}; {kept}") from error
                if writer.count:
                    warn(cfg.console, f"stopped; {kept}", images=writer.count)
                raise
    tell(tally, reader, cfg, out)


def write_detections(
    reader: BagReader,
    writer: BagWriter,
    find: Callable[[BagFrame], list[Result]],
    tally: "Tally",
    cfg: DictConfig,
) -> None:
    """Write what is found in each image, under a bar; say what is doubtful as it comes.

    Raises:
        UserError: Not one image could be used, or one cannot be read and is not skipped.
    """
    with bars(shown=cfg.console != JSON, transient=True) as bar:
        task = bar.add_task("images", total=reader.images)
        for frame in reader.frames():
            try:
                results = find(frame)
            except UserError as error:
                reader.leave_out(stamp_of(frame), error)
                continue
            tally.add(frame, results, cfg.console)
            writer.write(make_detections(results, frame.header), frame.time)
            for sentence in reader.warnings[tally.warned :]:
                warn(cfg.console, sentence)
            tally.warned = len(reader.warnings)
            done = reader.unpaired + reader.early + len(reader.skipped)
            bar.update(task, completed=tally.images + done)
    if not tally.images:
        raise UserError(f"bag={cfg.bag}: {reader.explain_none()}")


@dataclass
class Tally:
    """What was found in a bag."""

    found: dict[str, int]  # images by object
    images: int = 0
    blank: int = 0  # images in which nothing can be found, see `find_blank`
    warned: int = 0  # of the reader's warnings
    doubted: set[str] = field(default_factory=set)  # objects and reasons that were warned of
    doubts: dict[str, list[str]] = field(default_factory=dict)  # by object, where it is not shown

    def add(self, frame: BagFrame, results: Sequence[Result], console: str) -> None:
        """Count an image, and say what makes its results doubtful."""
        self.images += 1
        # single images that are blank have no results, and tracks say that they are
        self.blank += not results or bool(results[0].blank)
        shown = {one.object for one in list_shown(results)}
        for one in results:
            self.found[one.object] += one.object in shown
            if one.object not in shown:
                self.doubts.setdefault(one.object, []).extend(one.warnings)
            say_doubt(one, f"image of {stamp_of(frame) / 1e9:.3f} s", self.doubted, console)


def tell(tally: Tally, reader: BagReader, cfg: DictConfig, out: Path) -> None:
    """Say what was found, and what is doubtful."""
    if reader.distorted:
        said = "warning: the camera has a lens distortion, and images are taken as rectified ones; "
        said += "if they are not: rectify=true"
        say(cfg.console, "distorted", said)
    if tally.blank:
        said = f"warning: {tally.blank} of {tally.images} images have no depth, or one color"
        say(cfg.console, "blank", said)
    if reader.skipped:
        said = f"warning: {len(reader.skipped)} messages were left out; the first: "
        say(cfg.console, "skipped", said + reader.skipped[0], skipped=len(reader.skipped))
    for name, count in tally.found.items():
        if not count:
            doubts = tally.doubts.get(name, [])
            say_commonest(name, "is in no image", doubts, tally.images, "images", cfg.console)
    if cfg.console != JSON:
        early = f", {reader.early} before the first camera_info" if reader.early else ""
        print(f"{tally.images} images, {reader.unpaired} without depth{early}")
        for name, count in tally.found.items():
            print(f"{name}: in {count}")
    ended(
        cfg.console, "converted", {"bag": out}, [],
        images=tally.images, unpaired=reader.unpaired, early=reader.early, blank=tally.blank,
        skipped=len(reader.skipped), found=tally.found,
    )  # fmt: skip


def choose_finder(
    estimator: Estimator, track: bool, seed: int
) -> Callable[[BagFrame], list[Result]]:
    """Return what finds the objects in a frame: each frame by itself, or by tracking.

    A frame by which nothing can be judged, as a camera sends that starts or is covered, shows no
    object.
    """
    if track:
        tracker = Tracker(estimator, seed=seed, threads=torch.get_num_threads())
        return lambda frame: [*tracker.update_all(frame.rgb, frame.depth, frame.intrinsics)]

    def find(frame: BagFrame) -> list[Result]:
        if find_blank(frame.rgb, frame.depth):
            return []
        (results,) = estimator.predict_batch(frame.rgb, frame.depth, frame.intrinsics, seed=seed)
        return results

    return find
