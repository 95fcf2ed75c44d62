"""Spoil the files of tiny datasets at random, and see whether readers and check_data notice.

    python bench/mutations.py [COUNT] [--seed SEED] [--format fat|ycb_video|bop] [--list]

Each mutation spoils one file of a dataset in the FAT, YCB-Video or BOP format, made in a temporary
folder. The dataset is then read with data.on_error=raise, read with data.on_error=skip, and checked
as check_data does. Whatever is refused must be refused in one line, and counted by `skip`.

What is accepted is compared with the truth. It is wrong where the object's outline would move by
more than a tenth of the image, its depth by more than a tenth, or where less than half of its mask
is left; then check_data must list it. The color of images is not judged. Prints the counts; the
exit status is 1 where something was not noticed.
"""

import argparse
import random
import shutil
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

HOME = Path(__file__).parents[1]
sys.path[:0] = [str(HOME / "bench"), str(HOME / "tests" / "data")]

from dataset_trees import HIGH, LOW, bop_scene, fat_tree, pose, write_mesh, ycb_frame  # noqa: E402
from spoiling import spoil  # noqa: E402

from posefilter.checking.check import check_dataset  # noqa: E402
from posefilter.data.frames import NotShown, Sample  # noqa: E402
from posefilter.data.module import PoseDataModule  # noqa: E402
from posefilter.data.readers.registry import open_reader  # noqa: E402
from posefilter.errors import BadData, UserError  # noqa: E402
from posefilter.meshes import ycb  # noqa: E402
from posefilter.meshes.store import MeshStore  # noqa: E402

FORMATS = ("fat", "ycb_video", "bop")
SECONDS = 20  # after which a reader hangs
_FAR, _LEAST_IOU = 0.1, 0.5  # of the image's width and of the distance; of masks
_NAMES = {"fat": "toy", "ycb_video": "003_cracker_box", "bop": "obj_000002"}


class Hang(BaseException):
    """A reader took too long."""


class Base(NamedTuple):
    """A dataset that is right."""

    source: str
    root: Path
    meshes: MeshStore
    samples: dict[str, Sample]


