"""Measure how large and bright the target is in what a training sees, and in what it is tested on.

    python bench/target_sizes.py [--count 200] TRAINING ... -- TEST ...

TRAINING and TEST are settings of train.py that choose data, such as data=fat data.root=DIR
data.object=009_gelatin_box data/augment=camera. Printed are percentiles of the target's visible
pixels and of its distance, at the width that the network is given, and of its brightest channel. A
filter that never saw its object as large or bright as a photograph shows it must extrapolate.
"""

import argparse
import json
import sys
from collections.abc import Sequence

import numpy as np
from torch.utils.data import DataLoader

import posefilter
from posefilter.cli.instantiate import instantiate
from posefilter.data.module import PoseDataModule

PERCENTILES = (10, 50, 90)


def measure(loader: DataLoader, count: int) -> dict[str, list[float]]:
    """Return percentiles of the target over a loader's first images.

    Args:
        loader: Batches with masks and poses.
        count: Images to look at.

    Returns:
        Of the images that show the target "pixels" and "brightness", the mean of its brightest
        channel in [0, 1]; "distance" [m] of its frame, and "missing", the percentage of images
        without one pixel of it.
    """
    pixels: list[int] = []
    distance: list[float] = []
    brightness: list[float] = []
    for batch in loader:
        pixels += batch.mask.flatten(1).sum(1).tolist()
        distance += batch.camera_from_object[:, 2, 3].tolist()
        shown = (batch.rgb * batch.mask).sum((2, 3)) / batch.mask.sum((2, 3))
        brightness += shown.amax(1).tolist()
        if len(pixels) >= count:
            break
    seen = np.array(pixels[:count])
    bright = np.array(brightness[:count])[seen > 0]
    return {
        "images": [len(seen)],
        "pixels": np.percentile(seen[seen > 0], PERCENTILES).round().tolist(),
        "brightness": np.percentile(bright, PERCENTILES).round(2).tolist(),
        "distance": np.percentile(distance[:count], PERCENTILES).round(2).tolist(),
        "missing": [round(100 * float((seen == 0).mean()), 1)],
    }


def load(typed: Sequence[str], stage: str) -> DataLoader:
    """Return the loader of a stage, "fit" or "test", of the data that settings choose."""
    config = posefilter.compose([*typed, "data.workers=0", "data.progress=false"])
    data = instantiate(config.data, "data")
    assert isinstance(data, PoseDataModule)
    data.setup(stage)
    return data.train_dataloader() if stage == "fit" else data.test_dataloader()


def main(arguments: Sequence[str]) -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    own, typed = parser.parse_known_args(list(arguments))
    if "--" not in typed:
        parser.error("give settings of the training data, --, and settings of the test data")
    at = typed.index("--")
    for name, words, stage in (("train", typed[:at], "fit"), ("test", typed[at + 1 :], "test")):
        print(
            json.dumps(
                {"data": name, "percentiles": PERCENTILES, **measure(load(words, stage), own.count)}
            )
        )


if __name__ == "__main__":
    main(sys.argv[1:])
