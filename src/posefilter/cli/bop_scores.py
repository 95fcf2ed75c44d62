"""Estimates of several instances against a dataset's, as the BOP challenge scores them."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.base import BaseReader
from posefilter.errors import BadData, UserError
from posefilter.geometry.symmetries import densify
from posefilter.meshes.mesh import Mesh, hull_vertices
from posefilter.metrics.bop import REFERENCE_WIDTH, mspd_of_vertices, mssd
from posefilter.metrics.bop_recall import TargetErrors, compute_average_recall
from posefilter.metrics.bop_results import PoseRow, to_mesh
from posefilter.metrics.bop_targets import Target
from posefilter.metrics.matching import match_greedily
from posefilter.metrics.vsd import vsd
from posefilter.rendering.embree import EmbreeRenderer, render_depth

_VISIBLE = 0.1  # the least visibility of a target, as the challenge has it
Key = tuple[int, int, int]  # scene_id, im_id, obj_id
_Item = TypeVar("_Item", FrameRecord, PoseRow)


def assign_estimates(
    rows: Sequence[PoseRow], records: Sequence[FrameRecord], data: PoseDataModule
) -> dict[str, PoseRow]:
    """Return the estimate of each instance, by the record's key.

    Of a class that an image shows once, it is the most confident estimate. Of several instances,
    the most confident estimates, as many as the image has instances, are matched in turn to the
    nearest instance by MSSD.

    Args:
        rows: The estimates.
        records: The instances that are tested, of their images some or all.
        data: Their dataset.
    """
    by_key = sort_rows(rows)
    place = {record.key: i for i, record in enumerate(data.reader.records())}
    tested = {record.key for record in records}
    out: dict[str, PoseRow] = {}
    for key, every in _group_whole(records, data.reader).items():
        own, known = every, by_key.get(key, [])
        if len(every) > 1:
            read = _read_shown([place[record.key] for record in every], data.reader)
            own, samples = [every[i] for i, _ in read], [sample for _, sample in read]
        if len(own) == 1 and known:
            out[own[0].key] = known[0]
        if len(own) < 2:
            continue
        object_model = data.object_model(data.objects.index(own[0].object))
        truths, poses = _stack_poses(samples, known[: len(own)], data.reader)
        points = torch.cat([object_model.hull, object_model.points]).double()
        errors = _pair(mssd, poses, truths, densify(object_model.symmetries.double()), points)
        out |= {own[t].key: known[e] for e, t in match_greedily(errors, np.inf)}
    return {key: row for key, row in out.items() if key in tested}


def score_targets(
    rows: Sequence[PoseRow],
    targets: Sequence[Target] | None,
    records: Sequence[FrameRecord],
    data: PoseDataModule,
) -> dict[str, Any]:
    """Return the average recall of estimates.

    Args:
        rows: The estimates.
        targets: What is to be found; None: of the images and classes of `records`, all instances of
            visibility 0.1 or more.
        records: The instances that are tested.
        data: Their dataset, with the meshes of its objects.

    Returns:
        {"ar", "ar_vsd", "ar_mssd", "ar_mspd", "targets", "estimates", "left_out"}; recalls in
        [0, 100]. The last counts objects in images that cannot be read, where such are skipped.

    Raises:
        UserError: A target is not in the data, or an object has no mesh.
    """
    every = data.reader.records()
    groups = _group_whole(records, data.reader) if targets is None else _group(every)
    classes = {record.obj_id for record in every}
    counts = None if targets is None else {one[:3]: one.inst_count for one in targets}
    place = {record.key: i for i, record in enumerate(every)}
    by_key = sort_rows(rows)
    judge = _Judge(data)
    scored, used, left_out = list[TargetErrors](), 0, 0
    for key in groups if counts is None else counts:
        if key not in groups:
            names = dict(zip(Target._fields, key, strict=False))
            hint = "" if key[2] in classes else " (data.object=null takes all objects)"
            raise UserError(f"targets: the data have no instance of {names}{hint}")
        try:
            read = _read_shown([place[record.key] for record in groups[key]], data.reader)
        except BadData:
            if data.reader.on_error != "skip":
                raise
            left_out += 1
            continue
        samples = [sample for _, sample in read]
        shares = [data.reader.visible_share(sample) for sample in samples]
        order = np.argsort(-np.nan_to_num(shares, nan=1.0), kind="stable").tolist()
        if counts is None:
            order = [i for i in order if not shares[i] < _VISIBLE]
        else:  # the most visible, of which the target says how many
            order = order[: counts[key]]
        if order:
            known = by_key.get(key, [])[: len(order)]
            used += len(known)
            scored.append(judge.score([samples[i] for i in order], known))
    count = sum(one.mssd.shape[1] for one in scored)
    counted = {"targets": count, "estimates": used, "left_out": left_out}
    return {**compute_average_recall(scored), **counted}


def _read_shown(places: Sequence[int], reader: BaseReader) -> list[tuple[int, Sample]]:
    """Return the instances of which a pixel is seen, each with its number; the others are no
    targets.
    """
    samples = []
    for i, place in enumerate(places):
        with suppress(NotShown):
            samples.append((i, reader.read(place)))
    return samples


class _Judge:
    """Measures the three errors of the challenge, with what they take of each object."""

    def __init__(self, data: PoseDataModule) -> None:
        self.data, self.renderer = data, EmbreeRenderer(keep=4)
        self._get = cache(self._load)

    def score(self, samples: Sequence[Sample], rows: Sequence[PoseRow]) -> TargetErrors:
        """Return the errors of estimates of one class in one image, the most confident first."""
        first = samples[0]
        mesh, symmetries, points, diameter = self._get(first.object_id)
        K = first.intrinsics.astype(np.float64)
        truths, poses = _stack_poses(samples, rows, self.data.reader)
        camera = torch.from_numpy(K)
        vertices = torch.from_numpy(mesh.vertices).double()
        measure = partial(mspd_of_vertices, vertices=vertices, intrinsics=camera)
        pixels = _pair(measure, poses, truths, symmetries, points)
        true_depths = [self._render(mesh, pose, K, first) for pose in truths]
        surface = np.zeros((len(poses), len(truths), 10))
        for e, pose in enumerate(poses):
            depth = self._render(mesh, pose, K, first)
            for t, true in enumerate(true_depths):
                surface[e, t] = vsd(depth, true, first.depth, K, diameter)
        return TargetErrors(
            surface,
            _pair(mssd, poses, truths, symmetries, points) / diameter,
            pixels * REFERENCE_WIDTH / first.rgb.shape[1],
        )

    def _render(self, mesh: Mesh, pose: Tensor, K: np.ndarray, like: Sample) -> np.ndarray:
        height, width = like.depth.shape
        return render_depth([mesh], [pose.numpy()], K, height, width, self.renderer)[0]

    def _load(self, index: int) -> tuple[Mesh, Tensor, Tensor, float]:
        name = self.data.objects[index]
        if name not in self.data.meshes.names():
            raise UserError(f"data.meshes: has no {name}, which VSD renders; name the meshes")
        mesh, object_model = self.data.meshes.load(name), self.data.object_model(index)
        points = torch.from_numpy(hull_vertices(mesh.vertices)).double()
        symmetries = densify(object_model.symmetries.double())
        return mesh, symmetries, points, float(object_model.diameter)


def _pair(
    measure: Any, poses: Tensor, truths: Tensor, symmetries: Tensor, points: Tensor
) -> np.ndarray:
    """Return an error of each estimate against each truth, (E, T)."""
    out = np.zeros((len(poses), len(truths)))
    for e, pose in enumerate(poses):
        for t, truth in enumerate(truths):
            out[e, t] = float(measure(pose, truth, symmetries, points))
    return out


def _stack_poses(
    samples: Sequence[Sample], rows: Sequence[PoseRow], reader: BaseReader
) -> tuple[Tensor, Tensor]:
    """Return true and estimated poses (T, 4, 4), (E, 4, 4) in the mesh file's frame, float64."""
    native = reader.native_from_mesh(reader.objects[samples[0].object_id])
    truths = np.stack([sample.camera_from_object for sample in samples]).astype(np.float64)
    poses = [to_mesh(row.camera_from_native, native) for row in rows]
    stacked = np.stack(poses) if poses else np.zeros((0, 4, 4))
    return torch.from_numpy(truths), torch.from_numpy(stacked)


def _group(items: Iterable[_Item]) -> dict[Key, list[_Item]]:
    out: dict[Key, list[_Item]] = {}
    for one in items:
        out.setdefault((one.scene_id, one.im_id, one.obj_id), []).append(one)
    return out


def _group_whole(
    records: Sequence[FrameRecord], reader: BaseReader
) -> dict[Key, list[FrameRecord]]:
    """Return all instances of the images and classes of some of them: an estimate that is of
    another instance than those is not theirs.
    """
    some = _group(records)
    every = _group(reader.records())
    return {key: every[key] for key in some}


def sort_rows(rows: Sequence[PoseRow]) -> dict[Key, list[PoseRow]]:
    """Return the estimates of each class in each image, the most confident first; equally
    confident ones stay in their order.
    """
    return _group(sorted(rows, key=lambda row: -row.score))  # of equal ones the first, as BOP's