def main(arguments: list[str] | None = None) -> int:
    """Spoil so many files; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", choices=FORMATS)
    parser.add_argument("--list", action="store_true", help="print each mutation")
    given = parser.parse_args(arguments)
    print(f"{given.count} mutations, seed {given.seed}")
    formats = (given.format,) if given.format else FORMATS
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        bases = [make_base(source, Path(folder) / source) for source in formats]
        for number in range(given.count):
            rng = random.Random(f"{given.seed} {number}")
            base = bases[number % len(bases)]
            what, outcome, detail = try_one(base, Path(folder) / "work", rng)
            counts[outcome] += 1
            if given.list or outcome in FAILURES:
                print(f"{number} {base.source} {what}: {outcome}{detail}")
    for outcome in (*OUTCOMES, *FAILURES):
        print(f"{counts[outcome]:6d}  {outcome}")
    return 1 if any(counts[outcome] for outcome in FAILURES) else 0


OUTCOMES = (
    "refused in one line, and counted by skip",
    "accepted, and listed by check_data",
    "accepted, and as it was",
    "accepted, and no pose, depth or mask is wrong",
)
FAILURES = (
    "raw traceback",
    f"no answer within {SECONDS} s",
    "refused in several lines",
    "refused, but not counted by skip",
    "wrong data accepted",
)


def make_base(source: str, folder: Path) -> Base:
    """Write a dataset that is right, and read it."""
    name, root = _NAMES[source], folder / "data"
    meshes = MeshStore(write_mesh(folder / "meshes", name))
    if source == "fat":
        fat_tree(root, scenes=2, frames=2, name=name)
    for k in range(4):
        each = pose((0.2 + 0.5 * k, 0.3 * k - 0.7, 0.4), (0.04, 0.01 * k - 0.02, 0.42))
        if source == "ycb_video":
            stem = root / f"{k // 2 + 1:04d}" / f"{k % 2 + 1:06d}"
            stem.parent.mkdir(parents=True, exist_ok=True)
            ycb_frame(stem, [(2, each)], ycb.ycbvideo_from_original(name))
        elif source == "bop":
            bop_scene(root / f"{k + 1:06d}", [[(2, each)]])
    reader = open_reader(source, root, name, meshes)
    samples = {record.key: reader.read(i) for i, record in enumerate(reader.records())}
    assert len(samples) == 4
    assert not check_dataset(open_reader(source, root, name, meshes, "skip"), meshes)["problems"]
    return Base(source, root, meshes, samples)


def try_one(base: Base, work: Path, rng: random.Random) -> tuple[str, str, str]:
    """Spoil a copy of a dataset and read it.

    Returns:
        What was done, what came of it (one of `OUTCOMES` and `FAILURES`), and the words of the
        refusal or the problem.
    """
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(base.root, work)
    what = spoil(work, rng)
    try:
        with limited(SECONDS), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # no line of NumPy's on the console
            return what, *judge(base, work)
    except Hang:
        return what, FAILURES[1], ""
    except Exception as error:
        return what, FAILURES[0], f": {type(error).__name__}: {error}"[:300]


def judge(base: Base, work: Path) -> tuple[str, str]:
    """Return what comes of reading a spoiled dataset, and its words."""
    name = _NAMES[base.source]
    refused, reported, samples = "", True, dict[str, Sample]()
    try:
        reader = open_reader(base.source, work, name, base.meshes)
        for i, record in enumerate(reader.records()):
            samples[record.key] = reader.read(i)
            reader.others(i)
    except UserError as error:
        # an object that is hidden has no pixel of the label, which is no problem of the data
        refused, reported = str(error), not isinstance(error, NotShown)
    if "\n" in refused:
        return FAILURES[2], f": {refused}"[:300]
    problems = list_problems(base, work)
    if refused:
        counted = count_skipped(base, work)
        words = f": {refused[:200]}"
        noticed = counted and (problems or not reported)
        return (OUTCOMES[0] if noticed else FAILURES[3]), words
    wrong = [
        flaw
        for key, sample in samples.items()
        if key in base.samples and (flaw := find_wrong(sample, base.samples[key]))
    ]
    if wrong and not problems:
        return FAILURES[4], f": {wrong[0]}"
    if problems:
        return OUTCOMES[1], f": {problems[0][:200]}"
    same = samples.keys() == base.samples.keys() and all(
        is_same(sample, base.samples[key]) for key, sample in samples.items()
    )
    return OUTCOMES[2] if same else OUTCOMES[3], ""


def list_problems(base: Base, work: Path) -> list[str]:
    """Return what check_data says; a refusal to read anything is a problem too."""
    try:
        reader = open_reader(base.source, work, _NAMES[base.source], base.meshes, "skip")
        found: list[str] = check_dataset(reader, base.meshes, limit=None)["problems"]
    except UserError as error:
        return [str(error)]
    return found


def count_skipped(base: Base, work: Path) -> int:
    """Return how many records and files data.on_error=skip leaves out; a dataset of which nothing
    can be read is refused as a whole, which counts as well.
    """
    try:
        data = PoseDataModule(
            base.source, work, _NAMES[base.source], base.meshes, on_error="skip",
            split={"test": 1.0}, progress=False,
        )  # fmt: skip
        data.setup("test")
    except BadData:
        return 0
    except UserError:
        return 1
    summary = data.describe()
    left = summary["splits"]["test"]["left_out"]
    return sum(summary["left_out_while_listing"].values()) + sum(left.values())


def find_wrong(sample: Sample, truth: Sample) -> str:
    """Return what is wrong with a sample, "" for nothing that matters."""
    if sample.mask.shape != truth.mask.shape:
        return f"{sample.mask.shape} pixels"
    (u, z), (u0, z0) = corners(sample), corners(truth)
    if not (np.isfinite(u).all() and (z > 0).all()):
        return "behind the camera"
    moved = float(np.abs(u - u0).max()) / truth.mask.shape[1]
    if moved > _FAR:
        return f"the object is {moved:.2f} image widths off"
    off = float(np.abs(z / z0 - 1).max())
    if off > _FAR:
        return f"the object's distance is {100 * off:.0f} % off"
    both = truth.mask & (sample.depth > 0) & (truth.depth > 0)
    if both.any():
        ratio = float(np.median(np.abs(sample.depth[both] / truth.depth[both] - 1)))
        if ratio > _FAR:
            return f"depth on the object is {100 * ratio:.0f} % off"
    union = (sample.mask | truth.mask).sum()
    iou = float((sample.mask & truth.mask).sum() / union)
    return f"the mask's IoU with the true one is {iou:.2f}" if iou < _LEAST_IOU else ""


def corners(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Return where the corners of the object's box are seen (8, 2) [px], and their depth (8,)."""
    box = np.stack(np.meshgrid(*zip(LOW, HIGH, strict=True)), -1).reshape(-1, 3)
    pose = sample.camera_from_object.astype(float)
    points = box @ pose[:3, :3].T + pose[:3, 3]
    seen = points @ sample.intrinsics.astype(float).T
    return seen[:, :2] / seen[:, 2:], points[:, 2]


def is_same(sample: Sample, truth: Sample) -> bool:
    """Tell whether two samples are the same, color included."""
    names = ("rgb", "depth", "mask", "intrinsics", "camera_from_object")
    return all(np.array_equal(getattr(sample, name), getattr(truth, name)) for name in names)


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise Hang where what follows takes longer."""

    def stop(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


if __name__ == "__main__":
    sys.exit(main())
