"""Explain a run or a sweep on one HTML page: python report.py run=RUN, or sweep=DIR."""

import sys
from pathlib import Path

from posefilter.cli import run_command
from posefilter.cli.report import spelled

if __name__ == "__main__":
    sys.exit(run_command("report", Path(__file__).parent, spelled(sys.argv[1:])))
