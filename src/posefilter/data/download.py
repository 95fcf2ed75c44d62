"""Fetch an archive: goes on where a broken transfer stopped, checks its SHA-256, appears under its
name only when whole.
"""

import hashlib
import shutil
import stat
import tarfile
import urllib.error
import urllib.request
import zipfile
import zlib
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.parse import urlparse

from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from posefilter.errors import UserError
from posefilter.paths import stays_inside
from posefilter.progress import bars

_BLOCK = 1 << 20
_MOST_GROWTH = 100  # times an archive's size, unpacked
_COLUMNS = (
    TextColumn("{task.description}"),
    BarColumn(),
    DownloadColumn(),
    TransferSpeedColumn(),
    TimeRemainingColumn(),
)


def fetch(
    url: str,
    path: Path | str,
    sha256: str | None = None,
    retries: int = 5,
    timeout: float = 30.0,
    progress: bool = True,
) -> Path:
    """Download `url` to `path` unless it is there already; return the path.

    The transfer goes to `<path>.part`; up to `retries` more tries, and a later call, ask the server
    for the rest only. Raises UserError where the server refuses or cannot be reached, and where the
    checksum differs (the file is removed).
    """
    path = Path(path)
    if path.is_file():
        _verify(path, path, sha256, url)
        return path
    if urlparse(url).scheme not in ("http", "https"):
        raise UserError(f"{url}: only http and https addresses can be fetched")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.part")
    with bars(*_COLUMNS, shown=progress) as bar:
        task = bar.add_task(path.name, total=None)
        for attempt in range(retries + 1):
            try:
                if _transfer(url, partial, timeout, bar, task):
                    break
                reason = "the connection was cut"
            except urllib.error.HTTPError as error:
                if error.code < 500:
                    raise UserError(
                        f"{url}: the server says {error.code} {error.reason}"
                    ) from error
                reason = f"the server says {error.code} {error.reason}"
            except (urllib.error.URLError, HTTPException, TimeoutError, ConnectionError) as error:
                reason = str(getattr(error, "reason", error)) or type(error).__name__
            if attempt == retries:
                kept = partial.stat().st_size if partial.is_file() else 0
                raise UserError(
                    f"{url}: {reason}, {retries + 1} times; {kept:,} bytes are kept, the same "
                    f"command goes on from there"
                )
    _verify(partial, path, sha256, url)
    partial.replace(path)
    return path


def unpack(archive: Path | str, folder: Path | str) -> Path:
    """Unpack a zip or tar archive, whole or not at all; return the folder.

    Raises UserError where it is corrupt, names places outside of the folder, holds links, or grows
    out of bounds.
    """
    archive, folder = Path(archive), Path(folder)
    if folder.exists():
        raise UserError(
            f"{folder}: exists already; remove it, or choose another folder to unpack "
            f"{archive.name} into"
        )
    check_members(archive)
    partial = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        # refuses members that point outside
        how = {} if archive.suffix == ".zip" else {"filter": "data"}
        shutil.unpack_archive(archive, partial, **how)  # type: ignore[arg-type]
    except (shutil.ReadError, ValueError, EOFError, OSError) as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise UserError(f"{archive}: cannot be unpacked ({error})") from error
    partial.replace(folder)
    return folder


def check_members(archive: Path) -> None:
    """Raise UserError unless an archive holds plain files and folders below its own, of a size that
    it can have.
    """
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as opened:
                members = [
                    (m.filename, m.file_size, not stat.S_ISLNK(m.external_attr >> 16))
                    for m in opened.infolist()
                ]
        else:
            with tarfile.open(archive) as opened_tar:
                members = [(m.name, m.size, m.isfile() or m.isdir()) for m in opened_tar]
    except (OSError, tarfile.TarError, zipfile.BadZipFile, EOFError, zlib.error) as error:
        raise UserError(f"{archive}: cannot be unpacked ({error})") from error
    for name, _, plain in members:
        if not plain:
            raise UserError(
                f"{archive}: {name[:80]!r} in it is a link or device, which is not unpacked"
            )
        if not stays_inside(name, Path()):
            raise UserError(f"{archive}: {name[:80]!r} in it leads out of its folder")
    total = sum(size for _, size, _ in members)
    if total > _MOST_GROWTH * archive.stat().st_size + _BLOCK:
        raise UserError(
            f"{archive}: would grow to {total:,} bytes, more than {_MOST_GROWTH} times its size"
        )


def _transfer(url: str, partial: Path, timeout: float, bar: Progress, task: object) -> bool:
    """Append to the partial file what is still missing; tell whether it is whole now."""
    have = partial.stat().st_size if partial.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        response: HTTPResponse = urllib.request.urlopen(request, timeout=timeout)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # nothing is left to send, or the file there is another one
            return _whole(error.headers.get("Content-Range", ""), have, partial)
        raise
    with response:
        resumed = response.status == 206
        if resumed and not response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
            raise UserError(
                f"{url}: the server sent another part than was asked for; delete {partial}"
            )
        start = have if resumed else 0  # a server that knows no ranges begins anew
        length = response.headers.get("Content-Length")
        total = start + int(length) if length else None
        bar.update(task, total=total, completed=start)  # type: ignore[arg-type]
        with partial.open("ab" if resumed else "wb") as file:
            while block := response.read(_BLOCK):
                file.write(block)
                bar.advance(task, len(block))  # type: ignore[arg-type]
    return total is None or partial.stat().st_size == total


def _whole(content_range: str, have: int, partial: Path) -> bool:
    """Tell whether `bytes */total` says that all is here; start anew where it does not."""
    if content_range.rpartition("/")[2] == str(have):
        return True
    partial.unlink()
    return False


def _verify(file: Path, path: Path, sha256: str | None, url: str) -> None:
    """Raise UserError, and remove the file, where its checksum is another."""
    if sha256 is None:
        return
    digest = hashlib.sha256()
    with file.open("rb") as opened:
        while block := opened.read(_BLOCK):
            digest.update(block)
    if digest.hexdigest() != sha256.lower():
        file.unlink()
        raise UserError(
            f"{path}: SHA-256 is {digest.hexdigest()}, not {sha256.lower()}: {url} has changed, "
            f"or came broken; removed"
        )
