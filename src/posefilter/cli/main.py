"""The console command: `posefilter train ...` does what `python train.py ...` does in a clone."""

import sys
from collections.abc import Sequence
from importlib.metadata import version

from posefilter.errors import MISTAKE

COMMANDS = {
    "train": "train a method and test it",
    "evaluate": "test a checkpoint, or poses from anywhere, on a dataset",
    "predict": "find the object in one photograph",
    "generate": "render a dataset",
    "check_data": "check a dataset: its meshes drawn over its images",
    "report": "explain a run or a sweep on one page",
    "onboard": "from a mesh to trained weights and a report",
    "export": "strip a checkpoint to what predicts",
}
_USAGE = "usage: posefilter COMMAND [setting=value ...]; posefilter COMMAND --help for its settings"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    Args:
        arguments: The command's name and what follows it; None: as typed.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help", "help"):
        width = max(map(len, COMMANDS))
        print(_USAGE, *(f"  {name:{width}}  {what}" for name, what in COMMANDS.items()), sep="\n")
        return 0
    if given[0] == "--version":
        print(f"posefilter {version('posefilter')}")
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


if __name__ == "__main__":
    sys.exit(main())
