"""Whether the parts of a method return what their protocols say: asked once, before a training.

A copy of the method looks at two images, one as a validation does, with its metrics, and one as a
training does, while each of its parts is watched. The method itself is left as it is, and so are
the random numbers.
"""

import inspect
import io
import logging
import zipfile
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from lightning import LightningModule
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor, nn

from posefilter.capabilities import list_parts
from posefilter.errors import UserError
from posefilter.geometry.pose import is_rigid
from posefilter.models.base import PoseEstimator
from posefilter.models.pose_pf import PosePF
from posefilter.pickles import check_pickle
from posefilter.types import Batch, BeliefBatch, ParticleOutput, Particles, Resampled, Step, Trace

log = logging.getLogger(__name__)
_RIGID = 1e-2  # of a rotation's entries
_NORMAL = 1e-3  # of the log of the weights' sum
# a method that provides one of these names has a function of this name
_FUNCTIONS = ("image_patches", "propose_poses", "score_poses", "surface_points")
_VERBS = ("schedule", "initialize", "reweight", "resample", "propagate", "estimate", "refine")
Watch = Callable[..., Any]  # given a part's name, the call, and its arguments


def check_method(method: PoseEstimator, seen: Batch, learned: Batch | None) -> None:
    """See whether a method's parts return what their protocols say.

    Args:
        method: It has its object; it is not changed.
        seen: Images, as of a validation.
        learned: Images, as of a training; None: no loss is computed.

    Raises:
        UserError: One does not; the message names its class.
    """
    for name in _FUNCTIONS:
        offered = name in type(method).provides and not callable(getattr(method, name, None))
        _need(not offered, type(method).__name__, f"`provides` {name}, but has no {name}()")
    with isolate_rng():
        try:
            twin = deepcopy(method)
        # whatever cannot be copied: it is looked at without the watching, as it will be used
        except (TypeError, RuntimeError, AttributeError) as error:
            log.debug("the method cannot be copied (%s)", error)
            _check_checkpoint(method)
            training = method.training
            with torch.no_grad():
                method.eval().box(method.predict_step(seen, 0), seen)
            method.train(training)
            return
        _check_checkpoint(twin)
        _Watcher(twin).watch()
        _look(twin.eval(), seen)
        # a method may have work of its own to do before a training's first step
        prepare = getattr(type(twin), "on_fit_start", None)
        if learned is not None and prepare in (None, LightningModule.on_fit_start):
            _learn(twin.train(), learned)


def _look(method: PoseEstimator, seen: Batch) -> None:
    """Check a validation of one batch, and what is logged of it."""
    with torch.no_grad():
        trace = method.predict_step(seen, 0)
        box = method.box(trace, seen)
        who, shape = f"{type(method).__name__}.box", (len(seen.rgb), 4)
        _check_tensor(who, "what it returned", box, shape, torch.float64)
        method.update_metrics(trace, seen)
    try:
        method.collect_results()
    except UserError:
        raise
    except Exception as error:  # some metrics need more images; others are raised again
        log.debug("no metrics could be computed of one image: %r", error)


def _learn(method: PoseEstimator, learned: Batch) -> None:
    """Check the losses of a training's first step."""
    try:
        losses: Any = method.training_losses(learned, method.generator("train", 0))
    except UserError:
        raise
    except Exception as error:  # the training raises it again, where it can be found
        log.debug("no loss could be computed without a trainer: %r", error)
        return
    who = f"{type(method).__name__}.training_losses"
    _need(isinstance(losses, Mapping), who, f"returned a {type(losses).__name__}, not a dict")
    for name, value in losses.items():
        _check_loss(who, f"'{name}'", value, len(learned.rgb), _learns(method))


def _check_loss(who: str, what: str, value: Any, images: int, learns: bool) -> None:
    _check_tensor(who, what, value, (images,), torch.float16, torch.bfloat16, torch.float64)
    _need(
        value.requires_grad or not learns,
        who,
        f"{what} requires no gradient, so that nothing is learned from it (detached?)",
    )


def _learns(module: nn.Module) -> bool:
    """Tell whether a module is being trained, and has anything to train."""
    trained = module.training and torch.is_grad_enabled()
    return trained and any(weight.requires_grad for weight in module.parameters())


