"""Find trained weights by path or by name."""

from pathlib import Path

from posefilter.errors import UserError

_HERE = Path(__file__).parent
# of an installed wheel, and of a clone
FOLDERS = (_HERE / "weights", _HERE.parents[1] / "weights")


def find_weights(weights: str | Path | None) -> Path:
    """Return the checkpoint that a path or a name stands for.

    Args:
        weights: A checkpoint, a run's folder, or the name of weights that ship with posefilter,
            such as `003_cracker_box`.

    Raises:
        UserError: There is no such file, and no weights of that name.
    """
    if weights is None or not str(weights):
        raise UserError(
            "checkpoint: is missing; give checkpoint=RUN/checkpoints/best.ckpt, or a name such as "
            "003_cracker_box"
        )
    path = Path(weights)
    if path.exists():
        return path
    known = sorted(
        {file.stem: file for folder in FOLDERS for file in folder.glob("*.ckpt")}.items()
    )
    for name, file in known:
        if name == str(weights):
            return file
    names = ", ".join(name for name, _ in known) or "none"
    raise UserError(f"checkpoint={weights}: no such file, and no weights of that name ({names})")
