"""The comparison with peers counts what it says, and its programs answer or fail plainly."""

import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Generator

from posefilter.filters.loop import make_particles
from posefilter.filters.resample import Multinomial, Soft, Systematic
from posefilter.geometry.spaces import PixelSpace

Load = Callable[[str], ModuleType]


@pytest.fixture
def images(load_script: Load) -> ModuleType:
    return load_script("bench/peer_images.py")


@pytest.fixture
def clouds(load_script: Load) -> ModuleType:
    return load_script("bench/peer_clouds.py")


@pytest.fixture
def process(load_script: Load) -> ModuleType:
    return load_script("bench/peer_process.py")


def make_program(folder: Path, body: str) -> str:
    file = folder / "program.py"
    here = Path(__file__).parents[2] / "bench"
    start = f"import sys; sys.path.insert(0, {str(here)!r})\nfrom peer_process import serve\n"
    file.write_text(start + body)
    return str(file)


def test_a_program_answers_whatever_its_libraries_print(
    process: ModuleType, tmp_path: Path
) -> None:
    body = "def double(x):\n    print('noise')\n    return 2 * x\n"
    program = make_program(tmp_path, body + "serve({'versions': 'one'}, {'double': double})\n")
    with process.Peer(program) as peer:
        assert peer.about == {"versions": "one"}
        assert [peer.ask("double", x=x) for x in (1, 4)] == [2, 8]


def test_a_failure_of_a_program_is_told(process: ModuleType, tmp_path: Path) -> None:
    program = make_program(tmp_path, "serve({}, {'fail': lambda: 1 / 0})\n")
    with (
        process.Peer(program) as peer,
        pytest.raises(process.PeerError, match="ZeroDivisionError: division by zero"),
    ):
        peer.ask("fail")
    with pytest.raises(process.PeerError, match="ended without an answer"):
        process.Peer(make_program(tmp_path, "import sys; sys.exit(3)\n"))
    with pytest.raises(process.PeerError, match="cannot be run"):
        process.Peer(program, str(tmp_path / "no python"))


def test_pixels_become_the_points_that_project_to_them(clouds: ModuleType, tmp_path: Path) -> None:
    K = np.array([[500.0, 0, 31], [0, 510.0, 22], [0, 0, 1]])
    depth = np.zeros((48, 64), np.float32)
    depth[10, 20], depth[30, 40], depth[5, 5] = 0.8, 1.2, 3.0
    mask = np.zeros(depth.shape, bool)
    mask[30, 40] = True
    clouds.write_frame(tmp_path / "a.npz", clouds.Frame(depth, mask, K), truth=np.eye(4))
    frame = clouds.read_frame(str(tmp_path / "a.npz"))
    points = clouds.back_project(frame, masked=False)  # the third is too far away
    pixels = (points / points[:, 2:]) @ K.T
    np.testing.assert_allclose(pixels[:, :2], [[20, 10], [40, 30]], atol=1e-9)
    np.testing.assert_allclose(points[:, 2], [0.8, 1.2], atol=1e-6)
    assert clouds.back_project(frame, masked=True).shape == (1, 3)


def test_a_voxel_keeps_the_mean_of_its_points(clouds: ModuleType) -> None:
    points = np.array([[0.0, 0, 0], [0.4, 0, 0], [1.1, 0, 0], [0.1, 5.0, 2.2]])
    found = clouds.thin(points, 1.0)
    order = np.lexsort(found.T[::-1])
    np.testing.assert_allclose(found[order], [[0.1, 5.0, 2.2], [0.2, 0, 0], [1.1, 0, 0]])


def row(method: str, told: str, key: str, error: float, seconds: float) -> dict[str, Any]:
    errors = {"add": error, "add_s": error / 2, "diameter": 0.2}
    return {"title": "t", "method": method, "given": told, "key": key, "cpu": seconds} | errors


def test_ways_are_compared_on_the_images_that_all_have(images: ModuleType) -> None:
    rows = [row("pose_pf", "–", str(i), 0.004, 0.2) for i in range(4)]
    rows += [row("other", "mask", str(i), e, 1.0) for i, e in enumerate((0.03, 0.015, 0.5))]
    own, other = images.make_lines(rows, "t")
    assert own.startswith("| pose_pf | – | 3 | 100 | 100 | 100 | 100 | ")
    # 0.1 d is 2 cm; ADD below it in one of three, ADD-S in two
    assert other.startswith("| other | mask | 3 | 33 | 67 | 33 | 67 | ")
    assert other.endswith("| 1.00 | 5.0 |")
    assert images.make_lines(rows, "another") == []


