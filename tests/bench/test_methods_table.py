"""The table of results, from metrics files written by hand."""

import importlib.util
import json
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "bench" / "methods_table.py"
spec = importlib.util.spec_from_file_location("methods_table", SCRIPT)
assert spec is not None
assert spec.loader is not None
methods_table = importlib.util.module_from_spec(spec)
spec.loader.exec_module(methods_table)


def run(folder: Path, on: float, *overrides: str) -> None:
    folder.mkdir(parents=True)
    metrics = {"particles_on_object": on, "iou": 0.5, "add": {"auc": 40.0}, "overrides": list(overrides)}
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_seeds_are_joined_and_other_choices_kept_apart(tmp_path: Path) -> None:
    both = ("model=patch_pf", "experiment=memorise")
    run(tmp_path / "a", 0.9, *both, "seed=0", "variant=working")
    run(tmp_path / "b", 0.8, *both, "seed=1", "variant=working", "trainer.max_epochs=3")
    run(tmp_path / "c", 0.2, *both, "seed=0", "variant=paper")
    runs = methods_table.read_runs([tmp_path])
    lines = methods_table.table(runs).splitlines()
    assert lines[0] == "| method | variant | changed | seeds | on object % | box IoU | ADD AUC |"
    assert lines[2] == "| patch_pf | paper |  | 1 | 20.0 | 0.50 | 40.0 |"
    assert lines[3] == "| patch_pf | working |  | 2 | 85.0 ± 5.0 | 0.50 ± 0.00 | 40.0 ± 0.0 |"


def test_only_the_named_table_is_replaced() -> None:
    page = "a\n<!-- table: x -->\nold\n<!-- end -->\nb\n<!-- table: y -->\nkept\n<!-- end -->\n"
    assert methods_table.insert(page, "x", "new") == page.replace("old", "new")
