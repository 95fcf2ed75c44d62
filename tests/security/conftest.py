"""A watch over what the interpreter does, and a small checkpoint of a real method to make hostile
ones of.
"""

import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.types import ObjectModel

HOME = Path(__file__).parents[2]
_ALWAYS = (  # that no loading of a file has to do with
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "os.forkpty",
    "os.remove",
    "os.rename",
    "os.symlink",
    "os.link",
    "os.truncate",
    "os.chmod",
    "subprocess.Popen",
    "pty.spawn",
    "socket.connect",
    "socket.getaddrinfo",
    "urllib.Request",
    "ftplib.connect",
    "ctypes.dlopen",
    "webbrowser.open",
)

_OWN = ("os.remove", "os.truncate")  # allowed in a run's own folder
_armed: list["Watch"] = []


@cache
def _add_hook() -> None:
    """Add one audit hook for all watches: Python removes none, and calls each at every `open`,
    `import` and `id`, so that one a test would slow the rest of the session many times over.
    """

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        for watch in _armed:
            watch.see(event, arguments)

    sys.addaudithook(hook)


class Watch:
    """Writes down forbidden events while it is armed: processes, connections, writes, hostile
    imports, reads of secrets.
    """

    def __init__(self, secret: Path) -> None:
        self.secret, self.seen = secret, list[str]()
        self.own: Path | None = None  # a folder that may be written to
        _add_hook()

    def see(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Write an event down if it is forbidden."""
        if (
            event in _ALWAYS
            and "__pycache__" not in str(arguments[:1])
            and arguments[:1] != (None,)
            and not (event in _OWN and self._is_own_entry(arguments[0]))
        ):
            self.seen.append(f"{event} {arguments!r:.120}")
        elif event == "import" and str(arguments[0]).startswith("hostile"):
            self.seen.append(f"import {arguments[0]}")
        elif event == "open" and isinstance(arguments[0], str | bytes | Path):
            path, mode = str(arguments[0]), str(arguments[1] or "")
            own = self._is_own(path)
            if (set(mode) & set("wax+") and "__pycache__" not in path and not own) or str(
                self.secret
            ) in path:
                self.seen.append(f"open {path} {mode}")

    def _is_own(self, path: Any) -> bool:
        """Tell whether a path, links resolved, lies in the folder that may be written to."""
        return self.own is not None and Path(str(path)).resolve().is_relative_to(self.own)

    def _is_own_entry(self, path: Any) -> bool:
        """Tell whether a file lies in that folder: a link in it is removed, not what it names, and
        an open file is what it was opened as.
        """
        if isinstance(path, int):
            return self._is_own(f"/proc/self/fd/{path}")
        return self._is_own(Path(str(path)).parent)

    def __enter__(self) -> "Watch":
        _armed.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        _armed.remove(self)


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """Return a folder whose files nobody may read or write, with a file in it."""
    folder = tmp_path / "secret"
    folder.mkdir()
    (folder / "file.txt").write_text("private")
    return folder


@pytest.fixture
def watch(secret: Path) -> Iterator[Watch]:
    """Return the watch; at the end of the test nothing may have been seen, and the secret be as it
    was.
    """
    watching = Watch(secret)
    yield watching
    assert watching.seen == []
    assert [path.name for path in secret.iterdir()] == ["file.txt"]
    assert (secret / "file.txt").read_text() == "private"


@pytest.fixture(scope="session")
def _good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    job = compose_job(
        "train", HOME / "conf", ["model=cnn_patch", "debug=smoke", "filter.particles=8"], folder
    )
    points = torch.rand(50, 3)
    object_model = ObjectModel(
        "carton", points, points.mean(0), 0.5, 1.0, torch.eye(4)[None], points[:8]
    )
    method = build_method(recipe(job), object_model)
    content = {"state_dict": method.state_dict(), "global_step": 3, "epoch": 0}
    method.on_save_checkpoint(content)
    torch.save(content, folder / "good.ckpt")
    return folder / "good.ckpt"


@pytest.fixture
def content(_good: Path) -> dict[str, Any]:
    """Return what a good checkpoint holds, to be changed."""
    loaded: dict[str, Any] = torch.load(_good, weights_only=True)
    return loaded


@pytest.fixture
def good(_good: Path) -> Path:
    """Return a good checkpoint's file."""
    return _good


@pytest.fixture
def save(tmp_path: Path) -> Callable[[dict[str, Any]], Path]:
    """Return a function that writes a checkpoint."""

    def write(changed: dict[str, Any]) -> Path:
        torch.save(changed, tmp_path / "hostile.ckpt")
        return tmp_path / "hostile.ckpt"

    return write
