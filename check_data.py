"""Tell whether a dataset fits its meshes: python check_data.py data=fat data.root=DIR meshes=DIR."""

import sys
from pathlib import Path

from posefilter.cli import run_command

if __name__ == "__main__":
    sys.exit(run_command("check_data", Path(__file__).parent))
