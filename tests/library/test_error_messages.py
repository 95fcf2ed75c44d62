"""Reasons are told in one line, those of errors without a message too."""

from types import SimpleNamespace
from typing import Any

import pytest

from posefilter.errors import UserError, find_reason
from posefilter.estimator import Estimator


def test_a_reason_is_the_first_line_or_the_class() -> None:
    assert find_reason(ValueError("too long\nby far")) == "too long"
    assert find_reason(ValueError()) == "ValueError"
    assert find_reason(ValueError("")) == "ValueError"


@pytest.mark.parametrize("wrong", [3, "003_cracker_box", ["003_cracker_box"], None])
def test_an_estimator_of_something_else_names_load(wrong: Any) -> None:
    with pytest.raises(UserError, match=r"needs a list of methods; posefilter\.load makes one"):
        Estimator(wrong)


def test_a_device_that_fails_without_a_message_is_refused() -> None:
    def fail(device: str) -> None:
        raise AssertionError

    method: Any = SimpleNamespace(capabilities={"pose"}, to=fail)
    with pytest.raises(UserError, match=r"^device=cuda: cannot be used \(AssertionError\)$"):
        Estimator([method], device="cuda")
    for device in ("mps", 0, ""):  # 0 is a GPU to torch, and no wish for whatever there is
        with pytest.raises(UserError, match=rf"^device={device}: choose cpu, cuda or cuda:N"):
            Estimator([method], device=device)  # type: ignore[arg-type]
