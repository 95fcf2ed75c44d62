"""A detector's box is taught, told and judged about one truth: the whole object's, hidden parts
too.
"""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from test_image_space import working
from toy import W, scenes

from posefilter.geometry.boxes import box_iou, box_of_pose
from posefilter.labels.membership import OnObject
from posefilter.losses.displacement import Sides
from posefilter.models.cnn_patch import CnnPatch
from posefilter.types import Batch, Trace


def half_hidden() -> Batch:
    """Return scenes of which the object's lower half is hidden by something near."""
    batch = scenes(2)
    v = torch.arange(batch.mask.shape[2])[None, None, :, None]
    center = (batch.mask * v).sum((1, 2, 3), keepdim=True) / batch.mask.sum((1, 2, 3), keepdim=True)
    hidden = v > center
    return batch._replace(
        mask=batch.mask & ~hidden,
        depth=torch.where(hidden, 0.5, batch.depth),
        rgb=torch.where(hidden, 0.1, batch.rgb),
    )


def visible_box(mask: torch.Tensor) -> torch.Tensor:
    v, u = mask[0].nonzero().T
    return torch.stack([u.min(), v.min(), u.max() + 1, v.max() + 1]).float() - 0.5


def telling(method: CnnPatch, batch: Batch, box: torch.Tensor) -> Trace:
    """Return a run whose particles all tell this box, (B, 4) [px]."""
    with torch.no_grad():
        trace: Trace = method.predict_step(batch, 0)
    outputs = tuple(
        output._replace(
            latent=torch.cat(
                [particles.state - box[:, None, :2], box[:, None, 2:] - particles.state], -1
            )
            / W
        )
        for particles, output in zip(trace.particles, trace.outputs, strict=True)
    )
    return trace._replace(outputs=outputs)


def test_the_target_of_the_sides_has_an_iou_of_one() -> None:
    method, batch = working(CnnPatch, 9).eval(), half_hidden()
    height, width = batch.rgb.shape[-2:]
    whole = box_of_pose(
        batch.camera_from_object, method.object_model.hull, batch.intrinsics, height, width
    )
    seen = torch.stack([visible_box(mask) for mask in batch.mask])
    assert box_iou(seen, whole).max() < 0.75  # the two truths differ, or nothing is tested
    candidate_sampler = Sides(OnObject())
    for box, iou in ((whole, 1.0), (seen, box_iou(seen, whole).mean().item())):
        trace = telling(method, batch, box)
        lost = candidate_sampler(trace, batch, method.object_model).mean().item()
        assert lost == pytest.approx(0.0, abs=1e-4) if iou == 1.0 else lost > 0.2
        method._reset()
        method.update_metrics(trace, batch)
        assert method.compute_metrics()["iou"] == pytest.approx(iou, abs=1e-5)
