"""Tell whether a dataset fits its meshes: python check_data.py data=fat data.root=DIR
meshes=DIR.
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("check_data"))
