"""Files that are whole or not there: written beside their target, synced, then renamed; and files
that grow, whose content so far survives.
"""

import errno
import io
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path
from typing import BinaryIO, TextIO

from posefilter.errors import UserError

_PARTS = (".*.part", ".*.part.mp4")  # a video's ending tells its encoder the format
_UNKNOWN = "backslashreplace"
_SYNC_EVERY = 1.0  # of a file that grows [s]


def stamp_files(paths: Sequence[Path]) -> str:
    """Return what changes when one of some files does; those that are missing are left out."""
    states = [path.stat() for path in paths if path.exists()]
    return " ".join(f"{state.st_size}:{state.st_mtime_ns}" for state in states)


@contextmanager
def open_whole(path: Path, sync: bool = True) -> Iterator[BinaryIO]:
    """Open a file for writing that takes its name only when all of it is on the disk.

    Args:
        path: The file; missing folders are made.
        sync: Whether to wait until the disk has it, so that it outlives a loss of power as well.

    Raises:
        UserError: It cannot be written, as on a full disk.  What had the name before still has it.
    """
    # of its own for each thread: two may write one file, as a cache's do
    part = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            yield file
            file.flush()
            if sync:
                os.fsync(file.fileno())
        part.replace(path)
        if sync:
            _sync_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
        raise


@contextmanager
def open_whole_text(path: Path) -> Iterator[TextIO]:
    """Open a text for writing, in UTF-8, its line ends as they are written; as `open_whole`. What
    is not in UTF-8, as in names of files, is written by its number.
    """
    with open_whole(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", errors=_UNKNOWN, newline="")
        yield text
        text.flush()
        text.detach()


def write_whole(path: Path, content: bytes | memoryview | str, sync: bool = False) -> None:
    """Write a file, all of it or nothing; as `open_whole`, a text as `open_whole_text`."""
    with open_whole(path, sync) as file:
        file.write(content.encode(errors=_UNKNOWN) if isinstance(content, str) else content)


class GrowingFile:
    """A file that grows by whole pieces, and keeps them whatever ends its process.

    A piece outlives a SIGKILL from the moment that it is added, and a loss of power after a second.
    The file is made with the first piece; what has its name before is not touched.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: io.FileIO | None = None
        self._size, self._synced = 0, 0.0

    def add(self, piece: str) -> None:
        """Add a piece, all of it or nothing.

        Raises:
            UserError: It cannot be written, as on a full disk.
        """
        content = piece.encode()
        try:
            if self._file is None:
                self._file = io.FileIO(self.path, "x")
                _sync_folder(self.path.parent)
            # one call without a buffer: no signal comes between its first byte and its last
            if self._file.write(content) != len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._size += len(content)
            if time.monotonic() - self._synced >= _SYNC_EVERY:
                os.fsync(self._file.fileno())
                self._synced = time.monotonic()
        except OSError as error:
            if self._file is not None:
                with suppress(OSError):
                    self._file.truncate(self._size)
                    if not self._size:
                        self.path.unlink()
            raise UserError(f"{self.path}: cannot be written ({error.strerror})") from error

    def close(self) -> None:
        """Close the file, which stays."""
        if self._file is not None:
            self._file.close()


def remove_parts(folder: Path, places: Sequence[str], seconds: float = 0.0) -> None:
    """Remove what writers that were killed have left.

    Args:
        folder: A folder in which nobody writes now; or `seconds` must say what is old.
        places: Patterns of the folders in it that are looked at, "." for itself. One that is a link
            out of it is not: a folder of somebody else may have such links.
        seconds: Only what is older.
    """
    home = os.path.realpath(folder)
    for place, name in product(places, _PARTS):
        for part in folder.glob(f"{place}/{name}"):
            if os.path.commonpath([os.path.realpath(part.parent), home]) != home:
                continue
            with suppress(OSError):  # of another user, or gone by now
                if time.time() - part.lstat().st_mtime >= seconds:
                    part.unlink()


def _sync_folder(folder: Path) -> None:
    """Have the disk keep a folder's list of names, where the system can."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
