"""One writer a folder: a lock of the operating system, which ends with its process."""

import errno
import logging
import os
import socket
import time
from contextlib import suppress
from pathlib import Path

from posefilter.errors import UserError, printable

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)
LOCK = ".lock"  # in the folder, while it is held
_BUSY = (errno.EACCES, errno.EAGAIN)
_WITHOUT = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)  # file systems that have no locks
_PAUSE = 0.5  # [s]
_held: dict[str, tuple[int, int]] = {}  # folder -> (process, open file), of this process


def hold(folder: Path, wait: bool = False) -> bool:
    """Hold a folder until `release`, or until this process ends.

    Args:
        folder: The folder; it is made if it is missing.
        wait: Whether to wait for another process that holds it, rather than to refuse.

    Returns:
        Whether it is held by this call; False where this process held it before, or where there
        are no locks.

    Raises:
        UserError: Another process holds it, or it cannot be written to.
    """
    place = os.path.realpath(folder)
    if fcntl is None or _held.get(place, (0, 0))[0] == os.getpid():
        return False
    logged = False
    while True:
        try:
            number = _take(folder)
        except OSError as error:
            if error.errno in _WITHOUT:
                log.warning("%s: no locks here; let no other run write to it", folder)
                return False
            if error.errno not in _BUSY or not (folder / LOCK).exists():
                raise UserError(f"{folder}: cannot be written ({error.strerror})") from error
            if not wait:
                raise UserError(
                    f"{folder}: is in use by another run ({_owner(folder)}); wait for its end, or "
                    f"choose another folder"
                ) from error
            if not logged:
                log.info("%s: waiting for another run (%s)", folder, _owner(folder))
            logged = True
            time.sleep(_PAUSE)
            continue
        if number is not None:
            _held[place] = os.getpid(), number
            return True


def release(folder: Path) -> None:
    """Let go of a folder that this process holds; any other is left as it is."""
    place = os.path.realpath(folder)
    process, number = _held.get(place, (0, 0))
    if process == os.getpid():
        del _held[place]
        Path(place, LOCK).unlink(missing_ok=True)
        os.close(number)


def release_all() -> None:
    """Let go of every folder that this process holds."""
    for place in list(_held):
        release(Path(place))


def _take(folder: Path) -> int | None:
    """Return the open file of a lock that is held now; None where its file was removed meanwhile.

    Raises OSError where another process holds it, or the file cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # a folder of somebody else's may bring a link of that name: it is not followed
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    number = os.open(folder / LOCK, flags, 0o644)
    try:
        fcntl.lockf(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        own, there = os.fstat(number), _state(folder / LOCK)
        if there is None or (own.st_dev, own.st_ino) != (there.st_dev, there.st_ino):
            os.close(number)  # the one before has just removed it
            return None
    except BaseException:
        os.close(number)
        raise
    with suppress(OSError):  # a full disk: told where something that matters is written
        os.ftruncate(number, 0)
        os.write(number, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
    return number


def _state(path: Path) -> os.stat_result | None:
    try:
        return path.lstat()
    except OSError:
        return None


def _owner(folder: Path) -> str:
    try:
        with (folder / LOCK).open("rb") as file:
            return printable(file.read(80).decode(errors="replace").strip()) or "unknown"
    except OSError:
        return "unknown"
