"""Find objects in the images of a ROS 2 bag, and write detections into another bag."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import torch

from posefilter.cli.checkpoints import methods_of
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended, say
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.cli.predict import read_costs
from posefilter.errors import UserError
from posefilter.estimator import Estimator
from posefilter.progress import bars
from posefilter.result import Result
from posefilter.ros.bags import BagFrame, BagReader, BagWriter, Topics
from posefilter.ros.detections import make_detections
from posefilter.ros.messages import stamp_of
from posefilter.tracking.tracker import Tracker


def convert_bag(job: Job) -> None:
    """Write a Detection3DArray for each color image that has depth.

    Raises:
        UserError: The bag cannot be read, or not one of its images has depth and a camera.
    """
    cfg = job.cfg
    out = Path(str(cfg.out))
    if out.exists():
        raise UserError(f"out={out}: already exists; choose another")
    topics = Topics(str(cfg.color), str(cfg.depth), str(cfg.camera_info))
    with BagReader(
        Path(str(cfg.bag)), topics, float(cfg.max_time_difference), cfg.rectify
    ) as reader:
        settle(cfg.threads, cfg.seed)
        methods = methods_of(cfg.checkpoint, changes(cfg))
        estimator = Estimator(methods, costs=read_costs(cfg))
        find = choose_finder(estimator, cfg.track, cfg.seed)
        images, blank, found = 0, 0, Counter(dict.fromkeys(estimator.objects, 0))
        watch = bars(shown=cfg.console != JSON, transient=True)
        with BagWriter(out, str(cfg.detections)) as writer, watch as bar:
            task = bar.add_task("images", total=reader.images)
            if cfg.copy_messages:
                writer.add_connections(reader.reader.connections)  # first: it may be refused
            for frame in reader.frames():
                try:
                    message = make_detections(find(frame), frame.header)
                except UserError as error:
                    when = stamp_of(frame) / 1e9
                    raise UserError(f"bag={cfg.bag}: image of {when:.3f} s: {error}") from error
                blank += not frame.depth.any()
                writer.write(message, frame.time)
                found.update(one.id for one in message.detections)
                images += 1
                bar.update(task, completed=images + reader.unpaired + reader.early)
            if not images:
                raise UserError(
                    f"bag={cfg.bag}: no color image has depth within "
                    f"max_time_difference={cfg.max_time_difference} s, "
                    f"after a first camera_info"
                )
            if cfg.copy_messages:
                writer.copy(reader.messages())
    if reader.distorted:
        said = "warning: the camera has a lens distortion, and images are taken as rectified ones; "
        said += "if they are not: rectify=true"
        say(cfg.console, "distorted", said)
    if blank:
        say(cfg.console, "blank", f"warning: in {blank} of {images} images no pixel has depth")
    if cfg.console != JSON:
        early = f", {reader.early} before the first camera_info" if reader.early else ""
        print(f"{images} images, {reader.unpaired} without depth{early}")
        for name, count in found.items():
            print(f"{name}: in {count}")
    ended(
        cfg.console, "converted", {"bag": out}, [],
        images=images, unpaired=reader.unpaired, early=reader.early, blank=blank, found=dict(found),
    )  # fmt: skip


def choose_finder(
    estimator: Estimator, track: bool, seed: int
) -> Callable[[BagFrame], list[Result]]:
    """Return what finds the objects in a frame: each frame by itself, or by tracking.

    A frame without any depth, as a camera sends that starts, shows no object.
    """
    if track:
        tracker = Tracker(estimator, seed=seed, threads=torch.get_num_threads())
        return lambda frame: [*tracker.update_all(frame.rgb, frame.depth, frame.intrinsics)]

    def find(frame: BagFrame) -> list[Result]:
        if not frame.depth.any():
            return []
        (results,) = estimator.predict_batch(frame.rgb, frame.depth, frame.intrinsics, seed=seed)
        return results

    return find
