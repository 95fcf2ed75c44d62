"""Check a checkpoint, which others may have written: its archive, and its tensors."""

import math
import re
import stat
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from posefilter.cli.plain import walk
from posefilter.errors import UserError
from posefilter.geometry.pose import is_rigid
from posefilter.models.quantization import OFFSET
from posefilter.paths import is_plain_name
from posefilter.pickles import check_pickle

_LARGEST = 8 << 30  # bytes of a file
_MOST_FILES = 50_000  # in an archive
# of what is in it: optimizers and loops hold a few values a parameter
_MOST_NODES, _DEEPEST = 500_000, 64
_PART = re.compile(r"[\w.\-]{1,100}(/[\w.\-]{1,100}){0,4}")
_LONGEST = 500  # name of a weight
_POINTS = 1_000_000  # of an object's surface
_MOST = {"symmetries": 10_000, "texture": 20_000, "shape_symmetries": 1_000}  # rows
_PARTS = 100
_FARTHEST = 1000.0  # length of an object [m]
_SPREAD = 4  # times the bytes of a file that its weights may stand for


def check_archive(file: Path) -> None:
    """Raise UserError unless a file is an archive as torch.save writes it: parts stored as they
    are, no larger than it.

    Args:
        file: The file.
    """
    size = file.stat().st_size
    if size > _LARGEST:
        raise UserError(f"{size / 1e9:.0f} GB is more than a checkpoint has")
    try:
        archive = zipfile.ZipFile(file)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise UserError("not readable as a checkpoint (no archive as torch writes it)") from error
    with archive:
        parts = archive.infolist()
        _check_parts(parts, size)
        try:  # torch looks at no checksum, and would load weights that are other numbers
            broken = archive.testzip()
        except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, EOFError) as error:
            raise UserError("not readable as a checkpoint (it is damaged)") from error
        if broken is not None:
            raise UserError(
                f"is damaged: its part {broken[:60]!r} is not what was written; copy it again"
            )
        for part in parts:
            if part.filename.lower().endswith(".pkl"):
                check_pickle(archive.read(part))


def _check_parts(parts: Sequence[zipfile.ZipInfo], size: int) -> None:
    if len(parts) > _MOST_FILES:
        raise UserError(f"{len(parts)} parts are more than a checkpoint has")
    for part in parts:
        if part.compress_type != zipfile.ZIP_STORED or part.file_size != part.compress_size:
            raise UserError(
                f"its part {part.filename[:60]!r} is compressed, which torch does not do"
            )
        if (
            not _PART.fullmatch(part.filename)
            or ".." in part.filename.split("/")
            or stat.S_ISLNK(part.external_attr >> 16)
        ):
            raise UserError(f"its part {part.filename[:60]!r} is not named as torch names them")
    if sum(part.file_size for part in parts) > size:
        raise UserError("its parts claim to be larger than the file")
    if len({part.filename.lower() for part in parts}) < len(parts):  # torch's reader sees no case
        raise UserError("two of its parts have one name")


def check_content(checkpoint: Any, file: Path) -> dict[str, Any]:
    """Return what a checkpoint holds.

    Raises UserError where it is none of ours, or a tensor is not what it seems.
    """
    if not isinstance(checkpoint, dict) or not {"state_dict", "recipe", "object_model"} <= set(
        checkpoint
    ):
        raise UserError("not made by this project's train.py (no recipe or object in it)")
    size = file.stat().st_size
    for count, (_, depth, value) in enumerate(walk(checkpoint), 1):
        if count > _MOST_NODES or depth > _DEEPEST:
            raise UserError(
                f"holds more than a checkpoint does ({_MOST_NODES} values, {_DEEPEST} deep)"
            )
        if isinstance(value, Tensor):
            check_tensor(value, size)
    state = checkpoint["state_dict"]
    if not isinstance(state, dict) or not all(
        isinstance(k, str) and k.isprintable() and len(k) <= _LONGEST and isinstance(v, Tensor)
        for k, v in state.items()
    ):
        raise UserError("its state_dict should hold tensors by name")
    if sum(value.numel() * value.element_size() for value in state.values()) > _SPREAD * size:
        raise UserError("its weights claim to be larger than the file")
    _check_object(checkpoint["object_model"])
    return checkpoint


