"""What a result says in words."""

from types import SimpleNamespace

import pytest

from posefilter.result import Result


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("found", "box: found, probability 0.90"),
        ("unsure", "box: unsure, probability 0.90, 0.95 that it is there"),
        ("absent", "box: absent, probability 0.95 that it is there"),
        (None, "box, score 1.50"),
    ],
)
def test_an_unsure_answer_says_both_whether_it_is_there_and_whether_it_is_right(
    verdict: str | None, words: str
) -> None:
    one = SimpleNamespace(object="box", verdict=verdict, probability=0.9, presence=0.95, score=1.5)
    assert Result.describe(one) == words  # type: ignore[arg-type]
