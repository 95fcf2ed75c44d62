"""The settings of a trained filter as plain data, for programs that run the exported networks."""

from dataclasses import asdict
from typing import Any

import torch

from posefilter.confidence.second_look import LEAST_DEPTH
from posefilter.errors import UserError
from posefilter.filters import estimate, initialize, propagate, refine, resample, reweight
from posefilter.filters.agreement import Agreement
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.texture import (
    Print,
    TextureRotations,
    coarsen_texture,
    list_rotations,
    read_print,
)
from posefilter.filters.texture_alignment import TextureAlignment, find_sides
from posefilter.models.base import PoseEstimator
from posefilter.models.image_space import ImageSpace
from posefilter.models.pose_pf import PosePF
from posefilter.models.zoom import AGREED, HEAVIEST, LEAST_ZOOM, MOST_ZOOM, STEPS
from posefilter.nets.likelihood import PoseLikelihood
from posefilter.types import ObjectModel

VERSION = 1  # of the files' format


def describe_filter(method: PoseEstimator) -> dict[str, Any]:
    """Return what a program needs to know of a filter, beside its networks.

    Args:
        method: The trained method, with its object.

    Raises:
        UserError: A component cannot be exported; the message names a choice that can.
    """
    check_method(method)
    own, object_model = method.filter, method.object_model
    return {
        "version": VERSION,
        "particles_are": "poses" if isinstance(method, PosePF) else "pixels",
        "object": object_model.name,
        "center": object_model.center.tolist(),
        "radius": float(object_model.radius),
        "diameter": float(object_model.diameter),
        "first_particles": own.initial_particles,
        "particles": own.particles,
        "levels": [float(level) for level in own.schedule(own.steps)],
        "points": method.pixels if isinstance(method, PosePF) else None,
        "quasi_monte_carlo": isinstance(method, PosePF) and method.quasi_monte_carlo,
        "latent_width": method.latent_width,
        "zoom": _describe_zoom(own),
        "initialize": _describe_start(own.initialize),
        "resample": _choose(own.resample, "resample", systematic=resample.Systematic,
                            none=resample.NoResampling),
        "reweight": _choose(own.reweight, "reweight",
                            current_likelihood=reweight.CurrentLikelihood),
        "propagate": [part for one in _list(own.propagate) for part in _describe_move(one, method)],
        "estimate": _describe_estimate(own.estimate),
        "refine": [
            part for one in _list(own.refine) for part in _describe_refinement(one, method)
        ],
    }  # fmt: skip


def check_method(method: PoseEstimator) -> None:
    """Check that a method's networks can be exported.

    Raises:
        UserError: They cannot.
    """
    if "pose" not in method.capabilities:
        raise UserError(f"{type(method).__name__} detects, and estimates no pose to be exported")
    if isinstance(method, ImageSpace):
        return
    if not isinstance(method, PosePF) or type(method).measure is not PosePF.measure:
        raise UserError(f"format: the networks of {type(method).__name__} cannot be exported")
    likelihood = method.likelihood
    contextual = isinstance(likelihood, PoseLikelihood) and likelihood.context is not None
    if method.proposals is None or not contextual:
        raise UserError(
            "format: of pose_pf only model/proposals=dense with model/likelihood=surface or "
            "contextual is exported"
        )


def _list(component: Any) -> list[Any]:
    """Return the components of a chain, or the only one."""
    return component.components if hasattr(component, "components") else [component]


def _refuse(component: Any, group: str, *choices: str) -> UserError:
    return UserError(
        f"filter/{group}: {type(component).__name__} is not exported; choose {' or '.join(choices)}"
    )


def _choose(component: Any, group: str, **kinds: type) -> str:
    for name, kind in kinds.items():
        if type(component) is kind:
            return name
    raise _refuse(component, group, *kinds)


def _describe_zoom(own: ParticleFilter) -> dict[str, Any] | None:
    """Return when a magnified window is searched; None: never."""
    if own.magnified_width is None:
        return None
    return {
        "diameter": own.magnified_width,  # [widths of the image]
        "least": LEAST_ZOOM, "most": MOST_ZOOM, "steps": min(STEPS, own.steps),
        "heaviest": HEAVIEST, "agreed": AGREED, "least_depth": LEAST_DEPTH,
    }  # fmt: skip


