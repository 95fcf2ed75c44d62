"""Test a checkpoint, or poses from anywhere: python evaluate.py checkpoint=... data=...
data.root=....
"""

import sys
from pathlib import Path

from posefilter.cli import run_command

if __name__ == "__main__":
    sys.exit(run_command("evaluate", Path(__file__).parent))
