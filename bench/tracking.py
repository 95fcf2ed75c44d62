"""Tracks against single images on YCB-Video's photographs, and track losses that are induced.

    python bench/tracking.py --frames DIR --meshes DIR [--only 003_cracker_box] [--losses]

    python bench/tracking.py --sequences DIR=OBJECT [DIR=OBJECT ...] --meshes DIR

    python bench/tracking.py (--frames DIR | --sequences DIR) --meshes DIR --together 1 --together 4

    python bench/tracking.py (--frames DIR | --sequences DIR=OBJECT ...) --meshes DIR --beliefs

For each of YCB-Video's objects whose weights ship and that is in the scenes: every frame by itself,
then the same frames tracked, in one process. Figures are means over seeds, of single images over
the first four, and ± is the standard error of such a mean. Times are the processor's of this
process, so that other work on the machine changes them little; the ratio of the two is what to go
by. Then the frames once more, of which six are replaced by those of another scene: how many are
declared to show the object, and after how many frames it is recovered. Sequences are folders of
generate.py with moving= and fully_occluded_frames=: there the losses are in the frames. With
--together so many objects of a scene are tracked at once by one thread, by two that torch shares an
operation's work out to, and by two processes that have an object each: in turn, by the clock, on an
idle machine if the figures are to mean anything. Of the processor's time it is the first process'
share. Objects that a scene lacks are taken where it has too few, and are searched for in every
frame. With --beliefs, how often a track's belief holds the truth where its estimate is right,
calibrated and as the particles alone. Writes the tables of docs/results/tracking.md; rows of what
did not run stay.
"""

import argparse
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from confidence import degrees_of, is_right_pose, measure_error, summarize_errors
from marked import format_row, put_table, read_rows
from programs import HOME, make_parser

import posefilter
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.sequences import SceneVideo, VideoFrame, list_scenes
from posefilter.memory import keep_freed_memory
from posefilter.meshes import ycb
from posefilter.metrics.credibility import SHOWN
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import auc
from posefilter.metrics.tracks import measure_jitter
from posefilter.tracking.motion import ConstantVelocity
from posefilter.weights import list_shipped

PAGE = HOME / "docs" / "results" / "tracking.md"
AWAY = range(7, 13)  # frames that are replaced
SINGLE_SEEDS = 4
HEAD = (
    "object", "scene", "stride", "frames", "single: ADD AUC", "ADD-S AUC", "jitter mm", "degrees",
    "tracked: ADD AUC", "ADD-S AUC", "jitter mm", "degrees", "lost", "single s", "tracked ms",
    "ratio",
)  # fmt: skip
LOSSES = (
    "object", "scene", "away", "declared present", "of these in the first", "recovered after",
    "presence with it", "without",
)  # fmt: skip
SEQUENCES = (
    "object", "sequence", "step mm", "step degrees", "frames", "covered", "single: ADD AUC",
    "tracked: ADD AUC", "random walk", "single: ADD-S AUC", "tracked: ADD-S AUC", "lost",
    "covered: declared present", "recovered after",
)  # fmt: skip
RANDOM_WALK = ConstantVelocity(velocity_gain=0, max_noise_scale=1)
BELIEFS = (
    "object", "frames of", "scenes", "belief", "right frames",
    f"ellipsoids of {' / '.join(map(str, SHOWN))} %", "off: mm", "degrees", "says: mm", "degrees",
    "holds: translation %", "rotation %",
)  # fmt: skip
TOGETHER = (
    "scene", "objects", "of these away", "frames", "threads", "frame ms", "mean", "slowest",
    "frames/s", "CPU ms", "ADD AUC, mean", "least", "frames lost",
)  # fmt: skip
WAYS = (
    ("one", 1, None),
    ("two, for an operation", 2, None),
    ("two, side by side", 2, 2),
)  # name, torch's threads, the tracker's


