"""Names of a dataset's or video's files are data in every table, whatever opens it."""

import csv
from pathlib import Path

import pytest

from posefilter.files import open_whole_text, write_whole
from posefilter.metrics.image_errors import ImageError, read_errors, write_errors
from posefilter.tracking.records import write_rows

NAMES = {
    "=1+1/scene/000000": "./=1+1/scene/000000",
    "@x": "./@x",
    "-2": "./-2",
    "+3": "./+3",
    "a\udcff\x1b[2J\n=1": r"a\udcff\x1b[2J\n=1",  # bytes that are in no encoding
    "mixed/süß =1": "mixed/süß =1",
}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_of_an_image_is_no_formula(name: str, tmp_path: Path) -> None:
    row = ImageError(1, 2, 3, "can", name, 0.5, 1, 1, 100, 0.5, 0.5, 0.5)
    write_errors(tmp_path / "errors.csv", [row])
    (read,) = read_errors(tmp_path / "errors.csv")
    assert read.image == NAMES[name]
    write_rows(tmp_path, [{"video": name, "frame": name, "object": "can"}])
    with (tmp_path / "tracks.csv").open(newline="") as file:
        (track,) = csv.DictReader(file)
    assert (track["video"], track["frame"], track["object"]) == (NAMES[name], NAMES[name], "can")


def test_what_is_in_no_encoding_is_written_by_its_number(tmp_path: Path) -> None:
    write_whole(tmp_path / "a", "ü\udcff")
    with open_whole_text(tmp_path / "b") as file:
        file.write("ü\udcff")
    assert (tmp_path / "a").read_text() == (tmp_path / "b").read_text() == r"ü\udcff"
