"""Going on with a run that was cut short: the same settings, from its last checkpoint."""

from pathlib import Path

import yaml

from posefilter.errors import UserError

_DROPPED = ("resume=", "out=", "hydra.run.dir=")


def run_folder(resume: str | Path) -> Path:
    """Return the folder of a run that is given by itself or by one of its checkpoints."""
    path = Path(resume)
    folder = path.parent.parent if path.suffix == ".ckpt" else path
    if not (folder / ".hydra" / "overrides.yaml").is_file():
        raise UserError(f"resume={resume}: not a run's folder (no .hydra/overrides.yaml in {folder})")
    return folder


def last_checkpoint(resume: str | Path) -> Path:
    """Return the checkpoint to go on from.  Raises UserError where there is none."""
    path = Path(resume)
    path = path if path.suffix == ".ckpt" else path / "checkpoints" / "last.ckpt"
    if not path.is_file():
        raise UserError(f"resume={resume}: no {path}; the run was stopped before its first checkpoint: start it anew")
    return path


def with_resumed(arguments: list[str]) -> list[str]:
    """Put the resumed run's own overrides ahead of the command line's, so that these may still change a thing."""
    given = [a.removeprefix("resume=") for a in arguments if a.startswith("resume=")]
    if not given or given[-1] in ("", "null"):
        return arguments
    folder = run_folder(given[-1])
    last_checkpoint(given[-1])
    before = yaml.safe_load((folder / ".hydra" / "overrides.yaml").read_text()) or []
    kept = [o for o in before if not o.startswith(_DROPPED)]
    named = {a.split("=", 1)[0].lstrip("+~") for a in arguments}
    kept = [o for o in kept if o.split("=", 1)[0].lstrip("+~") not in named]
    return [*kept, *arguments, f"out={folder}"]
