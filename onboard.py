"""From a mesh to trained weights and a report: python onboard.py mesh=drill.obj."""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("onboard"))
