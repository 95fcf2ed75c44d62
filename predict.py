"""Find the object in one photograph: python predict.py checkpoint=... rgb=... depth=...
intrinsics=....
"""

import sys
from pathlib import Path

from posefilter.cli import run_command

if __name__ == "__main__":
    sys.exit(run_command("predict", Path(__file__).parent))