def _check_checkpoint(method: PoseEstimator) -> None:
    """See whether a checkpoint would hold what the method is built from again."""
    who = f"{type(method).__name__}.on_save_checkpoint"
    written: dict[str, Any] = {"epoch": 0, "global_step": 0, "state_dict": method.state_dict()}
    method.on_save_checkpoint(written)
    for key in ("recipe", "object_model"):
        told = f"the checkpoint lacks '{key}': call super().on_save_checkpoint(checkpoint)"
        _need(key in written, who, told)
    del written["state_dict"]
    for key, value in written.items():
        file = io.BytesIO()
        try:
            torch.save(value, file)
            check_pickle(_read_pickle(file))
            file.seek(0)
            torch.load(file, weights_only=True)
        except Exception as error:  # pickle raises what it likes
            raise UserError(
                f"{who}: checkpoint['{key}'] holds other than tensors, numbers, texts, lists and "
                f"dicts, which no command reads again"
            ) from error


def _read_pickle(file: io.BytesIO) -> bytes:
    """Return the pickle of what torch.save wrote."""
    with zipfile.ZipFile(file) as archive:
        return next(archive.read(one) for one in archive.namelist() if one.endswith("data.pkl"))


def _need(good: bool, who: str, told: str) -> None:
    if not good:
        raise UserError(f"{who}: {told}")


def _need_type(who: str, value: Any, kind: type) -> None:
    told = f"returned a {type(value).__name__}, not a posefilter.types.{kind.__name__}"
    _need(isinstance(value, kind), who, told)


def _check_tensor(
    who: str,
    what: str,
    value: Any,
    shape: tuple[int | None, ...],
    *other_types: torch.dtype,
    infinite: bool = False,
) -> None:
    """Refuse what is no tensor of a shape, of float32 and with finite numbers.

    Args:
        who: The class.
        what: What the value is.
        value: What it returned.
        shape: None stands for any length.
        *other_types: That it may have, too.
        infinite: Whether it may be minus infinity.
    """
    wanted = f"({', '.join('*' if n is None else str(n) for n in shape)}{',' * (len(shape) == 1)})"
    told = f"{what} is a {type(value).__name__}, not a tensor {wanted}"
    _need(isinstance(value, Tensor), who, told)
    fits = len(shape) == value.dim() and all(
        n in (None, m) for n, m in zip(shape, value.shape, strict=True)
    )
    _need(fits, who, f"{what} has the shape {tuple(value.shape)}, not {wanted}")
    dtype = str(value.dtype).removeprefix("torch.")
    wants = "float32" if value.dtype.is_floating_point or not other_types else "floats"
    _need(value.dtype in (torch.float32, *other_types), who, f"{what} is {dtype}, not {wants}")
    good = value.isfinite() | (value == -torch.inf) if infinite else value.isfinite()
    _need(bool(good.all()), who, f"{what} is not finite")


