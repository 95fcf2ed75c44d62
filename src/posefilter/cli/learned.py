"""Which scenes a run has learned from, against those that would be tested now."""

from pathlib import Path

from posefilter.cli.checkpoints import find_checkpoint
from posefilter.cli.console import warn
from posefilter.data.module import PoseDataModule
from posefilter.data.splits import find_learned
from posefilter.limits import read_json

DATA = "data.json"  # of a run: how its data were divided
_USES = {"test": ("tested", ""), "val": ("calibrated on", ", so that probabilities are too high")}


def warn_of_learned(
    checkpoint: str, data: PoseDataModule, console: str, part: str = "test"
) -> None:
    """Say where scenes of a part are of those that the checkpoint's run has learned from.

    part: `test`, or `val` for what is calibrated on.
    """
    learned = list_learned(find_checkpoint(checkpoint).parent.parent / DATA, data, part)
    if learned:
        use, harm = _USES[part]
        sentence = (
            f"{len(learned)} of the scenes that are {use} were learned from by this run "
            f"({', '.join(learned[:3])}){harm}: the dataset or data.split has changed since"
        )
        warn(console, sentence, learned=learned)


def list_learned(record: Path, data: PoseDataModule, part: str = "test") -> list[str]:
    """Return the scenes of a part that a run has learned from, and did not have in that part.

    Args:
        record: Its data.json; there may be none.
        data: What is tested; another dataset than the run's has none of its scenes.
        part: `test`, or `val` for what is calibrated on.
    """
    before = read_json(record) if record.is_file() else None
    before = before if isinstance(before, dict) else {}
    same = Path(str(before.get("root"))).resolve() == data.root.resolve()
    split = before.get("split") if same else None
    if not isinstance(split, dict) or not all(isinstance(part, dict) for part in split.values()):
        return []
    return find_learned(split, data.split_record(), part)
