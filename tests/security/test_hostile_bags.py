"""A bag is data: its database computes nothing, its metadata do not multiply, and what is no file
is not waited for.
"""

import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rosbags")

from tests.security.test_small_and_large import refuse

from posefilter.errors import UserError
from posefilter.ros.bags import BagReader, Topics

KINDS = {
    "/c": "sensor_msgs/msg/Image",
    "/d": "sensor_msgs/msg/Image",
    "/i": "sensor_msgs/msg/CameraInfo",
}
MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB{})"
)
ENDLESS = (
    "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) "
    "SELECT max(x) AS schema_version FROM c"
)
METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  duration: {nanoseconds: 1}
  starting_time: {nanoseconds_since_epoch: 1}
  message_count: 0
  topics_with_message_count:
    - {topic_metadata: {name: /c, type: sensor_msgs/msg/Image, serialization_format: cdr,
        offered_qos_profiles: ""}, message_count: 0}
  compression_format: ""
  compression_mode: ""
  relative_file_paths: [x.db3]
"""
LEVEL = "a{}: &a{}\n  {}: [{}]\n"


def write_database(path: Path, computed: str = "", *statements: str) -> Path:
    connection = sqlite3.connect(path)
    connection.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
        "serialization_format TEXT, offered_qos_profiles TEXT)"
    )
    for i, (name, kind) in enumerate(KINDS.items(), 1):
        connection.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (i, name, kind))
    for statement in (MESSAGES.format(computed), *statements):
        connection.execute(statement)
    connection.commit()
    connection.close()
    return path


def write_folder(folder: Path, metadata: str = METADATA) -> Path:
    folder.mkdir()
    (folder / "metadata.yaml").write_text(metadata)
    write_database(folder / "x.db3")
    return folder


def multiply(key: str) -> str:
    """Metadata of 9^9 pairs."""
    levels = (LEVEL.format(i, i, key, ", ".join([f"*a{i - 1}"] * 9)) for i in range(1, 10))
    return "a0: &a0 {x: 1}\n" + "".join(levels) + "rosbag2_bagfile_information: *a9\n"


def linked(folder: Path) -> Path:
    write_folder(folder)
    (folder / "x.db3").rename(folder.parent / "elsewhere.db3")
    (folder / "x.db3").symlink_to(folder.parent / "elsewhere.db3")
    return folder


def piped(folder: Path, name: str) -> Path:
    write_folder(folder)
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    return folder


def pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


BLOB = " GENERATED ALWAYS AS (zeroblob(900000000))"
FILLED = "INSERT INTO messages(id, topic_id, timestamp) VALUES (1, 1, 1)"
BAGS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a view without an end": (
        lambda top: write_database(top / "x.db3", "", f"CREATE VIEW schema AS {ENDLESS}"),
        "has a view",
    ),
    "a trigger": (
        lambda top: write_database(
            top / "x.db3",
            "",
            "CREATE TRIGGER t AFTER INSERT ON topics BEGIN DELETE FROM topics; END",
        ),
        "has a trigger",
    ),
    "messages that are computed": (
        lambda top: write_database(top / "x.db3", BLOB, FILLED),
        "has a computed column",
    ),
    "a database that is virtual": (
        lambda top: write_database(top / "x.db3", "", "CREATE VIRTUAL TABLE schema USING fts5(a)"),
        "has a virtual table",
    ),
    "metadata that multiply": (lambda top: write_folder(top / "b", multiply("<<")), "merge keys"),
    "metadata that multiply by a tag": (
        lambda top: write_folder(top / "b", multiply('!!merge "a"')),
        "merge keys",
    ),
    "metadata without an end": (lambda top: piped(top / "b", "metadata.yaml"), "is no file"),
    "a database without an end": (lambda top: piped(top / "b", "x.db3"), "is no file"),
    "a file without an end": (lambda top: pipe(top / "x.mcap"), "is no file"),
    "a link that leads out": (lambda top: linked(top / "b"), "leads out of"),
    "no database": (
        lambda top: (top / "x.db3", (top / "x.db3").write_bytes(b"SQLite format 3\0" * 300))[0],
        "cannot be read as a ROS 2 bag",
    ),
}


def read(path: Path) -> Any:
    with BagReader(path, Topics("/c", "/d", "/i"), 0.02) as reader:
        return list(reader.frames())


@pytest.mark.parametrize("what", BAGS)
def test_a_hostile_bag_is_refused(what: str, tmp_path: Path) -> None:
    make, said = BAGS[what]
    path = make(tmp_path)
    answer = refuse(lambda: read(path))
    assert said in answer
    assert answer.startswith(f"bag={tmp_path}")


def test_a_plain_bag_is_read(tmp_path: Path) -> None:
    """So that the others are refused for what was changed in them."""
    assert read(write_database(tmp_path / "x.db3")) == []
    with pytest.raises(UserError, match="no such topic; it has /c"):
        read(write_folder(tmp_path / "b"))
