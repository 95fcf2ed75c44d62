"""The rehearsal before a training refuses a part that does not keep to its protocol, in one line
that names its class, and leaves no trace in what is trained.
"""

import random
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tests.models.toy import scenes, square
from torch import Tensor, nn

from posefilter.errors import UserError
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromDepth, UniformPixels
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Constant
from posefilter.geometry.lookup import sample
from posefilter.geometry.spaces import PixelSpace
from posefilter.labels.displacement import TowardsObject
from posefilter.labels.membership import OnObject
from posefilter.losses.displacement import DirectDisplacement
from posefilter.losses.likelihood import Focal
from posefilter.models.base import PoseEstimator, with_lightning
from posefilter.models.box_heads import QuantileBox
from posefilter.models.pose_particles import PoseParticles
from posefilter.models.rehearsal import check_method
from posefilter.types import ParticleOutput


class Own(PoseEstimator):
    """Particles are pixels that look at one color, as an author's first method may have it."""

    provides = ("pixel_space", "rollout", "displacement")

    def __init__(self, **base: Any) -> None:
        super().__init__(**base)
        self.net = nn.Linear(4, 3)
        self.seen = 0

    @property
    def space(self) -> PixelSpace:
        return PixelSpace()

    def encode(self, batch: Any) -> Tensor:
        return torch.cat([batch.rgb, batch.depth], 1)

    def measure(self, encoding: Any, particles: Any, step: Any, generator: Any) -> Any:
        self.seen += 1
        torch.randn(3)
        out = self.net(sample(encoding, particles.state))
        pose = torch.eye(4).expand(*out.shape[:2], 4, 4)
        return ParticleOutput(F.logsigmoid(out[..., 0]), out[..., 1:], pose, particles.latent)

    def box(self, trace: Any, batch: Any) -> Tensor:
        return QuantileBox(size=9)(trace, batch, self.object_model)


class OwnLoss:
    """A small likelihood where particles are."""

    def __call__(self, trace: Any, batch: Any, object_model: Any) -> Any:
        return trace.outputs[-1].log_likelihood.mean(1)


def build(kind: type[PoseEstimator] = Own, loss: Any = None, **parts: Any) -> PoseEstimator:
    given = {
        "initialize": UniformPixels(),
        "schedule": Constant(1.0),
        "reweight": CurrentLikelihood(),
        "resample": Systematic(),
        "propagate": Gaussian(),
        "estimate": Argmax(),
        "refine": NoRefine(),
    }
    rolled = ParticleFilter(particles=16, steps=3, **(given | parts))
    method = kind(
        filter=rolled, loss=loss or OwnLoss(), optimizer=partial(torch.optim.Adam, lr=1e-3)
    )
    method.set_object(square())
    return method


def rehearse(method: PoseEstimator) -> None:
    check_method(method, scenes(1), scenes(2))


def test_a_method_that_fits_is_left_as_it_was() -> None:
    method = build()
    method.train()
    weights = {name: value.clone() for name, value in method.state_dict().items()}
    torch.manual_seed(3)
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    expected = torch.randn(2), random.random(), np.random.rand()  # noqa: NPY002
    torch.manual_seed(3)
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    rehearse(method)
    drawn = torch.randn(2), random.random(), np.random.rand()  # noqa: NPY002
    assert torch.equal(drawn[0], expected[0])
    assert drawn[1:] == expected[1:]
    assert method.training
    assert isinstance(method, Own)
    assert method.seen == 0
    assert type(method) is Own
    assert type(method.filter.propagate) is Gaussian
    for name, value in method.state_dict().items():
        assert torch.equal(value, weights[name])


def test_a_method_that_cannot_be_copied_is_looked_at_as_it_is() -> None:
    method = build()
    method.hook = (one for one in ())  # type: ignore[assignment]
    rehearse(method)
    assert isinstance(method, Own)
    assert method.seen == 3


# -- parts of the filter ----------------------------------------------------------------------


class ShortSchedule(Constant):
    def __call__(self, steps: int) -> list[float]:
        return super().__call__(steps)[:-1]


class NanSchedule(Constant):
    def __call__(self, steps: int) -> list[float]:
        return [float("nan")] * steps


class Resample(Systematic):
    change: Any = staticmethod(lambda out: out)

    def __call__(self, *args: Any) -> Any:
        return self.change(super().__call__(*args))


def resampling(change: Any) -> Any:
    return type("Tempered", (Resample,), {"change": staticmethod(change)})()


def mixture_of(resampled: Any) -> Tensor:
    """Return the mixtures that children of 16 particles are, each its ancestor alone."""
    return torch.nn.functional.one_hot(resampled.ancestors, 16).float()


class Walk(Gaussian):
    change: Any = staticmethod(lambda old, new: new)

    def __call__(self, state: Tensor, *args: Any) -> Any:
        return self.change(state, super().__call__(state, *args))


