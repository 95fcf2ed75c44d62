"""What a command says: sentences and tables, or with console=json a JSON object a line."""

import json
import logging
import math
import re
import shlex
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from posefilter.cli.arguments import quote
from posefilter.cli.choices import config_folders, typed_plugins
from posefilter.cli.ranks import is_follower
from posefilter.errors import printable_lines

JSON = "json"
Files = Mapping[str, Path | str]


def say(console: str, event: str, sentence: str, **content: Any) -> None:
    """Print a sentence, or for machines its content; of several processes, the first one does."""
    if is_follower():
        return
    print(
        json.dumps({"event": event, **finite(content)})
        if console == JSON
        else printable_lines(sentence),
        flush=True,
    )


def warn(console: str, sentence: str, **content: Any) -> None:
    """Say what is doubtful."""
    say(console, "warning", f"warning: {sentence}", **content)


def ended(
    console: str, event: str, files: Files, following: Sequence[str] = (), **content: Any
) -> None:
    """Say where everything was written, and what may be typed next.

    For machines: the last line, with all content.
    """
    if is_follower():
        return
    if console == JSON:
        paths = {name: str(path) for name, path in files.items()}
        say(console, event, "", **content, files=paths, next=list(following))
        return
    out = Console(soft_wrap=True, highlight=False)  # paths and commands must survive being copied
    width = max((len(name) for name in files), default=0)
    out.print(Text("written", "bold"))
    for name, path in files.items():
        out.print(Text.assemble(f"  {name:{width}}  ", (str(path), "cyan")))
    if following:
        out.print(Text("next", "bold"))
    for command in following:
        out.print(Text.assemble("  ", (command, "green")))


def show_table(console: str, title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print a table of names and values; for machines, nothing."""
    if is_follower() or console == JSON:
        return
    table = Table("", "", show_header=False)
    table.columns[1].justify = "right"
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    terminal = Console()
    # a line of its own: within the table a path would be cut in the middle of words
    terminal.print(Text(title, style="bold"), soft_wrap=True)
    terminal.print(table)


def typed(command: str, **settings: Any) -> str:
    """Return a command line that survives the shell and Hydra: `python train.py data.root=DIR`, or
    `posefilter train ...` where that was typed; `__` stands for a dot.

    It has the folder of settings and the plug-ins of the command that is running.
    """
    words = [name_program(command)]
    for folder in config_folders(sys.argv[1:]):
        words += ["--config-dir", shlex.quote(str(folder))]
    plugins = typed_plugins(sys.argv[1:])
    settings |= {"plugins": plugins} if plugins and "plugins" not in settings else {}
    return " ".join([*words, *(setting(k.replace("__", "."), v) for k, v in settings.items())])


def typed_prediction(checkpoint: Path) -> str:
    """Return a command line that estimates with a checkpoint, with an image of no dataset."""
    image = "rgb=a.png depth=a_depth.png intrinsics=fx,fy,cx,cy depth_scale=UNITS_PER_METER"
    return f"{typed('predict', checkpoint=checkpoint)} {image}"


def name_program(command: str) -> str:
    """Return a command as it is typed here: a script's path, where another one was typed so."""
    if is_installed():
        return f"posefilter {command}"
    beside = Path(sys.argv[0]).with_name(f"{command}.py")
    script = beside if beside.parent != Path() and beside.is_file() else beside.name
    return f"python {shlex.quote(str(script))}"


def is_installed() -> bool:
    """Tell whether the console command `posefilter` was typed, rather than a script of a clone."""
    typed = Path(sys.argv[0])
    return typed.stem == "posefilter" or typed.parts[-2:] == ("posefilter", "__main__.py")


def setting(key: str, value: Any) -> str:
    """Return one setting as it is typed; what Hydra would take apart is quoted for it."""
    if isinstance(value, list):
        return shlex.quote(f"{key}=[{','.join(map(str, value))}]")
    text = str(value)
    if not re.fullmatch(r"[\w./:\-~ ]*", text):
        text = quote(text)
    return shlex.quote(f"{key}={text}") if re.search(r"[^\w./:\-=~]", text) else f"{key}={text}"


def finite(content: Any) -> Any:
    """Return plain content with NaN and infinity as null, and paths as text."""
    if isinstance(content, Mapping):
        return {str(key): finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return str(content) if isinstance(content, Path) else content


def settle_logging(console: str) -> None:
    """Have the log's lines on the console be sentences; for machines, on stderr, and only warnings.
    Of several processes, all but the first one say warnings alone.

    Files keep all. What a thread of TensorBoard cannot write (a full disk) is not printed: the next
    event that is written raises it.
    """
    threading.excepthook = _report_thread
    for handler in logging.getLogger().handlers:
        if type(handler) is logging.StreamHandler:
            if console == JSON:
                handler.setStream(sys.stderr)
            if console == JSON or is_follower():
                handler.setLevel(logging.WARNING)
            handler.setFormatter(_Plain("%(message)s"))


class _Plain(logging.Formatter):
    """Writes lines without what a terminal would obey: names in files of others are in them."""

    def format(self, record: logging.LogRecord) -> str:
        return printable_lines(super().format(record))


def _report_thread(failed: threading.ExceptHookArgs) -> None:
    """Print what a thread failed by, unless it is raised once more where it can be explained."""
    written = type(failed.thread).__module__.startswith("tensorboard.")
    if not (written and isinstance(failed.exc_value, OSError)):
        threading.__excepthook__(failed)


def logging_for(arguments: Sequence[str]) -> list[str]:
    """Return what keeps Hydra's own log, of sweeps, off stdout where that is for machines."""
    stream = "hydra.hydra_logging.handlers.console.stream=ext://sys.stderr"
    return [stream] if f"console={JSON}" in arguments else []