def test_the_best_setting_of_validation_is_taken(images: ModuleType) -> None:
    first, second = images.PPF_TRIED[:2]
    rows = [row(f"PPF: {images.describe(first)}", "–", "1", 0.06, 1.0)]
    rows += [row(f"PPF: {images.describe(second)}", "–", "1", 0.02, 1.0)]
    rows += [row(f"PPF: {images.describe(first)}", "mask", "1", 0.01, 1.0)]
    rows += [row(f"PPF: {images.describe(second)}", "mask", "1", 0.9, 1.0)]
    assert images.choose(rows, "PPF", masked=False) == second
    assert images.choose(rows, "PPF", masked=True) == first
    assert images.choose([], "PPF", masked=True) == first


def test_what_is_measured_is_not_measured_again(images: ModuleType, tmp_path: Path) -> None:
    asked: list[str] = []

    def estimate(case: Any) -> tuple[np.ndarray, float, float]:
        asked.append(case.key)
        return case.image.truth, 0.5, 0.4

    image = images.Image(None, None, None, np.eye(4))
    cases = [images.Case(k, "003_cracker_box", "s", image, ("", "")) for k in ("a", "b")]
    way, file = images.Way("w", False, estimate), tmp_path / "rows.jsonl"
    assert len(images.measure([way], cases[:1], file, "t")) == 1
    rows = images.measure([way], cases, file, "t")
    assert asked == ["a", "b"]
    assert [(one["key"], one["add"]) for one in rows] == [("a", 0.0), ("b", 0.0)]
    assert rows == [json.loads(line) for line in file.read_text().splitlines()]
    assert images.measure([way], cases, file, "u", until=-math.inf) == rows


def test_filter_cores_are_compared_pair_by_pair(load_script: Load) -> None:
    filters = load_script("bench/peer_filters.py")
    ours = [{"seconds": s, "evidence": -3.0} for s in (0.1, 0.2, 0.1)]
    theirs = [{"seconds": s, "evidence": -3.2} for s in (0.3, 0.2, 0.2)]
    own, other = filters.make_lines(1000, 10, {"posefilter": ours, "slow": theirs})
    assert own == "| 1,000 | posefilter | 0.10 | 1 | – | – | -3.0 |"
    assert other == "| 1,000 | slow | 0.05 | 2.0 | 1.0 | 3.0 | -3.2 |"


def test_the_peer_task_is_that_of_the_filter(load_script: Load) -> None:
    """The log evidence of many particles is that of fewer, up to their noise."""
    worker = load_script("bench/worker_posefilter.py")
    few = [worker.run(2000, 10, seed)["evidence"] for seed in range(3)]
    assert abs(np.mean(few) - worker.run(20_000, 10, 5)["evidence"]) < 0.5


def test_operations_of_the_likelihood_are_counted(load_script: Load) -> None:
    roofline = load_script("bench/roofline.py")
    from posefilter.nets.layers import ResnetFC

    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.enter, self.leave = torch.nn.Linear(7, 5), torch.nn.Linear(5, 1)
            self.blocks = torch.nn.ModuleList([ResnetFC(5)])

    assert roofline.count_operations(Net()) == 2 * (7 * 5 + 2 * 5 * 5 + 5)


def test_seconds_of_an_inner_function_are_its_own(load_script: Load) -> None:
    roofline = load_script("bench/roofline.py")
    names = ModuleType("names")
    names.inner = lambda: sum(range(400_000))  # type: ignore[attr-defined]
    names.outer = lambda: [names.inner() for _ in range(3)]  # type: ignore[attr-defined]
    plain, recorder = names.outer, roofline.Recorder()
    recorder.watch(names, "inner", "in")
    recorder.watch(names, "outer", "out")
    names.outer()
    recorder.close()
    assert names.outer is plain
    assert recorder.seconds["in"] > 5 * recorder.seconds["out"] >= 0