class Outcome(NamedTuple):
    """What came of the frames in one way."""

    add: float  # AUC
    add_s: float
    jitter: tuple[float, float]  # [mm], [degrees]
    lost: int
    seconds: float  # the median frame's; of a track without its first


def judge(
    found: tuple[Sequence[Any], Sequence[float]], frames: Sequence[VideoFrame], first: int = 0
) -> Outcome:
    """Return the figures of results, a frame each, and their seconds from the `first` on; what is
    lost counts as missed.
    """
    results, seconds = found
    object_model = results[0].object_model
    poses = torch.from_numpy(np.stack([one.pose for one in results]))
    truth = torch.from_numpy(np.stack([frame.truth[object_model.name] for frame in frames]))
    missed = torch.tensor([not getattr(one, "is_tracked", True) for one in results])
    errors = [f(poses, truth, object_model.points.double()) for f in (add, add_s)]
    areas = [auc(torch.where(missed, math.inf, error)) for error in errors]
    jitter = measure_jitter(poses, truth, object_model.center.double())
    return Outcome(areas[0], areas[1], jitter, int(missed.sum()), float(np.median(seconds[first:])))


def run_single(
    estimator: posefilter.Estimator, frames: Sequence[VideoFrame], seed: int = 0
) -> tuple[list[Any], list[float]]:
    """Estimate every frame by itself; return the results and the processor's seconds."""
    results, seconds = [], []
    for frame in frames:
        start = time.process_time()
        results.append(estimator.predict(frame.rgb, frame.depth, frame.intrinsics, seed=seed))
        seconds.append(time.process_time() - start)
    return results, seconds


def run_tracked(
    estimator: posefilter.Estimator,
    frames: Sequence[VideoFrame],
    settings: posefilter.TrackerSettings | None = None,
    seed: int = 0,
) -> tuple[list[Any], list[float]]:
    """Track the frames; return the results and the processor's seconds."""
    tracker, results, seconds = posefilter.Tracker(estimator, settings, seed), [], []
    for frame in frames:
        start = time.process_time()
        results.append(tracker.update(frame.rgb, frame.depth, frame.intrinsics))
        seconds.append(time.process_time() - start)
    return results, seconds


def measure_loss(
    estimator: posefilter.Estimator,
    frames: Sequence[VideoFrame],
    other: Sequence[VideoFrame],
    seed: int,
) -> tuple[int, int, int | None, float, float]:
    """Replace some frames by another scene's, and track.

    Returns:
        In how many of these the object was declared present, and how many of them are the delay of
        a loss; in which of its own that came back it is found, or None; the least presence of a
        frame with it, and the greatest of one without.
    """
    mixed = [other[n] if n in AWAY else frame for n, frame in enumerate(frames)]
    results, _ = run_tracked(estimator, mixed, seed=seed)
    said = [results[n].is_tracked for n in AWAY]
    back = find_recovery(results, frames, range(AWAY.stop, len(frames)))
    early = sum(said[: posefilter.TrackerSettings().patience - 1])
    there = min(r.presence for n, r in enumerate(results) if r.is_tracked and n not in AWAY)
    return sum(said), early, back, there, max(results[n].presence for n in AWAY)


def measure_losses(
    estimator: posefilter.Estimator,
    scene: str,
    frames: Sequence[VideoFrame],
    other: Sequence[VideoFrame],
    seeds: int,
) -> str:
    """Return the row of what became of the tracks of all seeds."""
    found = [measure_loss(estimator, frames, other, seed) for seed in range(seeds)]
    said, early, back, there, away = zip(*found, strict=True)
    cells = [estimator.objects[0], scene, str(len(AWAY)), f"{np.mean(said):.1f}"]
    cells += [f"{np.mean(early):.1f}", describe_recovery(back), f"{min(there):.2f}"]
    return format_row([*cells, f"{max(away):.2f}"])


