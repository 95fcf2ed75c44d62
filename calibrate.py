"""Give a checkpoint a probability that its answers are right: python calibrate.py checkpoint=...
data=... data.root=....
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("calibrate"))
