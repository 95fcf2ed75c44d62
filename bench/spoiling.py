"""Ways to spoil a file of a dataset, for bench/mutations.py: each changes one file at random and
returns in words what it did.
"""

import json
import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io

Rng = random.Random
_NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 1e-9, 1e9, 1e30, -1e30, 1e308, float("nan"), float("inf"), 10**400, 2**63, 0.5, 65535,
)  # fmt: skip
_VALUES: tuple[Any, ...] = (
    None, True, False, "", "text", "1", "\u00fc\u0000", [], {}, [None], [[]], {"a": 1}, [1, 2, 3],
    *_NUMBERS,
)  # fmt: skip


def spoil(root: Path, rng: Rng) -> str:
    """Spoil one file below a folder.

    Args:
        root: The dataset.
        rng: Source of randomness.

    Returns:
        The file and what was done to it.
    """
    files = sorted(path for path in root.rglob("*") if path.is_file())
    path = rng.choice(files)
    # as many settings as images, though there are fewer of their files
    settings = [file for file in files if file.suffix in (".json", ".mat")]
    path = rng.choice(settings) if rng.random() < 0.5 else path
    ways: list[Callable[[Path, Rng], str]] = [_spoil_bytes, _spoil_place]
    own = {".json": _spoil_json, ".mat": _spoil_mat, ".png": _spoil_image, ".jpg": _spoil_image}
    way = own.get(path.suffix) if rng.random() < 0.8 else None
    where = path.relative_to(root)
    return f"{where}: {(way or rng.choice(ways))(path, rng)}"


def _spoil_bytes(path: Path, rng: Rng) -> str:
    """Change what a file holds, whatever that means."""
    data = bytearray(path.read_bytes())
    way = rng.choice(["truncate", "flip", "empty", "zeros", "noise", "other", "append", "utf16"])
    if way == "truncate":
        data = data[: rng.randrange(len(data))]
    elif way == "flip":
        for _ in range(rng.choice([1, 1, 3, 30])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif way == "empty":
        data = bytearray()
    elif way == "zeros":
        data = bytearray(len(data))
    elif way == "noise":
        data = bytearray(rng.randbytes(len(data)))
    elif way == "other":
        near, far = (
            sorted(p for p in folder.rglob("*") if p.is_file() and p != path)
            for folder in (path.parent, path.parent.parent)
        )
        other = rng.choice(near or far)
        path.write_bytes(other.read_bytes())
        return f"bytes of {other.name}"
    elif way == "append":
        data += rng.randbytes(50)
    else:
        data = bytearray(bytes(data[:2000]).decode("latin-1").encode("utf-16"))
    path.write_bytes(bytes(data))
    return f"bytes: {way}"


def _spoil_place(path: Path, rng: Rng) -> str:
    """Change what stands under a file's name, or beside it."""
    way = rng.choice(["missing", "folder", "dangling", "loop", "outside", "denied", "stray", "dir"])
    if way == "stray":
        names = ["\u00b2.left.json", "9" * 30 + ".left.json", "-meta.mat", ".png", "x" * 200, "0"]
        names += ["000009.left.json", "000009-meta.mat", "a b.json", "Thumbs.db", "\u00fc.png"]
        path.with_name(rng.choice(names)).write_bytes(rng.choice([b"", b"{}", b"\xff"]))
        return "a stray file beside it"
    if way == "dir":
        names = ["\u00b2", "000077", "0077", "9" * 30, ".hidden", "mixed"]
        path.with_name(rng.choice(names)).mkdir(exist_ok=True)
        return "a stray folder beside it"
    if way == "denied":
        path.chmod(0)
        return "permission denied"
    path.unlink()
    if way == "folder":
        path.mkdir()
    elif way == "dangling":
        path.symlink_to(path.with_name("nowhere"))
    elif way == "loop":
        path.symlink_to(path)
    elif way == "outside":
        path.symlink_to(Path(os.devnull) if rng.random() < 0.5 else Path("/etc/hostname"))
    return way


def _spoil_json(path: Path, rng: Rng) -> str:
    """Change a value of a JSON file."""
    content = json.loads(path.read_text())
    if rng.random() < 0.1:
        text = rng.choice(["[" * 100_000, "9" * 5000, "null", "[]", "{}", '"x"', "{", "NaN", "1"])
        path.write_text(text)
        return f"JSON: {text[:10]}"
    places = list(_places(content))
    holder, key, where = rng.choice(places)
    value = holder[key]
    way = rng.choice(["value", "value", "number", "delete", "scale", "swap", "nest", "twice"])
    if way == "number" and not _is_number(value):
        numbers = [one for one in places if _is_number(one[0][one[1]])]
        holder, key, where = rng.choice(numbers)
    value = holder[key]
    if way == "number" or (way == "scale" and _is_number(value)):
        new: Any = rng.choice(
            [*_NUMBERS, -value, value * 10, value / 10, value * 1000, value + 100]
        )
        holder[key] = new
    elif way == "delete":
        del holder[key]
        new = "deleted"
    elif way in ("scale", "swap") and isinstance(value, list) and value:
        new = _rearrange(value, rng)
        holder[key] = new
    elif way == "nest":
        new = value
        for _ in range(rng.choice([1, 2, 500])):
            new = [new]
        holder[key], new = new, "nested"
    elif way == "twice" and isinstance(holder, list):
        holder.append(value)
        new = "twice"
    else:
        new = rng.choice(_VALUES)
        holder[key] = new
    path.write_text(json.dumps(content))
    return f"{where} = {str(new)[:40]}"


def _rearrange(value: list[Any], rng: Rng) -> list[Any]:
    """Return a list of numbers in another order or size."""
    flat = [x for row in value for x in row] if isinstance(value[0], list) else list(value)
    way = rng.choice(["reverse", "roll", "negative", "transpose", "short", "zero", "scale"])
    if not all(map(_is_number, flat)):
        return value[::-1] if way in ("reverse", "roll") else value[:-1]
    if way == "transpose" and round(len(flat) ** 0.5) ** 2 == len(flat):
        size = round(len(flat) ** 0.5)
        new = np.array(flat, dtype=float).reshape(size, size).T.ravel().tolist()
    elif way == "roll":
        new = flat[1:] + flat[:1]
    elif way == "reverse":
        new = flat[::-1]
    elif way == "short":
        return value[:-1]
    else:
        factor = {"negative": -1.0, "zero": 0.0}.get(way, rng.choice([0.001, 0.1, 2.0, 10, 1000]))
        new = [factor * x for x in flat]
    if isinstance(value[0], list):
        width = len(value[0])
        return [new[i : i + width] for i in range(0, len(new), width)]
    return new


def _spoil_mat(path: Path, rng: Rng) -> str:
    """Change an array of a MATLAB file."""
    arrays = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}
    key = rng.choice(sorted(arrays))
    value = arrays[key].astype(float)
    way = rng.choice(
        ["delete", "nan", "inf", "zero", "negative", "scale", "transpose", "element", "text",
         "cell", "empty", "complex", "roll", "wide", "struct", "bool"]
    )  # fmt: skip
    if way == "delete":
        del arrays[key]
    elif way in ("nan", "inf", "element"):
        value.flat[rng.randrange(value.size)] = (
            float(way) if way != "element" else rng.choice(_NUMBERS[:10])
        )
        arrays[key] = value
    else:
        factor = {"zero": 0.0, "negative": -1.0}.get(
            way, rng.choice([1e-9, 0.001, 0.1, 2, 10, 1000])
        )
        arrays[key] = {
            "transpose": value.T,
            "text": np.array(["text"]),
            "cell": np.array([value, "x"], dtype=object),
            "empty": np.zeros((0, 0)),
            "complex": value + 1j,
            "roll": np.roll(value, 1, axis=0),
            "wide": np.tile(value, (1, 2) + (1,) * (value.ndim - 2)),
            "struct": {"a": value},
            "bool": value > 0,
        }.get(way, value * factor)
    scipy.io.savemat(path, arrays)
    return f"{key}: {way}"


