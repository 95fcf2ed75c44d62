"""Explain a run or a sweep on one HTML page: python report.py run=RUN, or sweep=DIR."""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("report"))
