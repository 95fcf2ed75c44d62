"""Tracks: ViSP's model-based tracker and posefilter's on YCB-Video's photographs, in one run.

`bench/peers.py tracks` says how it is called. ViSP's tracker is told the true pose of the first
image; posefilter's finds it, and draws at random: its figures are means over seeds. ViSP's model of
a box is its oriented bounding box, of other objects the mesh with its vertices merged in cells of a
fifteenth of the diameter. All combinations of features are printed, none is chosen.
"""

import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from marked import format_row

import posefilter
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.sequences import SceneVideo, VideoFrame, list_scenes
from posefilter.meshes.mesh import Mesh, diameter
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import auc
from tracking import run_tracked

BOXES = ("003_cracker_box", "004_sugar_box", "009_gelatin_box")
FEATURES = {"dense depth": 8, "edges, depth": 9, "KLT, depth": 10, "edges, KLT, depth": 11}
WAYS = ("posefilter", *FEATURES)
HEAD = ("object", "scene", "frames", *(f"{way}: ADD AUC" for way in WAYS))
HEAD_S = ("object", "scene", "frames", *(f"{way}: ADD-S AUC" for way in WAYS))
HEAD_T = ("object", "scene", "frames", *(f"{way}: ms a frame" for way in WAYS))
CELLS = 15
SEEDS = 5  # of posefilter's tracker
# corners of the faces of a box, counter-clockwise from outside; a corner's bits are its sides
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def make_box(mesh: Mesh) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return the corners (8, 3) [m] and faces of a mesh's smallest box."""
    import trimesh

    box_from_mesh, extents = trimesh.bounds.oriented_bounds(mesh.vertices)
    mesh_from_box = np.linalg.inv(box_from_mesh)
    signs = np.array([[(i >> 2) & 1, (i >> 1) & 1, i & 1] for i in range(8)]) - 0.5
    corners = signs * extents @ mesh_from_box[:3, :3].T + mesh_from_box[:3, 3]
    return corners, [tuple(face) for face in SIDES]


def merge_vertices(mesh: Mesh, cells: int = CELLS) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return vertices (V, 3) [m] and triangles of a mesh whose vertices are merged in cells."""
    side = diameter(mesh.vertices) / cells
    cell = np.floor((mesh.vertices - mesh.vertices.min(0)) / side).astype(int)
    _, index, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    sums = [np.bincount(index, mesh.vertices[:, axis]) for axis in range(3)]
    vertices = np.stack(sums, axis=1) / count[:, None]
    faces = index[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # the same three corners once, in the order that they first have
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return vertices, [tuple(map(int, face)) for face in faces[np.sort(first)]]


def write_cao(path: Path, vertices: np.ndarray, faces: Sequence[tuple[int, ...]]) -> None:
    """Write a model in ViSP's CAO format."""
    lines = ["V1", str(len(vertices)), *(" ".join(f"{x:.6f}" for x in v) for v in vertices)]
    lines += ["0", "0", str(len(faces))]
    lines += [" ".join(map(str, (len(face), *face))) for face in faces]
    path.write_text("\n".join([*lines, "0", "0", ""]))


def write_sequence(path: Path, frames: Sequence[VideoFrame], start: np.ndarray) -> None:
    """Write images as worker_visp.cpp reads them.  start (4, 4) [m]."""
    height, width = frames[0].depth.shape
    K = frames[0].intrinsics
    with path.open("wb") as file:
        file.write(np.array([len(frames), height, width], np.int32).tobytes())
        file.write(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], float).tobytes())
        file.write(np.ascontiguousarray(start, float).tobytes())
        for frame in frames:
            file.write(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).tobytes())
            file.write(np.ascontiguousarray(frame.depth, np.float32).tobytes())


def run_visp(
    program: str, model: Path, sequence: Path, features: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses (T, 4, 4) [m], and the processor's seconds (T,).

    Raises:
        RuntimeError: The program failed.
    """
    words = [program, str(model), str(sequence), str(features)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    # ViSP says on the standard output what it read of a model
    lines = [line.split() for line in done.stdout.splitlines()]
    rows = [[float(x) for x in line] for line in lines if len(line) == 18 and _is_number(line[0])]
    if done.returncode or not rows:
        raise RuntimeError(f"{program}: {done.stderr.strip().splitlines()[-1:] or 'no output'}")
    told = np.array(rows)
    return told[:, :16].reshape(-1, 4, 4), told[:, 16]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def compare(
    program: str, name: str, mesh: Mesh, frames: Sequence[VideoFrame], folder: Path
) -> dict[str, tuple[float, float, float]]:
    """Return ADD AUC, ADD-S AUC and the median milliseconds of each way."""
    estimator = posefilter.load(name, device="cpu")
    estimator.predict(frames[0].rgb, frames[0].depth, frames[0].intrinsics)  # warm
    points = estimator.object_models[0].points.double()
    truth = torch.from_numpy(np.stack([frame.truth[name] for frame in frames]))
    tracked = [run_tracked(estimator, frames, seed=seed) for seed in range(SEEDS)]
    out = {WAYS[0]: [(np.stack([r.pose for r in results]), np.array(s)) for results, s in tracked]}
    model, sequence = folder / f"{name}.cao", folder / f"{name}.bin"
    write_cao(model, *(make_box(mesh) if name in BOXES else merge_vertices(mesh)))
    write_sequence(sequence, frames, frames[0].truth[name])
    for way, features in FEATURES.items():
        out[way] = [run_visp(program, model, sequence, features)]
    sequence.unlink()
    judged = {}
    for way, runs in out.items():
        scores = [
            [auc(error(torch.from_numpy(poses), truth, points)) for error in (add, add_s)]
            for poses, _ in runs
        ]
        plain, symmetric = np.mean(scores, axis=0).tolist()
        took = np.concatenate([took[1:] for _, took in runs])
        judged[way] = (plain, symmetric, 1000 * float(np.median(took)))
    return judged


def measure(
    program: str, frames: str, meshes: str, names: Sequence[str], folder: Path
) -> list[tuple[str, tuple[str, ...], list[str]]]:
    """Return the tables: ADD AUC, ADD-S AUC, milliseconds."""
    store = open_meshes(meshes, None, "ycb_video", list(names))
    reader = open_reader("ycb_video", frames, list(names), store, subsets=["data"])
    rows: list[tuple[list[str], dict[str, Any]]] = []
    for scene in list_scenes(reader):
        video = SceneVideo(reader, scene, names)
        every = list(video)
        for name in video.objects or ():
            begun = time.monotonic()
            judged = compare(program, name, store.load(name), every, folder)
            rows.append(([name, video.name, str(len(every))], judged))
            print(name, judged, f"{time.monotonic() - begun:.0f} s", flush=True)
    tables = []
    for title, head, column, digits in (
        ("tracks ADD", HEAD, 0, 1),
        ("tracks ADD-S", HEAD_S, 1, 1),
        ("tracks ms", HEAD_T, 2, 0),
    ):
        lines = [
            format_row([*first, *(f"{judged[way][column]:.{digits}f}" for way in WAYS)])
            for first, judged in rows
        ]
        tables.append((title, head, lines))
    return tables