def walking(change: Any) -> Any:
    return type("Student", (Walk,), {"change": staticmethod(change)})()


class Best(Argmax):
    change: Any = staticmethod(lambda out: out)

    def __call__(self, *args: Any) -> Any:
        return self.change(super().__call__(*args))


def choosing(change: Any) -> Any:
    return type("TopK", (Best,), {"change": staticmethod(change)})()


class Reweight(CurrentLikelihood):
    def __call__(self, *args: Any) -> Any:
        return super().__call__(*args).mean(1)


class Start(UniformPixels):
    def __call__(self, *args: Any) -> Any:
        return super().__call__(*args)[:, :-1]


class NoCall:
    """An author forgot it."""


PARTS = {
    "short": (
        {"schedule": ShortSchedule(1.0)},
        r"ShortSchedule: returned 2 noise levels .*steps=3",
    ),
    "nan": ({"schedule": NanSchedule(1.0)}, "NanSchedule: a noise level is no finite number"),
    "tuple": ({"resample": resampling(tuple)}, "Tempered: returned a tuple, not a .*Resampled"),
    "count": (
        {"resample": resampling(lambda r: r._replace(log_weights=r.log_weights[:, 1:]))},
        r"Tempered: log_weights has the shape \(\d, 15\), not \(\d, 16\)",
    ),
    "ancestors": (
        {"resample": resampling(lambda r: r._replace(ancestors=r.ancestors[:, 1:]))},
        "Tempered: ancestors have the shape",
    ),
    "int32": (
        {"resample": resampling(lambda r: r._replace(ancestors=r.ancestors.int()))},
        "Tempered: ancestors are torch.int32",
    ),
    "range": (
        {"resample": resampling(lambda r: r._replace(ancestors=r.ancestors + 1000))},
        "Tempered: ancestors are not all among the 16 particles",
    ),
    "weights": (
        {"resample": resampling(lambda r: r._replace(log_weights=r.log_weights.exp()))},
        "Tempered: the weights of the resampled particles sum to",
    ),
    "mixture": (
        {"resample": resampling(lambda r: r._replace(mixture_weights=2 * mixture_of(r)))},
        "Tempered: mixture_weights are no weights: a child's should sum to 1",
    ),
    "moved shape": (
        {"propagate": walking(lambda old, new: new[..., :1])},
        r"Student: what it returned has the shape \(\d, 16, 1\)",
    ),
    "double": ({"propagate": walking(lambda old, new: new.double())}, "Student: .* is float64"),
    "in place": ({"propagate": walking(lambda old, new: old.add_(1))}, "Student: .* in place"),
    "best": (
        {"estimate": choosing(lambda b: b._replace(best=b.best[:, :3]))},
        "TopK: the estimate `best` has the shape",
    ),
    "notnum": (
        {"estimate": choosing(lambda b: b._replace(best=b.best * torch.nan))},
        "TopK: the estimate `best` is not finite",
    ),
    "score": (
        {"estimate": choosing(lambda b: b._replace(score=b.log_weights))},
        r"TopK: score has the shape \(\d, 16\), not \(\d,\)",
    ),
    "belief": ({"estimate": choosing(tuple)}, "TopK: returned a tuple, not a .*BeliefBatch"),
    "reweight": ({"reweight": Reweight()}, "Reweight: what it returned has the shape"),
    "start": ({"initialize": Start()}, "Start: what it returned has the shape"),
    "no call": ({"refine": NoCall()}, r"NoCall: has no __call__\(\)"),
}


@pytest.mark.parametrize("mistake", PARTS)
def test_a_part_that_returns_something_else_is_named(mistake: str) -> None:
    parts, told = PARTS[mistake]
    with pytest.raises(UserError, match=told) as refusal:
        rehearse(build(**parts))
    assert "\n" not in str(refusal.value)


# -- losses -----------------------------------------------------------------------------------


class Changed(OwnLoss):
    change: Any = staticmethod(lambda loss: loss)

    def __call__(self, *args: Any) -> Any:
        return self.change(super().__call__(*args))


LOSSES = {
    "scalar": (lambda x: x.mean(), r"Bad: the loss has the shape \(\), not \(2,\)"),
    "particles": (lambda x: x[:, None].expand(-1, 16), r"the shape \(2, 16\), not \(2,\)"),
    "none": (lambda x: None, "Bad: the loss is a NoneType, not a tensor"),
    "float": (lambda x: float(x.detach().mean()), "Bad: the loss is a float, not a tensor"),
    "detached": (lambda x: x.detach(), "Bad: the loss requires no gradient"),
    "nan": (lambda x: x * torch.nan, "Bad: the loss is not finite"),
}


