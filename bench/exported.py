"""Exported filters against PyTorch on YCB-Video's photographs: do they give the same poses?

    python bench/exported.py DIR --checkpoint 003_cracker_box --frames DIR --meshes DIR

DIR is what `export.py format=onnx` wrote of the checkpoint, a pose_pf. Each frame is estimated
three times: by PyTorch with two seeds, and by examples/onnx/poses.py. The two seeds tell how far
apart estimates are that differ in their random numbers alone. Times are the processor's.
"""

import sys
import time

import numpy as np
import torch
from programs import HOME, make_parser

import posefilter
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.sequences import SceneVideo, list_scenes
from posefilter.metrics.errors import add
from posefilter.metrics.scores import auc

WAYS = ("torch, seed 0", "torch, seed 1", "ONNX Runtime")


def main() -> None:
    """Measure, and print a table."""
    parser = make_parser(__doc__)
    parser.add_argument("folder")
    parser.add_argument("--checkpoint", default="003_cracker_box")
    parser.add_argument("--frames", required=True)
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--scene", default="0001")
    parser.add_argument("--stride", type=int, default=1)
    typed = parser.parse_args()
    sys.path.insert(0, str(HOME / "examples" / "onnx"))
    from poses import PoseFilter

    torch.set_num_threads(1)
    estimator = posefilter.load(typed.checkpoint, device="cpu")
    (model,) = estimator.object_models
    meshes = open_meshes(typed.meshes, 1.0, "ycb_video", [model.name])
    reader = open_reader("ycb_video", typed.frames, None, meshes, "raise")
    exported = PoseFilter(typed.folder)
    poses: dict[str, list[np.ndarray]] = {name: [] for name in WAYS}
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    truth = []
    scene = next(one for one in list_scenes(reader) if one.name == typed.scene)
    for frame in SceneVideo(reader, scene, [model.name], typed.stride):
        if model.name not in frame.truth:
            continue
        truth.append(frame.truth[model.name])
        image = (frame.rgb, frame.depth, frame.intrinsics)
        finders = (
            lambda image=image: estimator.predict(*image, seed=0).pose,
            lambda image=image: estimator.predict(*image, seed=1).pose,
            lambda image=image: exported.estimate(*image)[0].astype(np.float64),
        )
        for name, find in zip(WAYS, finders, strict=True):
            start = time.process_time()
            poses[name].append(find())
            seconds[name].append(time.process_time() - start)
    true = torch.from_numpy(np.stack(truth)).float()
    first = torch.from_numpy(np.stack(poses[WAYS[0]])).float()
    print(f"{model.name}, scene {typed.scene}, {len(truth)} frames")
    print("| way | ADD AUC | median ADD mm | from torch, seed 0: median mm | most mm | CPU s |")
    print("|---|---|---|---|---|---|")
    for name in WAYS:
        own = torch.from_numpy(np.stack(poses[name])).float()
        errors, apart = add(own, true, model.points), 1000 * add(own, first, model.points)
        row = [auc(errors), 1000 * float(errors.median()), float(apart.median())]
        shown = [f"{value:.1f}" for value in [*row, float(apart.max())]]
        print(f"| {name} | {' | '.join(shown)} | {np.median(seconds[name]):.2f} |")


if __name__ == "__main__":
    main()
