"""README's Python example runs as it stands, in a clone."""

import re
from pathlib import Path
from typing import Any

import pytest

HOME = Path(__file__).parents[2]


def test_the_example_finds_the_box(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(HOME)
    (example,) = re.findall(r"```python\n(.*?)```", (HOME / "README.md").read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["result"].verdict == "found"
    assert names["result"].covariance.shape == (6, 6)
    assert "(95 %)" in capsys.readouterr().out
