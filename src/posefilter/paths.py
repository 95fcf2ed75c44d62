"""Keep what files say of other files inside one folder: no absolute path, no `..`, no link out."""

import os
import unicodedata
from functools import lru_cache
from pathlib import Path, PureWindowsPath

from posefilter.errors import UserError, printable

_FORMULAS = ("=", "+", "-", "@")  # what begins so a spreadsheet computes


def find_conf() -> Path:
    """Return the folder of the configuration: inside an installed package, else the clone's."""
    here = Path(__file__).parent
    inside = here / "conf"
    return inside if inside.is_dir() else here.parents[1] / "conf"


def is_plain_name(name: str) -> bool:
    """Tell whether a name is one part of a path and nothing else: no separator, no leading dot,
    nothing that a spreadsheet takes for a formula or a command for an option, only what can be
    printed, also where letters that mean the same are made one; a file of that name, with a suffix,
    can be made.
    """
    same = unicodedata.normalize("NFKC", name)
    return (
        0 < len(name) <= 100
        and name.isprintable()
        and len(name.encode()) <= 200
        and name == name.strip()
        and not same.startswith((".", "~", *_FORMULAS))
        and not set(same) & set("/\\:")
    )


def name_in_table(name: str) -> str:
    """Return a file's name as a table has it: as it is, but for what a terminal would obey, and a
    `./` ahead of what a spreadsheet would take for a formula.
    """
    return f"./{printable(name)}" if name.startswith(_FORMULAS) else printable(name)


def stays_inside(path: str, folder: Path) -> bool:
    """Tell whether a path that a file states is relative and stays below a folder, links resolved.

    A folder `outputs` that the user has made a link counts as a part of the folder.
    """
    if "\0" in path or "://" in path or path.startswith("~"):
        return False
    for kind in (Path(path), PureWindowsPath(path)):
        if kind.is_absolute() or kind.drive or ".." in kind.parts:
            return False
    homes = (Path(os.path.realpath(folder)), Path(os.path.realpath(folder / "outputs")))
    return any(Path(os.path.realpath(folder / path)).is_relative_to(home) for home in homes)


def find_list(file: str, root: Path) -> Path | None:
    """Return where a list of frames is that a setting names: by its path, or in a dataset's folder
    or that of the dataset above, with or without `image_sets`; None: nowhere.
    """
    inner = (Path(file), Path("image_sets", file))
    candidates = (Path(file), *(home / one for home in (root, root.parent) for one in inner))
    return next((path for path in candidates if path.is_file()), None)


def check_inside(path: Path, root: Path) -> Path:
    """Return a path below a root as it is.

    Raises UserError where links or `..` lead out of the root.
    """
    folder, home = _real(str(path.parent)), _real(str(root))
    real = os.path.realpath(path) if path.is_symlink() else f"{folder}/{path.name}"
    if path.name == ".." or os.path.commonpath([real, home]) != home:
        raise UserError(
            f"{path}: leads out of {root}; what a dataset or mesh names must lie in its own "
            "folder: name the folder that it leads to instead"
        )
    return path


def check_links(folder: Path, instead: str = "give another out=") -> None:
    """Raise UserError where a link leads out of a folder: what is written would go elsewhere.

    Args:
        folder: The folder; it need not be there.
        instead: What to do where the link is to stay, for messages.
    """
    home = os.path.realpath(folder)
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place, name)
            if path.is_symlink() and os.path.commonpath([os.path.realpath(path), home]) != home:
                raise UserError(
                    f"{path}: is a link that leads out of {folder}, and what is written would go "
                    f"elsewhere; remove it, or {instead}"
                )


@lru_cache(maxsize=4096)
def _real(folder: str) -> str:
    return os.path.realpath(folder)
