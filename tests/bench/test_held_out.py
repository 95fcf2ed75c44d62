"""The bench of held-out renders: kinds of objects, and rows that stay in their file."""

import csv
import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

HOME = Path(__file__).parents[2]


@pytest.fixture
def held_out(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/held_out.py")


def test_an_object_at_the_edge_is_cut_off_and_one_of_few_pixels_is_small(
    held_out: ModuleType,
) -> None:
    mask = np.zeros((240, 320), dtype=bool)
    mask[100:150, 100:150] = True
    assert held_out.kind_of(mask) == "whole"
    assert held_out.kind_of(np.roll(mask, -100, axis=1)) == "cut"
    mask[120:] = False
    assert held_out.kind_of(mask) == "small"
    # the same object in an image of twice the size has four times the pixels
    assert held_out.kind_of(np.kron(mask, np.ones((2, 2), dtype=bool))) == "small"


def test_each_kind_has_the_area_of_its_own_images(held_out: ModuleType) -> None:
    plain, symmetric = torch.tensor([0.0, 0.2, 0.05]), torch.tensor([0.0, 0.0, 0.2])
    found = held_out.measure_kinds(["whole", "cut", "whole"], plain, symmetric)
    assert found["small"] == [0, None, None]
    assert found["cut"] == [1, pytest.approx(0.0), pytest.approx(100.0)]
    assert found["whole"][0] == 2
    assert found["whole"][1] > found["whole"][2] == pytest.approx(50.0)


def _row(name: str, weights: str, part: str, area: float) -> dict[str, object]:
    areas = {"add_auc": area, "add_interval": [1, 2], "add_s_auc": 3.0, "add_s_interval": [2, 4]}
    shares = {"add_recall": 0.5, "add_s_recall": 0.5, "median_mm": 1.0}
    kinds = {"whole": [1, area, area], "cut": [0, None, None], "small": [0, None, None]}
    first = {"object": name, "weights": weights, "part": part, "images": 1, "scenes": 1}
    return first | areas | shares | {"kinds": kinds}


def test_rows_of_other_weights_stay_in_the_file(held_out: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(",".join(held_out.HEAD) + "\nin the frame,mug,old,test,1\n")
    held_out.write_rows([_row("mug", "old", "test", 10.0), _row("bowl", "old", "test", 20.0)], path)
    held_out.write_rows([_row("mug", "old", "test", 30.0), _row("mug", "old", "train", 40.0)], path)
    lines = path.read_text().splitlines()
    assert lines[0] == ",".join(held_out.HEAD)
    rows = [("bowl", "test", 20.0), ("mug", "test", 30.0), ("mug", "train", 40.0)]
    expected = [
        f"BOP,{name},old,{part},1,1,{area},1,2,3.0,2,4,50,50,1.0,1,{area},{area},0,,,0,,"
        for name, part, area in rows
    ]
    # what was chosen by another visibility is no earlier row of the same
    assert lines[1:] == [*expected, "in the frame,mug,old,test,1"]


def test_the_file_in_the_docs_stays_as_it_is_without_rows(
    held_out: ModuleType, tmp_path: Path
) -> None:
    copy = tmp_path / "rows.csv"
    copy.write_bytes(held_out.ROWS.read_bytes())
    held_out.write_rows([], copy)
    assert copy.read_bytes() == held_out.ROWS.read_bytes()
    with copy.open(newline="") as file:
        assert {len(cells) for cells in csv.reader(file)} == {len(held_out.HEAD)}


@pytest.fixture
def shipped(held_out: ModuleType) -> dict[str, dict[str, str]]:
    """Return the rows of the files that ship, by object."""
    with held_out.ROWS.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["visibility"] == "BOP"]
    return {row["object"]: row for row in rows if row["object"] == row["weights"]}


def test_the_page_of_weights_has_the_rows_of_the_files(shipped: dict[str, dict[str, str]]) -> None:
    text = (HOME / "weights" / "README.md").read_text()
    _, _, text = text.partition("## Accuracy on held-out")
    lines = dict(re.findall(r"^\| `(\w+)\.ckpt` \| (.*) \|$", text, re.MULTILINE))
    form = "{} | {} ({} to {}) | {} ({} to {}) | {} % | {} % | {} mm"
    columns = [
        "scenes",
        *(f"{e} AUC{end}" for e in ("ADD", "ADD-S") for end in ("", " from", " to")),
    ]
    columns += ["ADD < 0.1 d %", "ADD-S < 0.1 d %", "median mm"]
    wanted = {name: form.format(*map(row.get, columns)) for name, row in shipped.items()}
    assert lines == wanted


def test_the_page_of_photographs_has_the_loss_of_small_objects(
    shipped: dict[str, dict[str, str]],
) -> None:
    kinds = {"small": "fully in the frame", "truncated": "truncated", "in frame": "the others"}
    text = (HOME / "docs" / "results" / "photographs.md").read_text()
    count = {k: sum(int(row[f"{k}: images"]) for row in shipped.values()) for k in kinds}
    shares, means = [count["small"] / sum(count.values())], defaultdict[str, list[str]](list)
    for error in ("ADD", "ADD-S"):
        lost = {
            kind: sum(
                int(row[f"{kind}: images"]) * (100 - float(row[f"{kind}: {error} AUC"] or 0))
                for row in shipped.values()
            )
            for kind in kinds
        }
        shares.append(lost["small"] / sum(lost.values()))
        for kind, start in kinds.items():
            means[start].append(f"{100 - lost[kind] / count[kind]:.1f}")
    (sentence,) = re.findall(r"^Small objects still lose most: .*$", text, re.MULTILINE)
    assert re.findall(r"(\d+) %", sentence) == [f"{100 * share:.0f}" for share in shares]
    for start, areas in means.items():
        (row,) = re.findall(rf"^\| {start}[^|]* \| ([\d.]+) \| ([\d.]+) \|$", text, re.MULTILINE)
        assert [*row] == areas


def test_two_checkpoints_are_compared_on_the_same_images(held_out: ModuleType) -> None:
    scenes = [f"scene{i // 2}" for i in range(40)]
    worse = (torch.arange(40) + 0.5) / 1000
    first = held_out.Errors(worse, torch.zeros(40), 0.02)
    same = held_out.compare(scenes, first, first)
    assert "+0.0 [0.0, 0.0]" in same
    better = held_out.compare(scenes, first, held_out.Errors(worse / 2, torch.zeros(40), 0.02))
    cells = [cell.strip() for cell in better.strip("|").split("|")]
    gain, low, high = (
        float(x) for x in cells[1].replace("[", "").strip("]").replace(",", "").split()
    )
    assert 5 < low < gain < high < 15
    assert gain == pytest.approx(10.25, abs=1.5)
    assert cells[3] == "20, 40"