def describe_recovery(back: Sequence[int | None]) -> str:
    """Return after how many frames objects were found again, and how many were not."""
    counts = [count for count in back if count is not None]
    slowest = f"{np.mean(counts):.1f}, at most {max(counts)}" if counts else "–"
    missed = len(back) - len(counts)
    return f"{slowest}; not again: {missed}" if missed else slowest


def average(outcomes: Sequence[Outcome], name: str, digits: int = 1) -> str:
    """Return the mean of a figure over seeds, and its standard error."""
    values = [getattr(one, name) for one in outcomes]
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    error = np.std(values, ddof=1) / math.sqrt(len(values))
    return f"{np.mean(values):.{digits}f} ± {error:.{digits}f}"


def compare(
    estimator: posefilter.Estimator,
    scene: str,
    frames: Sequence[VideoFrame],
    strides: Sequence[int],
    seeds: int,
) -> Iterator[str]:
    """Yield the row of single images against tracks at each stride."""
    name = estimator.objects[0]
    estimator.predict(frames[0].rgb, frames[0].depth, frames[0].intrinsics)  # warm
    alone = [run_single(estimator, frames, seed) for seed in range(min(seeds, SINGLE_SEEDS))]
    for stride in strides:
        some = frames[::stride]
        single = [judge((found[::stride], times[::stride]), some) for found, times in alone]
        tracked = [
            judge(run_tracked(estimator, some, seed=seed), some, first=1) for seed in range(seeds)
        ]
        yield make_row(name, scene, stride, single, tracked, len(some))


def make_row(
    name: str,
    scene: str,
    stride: int,
    single: Sequence[Outcome],
    tracked: Sequence[Outcome],
    n: int,
) -> str:
    """Return a line of the table."""
    both = list[str]()
    for some in (single, tracked):
        shift, turn = np.mean([one.jitter for one in some], axis=0)
        both += [average(some, "add"), average(some, "add_s"), f"{shift:.1f}", f"{turn:.2f}"]
    lost = f"{np.mean([one.lost for one in tracked]):.2g}"
    once, again = (float(np.median([one.seconds for one in some])) for some in (single, tracked))
    cells = [name, scene, str(stride), str(n), *both, lost, f"{once:.2f}"]
    cells += [f"{1000 * again:.0f}", f"{once / again:.0f}"]
    return format_row(cells)


def measure_sequence(
    estimator: posefilter.Estimator, sequence: str, frames: Sequence[VideoFrame], seeds: int
) -> str:
    """Return the row of a rendered sequence, in whose middle the object is covered.

    Tracks are of the default settings, and of a random walk.
    """
    name, model = estimator.objects[0], estimator.object_models[0]
    shown = [n for n, frame in enumerate(frames) if name in frame.truth]
    covered = [n for n in range(shown[0], shown[-1]) if n not in shown]
    after = [n for n in shown if n > max(covered, default=len(frames))]
    own = [frames[n] for n in shown]
    single = [
        judge(run_single(estimator, own, seed), own) for seed in range(min(seeds, SINGLE_SEEDS))
    ]
    fixed = posefilter.TrackerSettings(motion=RANDOM_WALK)
    tracks, others = (
        [run_tracked(estimator, frames, settings, seed)[0] for seed in range(seeds)]
        for settings in (None, fixed)
    )
    scores, walks = (
        [judge(([one[n] for n in shown], [0.0]), own) for one in results]
        for results in (tracks, others)
    )
    steps = measure_steps(frames, name, model.center.double())
    back = [find_recovery(one, frames, after) for one in tracks]
    cells = [name, sequence, *(f"{x:.1f}" for x in steps), str(len(frames)), str(len(covered))]
    cells += [average(single, "add"), average(scores, "add"), average(walks, "add")]
    cells += [average(single, "add_s"), average(scores, "add_s")]
    cells += [f"{np.mean([one.lost for one in scores]):.1f}"]
    cells += [f"{np.mean([sum(one[n].is_tracked for n in covered) for one in tracks]):.1f}"]
    return format_row([*cells, describe_recovery(back)])


