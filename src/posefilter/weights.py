"""Find trained weights by path or by name, and fetch those that are elsewhere."""

import difflib
import io
import os
import shlex
from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import urljoin, urlparse

from posefilter.errors import UserError, find_reason
from posefilter.files import write_whole
from posefilter.limits import read_bytes
from posefilter.paths import is_plain_name

# the address of a folder of weights with a registry.txt: lines of `<name>.ckpt sha256:<digest>`
URL = "POSEFILTER_WEIGHTS_URL"
# where what was fetched is kept; unset: the system's place for caches
CACHE = "POSEFILTER_CACHE"
ALL = "all"  # the weights that ship
_REGISTRY, _TIMEOUT, _RETRIES = "registry.txt", 30, 2  # [s]
_MOST_LIST, MOST_BYTES = 1 << 20, 1 << 30  # of a list, and of weights that are fetched
_LONGEST = 1000  # of a line of a list
_SHOWN = 20  # names of a list
_HERE = Path(__file__).parent
# of an installed wheel, and of a clone
FOLDERS = (_HERE / "weights", _HERE.parents[1] / "weights")


def find_weights(weights: str | Path | None, setting: str = "checkpoint") -> Path:
    """Return the checkpoint that a path or a name stands for.

    A name is looked up among the weights that ship, then in the cache and at the address in the
    environment variable POSEFILTER_WEIGHTS_URL, if it is set.

    Args:
        weights: A checkpoint, a run's folder, a name such as `003_cracker_box`, or a pattern of
            one file.
        setting: What names it, for messages.

    Raises:
        UserError: There is no such file, and no weights of that name; or they cannot be fetched.
    """
    if weights is None or not str(weights):
        raise UserError(
            f"{setting}: is missing; give {setting}=RUN/checkpoints/best.ckpt, or a name such as "
            "003_cracker_box"
        )
    if not isinstance(weights, str | os.PathLike):
        raise UserError(f"{setting}={weights}: must be a file, a run's folder or a name")
    # that of Path raises where there is no such user
    path, name = Path(os.path.expanduser(weights)), str(weights)  # noqa: PTH111
    shipped = list_shipped()
    if path.exists() and not (name in shipped and _is_another_folder(path)):
        return path
    if is_several(name) and name != ALL:  # a pattern of one file
        one, *others = expand_weights(name, setting)
        if others:
            raise UserError(
                f"{setting}={weights}: stands for {1 + len(others)} files ({one}, {others[0]}"
                f"{', ...' if len(others) > 1 else ''}); here it must be one"
            )
        return Path(one)
    if name in shipped:
        return shipped[name]
    url = os.environ.get(URL, "")
    if url and is_plain_name(name) and not path.suffix:
        return fetch_weights(name, url)
    if path.suffix == ".ckpt" and path.stem in shipped:  # as in a clone, typed elsewhere
        raise UserError(f"{setting}={weights}: no such file; did you mean {setting}={path.stem}?")
    known = ", ".join(sorted(shipped)) or "none"
    near = [one for one in shipped if name.lower() and name.lower() in one.lower()]
    near = near or difflib.get_close_matches(name.lower(), shipped, 1)
    meant = f"; did you mean {near[0]}?" if len(near) == 1 else ""
    raise UserError(
        f"{setting}={weights}: no such file, and no weights of that name ({known}){meant}"
    )


def _is_another_folder(path: Path) -> bool:
    """Tell whether a path is a folder and no run's: images or results of an object may lie in one
    that has the name of its weights.
    """
    return path.is_dir() and not (path / "checkpoints").exists()


def list_shipped() -> dict[str, Path]:
    """Return the weights that ship, by name."""
    files = [file for folder in FOLDERS for file in folder.glob("*.ckpt")]
    return {file.stem: file for file in sorted(files, key=lambda file: file.stem)}


def is_several(weights: object) -> bool:
    """Tell whether a setting stands for a list of checkpoints: a sequence, `all`, or a pattern."""
    if isinstance(weights, str | Path):
        name = str(weights)
        if name == ALL:
            return not Path(name).exists() or _is_another_folder(Path(name))
        return not Path(name).exists() and any(sign in name for sign in "*?[")
    return isinstance(weights, Sequence)


def expand_weights(
    weights: str | Path | Sequence[str | Path], setting: str = "checkpoint"
) -> list[str | Path]:
    """Return the checkpoints that a setting stands for, none of them twice.

    Args:
        weights: A checkpoint as `find_weights` takes it; `all` for those that ship; a pattern of
            files or of names, such as `weights/00*.ckpt` or `00*`; or a list of such.
        setting: What names them, for messages.

    Raises:
        UserError: There are none.
    """
    found: list[str | Path]
    if not isinstance(weights, str | Path | Iterable):
        raise UserError(f"{setting}={weights}: must be a name or a file of weights, or a list")
    if not isinstance(weights, str | Path):
        found = [one for part in weights for one in expand_weights(part, setting)]
    elif not is_several(weights):
        found = [weights]
    elif str(weights) == ALL:
        found = [*list_shipped().values()]
    else:
        path = Path(os.path.expanduser(weights))  # noqa: PTH111  # which raises nothing
        found = [*sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))]
        found += [file for name, file in list_shipped().items() if fnmatch(name, str(weights))]
    if not found:
        raise UserError(f"{setting}={weights}: no weights there; name those of one object at least")
    return list(dict.fromkeys(found))


