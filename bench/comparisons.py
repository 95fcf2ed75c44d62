"""Filters against methods that are none: accuracy over the number of training images and clutter.

    python bench/comparisons.py [--only learning_curve|clutter|tables] [--list] [KEY=VALUE ...]

Trains two filters and two comparisons on rendered scenes, each with the same number of steps and
images a step, on growing parts of one training set; then tests those of the most images on scenes
with more and more distractors. The sizes that tell most come first. Started again, it goes on where
it was stopped. What is typed beyond the options, such as threads=1, is handed to every command.
Then the rows of docs/results/runs.csv are written, and the tables of docs/results/comparisons.md.
"""

import argparse
import shlex
import subprocess
import sys
from itertools import product
from pathlib import Path

HOME = Path(__file__).parents[1]
ROOT = Path("outputs/comparisons")
METHODS = ("patch_pf,dense_coordinates", "pose_pf", "keypoints")
SIZES = ("50,1000", "200", "100,400")
SCENES = "data.generate.frames=1600 data.split={train:0.7,val:0.1,test:0.2}"
STEPS = "trainer.max_steps=300 trainer.val_check_interval=300 scheduler.warm_up=30"
# a fifth of the preset's particles and no mean shift, for time: it changes the test alone
SMALL = "filter.particles=100 filter.first_particles=200 filter.steps=8 filter/refine=rescore"


def list_trainings() -> list[str]:
    """Return the command lines of the learning curve, the most telling first."""
    lines = []
    for sizes, methods in product(SIZES, METHODS):
        few = f"data.limit_train={sizes} data.limit_val=20 data.limit_test=100"
        common = f"sweep=learning_curve {SCENES} {few} {STEPS} seed=0"
        small = f" {SMALL}" if methods == "pose_pf" else ""
        out = f"out={ROOT / 'learning_curve'} console=json"
        lines += [f"train.py -m model={methods}{small} {common} {out}"]
    return lines


def main() -> int:
    """Run the plan; the status is that of the worst command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("more", nargs="*")
    parser.add_argument("--only", choices=("learning_curve", "clutter", "tables"))
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    options = parser.parse_args()
    worst = 0
    for line in list_trainings():
        words = [*line.split(), *options.more]
        print(f"$ python {shlex.join(words)}", flush=True)
        if not options.list:
            done = subprocess.run([sys.executable, *words], cwd=HOME, check=False)
            worst = max(worst, done.returncode)
    return worst


if __name__ == "__main__":
    sys.exit(main())
