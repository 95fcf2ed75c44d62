"""Find several instances of an object in rendered scenes: how many are found, and at what cost.

    python generate.py out=DIR frames=36 meshes=MESHES object=003_cracker_box instances=3 seed=4242
        lookalike_texture=same
    python bench/instances.py --root DIR --meshes MESHES --object 003_cracker_box [--limit 36]
        [--classes 5] [--draw FOLDER] [--out FILE.json]

A frame counts in the first table where every instance is visible to more than `--visible`. An
instance is found where a result, matched to it, has an ADD below 0.1 diameters up to the object's
symmetries; results are matched by falling probability, each to the nearest instance that is free.
Of these the beliefs are measured: how far the estimate is off, what the belief says of that, and
how often its ellipsoids hold the truth.
The cost is the processor's time of a call that asks for all instances over that of one that asks
for the one object; with `--classes`, also that of a call for so many objects whose weights ship.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from confidence import degrees_of, list_frames, measure_error, summarize_errors

import posefilter
from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.figures.canvas import save_image
from posefilter.figures.detections import Drawn, draw_detections
from posefilter.metrics.bop_results import PoseRow, choose_score, to_native, write_poses_csv
from posefilter.metrics.errors import add_up_to_symmetry
from posefilter.metrics.matching import match_greedily
from posefilter.weights import list_shipped


def take_time(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a call returns, and the seconds of one processor that it took: what else the
    machine does counts for nothing.
    """
    start = time.process_time()
    value = call()
    return value, time.process_time() - start


def measure_errors(results: list[Any], truths: list[np.ndarray]) -> np.ndarray:
    """Return the ADD of each result against each truth, in diameters, (R, T)."""
    out = np.full((len(results), len(truths)), np.inf)
    for r, result in enumerate(results):
        object_model, pose = result.object_model, torch.from_numpy(result.pose)
        for t, truth in enumerate(truths):
            error = add_up_to_symmetry(
                pose[None],
                torch.from_numpy(truth)[None],
                object_model.points,
                object_model.symmetries,
            )
            out[r, t] = float(error) / object_model.diameter
    return out


def judge(
    estimator: posefilter.Estimator, samples: list[Sample], shares: list[float], seed: int
) -> tuple[dict[str, Any], list[Any]]:
    """Return what is found in a frame, and the results."""
    image = (samples[0].rgb, samples[0].depth, samples[0].intrinsics.astype(np.float64))
    wanted = len(samples)
    results, several = take_time(lambda: estimator.predict(*image, instances=wanted, seed=seed))
    _, one = take_time(lambda: estimator.predict(*image, seed=seed))
    truths = [s.camera_from_object.astype(np.float64) for s in samples]
    pairs = match_greedily(measure_errors(results, truths), 0.1)
    degrees = degrees_of(estimator.methods[0])
    beliefs = [
        measure_error(results[r].belief, results[r].pose, truths[t], degrees) for r, t in pairs
    ]
    overlap = sum(one.mask.astype(int) for one in results).max() if results else 0
    return {
        "instances": wanted,
        "visible": shares,
        "found": sorted(t for _, t in pairs),
        "beliefs": beliefs,
        "results": len(results),
        "declared": sum(one.verdict == "found" for one in results),
        "declared_right": sum(results[r].verdict == "found" for r, _ in pairs),
        "most_claims_of_a_pixel": int(overlap),
        "seconds": several,
        "seconds_one": one,
    }, results


def list_lines(
    results: list[Any], record: FrameRecord, reader: BaseReader, seconds: float
) -> list[PoseRow]:
    """Return the results of a frame in BOP's format."""
    native, ids = reader.native_from_mesh(record.object), (record.scene_id, record.im_id)
    scores = [choose_score(one.probability, one.score) for one in results]
    return [
        PoseRow(*ids, record.obj_id, score, to_native(one.pose, native), seconds)
        for one, score in zip(results, scores, strict=True)
    ]


