"""Write checkpoints with today's names in recipe and calibration; their tensors stay as they are.

    python bench/upgrade_weights.py weights/*.ckpt

`evaluate.py` and the other commands read earlier names too, see `src/posefilter/cli/renamed.py`.
"""

from pathlib import Path

from programs import make_parser

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.cli.files import pack_whole
from posefilter.confidence.calibration import read_calibration
from posefilter.files import write_whole


def upgrade_file(path: Path) -> bool:
    """Write a checkpoint with today's names; return whether it had others."""
    checkpoint = read_checkpoint(path)
    if checkpoint.get("calibration") is not None:
        said = f"checkpoint={path}"
        checkpoint["calibration"] = read_calibration(checkpoint["calibration"], said).to_plain()
    content = pack_whole(checkpoint)
    if content == path.read_bytes():
        return False
    write_whole(path, content, sync=True)
    return True


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("checkpoint", type=Path, nargs="+")
    for path in parser.parse_args().checkpoint:
        print(f"{path}: {'written' if upgrade_file(path) else 'as it was'}")