def measure_steps(
    frames: Sequence[VideoFrame], name: str, center: torch.Tensor
) -> tuple[float, float]:
    """Return how far an object moves from one frame to the next, root mean square [mm], [degrees];
    of frames that follow each other: a gap while it is covered is no step.
    """
    truths = [frame.truth.get(name) for frame in frames]
    pairs = [(a, b) for a, b in pairwise(truths) if a is not None and b is not None]
    still = torch.eye(4).double().expand(2, 4, 4)
    steps = [measure_jitter(torch.from_numpy(np.stack(pair)), still, center) for pair in pairs]
    shift, turn = np.sqrt(np.square(steps).mean(0))
    return float(shift), float(turn)


def find_recovery(
    results: Sequence[Any], frames: Sequence[VideoFrame], numbers: Sequence[int]
) -> int | None:
    """Return in which of some frames, counted from 1, an object is found, or None."""
    for count, n in enumerate(numbers, start=1):
        result, model = results[n], results[n].object_model
        if result.is_tracked:
            truth = torch.from_numpy(frames[n].truth[result.object])[None]
            error = float(add_s(torch.from_numpy(result.pose)[None], truth, model.points))
            if error < 0.1 * model.diameter:
                return count
    return None


def measure_together(
    estimators: Sequence[posefilter.Estimator],
    scene: str,
    frames: Sequence[VideoFrame],
    rounds: int,
) -> Iterator[str]:
    """Yield the rows of objects that are tracked at once, a way each; see `WAYS`.

    Times are of the frames after the first, of each the median of the rounds, once the same frames
    have been tracked before.
    """
    names = [one.objects[0] for one in estimators]
    present = [name for name in names if any(name in frame.truth for frame in frames)]
    times = np.zeros((len(WAYS), rounds, len(frames), 2))
    answers: list[list[list[Any]]] = [[] for _ in WAYS]
    for turn in range(rounds):
        for way, (_, threads, side) in enumerate(WAYS):
            if side and len(names) == 1:
                continue
            torch.set_num_threads(threads)
            tracker = posefilter.Tracker(estimators, threads=side)
            tracker.wait()
            for frame in frames:  # a process is slow in its first frames, and videos are longer
                tracker.update_all(frame.rgb, frame.depth, frame.intrinsics)
            tracker.reset()
            answers[way] = []
            for n, frame in enumerate(frames):
                start = time.perf_counter(), time.process_time()
                found = tracker.update_all(frame.rgb, frame.depth, frame.intrinsics)
                now = time.perf_counter(), time.process_time()
                times[way, turn, n] = np.subtract(now, start)
                answers[way].append(found)
            tracker.close()
    for way, (title, _, _) in enumerate(WAYS):
        if not answers[way]:
            continue
        wall, cpu = 1000 * np.median(times[way, :, 1:], axis=0).T
        scores, lost = [], 0
        for k, name in enumerate(names):
            shown = [n for n, frame in enumerate(frames) if name in frame.truth]
            if shown:
                own = [answers[way][n][k] for n in shown]
                scored = judge((own, [0.0]), [frames[n] for n in shown])
                scores.append(scored.add)
                lost += scored.lost
        cells = [scene, str(len(names)), str(len(names) - len(present)), str(len(frames)), title]
        cells += [f"{x:.0f}" for x in (np.median(wall), wall.mean(), wall.max())]
        cells += [f"{1000 / wall.mean():.1f}", f"{cpu.mean():.0f}"]
        cells += [f"{np.mean(scores):.1f}", f"{min(scores):.1f}", str(lost)]
        yield format_row(cells)


