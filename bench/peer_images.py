"""Single images: Open3D, OpenCV's PPF and `pose_pf` on the same frames, in one run.

`bench/peers.py images` says how it is called. Each program runs in an environment of its own and
waits while another computes, so that all have the machine to themselves. Results are lines of a
file: started again, what is there is not measured again.
"""

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from held_out import LEAST, SPLIT
from marked import format_row
from peer_clouds import Frame, write_frame, write_model
from peer_process import Peer

import posefilter
from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.splits import split_records
from posefilter.meshes.mesh import sample_surface, surface_points
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import auc, recall

MODEL_POINTS = 20_000  # of the mesh, that the peers are given
HEAD = ("method", "given", "frames", "ADD < 0.1 d %", "ADD-S < 0.1 d %", "ADD < 2 cm %")
HEAD += ("ADD-S < 2 cm %", "ADD AUC", "ADD-S AUC", "median s", "ratio")
OWN = "pose_pf"
Settings = dict[str, Any]
Shown = tuple[str, str, Sample]  # object, scene, image

# what was tried on validation renders, each with the mask and without
OPEN3D_TRIED: tuple[Settings, ...] = (
    {"voxel": 0.005, "iterations": 100_000, "mutual": False, "planes": 0},
    {"voxel": 0.005, "iterations": 100_000, "mutual": True, "planes": 0},
    {"voxel": 0.003, "iterations": 100_000, "mutual": False, "planes": 0},
    {"voxel": 0.008, "iterations": 400_000, "mutual": False, "planes": 0},
    {"voxel": 0.005, "iterations": 100_000, "mutual": False, "planes": 1},
)
PPF_TRIED: tuple[Settings, ...] = (
    {"step": 0.1, "share": 0.2, "best": 10, "pick": "support"},
    {"step": 0.1, "share": 0.2, "best": 1, "pick": "votes"},
    {"step": 0.1, "share": 0.5, "best": 10, "pick": "support"},
    {"step": 0.08, "share": 0.2, "best": 10, "pick": "support"},
)
TRIED = {"Open3D": OPEN3D_TRIED, "PPF": PPF_TRIED}


class Image(NamedTuple):
    """An image, and where the object is in it."""

    rgb: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray  # (H, W) [m]
    intrinsics: np.ndarray  # (3, 3) [px]
    truth: np.ndarray  # (4, 4) camera_from_object [m]


class Case(NamedTuple):
    """An object in an image, as all methods are asked for it."""

    key: str
    object: str
    scene: str
    image: Image
    files: tuple[str, str]  # of the model and the image, for programs elsewhere


class Way(NamedTuple):
    """A way to estimate a pose."""

    method: str
    masked: bool
    estimate: Callable[[Case], tuple[np.ndarray, float, float]]  # pose, seconds, processor's


def read_photographs(root: str, meshes: str, names: Sequence[str], max_images: int) -> list[Shown]:
    """Return YCB-Video's photographs that show the objects, in order, at most so many of each."""
    store = open_meshes(meshes, None, "ycb_video", list(names))
    reader = open_reader("ycb_video", root, list(names), store, subsets=["data"])
    every = range(len(reader.records()))
    return [
        (name, record.group, sample)
        for name in names
        for record, sample in islice(_read(reader, every, name, 0.0), max_images)
    ]


def read_renders(
    root: str, meshes: str, names: Sequence[str], max_images: int, part: str
) -> list[Shown]:
    """Return renders that show the objects, of the split of bench/held_out.py."""
    reader = open_reader("fat", root, None, open_meshes(meshes, None, "fat", list(names)))
    chosen = split_records(reader.records(), SPLIT, 0, Path(root))[part]
    out = []
    for name in names:
        own = [i for i in chosen if reader.records()[i].object == name]
        order = np.random.default_rng(0).permutation(own)
        found = islice(_read(reader, map(int, order), name, LEAST), max_images)
        out += [(name, record.name.rsplit("/", 1)[0], sample) for record, sample in found]
    return out


def _read(
    reader: Any, order: Iterable[int], name: str, least: float
) -> Iterator[tuple[FrameRecord, Sample]]:
    """Yield what shows an object, of which a share of `least` is visible."""
    for index in order:
        record = reader.records()[index]
        if record.object != name:
            continue
        try:
            sample = reader.read(index)
        except NotShown:
            continue
        if not least or reader.visible_share(sample) >= least:
            yield record, sample


