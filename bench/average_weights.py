"""Average the weights of a file and of the run that was trained on from it.

    python bench/average_weights.py weights/NAME.ckpt RUN/checkpoints/best.ckpt OUT.ckpt --share 0.5

The share is that of the run. A line between weights before and after a training on keeps some of
what either can do (WiSE-FT, Wortsman et al. 2022). What the file does not have, the surface term of
files from before it, counts as the term that has not learned anything: its last layer is zero.
OUT.ckpt is a checkpoint for export.py, as the run's; with `--keep` its recipe and its object are
those of the file. It has no calibration: other weights need another.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import torch
from programs import make_parser
from torch import Tensor

import posefilter
from posefilter.cli.checkpoints import read_checkpoint
from posefilter.cli.files import save_whole
from posefilter.errors import UserError
from posefilter.weights import find_weights

_ZERO_AT_FIRST = "likelihood.surface.leave."


def average(
    before: Mapping[str, Tensor], after: Mapping[str, Tensor], share: float
) -> dict[str, Tensor]:
    """Return the weights between two states of a network.

    Args:
        before: Tensors by name; may lack those of the surface term.
        after: Tensors by name.
        share: Of `after`, in [0, 1].

    Returns:
        Tensors by the names of `after`; whole numbers are those of `after`.

    Raises:
        ValueError: Another tensor than those of the surface term is missing, or has another shape.
    """
    out = {}
    for name, new in after.items():
        old = before.get(name)
        if old is None and not name.startswith("likelihood.surface."):
            raise ValueError(f"{name}: the file has no such weights")
        if old is not None and old.shape != new.shape:
            raise ValueError(f"{name}: {tuple(old.shape)} before, {tuple(new.shape)} after")
        if not new.is_floating_point():
            out[name] = new
        elif old is not None:
            out[name] = torch.lerp(old.to(new), new, share)
        else:
            out[name] = share * new if name.startswith(_ZERO_AT_FIRST) else new
    return out


def main() -> int:
    """Write the average."""
    parser = make_parser(__doc__)
    parser.add_argument("before", help="a file of weights")
    parser.add_argument("after", type=Path, help="a checkpoint of the run that began with it")
    parser.add_argument("out", type=Path)
    parser.add_argument("--share", type=float, default=0.5, help="of the run")
    parser.add_argument(
        "--keep", action="store_true", help="the recipe and the object of the file, not of the run"
    )
    options = parser.parse_args()
    if not 0 <= options.share <= 1:
        parser.error("--share is in [0, 1]")
    try:
        method = posefilter.load(options.before, device="cpu").methods[0]
        checkpoint = read_checkpoint(options.after)
        state = average(method.state_dict(), checkpoint["state_dict"], options.share)
        if options.keep:
            checkpoint = read_checkpoint(find_weights(options.before))
            checkpoint.pop("calibration", None)
        save_whole({**checkpoint, "state_dict": state}, options.out)
    except (UserError, ValueError) as error:
        print(f"average_weights: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
