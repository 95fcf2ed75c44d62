"""Test a checkpoint, or poses of any other method: python evaluate.py checkpoint=... data=...
data.root=....
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("evaluate"))
