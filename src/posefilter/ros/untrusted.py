"""What a bag of somebody else may be: looked at before its reader opens it.

The reader opens whatever has the right name, and runs what a database defines: a view may compute
without end, and a computed column be as large as it likes.
"""

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from posefilter.errors import UserError
from posefilter.limits import read_bytes
from posefilter.paths import check_inside

_SQLITE = b"SQLite format 3\0"
# of YAML, plainly or by a tag or in UTF-16: a few lines of it stand for millions of keys
_MERGE = re.compile(rb"<<|!!|!<|\0|^%", re.MULTILINE)
_MOST_METADATA = 1 << 24  # [bytes]


def check_bag(path: Path) -> None:
    """Check a bag's file or folder.

    Raises:
        UserError: It has what is no file, leads out of its folder, metadata that multiply, or a
            database that computes.
    """
    for file in _list_files(path):
        if file.name == "metadata.yaml" and _MERGE.search(read_bytes(file, _MOST_METADATA)):
            raise UserError(f"{file}: has merge keys or tags (<<, !!), which no recorder writes")
        with file.open("rb") as opened:
            database = opened.read(len(_SQLITE)) == _SQLITE
        if database and (computed := _find_computed(file)):
            raise UserError(f"{file}: has {computed}, which no recorder writes")


def _list_files(path: Path) -> Iterator[Path]:
    """Yield the bag's files.  Raises UserError where one is none."""
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if path.is_dir():
            check_inside(file, path)
        if file.is_file():
            yield file
        elif file.exists() and not file.is_dir():
            raise UserError(f"{file}: is no file that can be read")


def _find_computed(file: Path) -> str:
    """Return what a database computes when it is read, "" for nothing."""
    with closing(sqlite3.connect(f"{file.resolve().as_uri()}?immutable=1", uri=True)) as database:
        for kind, name, source in database.execute("SELECT type, name, sql FROM sqlite_master"):
            if kind not in ("table", "index"):
                return f"a {str(kind)[:20]}"
            if kind == "table" and re.match(r"\s*CREATE\s+VIRTUAL", str(source), re.IGNORECASE):
                return "a virtual table"
            columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,))
            if kind == "table" and any(hidden for (hidden,) in columns):
                return "a computed column"
    return ""
