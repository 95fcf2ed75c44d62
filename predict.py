"""Find the object in one photograph: python predict.py checkpoint=... rgb=... depth=...
intrinsics=....
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("predict"))
