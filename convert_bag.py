"""Find objects in the images of a ROS 2 bag:
python convert_bag.py in.mcap out.mcap checkpoint=003_cracker_box.
"""

import sys

from posefilter.cli.command import run_command

if __name__ == "__main__":
    sys.exit(run_command("convert_bag"))