def run_together(options: argparse.Namespace, names: Sequence[str]) -> None:
    """Measure objects that are tracked at once, print and write."""
    lines, kind = [], "fat" if options.sequences else "ycb_video"
    meshes = open_meshes(options.meshes, None, kind, names)
    loaded = {name: posefilter.load(name, device="cpu") for name in names}
    for folder in options.sequences or [options.frames]:
        parts = {} if options.sequences else {"subsets": ["data"]}
        reader = open_reader(kind, folder, None if options.sequences else names, meshes, **parts)
        for one in list_scenes(reader):
            video = SceneVideo(reader, one, names)
            frames, there = list(video), video.objects or ()
            if not there or options.scene not in (None, video.name):
                continue
            order = sorted(names, key=lambda name: name not in there)
            for count in options.together:
                chosen = [loaded[name] for name in order[:count]]
                scene = Path(folder).name if options.sequences else video.name
                for line in measure_together(chosen, scene, frames, options.rounds):
                    lines.append(line)
                    print(line, flush=True)
    write_table("together", TOGETHER, lines, 5)


def run_sequences(folders: Sequence[str], meshes: str, seeds: int) -> None:
    """Measure rendered sequences, a folder and its object each, print and write."""
    lines = []
    for name, folder, scenes in open_sequences(folders, meshes):
        estimator = posefilter.load(name, device="cpu")
        for scene in scenes:
            lines.append(measure_sequence(estimator, folder, list(scene), seeds))
            print(lines[-1], flush=True)
    write_table("sequences", SEQUENCES, lines, 2)


def measure_beliefs(
    estimator: posefilter.Estimator, frames: Sequence[VideoFrame], seeds: int
) -> dict[str, list[dict[str, Any]]]:
    """Return how far right estimates of tracked frames are off, and what their beliefs say of that:
    those of the results, and the particles alone.
    """
    rows: dict[str, list[dict[str, Any]]] = {"calibrated": [], "particles": []}
    for seed in range(seeds):
        tracker = posefilter.Tracker(estimator, seed=seed)
        (track,) = tracker.tracks
        for frame in frames:
            result = tracker.update(frame.rgb, frame.depth, frame.intrinsics)
            truth = frame.truth.get(result.object)
            if truth is None or result.status in ("started", "lost"):
                continue
            truth = truth.astype(np.float64)
            if not is_right_pose(result, truth) or not result.belief_calibrated:
                continue
            assert track.state is not None
            poses, weights = track.state.belief.state, track.state.belief.log_weights.softmax(1)
            particles = replace(
                result.belief,
                samples=poses[0].double().cpu().numpy(),
                weights=weights[0].double().cpu().numpy(),
                draws=0,
            )
            degrees = degrees_of(track.method)
            rows["calibrated"].append(measure_error(result.belief, result.pose, truth, degrees))
            rows["particles"].append(measure_error(particles, result.pose, truth))
    return rows


def list_belief_rows(
    name: str, source: str, scenes: int, rows: Mapping[str, Sequence[Mapping[str, Any]]]
) -> Iterator[str]:
    """Yield the lines of an object's beliefs in the table, one of each kind."""
    for kind, own in rows.items():
        if not own:
            continue
        found = summarize_errors(own)
        cells = [name, source, str(scenes), kind, str(len(own))]
        cells.append(" / ".join(f"{x:.0f}" for x in found.ellipsoids))
        cells += [f"{x:.1f}" for x in (*found.off, *found.says)]
        cells += [f"{x:.0f}" for x in found.within]
        yield format_row(cells)


def run_beliefs(
    videos: Sequence[tuple[str, Sequence[SceneVideo]]], source: str, seeds: int
) -> None:
    """Measure the beliefs of tracks, print and write.

    Args:
        videos: Objects and their scenes.
        source: What the scenes are.
        seeds: Of the filter.

    Particles alone have a line of all objects only, where there are several.
    """
    lines, every, count = [], dict[str, list[dict[str, Any]]](), 0
    for name, scenes in videos:
        estimator = posefilter.load(name, device="cpu")
        rows: dict[str, list[dict[str, Any]]] = {}
        for scene in scenes:
            for kind, found in measure_beliefs(estimator, list(scene), seeds).items():
                rows.setdefault(kind, []).extend(found)
                every.setdefault(kind, []).extend(found)
        own = {"calibrated": rows["calibrated"]} if len(videos) > 1 else rows
        lines += list_belief_rows(name, source, len(scenes), own)
        count += len(scenes)
        print(*lines[-1:], flush=True)
    if len(videos) > 1:
        lines += list_belief_rows(f"{len(videos)} objects", source, count, every)
    write_table("beliefs", BELIEFS, lines, 4)


