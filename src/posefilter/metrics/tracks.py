"""Figures of a track: one object's poses, frame after frame, against the true ones."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.geometry.pose import invert
from posefilter.geometry.pose_statistics import twist_between


class Gap(NamedTuple):
    """Frames in a row in which an object was not tracked."""

    start: int  # the first of them
    length: int  # number of frames until it was tracked again, or the track ended
    ended: bool  # whether it was tracked again


def find_gaps(tracked: Sequence[bool]) -> list[Gap]:
    """Return the gaps of a track, in their order.

    Args:
        tracked: Of each frame, whether the object was tracked in it.
    """
    gaps, start = list[Gap](), 0
    for one, frames in groupby(tracked):
        end = start + len(list(frames))
        if not one:
            gaps.append(Gap(start, end - start, end < len(tracked)))
        start = end
    return gaps


def measure_jitter(poses: Tensor, truth: Tensor, center: Tensor) -> tuple[float, float]:
    """Return by how much a track's error changes from one frame to the next, root mean square.

    A constant offset has no jitter. Of an object that stands still before a still camera this is
    the motion that the estimate shows.

    Args:
        poses: (T, 4, 4) camera_from_object [m], in the order of the frames.
        truth: (T, 4, 4) likewise.
        center: (3,) the object's center [m].

    Returns:
        The center's jitter [mm] and the rotation's [degrees]; NaN for fewer than two frames.
    """
    if len(poses) < 2:
        return float("nan"), float("nan")
    error = invert(truth) @ poses
    twist = twist_between(error[:-1], error[1:], center)
    shift, turn = twist[:, :3].square().sum(1).mean(), twist[:, 3:].square().sum(1).mean()
    return float(1000 * shift.sqrt()), float(torch.rad2deg(turn.sqrt()))