class _Bounded:
    """A file that is written by a download, and ends it where more comes than there should.

    Args:
        file: Gets what comes.
        most: Bytes that may come.
        url: Where it comes from, for messages.
    """

    def __init__(self, file: BinaryIO, most: int, url: str) -> None:
        self._file, self._most, self._url = file, most, url

    def write(self, data: bytes) -> None:
        """Write a part.  Raises UserError where it is too much."""
        if self._file.tell() + len(data) > self._most:
            raise UserError(f"{self._url}: too large: more than {self._most:,} bytes were sent")
        self._file.write(data)

    def flush(self) -> None:
        """Do nothing: the file is flushed as it is closed."""


def _stay_secure(response: Any, *_: object, **__: object) -> None:
    """Raise UserError where a page of https leads to one of http, which anyone on the way may
    change: the checksums of what is fetched come from it.
    """
    there = urljoin(response.url, response.headers.get("location", ""))
    if response.is_redirect and urlparse(response.url).scheme == "https" != urlparse(there).scheme:
        raise UserError(f"{response.url}: leads to {there[:200]}, which is not https")


def _fetch_registry(url: str, index: Path, wanted: Path) -> bytes:
    """Download the list of weights. Where the address cannot be reached, weights that are in the
    cache are judged by the list there.
    """
    import pooch
    import requests

    loader = pooch.HTTPDownloader(timeout=_TIMEOUT, hooks={"response": _stay_secure})
    content = io.BytesIO()
    try:
        loader(url + _REGISTRY, _Bounded(content, _MOST_LIST, url + _REGISTRY), None)
    except (requests.ConnectionError, requests.Timeout):
        if not (wanted.is_file() and index.is_file()):
            raise
        return read_bytes(index, _MOST_LIST)
    return content.getvalue()


def _parse_registry(content: bytes) -> tuple[dict[str, str], dict[str, str]]:
    """Return the checksum of each file of a list, and the address of those that have one.

    Raises ValueError where a line is none of a list.
    """
    checksums, addresses = dict[str, str](), dict[str, str]()
    for number, line in enumerate(content.decode("utf-8-sig").splitlines(), 1):
        line = line.expandtabs().strip()
        if line.startswith("#"):
            continue
        if len(line) > _LONGEST or not line.isprintable():
            raise ValueError(f"line {number} of its list is too long, or not to be printed")
        match shlex.split(line):
            case []:
                continue
            case [name, checksum]:
                checksums[name] = checksum.lower()
            case [name, checksum, address]:
                checksums[name], addresses[name] = checksum.lower(), address
            case _:
                raise ValueError(f"line {number} of its list should be: NAME.ckpt sha256:DIGEST")
    return checksums, addresses


def fetch_weights(name: str, url: str, cache: Path | None = None) -> Path:
    """Return weights from the cache, or download them there and check their SHA-256.

    Args:
        name: Their name, without `.ckpt`.
        url: The address of the folder that holds them and a `registry.txt`.
        cache: Where to keep them; None: POSEFILTER_CACHE, else the system's place for caches.

    Raises:
        UserError: The address cannot be reached, does not list the name, or sends something else.
    """
    import pooch  # with requests, half a second
    import requests

    if urlparse(url).scheme not in ("http", "https"):
        raise UserError(f"{URL}={url}: only http and https addresses can be fetched")
    url = url.rstrip("/") + "/"
    folder = Path(cache or os.environ.get(CACHE) or pooch.os_cache("posefilter"))
    folder.mkdir(parents=True, exist_ok=True)
    index, file = folder / _REGISTRY, f"{name}.ckpt"
    loader = pooch.HTTPDownloader(timeout=_TIMEOUT)

    def load(address: str, place: str, pooch: Any) -> None:
        with Path(place).open("wb") as opened:
            loader(address, _Bounded(opened, MOST_BYTES, url + file), pooch)

    try:
        content = _fetch_registry(url, index, folder / file)
        checksums, addresses = _parse_registry(content)
        if file not in checksums:
            names = sorted(checksums)
            more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
            raise UserError(
                f"checkpoint={name}: {url} lists {', '.join(names[:_SHOWN]) or 'nothing'}{more}"
            )
        if not checksums[file].startswith("sha256:"):
            raise UserError(f"{url}{_REGISTRY}: gives no sha256 of {file}")
        write_whole(index, content)  # whole or not at all: others may read it meanwhile
        keeper = pooch.create(
            folder, url, registry=checksums, urls=addresses, retry_if_failed=_RETRIES
        )
        return Path(keeper.fetch(file, downloader=load))
    except (requests.RequestException, ConnectionError) as error:
        raise UserError(
            f"checkpoint={name}: {url} cannot be fetched ({type(error).__name__})"
        ) from error
    except (ValueError, OSError) as error:
        reason = find_reason(error)[:200]
        raise UserError(f"checkpoint={name}: {url} sent something else ({reason})") from error
