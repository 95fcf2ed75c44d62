"""Reduce a checkpoint to what prediction needs:
python export.py checkpoint=RUN/checkpoints/best.ckpt out=weights/NAME.ckpt.
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("export"))