def open_sequences(
    pairs: Sequence[str], meshes: str
) -> Iterator[tuple[str, str, list[SceneVideo]]]:
    """Yield of each DIR=OBJECT the object, the folder's name, and its scenes."""
    for folder, name in (pair.rsplit("=", 1) for pair in pairs):
        reader = open_reader("fat", folder, None, open_meshes(meshes, None, "fat", [name]))
        scenes = [SceneVideo(reader, scene, [name]) for scene in list_scenes(reader)]
        yield name, Path(folder).name, scenes


def write_table(name: str, head: Sequence[str], lines: Sequence[str], keys: int) -> None:
    """Put lines into a table of the page, in place of those of the same first `keys` cells."""
    page = PAGE.read_text()
    rows = {tuple(line.split(" | ")[:keys]): line for line in (*read_rows(page, name), *lines)}
    PAGE.write_text(put_table(page, name, head, rows.values()))


def main() -> None:
    """Measure, print and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--frames", help="a folder of YCB-Video")
    parser.add_argument("--sequences", nargs="+", help="folders that generate.py wrote, =OBJECT")
    parser.add_argument("--seeds", type=int, default=16, help="of tracks; --together has one")
    parser.add_argument("--meshes", required=True, help="a folder of YCB's meshes")
    parser.add_argument("--only", action="append", help="an object; can be repeated")
    parser.add_argument("--stride", type=int, action="append", help="1, and 4 of the tracks")
    parser.add_argument("--losses", action="store_true", help="the induced track losses alone")
    parser.add_argument("--beliefs", action="store_true", help="what tracks' beliefs are worth")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--together", type=int, action="append", help="objects at once")
    parser.add_argument("--scene", help="of --together; all without it")
    parser.add_argument("--rounds", type=int, default=1, help="of --together")
    options = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(options.threads)
    names = options.only or [name for name in list_shipped() if name in ycb.CLASSES]
    if options.together:
        run_together(options, names)
        return
    if options.sequences and options.beliefs:
        each = open_sequences(options.sequences, options.meshes)
        run_beliefs([(name, scenes) for name, _, scenes in each], "renders", options.seeds)
        return
    if options.sequences:
        run_sequences(options.sequences, options.meshes, options.seeds)
        return
    meshes = open_meshes(options.meshes, None, "ycb_video", names)
    reader = open_reader("ycb_video", options.frames, names, meshes, subsets=["data"])
    scenes = list_scenes(reader)
    if options.beliefs:
        there = [(scene, SceneVideo(reader, scene, names).objects or ()) for scene in scenes]
        pairs = [(scene, name) for scene, own in there for name in own]
        videos = [(name, [SceneVideo(reader, scene, [name])]) for scene, name in pairs]
        run_beliefs(videos, "photographs", options.seeds)
        return
    every = {scene.name: SceneVideo(reader, scene, names) for scene in scenes}
    rows, losses = [], []
    for group, video in every.items():
        frames = list(video)
        other = [frame for one in every if one != group for frame in every[one]]
        for name in video.objects or ():
            estimator = posefilter.load(name, device="cpu")
            if not options.losses:
                for row in compare(
                    estimator, group, frames, options.stride or [1, 4], options.seeds
                ):
                    rows.append(row)
                    print(row, flush=True)
            if other:
                losses.append(measure_losses(estimator, group, frames, other, options.seeds))
                print(losses[-1], flush=True)
    if rows:
        write_table("tracks", HEAD, rows, 3)
    write_table("losses", LOSSES, losses, 2)


if __name__ == "__main__":
    main()