@pytest.mark.parametrize("mistake", LOSSES)
def test_a_loss_that_returns_something_else_is_named(mistake: str) -> None:
    change, told = LOSSES[mistake]
    loss = type("Bad", (Changed,), {"change": staticmethod(change)})()
    with pytest.raises(UserError, match=told):
        rehearse(build(loss=loss))


def test_a_loss_of_another_signature_is_named() -> None:
    class Wrong:
        def __call__(self, trace: Any) -> None: ...

    with pytest.raises(UserError, match=r"Wrong.__call__\(self, trace.*takes other arguments"):
        rehearse(build(loss=Wrong()))


class Label(OnObject):
    change: Any = staticmethod(lambda label: label)

    def __call__(self, *args: Any) -> Any:
        return self.change(super().__call__(*args))


def labeling(change: Any) -> Any:
    return type("Center", (Label,), {"change": staticmethod(change)})()


class Masked:
    """A loss of one's own, whose label is bool."""

    def __init__(self, label: Any) -> None:
        self.label = label

    def __call__(self, trace: Any, batch: Any, object_model: Any) -> Tensor:
        on = self.label(trace, batch, object_model)[-1]
        return (trace.outputs[-1].log_likelihood * on).mean(1)


LABELS = {
    "last": (lambda x: x[-1], r"Center: the label has the shape \(2, 16\), not \(3, 2, 16\)"),
    "image": (lambda x: x[..., :1], r"Center: the label has the shape \(3, 2, 1\)"),
    "wide": (lambda x: x[..., None], r"the shape \(3, 2, 16, 1\), not \(3, 2, 16, 2\)"),
    "nan": (lambda x: x / 0, "Center: the label is not finite"),
    "list": (lambda x: [*x], r"Center: the label is a list, not a tensor \(3, 2, 16\)"),
}


@pytest.mark.parametrize("mistake", LABELS)
def test_a_label_that_returns_something_else_is_named(mistake: str) -> None:
    change, told = LABELS[mistake]
    with pytest.raises(UserError, match=told):
        rehearse(build(loss=Focal(labeling(change), steps="last")))


def test_a_label_of_the_protocols_shape_is_accepted() -> None:
    rehearse(build(loss=Focal(labeling(lambda x: x))))
    rehearse(build(loss=DirectDisplacement(TowardsObject())))
    rehearse(build(loss=Masked(labeling(lambda x: x > 0))))


# -- methods ----------------------------------------------------------------------------------


def measuring(**change: Any) -> type[PoseEstimator]:
    class Changed(Own):
        def measure(self, *args: Any) -> Any:
            out = super().measure(*args)
            new = {name: value(getattr(out, name)) for name, value in change.items()}
            return out._replace(**new)

    return Changed


METHODS = {
    "likelihood": ({"log_likelihood": lambda x: x[..., None]}, "log_likelihood has the shape"),
    "nan": ({"log_likelihood": lambda x: x * torch.nan}, "log_likelihood is not finite"),
    "impossible": ({"log_likelihood": lambda x: x - torch.inf}, "log_likelihood is -inf for all"),
    "double": ({"log_likelihood": lambda x: x.double()}, "log_likelihood is float64"),
    "no displacement": ({"displacement": lambda x: None}, "displacement is a NoneType"),
    "no pose": ({"pose": lambda x: None}, "pose is a NoneType"),
    "detached displacement": (
        {"displacement": lambda x: x.detach()},
        "displacement requires no gradient",
    ),
    "detached": (
        {"displacement": lambda x: x.detach(), "log_likelihood": lambda x: x.detach()},
        "nothing of its output requires a gradient",
    ),
}


@pytest.mark.parametrize("mistake", METHODS)
def test_a_measurement_that_is_something_else_is_named(mistake: str) -> None:
    change, told = METHODS[mistake]
    with pytest.raises(UserError, match=rf"Changed\.measure: {told}"):
        rehearse(build(measuring(**change)))


def test_claims_that_do_not_hold_are_named() -> None:
    class ClaimsPose(Own):
        provides = ("pixel_space", "rollout", "displacement", "pose")

    class ClaimsScores(Own):
        provides = ("pixel_space", "rollout", "displacement", "score_poses")

    with pytest.raises(UserError, match=r"ClaimsPose\.measure: `pose` is the identity everywhere"):
        rehearse(build(ClaimsPose))
    with pytest.raises(UserError, match=r"ClaimsScores: .*has no score_poses\(\)"):
        rehearse(build(ClaimsScores))


def test_losses_of_a_methods_own_are_named() -> None:
    class Own2(Own):
        def training_losses(self, batch: Any, generator: Any) -> Any:
            return {"loss": super().training_losses(batch, generator)["loss"], "b": None}

    with pytest.raises(UserError, match=r"Own2\.training_losses: 'b' is a NoneType"):
        rehearse(build(Own2))