def check_tensor(value: Tensor, size: int) -> None:
    """Raise UserError unless a tensor is plain, and all of it in a file of this size [bytes]."""
    shape = list(value.shape)
    plain = (
        type(value) in (Tensor, nn.Parameter)
        and value.layout is torch.strided
        and value.device.type == "cpu"
        and not value.is_complex()
    )
    if not plain or value.is_quantized:
        raise UserError(f"holds a tensor of an unusual kind ({value.layout}, {value.device.type})")
    held = value.untyped_storage().nbytes()
    if value.numel() * value.element_size() > held or held > size:
        raise UserError(f"a tensor of shape {shape[:8]} claims more elements than the file holds")


def _check_object(model: Any) -> None:
    shapes = {"points": (-1, 3), "center": (3,), "symmetries": (-1, 4, 4), "hull": (-1, 3)}
    # checkpoints of earlier versions have none of these
    packed = isinstance(model, dict) and model.get("texture_look") is not None
    later = {"texture": (-1, 3 if packed else 9), "shape_symmetries": (-1, 4, 4)}
    needed = {"name", "radius", "diameter", *shapes}
    optional = {"parts", "texture_look", OFFSET, *later}
    if not isinstance(model, dict) or set(model) - optional != needed:
        raise UserError(
            "its object should have name, points, center, radius, diameter, symmetries and hull"
        )
    name = model["name"]
    if not (isinstance(name, str) and is_plain_name(name)):
        raise UserError(f"its object's name {str(name)[:40]!r} is not a plain one")
    parts = {} if model.get("parts") is None else model["parts"]
    if not (
        isinstance(parts, dict)
        and len(parts) <= _PARTS
        and all(isinstance(part, str) and is_plain_name(part) for part in parts)
    ):
        raise UserError("its object's parts should be points by plain names")
    held = {key: model[key] for key in shapes}
    held |= {key: model[key] for key in later if model.get(key) is not None}
    named = {key: (value, (shapes | later)[key]) for key, value in held.items()}
    if OFFSET in model:
        named[OFFSET] = (model[OFFSET], (3,))
    named |= {f"part {part}": (points, (-1, 3)) for part, points in parts.items()}
    for key, (value, shape) in named.items():
        fits = isinstance(value, Tensor) and value.dim() == len(shape) and value.is_floating_point()
        if not fits or any(
            want not in (-1, have) for want, have in zip(shape, value.shape, strict=True)
        ):
            raise UserError(f"its object's {key} should be numbers of shape {shape}")
        most = _MOST.get(key, _POINTS)
        if not 0 < len(value) <= most or not bool((value.abs() < _FARTHEST).all()):
            raise UserError(
                f"its object's {key} should have 1 to {most} rows of finite lengths [m]"
            )
    for key in held:
        if key.endswith("symmetries") and not is_rigid(held[key].double()):
            raise UserError(f"its object's {key} should be turns, each with a shift")
    if packed:
        look, count = model["texture_look"], len(held["texture"]) if "texture" in held else -1
        fits = isinstance(look, Tensor) and look.dtype == torch.uint8
        if not (fits and look.shape == (count, 6)):
            raise UserError("its object's texture_look should be 6 bytes for each of its points")
    elif "texture" in held:
        colors = held["texture"][:, 6:]
        if not bool(((colors >= 0) & (colors <= 1)).all()):
            raise UserError("its object's texture should have colors in [0, 1]")
    for key in ("radius", "diameter"):
        if not (isinstance(model[key], float | int) and 0 < model[key] < 1000):
            raise UserError(f"its object's {key} should be a length [m]")


class Bounded(TorchFunctionMode):
    """While it is entered, tensors that are made anew stay within bounds: a recipe must not fill
    the memory.

    Args:
        elements: How many there may be, all tensors together.
        tensors: How many tensors.
    """

    def __init__(self, elements: int, tensors: int) -> None:
        super().__init__()
        self.elements, self.tensors = elements, tensors

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Count what a factory is to make, before it does."""
        kwargs = kwargs or {}
        if func in _FACTORIES:
            numbers = (value for _, _, value in walk((*args, kwargs.get("size"))))
            sizes = [one for one in numbers if isinstance(one, int) and not isinstance(one, bool)]
            self.elements -= math.prod(max(size, 1) for size in sizes)
            self.tensors -= 1
            if self.elements < 0 or self.tensors < 0:
                raise UserError(
                    "checkpoint: its recipe describes a method larger than the weights it brings"
                )
        return func(*args, **kwargs)


_FACTORIES = {
    *(torch.arange, torch.empty, torch.eye, torch.full, torch.linspace, torch.logspace),
    *(torch.ones, torch.rand, torch.randn, torch.zeros),
}