def _spoil_image(path: Path, rng: Rng) -> str:
    """Change the pixels of an image, or of what its header says."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    way = rng.choice(
        ["zero", "full", "mirror", "flip", "tenth", "double", "transpose", "small", "pixel",
         "channels", "depth8", "depth16", "bomb", "noise", "shift", "invert", "half", "float"]
    )  # fmt: skip
    if way == "bomb":
        path.write_bytes(_png(30_000, 30_000))
        return "image: 30,000 x 30,000 pixels"
    if way == "float":
        done, data = cv2.imencode(".tiff", np.full(image.shape[:2], np.nan, np.float32))
        assert done
        path.write_bytes(data.tobytes())
        return "image: NaN"
    most = np.iinfo(image.dtype).max
    rows, columns = image.shape[:2]
    pixel = np.zeros_like(image)
    pixel[rows // 2, columns // 2] = image.max()
    half = image.copy()
    half[:, : columns // 2] = 0
    spread = image[..., None] if image.ndim == 2 else image[..., :1]
    new = {
        "zero": lambda: np.zeros_like(image),
        "full": lambda: np.full_like(image, rng.choice([most, image.max()])),
        "mirror": lambda: image[:, ::-1],
        "flip": lambda: image[::-1],
        "tenth": lambda: image // 10,
        "double": lambda: (image.astype(np.int64) * 2).clip(0, most).astype(image.dtype),
        "transpose": lambda: image.swapaxes(0, 1),
        "small": lambda: image[::2, ::2],
        "pixel": lambda: pixel,
        "channels": lambda: np.repeat(spread, 3, -1) if image.ndim == 2 else spread[..., 0],
        "depth8": lambda: (image / most * 255).astype(np.uint8),
        "depth16": lambda: image.astype(np.uint16),
        "noise": lambda: np.frombuffer(rng.randbytes(image.nbytes), image.dtype).reshape(
            image.shape
        ),
        "shift": lambda: np.roll(image, columns // 3, axis=1),
        "invert": lambda: most - image,
        "half": lambda: half,
    }[way]()
    cv2.imwrite(str(path), np.ascontiguousarray(new))
    return f"image: {way}"


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def _places(node: Any, where: str = "") -> Any:
    """Yield (holder, key, path) of every value below a node."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in list(pairs):
        yield node, key, f"{where}.{key}"
        if isinstance(value, dict | list):
            yield from _places(value, f"{where}.{key}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
