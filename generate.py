"""Render a dataset: python generate.py out=DIR frames=400 object=carton; see conf/generate.yaml."""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("generate"))