def write_cases(folder: Path, found: Sequence[Shown], store: Any) -> None:
    """Write images and models to a folder, from which every program reads them."""
    folder.mkdir(parents=True)
    index = []
    for name in dict.fromkeys(name for name, _, _ in found):
        write_model(folder / f"{name}.npz", *draw_model(store, name))
    for number, (name, scene, sample) in enumerate(found):
        K, truth = sample.intrinsics.astype(float), sample.camera_from_object.astype(float)
        frame = Frame(sample.depth, sample.mask > 0, K)
        write_frame(folder / f"{number}.npz", frame, rgb=sample.rgb, truth=truth)
        index.append({"file": f"{number}.npz", "object": name, "scene": f"{name}/{scene}"})
    (folder / "index.json").write_text(json.dumps(index))


def read_cases(folder: Path, only: Sequence[str] = ()) -> list[Case]:
    """Return the cases of a folder; of some objects alone if they are named."""
    cases = []
    for row in json.loads((folder / "index.json").read_text()):
        if only and row["object"] not in only:
            continue
        path, model = folder / row["file"], folder / f"{row['object']}.npz"
        with np.load(path) as data:
            image = Image(data["rgb"], data["depth"], data["intrinsics"], data["truth"])
        files = (str(model), str(path))
        cases.append(Case(row["file"], row["object"], row["scene"], image, files))
    seen: Counter[str] = Counter()
    turns = []
    for case in cases:
        turns.append(seen[case.object])
        seen[case.object] += 1
    # the objects by turns, so that a run that is stopped has as many images of each
    return [case for _, case in sorted(zip(turns, cases, strict=True), key=lambda pair: pair[0])]