def test_a_method_that_needs_its_trainer_is_not_refused() -> None:
    class Asks(Own):
        def training_losses(self, batch: Any, generator: Any) -> Any:
            raise RuntimeError("Asks is not attached to a `Trainer`")

    rehearse(build(Asks))


def naming(name: str) -> type[PoseEstimator]:
    class Names(Own):
        def __init__(self, **base: Any) -> None:
            super().__init__(**base)
            setattr(self, name, nn.Linear(4, 3))

        def measure(self, *args: Any) -> Any:
            self.net = getattr(self, name)
            return super().measure(*args)

    return Names


@pytest.mark.parametrize("name", ["model", "likelihood", "proposals"])
def test_a_network_may_have_the_name_of_another_methods(name: str) -> None:
    for kind in (naming(name), with_lightning(naming(name))):
        rehearse(build(kind))


def test_a_network_of_poses_may_be_called_as_that_of_object_coordinates() -> None:
    class Poses(PoseParticles):
        def __init__(self, **base: Any) -> None:
            super().__init__(**base)
            self.proposals = nn.Conv2d(4, 7, 1)

    assert build(Poses, initialize=FromDepth()).space.dimensions == 6


@pytest.mark.parametrize("name", ["box", "space", "scores", "encode"])
def test_a_network_that_the_class_would_hide_is_named(name: str) -> None:
    with pytest.raises(UserError, match=f"^Names: its network `{name}` is hidden by .* class"):
        build(naming(name))


# -- metrics ----------------------------------------------------------------------------------


def measuring_by(value: Any) -> type[PoseEstimator]:
    class Measures(Own):
        def compute_metrics(self) -> dict[str, Any]:
            return super().compute_metrics() | {"own": {"spread": value}}

    return Measures


METRICS = {
    "vector": (torch.ones(3), r"'own/spread' is a Tensor of shape \(3,\), not a number"),
    "array": (np.ones((1, 2)), r"'own/spread' is a ndarray of shape \(1, 2\), not a number"),
    "object": ([object()], "'own/spread' is a object, not a number"),
}


@pytest.mark.parametrize("mistake", METRICS)
def test_a_metric_that_is_no_number_is_named(mistake: str) -> None:
    value, told = METRICS[mistake]
    with pytest.raises(UserError, match=rf"^Measures\.compute_metrics: {told}$"):
        rehearse(build(measuring_by(value)))


def test_a_metric_that_cannot_be_updated_is_noticed_before_the_training() -> None:
    class Measures(Own):
        def update_metrics(self, trace: Any, batch: Any) -> None:
            super().update_metrics(trace, batch)
            self.scores["spread"].update(trace.belief.best)

    with pytest.raises(KeyError, match="spread"):
        rehearse(build(Measures))


def test_a_metric_that_needs_more_images_is_not_refused() -> None:
    class Measures(Own):
        def compute_metrics(self) -> dict[str, Any]:
            if self.scores["iou"].count < 2:
                raise ValueError("at least two images")
            return super().compute_metrics()

    rehearse(build(Measures))


# -- checkpoints ------------------------------------------------------------------------------


def test_a_checkpoint_without_its_recipe_is_refused_before_the_training() -> None:
    class Forgets(Own):
        def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
            checkpoint["mine"] = 3

    class Pickles(Own):
        def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
            super().on_save_checkpoint(checkpoint)
            checkpoint["mine"] = object()

    class Nests(Own):
        def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
            super().on_save_checkpoint(checkpoint)
            checkpoint["mine"] = tuple(range(200))  # torch reads it, and our commands do not

    class Keeps(Own):
        def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
            super().on_save_checkpoint(checkpoint)
            checkpoint["mine"] = {"mean": torch.zeros(2), "names": ["a"]}

    told = r"Forgets\.on_save_checkpoint: the checkpoint lacks 'recipe': call super\(\)"
    with pytest.raises(UserError, match=told):
        rehearse(build(Forgets))
    with pytest.raises(UserError, match=r"Pickles\.on_save_checkpoint: checkpoint\['mine'\]"):
        rehearse(build(Pickles))
    with pytest.raises(UserError, match=r"Nests\.on_save_checkpoint: checkpoint\['mine'\]"):
        rehearse(build(Nests))
    rehearse(build(Keeps))


def test_a_method_that_saves_its_settings_once_more_is_refused_when_it_is_built() -> None:
    class Saves(Own):
        def __init__(self, **base: Any) -> None:
            super().__init__(**base)
            self.save_hyperparameters(ignore=["loss"])

    for kind in (Saves, with_lightning(Saves)):
        with pytest.raises(UserError, match=r"^Saves: calls save_hyperparameters\(\), .* recipe"):
            build(kind)
