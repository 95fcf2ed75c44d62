"""What methods and their components provide, and what components require: plain names, matched by
one check.

A class says so by two class attributes, `provides` and `requires`, tuples of names; a subclass that
says nothing has its parent's. What is chosen fits together where every requirement of every
component is provided by the method or by one of its components. A new method is checked, trained
and drawn by these names alone.
"""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from posefilter.errors import UserError

Capability = str  # one of `MEANINGS`
Capabilities = tuple[Capability, ...]

# what is needed where a name is required, after "needs"
MEANINGS: Mapping[str, str] = {
    "heatmaps": "training on maps of keypoints alone",
    "candidates": "scored candidate poses",
    "common_points": "a likelihood that reads the same image points for all poses",
    "color": "a method whose encodings keep the image's colors",
    "correspondences": "training on dense object coordinates alone",
    "depth": "a method whose encodings keep the measured depth",
    "displacement": "particles with a learned displacement",
    "free_latent": "a latent that is no input of the network",
    "grid_scores": "training on crops scored against rotations",
    "image_patches": "particles that see a patch of the image",
    "score_parts": "a likelihood that scores a part of the object",
    "score_points": "a likelihood that scores single image points",
    "score_samples": "a likelihood that scores colored points by themselves",
    "object_coordinates": "a network that predicts object coordinates",
    "parts": "a method whose particles are of the object's parts",
    "pixel_space": "particles that are pixels",
    "pose": "particles with a pose",
    "pose_space": "particles that are poses",
    "propose_poses": "a method that proposes poses",
    "ray_samples": "scored points along labeled rays",
    "objectness": "an objectness map of the image",
    "recordable": "a component that a GPU can replay",
    "rollout": "training that rolls out the filter",
    "score_poses": "a method that scores any pose",
    "surface_point_loss": "a loss on each particle's predicted object point",
    "surface_points": "particles with a measured point of the object",
    "within_parts": "resampling within each part's particles",
}


class Declared(NamedTuple):
    """What a class declares."""

    provides: frozenset[str] = frozenset()
    requires: frozenset[str] = frozenset()


def read_declared(kind: type) -> Declared:
    """Return what a class declares, itself or by a parent.

    Raises UserError where it does not declare capabilities.
    """
    return Declared(*(_read_names(kind, which) for which in Declared._fields))


def _read_names(kind: type, which: str) -> frozenset[str]:
    names = getattr(kind, which, ())
    where = f"{kind.__module__}.{kind.__qualname__}.{which}"
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise UserError(f"{where}={names!r}: must be a tuple, such as {which} = ('rollout',)")
    names = [*names]
    for name in names:
        if name not in MEANINGS:
            near = difflib.get_close_matches(str(name), MEANINGS, n=1, cutoff=0.5)
            told = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(MEANINGS)}"
            raise UserError(f"{where}: there is no capability {name!r}; {told}")
    return frozenset(names)


def list_parts(thing: Any) -> list[Any]:
    """Return an object and all that it is made of: public attributes, torch's submodules,
    containers.
    """
    found: dict[int, Any] = {}
    waiting = [thing]
    while waiting:
        one = waiting.pop(0)
        if id(one) in found or isinstance(one, type):
            continue
        found[id(one)] = one
        if isinstance(one, Mapping):
            waiting += one.values()
        elif isinstance(one, list | tuple):
            waiting += one
        elif hasattr(one, "__dict__"):
            waiting += [v for k, v in vars(one).items() if not k.startswith("_")]
            waiting += vars(one).get("_modules", {}).values()
    return list(found.values())


def collect_provided(method: Any) -> frozenset[str]:
    """Return what a method provides, itself or by one of its parts."""
    return frozenset().union(*(read_declared(type(part)).provides for part in list_parts(method)))


def check_parts(method: Any) -> None:
    """Raise UserError, naming the part, unless all of a method's parts find what they require."""
    parts = list_parts(method)
    for i, need in find_missing(read_declared(type(part)) for part in parts):
        raise UserError(
            f"{type(method).__name__}: its {type(parts[i]).__name__} needs "
            f"{MEANINGS.get(need, need)} ({need}), which none of its parts provides"
        )


def find_missing(components: Iterable[Declared]) -> list[tuple[int, str]]:
    """Match what components require with what all of them provide.

    Returns:
        (number, name) of each requirement that is not met, in the order of the components.
    """
    components = list(components)
    provided = frozenset().union(*(component.provides for component in components))
    return [
        (i, name)
        for i, component in enumerate(components)
        for name in sorted(component.requires - provided)
    ]
