"""Strip a checkpoint to what predicts: python export.py checkpoint=RUN/checkpoints/best.ckpt
out=weights/NAME.ckpt.
"""

import sys
from pathlib import Path

from posefilter.cli import run_command

if __name__ == "__main__":
    sys.exit(run_command("export", Path(__file__).parent))
