"""Follow objects through a video: python track.py checkpoint=... frames=DIR intrinsics=...."""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("track"))