class _Watcher:
    """Has each part of a method checked whenever it is called.

    A part's class is replaced by one of the same name that extends it, so that it is still an
    instance of its own class.
    """

    def __init__(self, method: PoseEstimator) -> None:
        self.method, self.offers = method, method.capabilities
        self._known: set[int] = set()

    def watch(self) -> None:
        """Watch the method, its filters, its likelihood, its loss and the labels of its losses."""
        method = self.method
        for one in (method.filter, method.train_rollout):
            for name in _VERBS:
                self._extend(getattr(one, name), __call__=getattr(self, f"_{name}"))
        self._extend(method.loss, __call__=self._loss)
        for part in list_parts([method.loss, getattr(method, "aux_losses", None)]):
            if callable(label := getattr(part, "label", None)):
                self._extend(label, __call__=self._label)
        if isinstance(method, PosePF):  # what others call so is their own
            self._extend(method.likelihood, __call__=self._likelihood)
        watches: dict[str, Watch] = {"measure": self._measure}
        if hasattr(method, "score_poses"):
            watches["score_poses"] = self._score_poses
        self._extend(method, **watches)

    def _extend(self, part: Any, **watches: Watch) -> None:
        if id(part) in self._known:
            return
        self._known.add(id(part))
        kind = type(part)
        _need("__call__" not in watches or callable(part), kind.__name__, "has no __call__()")
        own = {name: _wrap(kind, name, watch) for name, watch in watches.items()}
        content = {"__slots__": (), "__module__": kind.__module__, **own}
        try:
            metaclass: Any = type(kind)  # some forbid what `type` itself would make
            object.__setattr__(part, "__class__", metaclass(kind.__name__, (kind,), content))
        except TypeError:  # a function has no class of its own to extend
            log.debug("%s is not watched", kind.__name__)

    # -- the filter -------------------------------------------------------------------------------

    def _schedule(self, who: str, call: Watch, steps: int) -> Any:
        levels = call()
        count = len(levels) if hasattr(levels, "__len__") else 0
        _need(count == steps, who, f"returned {count} noise levels for filter.steps={steps}")
        good = all(np.isfinite(float(level)) and float(level) >= 0 for level in levels)
        _need(good, who, f"a noise level is no finite number of 0 or more: {levels}")
        return levels

    def _initialize(
        self, who: str, call: Watch, batch: Batch, encoding: Any, method: Any, count: int, *_: Any
    ) -> Any:
        state = call()
        own = tuple(state.shape[2:]) if isinstance(state, Tensor) else ()
        _check_tensor(who, "what it returned", state, (len(batch.rgb), count, *own))
        return state

    def _reweight(self, who: str, call: Watch, log_weights: Tensor, *_: Any) -> Any:
        out = call()
        _check_tensor(who, "what it returned", out, tuple(log_weights.shape), infinite=True)
        return out

    def _resample(self, who: str, call: Watch, particles: Particles, count: int, *_: Any) -> Any:
        out = call()
        _need_type(who, out, Resampled)
        B, N = particles.log_weights.shape
        _check_tensor(who, "log_weights", out.log_weights, (B, count), infinite=True)
        total = out.log_weights.logsumexp(1)
        told = f"the weights of the resampled particles sum to {total.exp().max():.3g}, not 1"
        _need(bool((total.abs() < _NORMAL).all()), who, f"{told}: log_weights are normalized logs")
        ancestors: Any = out.ancestors
        shape = tuple(getattr(ancestors, "shape", ()))
        _need(shape == (B, count), who, f"ancestors have the shape {shape}, not {(B, count)}")
        told = f"ancestors are {ancestors.dtype}, not torch.int64"
        _need(ancestors.dtype == torch.int64, who, told)
        inside = bool(((ancestors >= 0) & (ancestors < N)).all())
        _need(inside, who, f"ancestors are not all among the {N} particles")
        mixture = out.mixture_weights
        if mixture is not None:
            _check_tensor(who, "mixture_weights", mixture, (B, count, N))
            whole = bool((mixture.sum(2).log().abs() < _NORMAL).all() and (mixture >= 0).all())
            _need(whole, who, "mixture_weights are no weights: a child's should sum to 1")
        return out

    def _propagate(self, who: str, call: Watch, state: Tensor, *_: Any) -> Any:
        before = state.detach().clone()
        moved = call()
        _check_tensor(who, "what it returned", moved, tuple(state.shape))
        same = torch.equal(before, state.detach())
        _need(same, who, "changes the states that it is given in place; return new ones")
        return moved

    def _estimate(self, who: str, call: Watch, particles: Particles, *_: Any) -> Any:
        return self._check_belief(who, call(), len(particles.log_weights))

    def _refine(self, who: str, call: Watch, belief: BeliefBatch, *_: Any) -> Any:
        return self._check_belief(who, call(), len(belief.best))

    def _check_belief(self, who: str, out: Any, images: int) -> Any:
        _need_type(who, out, BeliefBatch)
        _check_tensor(who, "log_weights", out.log_weights, (images, None), infinite=True)
        count = out.log_weights.shape[1]
        _check_tensor(who, "poses", out.poses, (images, count, 4, 4))
        _check_tensor(who, "the estimate `best`", out.best, (images, 4, 4))
        if "pose" in self.offers:
            told = "the estimate `best` is no rotation and translation [m]"
            _need(is_rigid(out.best.detach(), _RIGID), who, told)
        _check_tensor(who, "score", out.score, (images,), infinite=True)
        return out

    # -- the method -------------------------------------------------------------------------------

    def _measure(
        self, who: str, call: Watch, encoding: Any, particles: Particles, step: Step, *_: Any
    ) -> Any:
        out = call()
        _need_type(who, out, ParticleOutput)
        B, N = particles.log_weights.shape
        _check_tensor(who, "log_likelihood", out.log_likelihood, (B, N), infinite=True)
        told = "log_likelihood is -inf for all particles of an image"
        _need(bool((out.log_likelihood > -torch.inf).any(1).all()), who, told)
        sizes = {
            "displacement": (B, N, self.method.space.dimensions),
            "pose": (B, N, 4, 4),
            "latent": (B, N, self.method.latent_width),
        }
        for name, size in sizes.items():
            _check_tensor(who, name, getattr(out, name), size)
        if "pose" in self.offers:
            told = "`pose` is no rotation and translation [m]"
            _need(is_rigid(out.pose.detach(), _RIGID), who, told)
            empty = bool((out.pose == torch.eye(4)).all())
            _need(not empty, who, "`pose` is the identity everywhere, but `provides` has pose")
        if _learns(self.method):
            learned = {
                name for name in ("log_likelihood", *sizes) if getattr(out, name).requires_grad
            }
            _need(bool(learned), who, "nothing of its output requires a gradient (detached?)")
            moves = "displacement" in learned or "displacement" not in self.offers
            told = "displacement requires no gradient, but `provides` has displacement"
            _need(moves, who, told)
        return out

    def _score_poses(self, who: str, call: Watch, encoding: Any, poses: Tensor, *_: Any) -> Any:
        out = call()
        _check_tensor(who, "what it returned", out, tuple(poses.shape[:2]), infinite=True)
        return out

    def _likelihood(self, who: str, call: Watch, image: Any, poses: Tensor, *_: Any) -> Any:
        out = call()
        kinds = (poses.dtype, torch.bfloat16)  # where that is fast
        _check_tensor(who, "what it returned", out, tuple(poses.shape[:2]), *kinds, infinite=True)
        likelihood: Any = self.method.likelihood
        told = "the scores require no gradient, so that nothing is learned (detached?)"
        _need(out.requires_grad or not _learns(likelihood), who, told)
        return out

    def _loss(self, who: str, call: Watch, trace: Trace, batch: Batch, *_: Any) -> Any:
        out = call()
        _check_loss(who, "the loss", out, len(batch.rgb), _learns(self.method))
        return out

    def _label(self, who: str, call: Watch, trace: Any, *_: Any) -> Any:
        out = call()
        # a loss of one's own may call it in its own way
        if not (isinstance(trace, Trace) and trace.particles):
            return out
        (B, N), *others = {tuple(one.log_weights.shape) for one in trace.particles}
        shape = (len(trace.particles), B, None if others else N)  # N may differ from step to step
        more = (self.method.space.dimensions,) if getattr(out, "ndim", 0) > len(shape) else ()
        dtype = getattr(out, "dtype", torch.float32)  # a label may be bool
        _check_tensor(who, "the label", out, (*shape, *more), dtype)
        return out


def _wrap(kind: type, name: str, watch: Watch) -> Watch:
    """Return a class's function, watched."""
    original = getattr(kind, name, None)
    seen = original
    if name == "__call__" and issubclass(kind, nn.Module):
        has = kind.forward is not nn.Module.forward
        name, seen = "forward", kind.forward if has else None
    who = kind.__name__ if name in ("__call__", "forward") else f"{kind.__name__}.{name}"
    if original is None or seen is None:
        raise UserError(f"{kind.__name__}: has no {name}()")
    signature = inspect.signature(seen)

    def watched(self: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            bound = signature.bind(self, *args, **kwargs)
        except TypeError as error:
            told = f"{kind.__name__}.{name}{signature}: takes other arguments than its protocol's"
            raise UserError(f"{told} ({error})") from error
        given = args if not kwargs else tuple(bound.arguments.values())[1:]
        return watch(who, lambda: original(self, *args, **kwargs), *given)

    return watched