def draw_model(store: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a mesh's surface (P, 3) [m], and their outward normals (P, 3)."""
    mesh = store.load(name)
    face, weights = sample_surface(mesh, MODEL_POINTS)
    corners = mesh.vertices[mesh.faces[face]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    return surface_points(mesh, face, weights), normals


def make_peer_way(method: str, peer: Peer, masked: bool, settings: Settings) -> Way:
    """Return a way that asks a peer's program."""

    def estimate(case: Case) -> tuple[np.ndarray, float, float]:
        model, frame = case.files
        told = peer.ask("estimate", model=model, frame=frame, masked=masked, **settings)
        return np.array(told["pose"]), told["seconds"], told["cpu"]

    return Way(method, masked, estimate)


def make_own_way(names: Iterable[str]) -> Way:
    """Return `pose_pf` with the weights that ship."""
    estimators = {name: posefilter.load(name, device="cpu") for name in dict.fromkeys(names)}

    def estimate(case: Case) -> tuple[np.ndarray, float, float]:
        estimator, image = estimators[case.object], case.image
        wall, cpu = time.perf_counter(), time.process_time()
        result = estimator.predict(image.rgb, image.depth, image.intrinsics)
        return result.pose, time.perf_counter() - wall, time.process_time() - cpu

    return Way(OWN, False, estimate)


def measure(
    ways: Sequence[Way], cases: Sequence[Case], file: Path, title: str, until: float = math.inf
) -> list[dict[str, Any]]:
    """Run every way on every case, by turns; return the rows of the file that belong to them.

    Args:
        ways: The ways.
        cases: The cases.
        file: Lines of results, read first and added to.
        title: What the results are of, such as "photographs"; others of the file are left alone.
        until: Stop before this time (`time.monotonic`), to be started again.
    """
    rows = read_rows(file)
    done = {(row["title"], row["method"], row["given"], row["key"]) for row in rows}
    models: dict[str, Any] = {}
    for case in cases:
        for way in ways:
            told = "mask" if way.masked else "–"
            if (title, way.method, told, case.key) in done:
                continue
            if time.monotonic() > until:
                return rows
            if case.object not in models:
                models[case.object] = posefilter.load(case.object, device="cpu").object_models[0]
            pose, seconds, cpu = way.estimate(case)
            row = {"title": title, "method": way.method, "given": told, "key": case.key}
            row |= {"object": case.object, "scene": case.scene, "seconds": seconds, "cpu": cpu}
            row |= judge(pose, case.image.truth, models[case.object])
            rows.append(row)
            with file.open("a") as lines:
                lines.write(json.dumps(row) + "\n")
    return rows


def read_rows(file: Path) -> list[dict[str, Any]]:
    """Return the results of a file, none if it is not there."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


def judge(pose: np.ndarray, truth: np.ndarray, model: Any) -> dict[str, float]:
    """Return the errors of a pose (4, 4) [m], and the object's diameter."""
    guess = torch.from_numpy(np.asarray(pose, dtype=float))[None]
    right = torch.from_numpy(truth)[None]
    plain, symmetric = (float(f(guess, right, model.points.double())) for f in (add, add_s))
    return {"add": plain, "add_s": symmetric, "diameter": model.diameter}


def summarize(rows: Sequence[dict[str, Any]], own_seconds: float) -> str:
    """Return the line of the table of one way."""
    diameter = torch.tensor([row["diameter"] for row in rows])
    errors = [torch.tensor([row[kind] for row in rows]).double() for kind in ("add", "add_s")]
    cells = [f"{recall(error, 0.1 * diameter):.0f}" for error in errors]
    cells += [f"{recall(error, 0.02):.0f}" for error in errors]
    cells += [f"{auc(error):.1f}" for error in errors]
    seconds = float(np.median([row["cpu"] for row in rows]))
    ratio = seconds / own_seconds  # not a number where posefilter was not asked
    cells += [f"{seconds:.2f}", "–" if math.isnan(ratio) else f"{ratio:.1f}"]
    return format_row([rows[0]["method"], rows[0]["given"], str(len(rows)), *cells])


def make_lines(rows: Sequence[dict[str, Any]], title: str) -> list[str]:
    """Return the table of a title: a line a way, over the cases that all of them have."""
    groups: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in rows:
        if row["title"] == title:
            groups.setdefault((row["method"], row["given"]), {})[row["key"]] = row
    if not groups:
        return []
    common = set.intersection(*(set(group) for group in groups.values()))
    kept = {
        way: [row for key, row in group.items() if key in common] for way, group in groups.items()
    }
    own = kept.get((OWN, "–"))
    seconds = float(np.median([row["cpu"] for row in own])) if own and common else math.nan
    return [summarize(group, seconds) for group in kept.values() if group]


def choose_few(cases: Sequence[Case], max_cases: int) -> list[Case]:
    """Return the first cases of each object."""
    names = dict.fromkeys(case.object for case in cases)
    return [
        case for name in names for case in [one for one in cases if one.object == name][:max_cases]
    ]


def choose(rows: Sequence[dict[str, Any]], method: str, masked: bool) -> Settings:
    """Return the setting of the greatest mean of 1 - ADD-S / 0.1 m (0 beyond) on validation
    renders; the first where none has been measured.
    """
    told = "mask" if masked else "–"
    found = []
    for settings in TRIED[method]:
        own = [
            row["add_s"]
            for row in rows
            if row["given"] == told and row["method"] == f"{method}: {describe(settings)}"
        ]
        if own:
            gain = (1 - torch.tensor(own).double() / 0.1).clamp_min(0).mean()
            found.append((float(gain), settings))
    return max(found, key=lambda pair: pair[0])[1] if found else TRIED[method][0]


def list_ways(
    programs: dict[str, Peer | None], tuned: Sequence[dict[str, Any]], tuning: bool
) -> list[Way]:
    """Return the ways of the peers: as chosen by results of tuning, or with every setting that is
    tried.
    """
    ways = []
    for method, peer in programs.items():
        if peer is None:
            continue
        for masked in (False, True):
            if not tuning:
                chosen = choose(tuned, method, masked)
                print(f"{method}, {'mask' if masked else 'whole'}: {describe(chosen)}", flush=True)
                ways.append(make_peer_way(method, peer, masked, chosen))
                continue
            for settings in TRIED[method]:
                if masked and settings.get("planes"):
                    continue  # planes are removed from whole clouds alone
                way = make_peer_way(method, peer, masked, settings)
                ways.append(way._replace(method=f"{method}: {describe(settings)}"))
    return ways


def describe(settings: Settings) -> str:
    """Return settings in words."""
    return ", ".join(f"{key} {value}" for key, value in settings.items())
