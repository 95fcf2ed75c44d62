"""Which scenes a run has learned from, against those that would be tested now."""

from pathlib import Path

from posefilter.data.module import PoseDataModule
from posefilter.data.splits import find_learned
from posefilter.limits import read_json

DATA = "data.json"  # of a run: how its data were divided


def list_learned(record: Path, data: PoseDataModule, part: str = "test") -> list[str]:
    """Return the scenes of a part that a run has learned from, and did not have in that part.

    Args:
        record: Its data.json; there may be none.
        data: What is tested; another dataset than the run's has none of its scenes.
        part: `test`, or `val` for what is calibrated on.
    """
    before = read_json(record) if record.is_file() else None
    if not isinstance(before, dict) or Path(str(before.get("root"))).resolve() != (
        data.root.resolve()
    ):
        return []
    split = before.get("split")
    if not isinstance(split, dict) or not all(isinstance(part, dict) for part in split.values()):
        return []
    return find_learned(split, data.split_record(), part)
