"""Train a method and test it: python train.py [model=...] [loss=...] [data=...]; see
conf/train.yaml.
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("train"))
