"""Write a trained filter as networks that run without posefilter, and its settings."""

import io
import json
import logging
import warnings
from collections.abc import Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from posefilter.data.resize import network_size
from posefilter.deploy.graphs import EncodeForPixels, EncodeForPoses, MeasurePixels, ScorePoses
from posefilter.deploy.resizing import Resize
from posefilter.deploy.settings import describe_filter
from posefilter.errors import UserError, missing_package
from posefilter.estimator import get_trained_size
from posefilter.files import write_whole
from posefilter.filters.initialize import FromObjectness
from posefilter.models.base import PoseEstimator
from posefilter.models.image_space import ImageSpace
from posefilter.models.pose_pf import PosePF
from posefilter.precision import in_float32

FORMATS = ("onnx", "torch")
OPSET = 18


class Graph(NamedTuple):
    """A network to be traced, with inputs to trace it on."""

    network: nn.Module
    inputs: tuple[Any, ...]
    dynamic: tuple[Any, ...] | None  # axes whose size may vary, for torch.export


class Graphs(NamedTuple):
    """The two networks of a filter."""

    encode: Graph
    measure: Graph
    size: tuple[int, int]  # height and width of the network's image [px]


def check_format(kind: str) -> None:
    """Check that a format is known, and that what writes it is installed.

    Raises:
        UserError: It is not.
    """
    if kind not in FORMATS:
        raise UserError(f"format={kind}: choose weights, {', '.join(FORMATS)}")
    missing = [one for one in ("onnx", "onnxscript") if kind == "onnx" and find_spec(one) is None]
    if missing:
        raise missing_package("format=onnx", missing[0], "export")


@in_float32
def write_filter(method: PoseEstimator, folder: Path, width: int, height: int, kind: str) -> float:
    """Write `encode` and `measure`, and filter.json.

    Args:
        method: The trained method, with its object.
        folder: Where to write.
        width: Of the camera's images [px].
        height: Of the camera's images [px].
        kind: "onnx", or "torch" for programs of torch.export.

    Returns:
        The files' size [MB].

    Raises:
        UserError: The method, or a component of its filter, cannot be exported.
    """
    check_format(kind)
    settings = describe_filter(method)
    graphs = make_graphs(method, width, height)
    settings |= {"camera": [width, height], "network": [graphs.size[1], graphs.size[0]]}
    files = {"filter.json": (json.dumps(settings, indent=1) + "\n").encode()}
    for name, graph in (("encode", graphs.encode), ("measure", graphs.measure)):
        file = f"{name}.{'onnx' if kind == 'onnx' else 'pt2'}"
        files[file] = to_onnx(graph) if kind == "onnx" else to_program(graph)
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        write_whole(folder / file, content, sync=True)
    return sum(map(len, files.values())) / 1e6


def make_graphs(method: PoseEstimator, width: int, height: int) -> Graphs:
    """Return a method's networks for images of a camera of width x height [px]."""
    trained = get_trained_size(method.recipe.get("settings", {}))
    resize = Resize((height, width), network_size(height, width, *trained))
    rgb = torch.zeros(height, width, 3, dtype=torch.uint8)
    depth, K = torch.ones(height, width), torch.eye(3)
    K[0, 0] = K[1, 1] = float(width)
    K[:2, 2] = torch.tensor([width / 2, height / 2])
    image = (rgb, depth, K)
    count = torch.export.Dim("particles", min=1)
    method = method.cpu().eval()
    with torch.no_grad():
        if isinstance(method, PosePF):
            encode: nn.Module = EncodeForPoses(method, resize)
            measure: nn.Module = ScorePoses(method, resize.after)
            poses = torch.eye(4).repeat(3, 1, 1)
            poses[:, 2, 3] = 1.0
            points = torch.export.Dim("points", min=1)
            found = encode.eval()(*image)[:5]
            inputs: tuple[Any, ...] = (poses, torch.tensor(0.01), torch.zeros(5, 2), *found)
            dynamic: tuple[Any, ...] = ({0: count}, None, {0: points}, *[None] * 5)
        else:
            assert isinstance(method, ImageSpace)
            strides, drawn = _find_strides(method, resize, image)
            encode = EncodeForPixels(method, resize, len(strides), drawn)
            measure = MeasurePixels(method, strides)
            found = encode.eval()(*image)
            levels = found[3 : 3 + len(strides)]
            state, latent = torch.zeros(3, 2), torch.zeros(3, method.latent_width)
            inputs = (state, latent, *found[:3], levels)
            dynamic = ({0: count}, {0: count}, None, None, None, tuple(None for _ in levels))
    return Graphs(Graph(encode, image, None), Graph(measure.eval(), inputs, dynamic), resize.after)


def _find_strides(
    method: ImageSpace, resize: Resize, image: tuple[Tensor, Tensor, Tensor]
) -> tuple[tuple[int, ...], bool]:
    """Return the strides of the encoder's maps, and whether its objectness draws particles."""
    color, z, K = resize(*image)
    strides = method.encoder(color, z, K).strides
    start = method.filter.initialize
    start = getattr(start, "initializer", start)
    return strides, isinstance(start, FromObjectness)


def trace(graph: Graph) -> torch.export.ExportedProgram:
    """Return a network as a program of torch.export, in float32."""
    with torch.no_grad(), _quietly():
        return torch.export.export(
            graph.network, graph.inputs, dynamic_shapes=graph.dynamic, strict=False
        )


def to_program(graph: Graph) -> bytes:
    """Return a traced network as torch.export saves it."""
    content = io.BytesIO()
    torch.export.save(trace(graph), content)
    return content.getvalue()


def to_onnx(graph: Graph) -> bytes:
    """Return a traced network as ONNX, its inputs and outputs by name."""
    network = graph.network
    names: tuple[Sequence[str], Sequence[str]] = (network.inputs, network.outputs)  # type: ignore[assignment]
    with torch.no_grad(), _quietly():
        program = torch.onnx.export(
            trace(graph), (), dynamo=True, opset_version=OPSET, external_data=False, verbose=False,
            input_names=list(names[0]), output_names=list(names[1]),
        )  # fmt: skip
    assert program is not None
    return bytes(program.model_proto.SerializeToString())


@contextmanager
def _quietly() -> Any:
    """Leave out what the exporters say of packages and interfaces that are not used here."""
    before = logging.root.manager.disable
    # onnx_ir, which onnxscript optimizes with, logs every constant that it merges
    logging.disable(logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            logging.disable(before)