def summarize(rows: list[dict[str, Any]], visible: float) -> dict[str, Any]:
    """Return the figures of all frames."""
    clear = [row for row in rows if min(row["visible"]) > visible]
    seen = [(v, k in row["found"]) for row in rows for k, v in enumerate(row["visible"])]
    many = [found for v, found in seen if v > visible]
    share = lambda part: 100 * sum(part) / len(part) if part else float("nan")  # noqa: E731
    own = [one for row in rows for one in row["beliefs"]]
    found = summarize_errors(own)._asdict() if own else {}
    return {
        "frames": len(rows),
        "clear_frames": len(clear),
        "all_found_of_clear": share([len(r["found"]) == r["instances"] for r in clear]),
        "instances_visible": len(many),
        "instances_found": share(many),
        "declared": sum(r["declared"] for r in rows),
        "declared_right": sum(r["declared_right"] for r in rows),
        "most_claims_of_a_pixel": max(r["most_claims_of_a_pixel"] for r in rows),
        "seconds_several": statistics.median(r["seconds"] for r in rows),
        "seconds_one": statistics.median(r["seconds_one"] for r in rows),
        "cost": statistics.median(r["seconds"] / r["seconds_one"] for r in rows),
        "beliefs": len(own),
        **{f"beliefs_{key}": value.round(1).tolist() for key, value in found.items()},
    }


def time_classes(count: int, first: str, images: list[tuple[Any, ...]]) -> dict[str, Any]:
    """Return the cost of a call for several classes over that of a call for the first alone."""
    names = [first, *(name for name in list_shipped() if name != first)][:count]
    several, one = posefilter.load(names, device="cpu"), posefilter.load(first, device="cpu")
    costs = []
    for image in images:
        _, alone = take_time(partial(one.predict, *image))
        _, all_of_them = take_time(partial(several.predict, *image, instances=1))
        costs.append(all_of_them / alone)
    return {"classes": names, "frames": len(costs), "cost": statistics.median(costs)}


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--root", required=True)
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--object", default="003_cracker_box")
    parser.add_argument("--weights", default=None, help="a checkpoint; else the one that ships")
    parser.add_argument("--limit", type=int, default=None)
    parser.add_argument("--visible", type=float, default=0.5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--classes", type=int, default=0)
    parser.add_argument("--draw", default=None, help="folder of a picture a frame")
    parser.add_argument("--csv", default=None, help="a file of all results in BOP's format")
    parser.add_argument("--out", default=None)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    estimator = posefilter.load(options.weights or options.object, device="cpu")
    meshes = open_meshes(options.meshes, None, "fat", options.object)
    reader = open_reader("fat", options.root, options.object, meshes)
    rows, images, lines = list[dict[str, Any]](), list[tuple[Any, ...]](), list[PoseRow]()
    for number, own in enumerate(list_frames(reader)[: options.limit]):
        samples = [reader.read(i) for i in own]
        shares = [reader.visible_share(sample) for sample in samples]
        row, results = judge(estimator, samples, shares, options.seed)
        rows.append(row)
        records = reader.records()
        lines += list_lines(results, records[own[0]], reader, row["seconds"])
        images.append((samples[0].rgb, samples[0].depth, samples[0].intrinsics))
        print(json.dumps({"frame": number, **row}), flush=True)
        if options.draw:
            mesh = meshes.load(options.object)
            marks = [
                Drawn(
                    one.describe(),
                    one.pose,
                    mesh,
                    f"{one.probability or 0:.2f}",
                    one.verdict == "unsure",
                )
                for one in results
            ]
            picture = draw_detections(samples[0].rgb, samples[0].intrinsics, marks)
            save_image(picture, Path(options.draw) / f"{number:03d}.png")
    if options.csv:
        write_poses_csv(Path(options.csv), lines)
    summary = summarize(rows, options.visible)
    if options.classes:
        summary["classes"] = time_classes(options.classes, options.object, images[:5])
    print(json.dumps(summary, indent=1))
    if options.out:
        Path(options.out).write_text(json.dumps({"summary": summary, "frames": rows}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