@pytest.fixture
def pydpf(process: ModuleType) -> Any:
    python = os.environ.get("POSEFILTER_PYDPF")
    if python is None:
        pytest.skip("POSEFILTER_PYDPF does not name the interpreter that has pydpf")
    with process.Peer("worker_pydpf.py", python) as peer:
        yield peer


@pytest.mark.parametrize("scheme", ["systematic", "soft", "multinomial"])
def test_resamplers_are_those_of_pydpf(pydpf: Any, scheme: str) -> None:
    log_weights = torch.randn(3, 64, generator=Generator().manual_seed(3)).double()
    log_weights = (2 * log_weights).log_softmax(1)
    particles = make_particles(torch.zeros(3, 64, 2, dtype=torch.float64), 0)
    particles = particles._replace(log_weights=log_weights)
    own = {"systematic": Systematic(), "soft": Soft(0.5), "multinomial": Multinomial()}[scheme]
    if scheme == "multinomial":  # other draws of the same law: 2,000 rows each
        many = log_weights[:1].expand(2000, -1)
        told = pydpf.ask("resample", scheme=scheme, log_weights=many.tolist(), seed=1)
        more = particles._replace(log_weights=many, state=torch.zeros(2000, 64, 2))
        ours = own(more, 64, PixelSpace(), Generator().manual_seed(2)).ancestors
        shares = [
            torch.bincount(x.flatten(), minlength=64) / x.numel()
            for x in (ours, torch.tensor(told["ancestors"]))
        ]
        torch.testing.assert_close(shares[0], shares[1], rtol=0, atol=0.004)
        return
    told = pydpf.ask("resample", scheme=scheme, log_weights=log_weights.tolist(), seed=7)
    ours = own(particles, 64, PixelSpace(), Generator().manual_seed(7))
    assert ours.ancestors.tolist() == told["ancestors"]
    theirs = torch.tensor(told["log_weights"], dtype=torch.float64)
    if scheme == "soft":  # ours are normalized
        theirs = theirs.log_softmax(1)
    torch.testing.assert_close(ours.log_weights, theirs, rtol=0, atol=1e-6)


def test_a_missing_peer_is_said_to_be_left_out(
    load_script: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    peers = load_script("bench/peers.py")
    from argparse import Namespace
    from contextlib import ExitStack

    options = Namespace(python_pydpf=None, python_particles=sys.executable + "x", threads=1)
    with ExitStack() as stack:
        assert peers.start_peers(options, ("pydpf",), stack) == {"pydpf": None}
        assert "pydpf: left out, give --python-pydpf" in capsys.readouterr().out
        with pytest.raises(peers.PeerError, match="cannot be run"):
            peers.start_peers(options, ("particles",), stack)


def test_faces_of_tracked_models_look_outwards(load_script: Load, tmp_path: Path) -> None:
    tracks = load_script("bench/peer_tracks.py")
    from posefilter.meshes.store import MeshStore

    mesh = MeshStore("builtin").load("carton")
    for vertices, faces in (tracks.make_box(mesh), tracks.merge_vertices(mesh)):
        assert len(faces) >= 6
        middle = vertices.mean(0)
        for face in faces:
            a, b, c = (vertices[i] for i in face[:3])
            assert np.cross(b - a, c - b) @ (a - middle) > 0
    vertices, faces = tracks.make_box(mesh)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), np.ptp(mesh.vertices, axis=0), rtol=0.02)
    tracks.write_cao(tmp_path / "a.cao", vertices, faces)
    lines = (tmp_path / "a.cao").read_text().splitlines()
    assert lines[:2] == ["V1", "8"]
    assert lines[10:13] == ["0", "0", "6"]
    assert [line.split()[0] for line in lines[13:19]] == ["4"] * 6


def test_a_failing_tracker_is_told(load_script: Load, tmp_path: Path) -> None:
    tracks = load_script("bench/peer_tracks.py")
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho cut off >&2\nexit 1\n")
    program.chmod(0o755)
    with pytest.raises(RuntimeError, match="cut off"):
        tracks.run_visp(str(program), tmp_path / "m", tmp_path / "s", 8)
    numbers = " ".join(["1"] * 16)
    program.write_text(f"#!/bin/sh\necho reading the model\necho {numbers} 0.25 1\n")
    poses, seconds = tracks.run_visp(str(program), tmp_path / "m", tmp_path / "s", 8)
    assert poses.shape == (1, 4, 4)
    assert seconds.tolist() == [0.25]
