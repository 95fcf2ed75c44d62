"""What the paper's losses can teach which network, by their gradients: parts of the failures follow
without any training.
"""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from test_image_space import paper
from toy import scenes, square

from posefilter.geometry.pose import invert, transform
from posefilter.labels.membership import OnObject
from posefilter.losses.likelihood import Bce
from posefilter.models.cnn_patch import CnnPatch
from posefilter.models.image_space import ImageSpace
from posefilter.models.patch_pf import PatchPF
from posefilter.models.pixel_pf import PixelPF
from posefilter.nets.glimpse import BilinearGlimpse
from posefilter.nets.heads import SurfacePointSixD, Unbounded


def taught(method: ImageSpace) -> ImageSpace:
    """Return the method with the gradients of one batch."""
    losses = method.train().training_losses(scenes(2), method.generator("train", 0))
    torch.stack([value.mean() for value in losses.values()]).sum().backward()
    return method


def learns(method: ImageSpace, part: str) -> bool:
    gradients = [p.grad for p in getattr(method.net, part).parameters()]
    return any(g is not None and bool(g.abs().sum() > 0) for g in gradients)


@pytest.mark.parametrize(
    ("method", "learning"),
    [
        # the loss is on poses alone, and a place reaches no pose: likelihood and displacement stay
        # as they were drawn
        (lambda: paper(PixelPF, 1), {"latent", "pose"}),
        (lambda: paper(PixelPF, 1, loss=Bce(OnObject())), {"latent", "likelihood"}),
        # whatever the unit of the displacement, which the paper does not state
        (lambda: paper(PixelPF, 1, displacement=Unbounded(1)), {"latent", "pose"}),
        (
            lambda: paper(PixelPF, 1, loss=Bce(OnObject()), displacement=Unbounded("learned")),
            {"latent", "likelihood"},
        ),
        # the place is told, so that the displacement learns what place is best to be told; the pose
        # learns to serve it
        (
            lambda: paper(PatchPF, 3, loss=Bce(OnObject(3))),
            {"latent", "likelihood", "displacement", "pose"},
        ),
        (lambda: paper(PatchPF, 3), {"latent", "likelihood", "displacement", "pose"}),
        # the canary: with smooth glimpses alone, every network of the first method learns
        (
            lambda: paper(PixelPF, 1, glimpse=BilinearGlimpse(1)),
            {"latent", "likelihood", "displacement", "pose"},
        ),
    ],
    ids=[
        "pixel_pf add",
        "pixel_pf bce",
        "pixel_pf add, 1 px",
        "pixel_pf bce, learned",
        "patch_pf bce",
        "patch_pf add",
        "pixel_pf add, smooth",
    ],
)
def test_which_networks_learn(method, learning: set[str]) -> None:
    made = taught(method())
    assert {
        part for part in ("latent", "pose", "likelihood", "displacement") if learns(made, part)
    } == learning


def test_a_detached_position_blocks_the_likelihoods_gradient_of_the_displacement() -> None:
    """Through the place, a loss that asks "am I on the object?" teaches to leave for where the
    answer is surely no.
    """
    for stopped, learning in ((False, True), (True, False)):
        method = taught(
            paper(
                PatchPF,
                3,
                loss=Bce(OnObject(3)),
                glimpse=BilinearGlimpse(3),
                detach_position=stopped,
            )
        )
        assert learns(method, "displacement") is learning
        assert learns(method, "likelihood")
        assert learns(method, "latent")


@pytest.mark.parametrize("unit", ["half_frame", 1])
def test_the_detectors_likelihood_is_never_taught(unit: str | float) -> None:
    method = taught(paper(CnnPatch, 9, displacement=Unbounded(unit)))
    likelihood, u, v = method.net.tell.weight.grad.abs().sum(1)
    assert likelihood == 0
    assert u > 0
    assert v > 0


def test_the_displacement_of_pixel_pf_is_never_trained() -> None:
    torch.manual_seed(0)
    method = paper(PixelPF, 1)
    drawn = {name: value.clone() for name, value in method.net.named_parameters()}
    optimizer = torch.optim.Adam(method.parameters(), lr=1e-3)
    for _ in range(3):
        optimizer.zero_grad()
        taught(method)
        optimizer.step()
    same = {
        part
        for part in ("latent", "pose", "likelihood", "displacement")
        if all(
            torch.equal(drawn[n], p) for n, p in method.net.named_parameters() if n.startswith(part)
        )
    }
    assert same == {"likelihood", "displacement"}


def test_outputs_without_a_loss_have_no_gradient() -> None:
    """Not even for one of zeros: where a place reaches no loss, most of the backward pass would be
    spent on it.
    """
    method = taught(paper(PixelPF, 1))
    assert all(
        p.grad is None
        for part in ("likelihood", "displacement")
        for p in getattr(method.net, part).parameters()
    )


def test_where_the_own_point_belongs_says_nothing_of_the_rotation() -> None:
    """The position is what remains of the measured point: turned anyhow, the pose puts it where it
    was told to belong.
    """
    code = SurfacePointSixD()
    code.set_object(square())
    g = torch.Generator().manual_seed(0)
    raw = torch.randn(2, 5, 9, generator=g, dtype=torch.float64).requires_grad_()
    point = torch.randn(2, 5, 3, generator=g, dtype=torch.float64) + torch.tensor([0.0, 0.0, 5.0])
    told = transform(invert(code.double()(raw, point).pose), point[:, :, None])
    told.square().sum().backward()
    assert raw.grad is not None
    assert raw.grad[..., 6:].abs().min() > 1e-6, "what was told is taught"
    assert raw.grad[..., :6].abs().max() < 1e-12
