"""The console command: `posefilter train ...` does what `python train.py ...` does in a clone."""

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

from posefilter.cli.ranks import STARTED, is_follower
from posefilter.errors import MISTAKE

COMMANDS = {
    "train": "train a method and test it",
    "evaluate": "test a checkpoint, or poses of any other method, on a dataset",
    "predict": "estimate the pose of one object or several in an RGB-D image",
    "track": "follow objects through a video",
    "convert_bag": "find objects in the images of a ROS 2 bag",
    "generate": "render a dataset",
    "check_data": "check that a dataset and its meshes fit each other",
    "report": "explain a run or a sweep, or compare two runs, on one HTML page",
    "onboard": "go from a mesh to trained weights and a report",
    "calibrate": "learn the probability that a checkpoint's poses are right",
    "export": "reduce a checkpoint to what prediction needs, or write its networks as ONNX",
}
_USAGE = "usage: posefilter COMMAND [setting=value ...]; posefilter COMMAND --help for its settings"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    Args:
        arguments: The command's name and what follows it; None: as typed.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if is_follower() and os.environ.get(STARTED) in COMMANDS:
        # Lightning starts the other processes of a training with what Hydra's parser is given
        given = [os.environ[STARTED], *given]
    if not given or given[0] in ("-h", "--help", "help"):
        width = max(map(len, COMMANDS))
        print(_USAGE, *(f"  {name:{width}}  {what}" for name, what in COMMANDS.items()), sep="\n")
        return 0
    if given[0] == "--version":
        print(describe_version())
        return 0
    if given[0] in ("-sc", "--shell_completion"):
        given = complete(given, os.environ.get("COMP_LINE", ""))
        if not given:
            return 0
    name = given[0].removesuffix(".py").replace("-", "_")
    if name not in COMMANDS:
        print(
            f"posefilter: {given[0]}: there is no such command; choose {', '.join(COMMANDS)}",
            file=sys.stderr,
        )
        return MISTAKE
    from posefilter.cli.command import run_command  # Hydra: the list of commands needs none

    return run_command(name, arguments=given[1:])


def describe_version() -> str:
    """Return the program's name and version."""
    return f"posefilter {version('posefilter')}"


def complete(given: Sequence[str], line: str) -> list[str]:
    """Return the command that completes a line of a shell; print the names of commands, and return
    nothing, where the line has none yet.

    Args:
        given: What Hydra's completion calls the program with.
        line: What was typed so far, such as `posefilter train mod`.
    """
    program, *words = line.split() or [""]
    if not words or (len(words) == 1 and not line.endswith(" ")):
        print(*(name for name in COMMANDS if name.startswith("".join(words))))
        return []
    os.environ["COMP_LINE"] = line.replace(f"{program} {words[0]}", program, 1)
    return [words[0], *given]


if __name__ == "__main__":
    sys.exit(main())