def _describe_start(start: Any) -> dict[str, Any]:
    if isinstance(start, initialize.Informed):  # the truth informs training alone
        start = start.initializer
    if isinstance(start, initialize.FromObjectness):
        return {"kind": "from_objectness", "uniform_fraction": start.uniform_fraction}
    known = {"uniform": initialize.UniformPixels, "from_proposals": initialize.FromProposals}
    return {"kind": _choose(start, "initialize", **known)}


def _describe_move(move: Any, method: PoseEstimator) -> list[dict[str, Any]]:
    if isinstance(move, propagate.Identity):
        return []
    if isinstance(move, propagate.LearnedDisplacement):
        return [{"kind": "displacement"}]
    if isinstance(move, propagate.Gaussian):
        return [{"kind": "gaussian", "noise_scale": move.noise_scale}]
    half = isinstance(move, propagate.HalfTurnRotations)
    if isinstance(method, PosePF) and (half or isinstance(move, propagate.AxisRotations)):
        any_angle = getattr(move, "uniform_angle_probability", 0.0)
        axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        own = {"probability": move.probability, "uniform_angle_probability": any_angle}
        return [{"kind": "turns", **own, "axes": axes if half else method.space.axes.tolist()}]
    choices = ("gaussian", "gaussian_and_axis_rotations", "learned", "identity")
    raise _refuse(move, "propagate", *choices)


def _describe_estimate(one: Any) -> dict[str, Any]:
    if isinstance(one, Agreement):
        names = ("scale_m", "hypotheses", "iterations", "effective_particles")
        return {"kind": "agreement", **{name: getattr(one, name) for name in names}}
    return {"kind": _choose(one, "estimate", argmax=estimate.Argmax)}


def _describe_refinement(one: Any, method: PoseEstimator) -> list[dict[str, Any]]:
    if isinstance(one, refine.NoRefine):
        return []
    if isinstance(one, refine.Rescore):
        return [{"kind": "rescore", **asdict(one)}]
    if isinstance(one, refine.MeanShift):
        return [{"kind": "mean_shift", **asdict(one)}]
    if isinstance(one, PointToPlaneIcp) and isinstance(method, PosePF):
        names = ("iterations", "initial_gate", "final_gate", "prior", "noise", "effective")
        surface = one.choose_points(method.object_model.points).tolist()
        own = {name: getattr(one, name) for name in names}
        return [{"kind": "icp", **own, "surface": surface}]
    if isinstance(one, TextureRotations) and isinstance(method, PosePF):
        return describe_rotations(one, method.object_model)
    if isinstance(one, TextureAlignment) and isinstance(method, PosePF):
        return [describe_alignment(one, method.object_model)]
    choices = (
        "mean_shift_icp_texture_alignment", "mean_shift_icp_texture", "mean_shift_icp",
        "mean_shift", "rescore", "none",
    )  # fmt: skip
    raise _refuse(one, "refine", *choices)


def describe_alignment(one: TextureAlignment, object_model: ObjectModel) -> dict[str, Any]:
    """Return what an alignment with the texture needs."""
    own = read_print(object_model)
    names = (
        *("iterations", "initial_blur", "prior", "independent", "min_correlation"),
        *("texture_error", "min_gain", "gate"),
    )
    return {
        "kind": "texture_alignment",
        **{name: getattr(one, name) for name in names},
        "noise": one.depth.noise,
        "effective": one.depth.effective,
        "surface": one.depth.choose_points(object_model.points).tolist(),
        "print": _list_print(own),
        "spacing": own.spacing,
        "sides": find_sides(own.normals).tolist(),
    }


def _list_print(own: Print) -> list[list[float]]:
    """Return textured points as rows of nine numbers."""
    rows = torch.cat([own.points, own.normals, own.color], dim=1).tolist()
    return [[round(x, 5) for x in row] for row in rows]


def describe_rotations(one: TextureRotations, object_model: ObjectModel) -> list[dict[str, Any]]:
    """Return what turns by texture need; nothing where the shape leaves no turn open."""
    turns, coarse = list_rotations(object_model)
    if len(turns) == 1:
        return []
    own = read_print(coarsen_texture(object_model))
    return [
        {
            "kind": "texture",
            **{name: getattr(one, name) for name in ("learned_weight", "pixels", "sigma")},
            "surface": _list_print(own),
            "spacing": own.spacing,
            "turns": [[round(x, 6) for x in turn[:3].flatten().tolist()] for turn in turns],
            "coarse": coarse.tolist(),
        }
    ]
