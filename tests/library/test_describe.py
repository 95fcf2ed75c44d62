"""What a result says in words."""

from types import SimpleNamespace

import numpy as np
import pytest

from posefilter.cli.predict import mark_result, print_result
from posefilter.confidence.tolerance import PoseTolerance
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
    one = answer(verdict) if verdict else answer(None, probability=None)
    assert Result.describe(one) == words  # type: ignore[arg-type]


def test_no_probability_is_told_as_certain() -> None:
    """Some hundred calibration frames do not tell so much."""
    sure, none = answer("found", probability=0.9992), answer("absent", presence=0.002)
    assert Result.describe(sure) == "box: found, probability 0.99"  # type: ignore[arg-type]
    assert Result.describe(none) == "box: absent, probability 0.01 that it is there"  # type: ignore[arg-type]


NOTHING = {"wrong_size": False, "blank": "", "pose_tolerance": None}


def answer(verdict: str | None, **more: object) -> SimpleNamespace:
    own = {"object": "box", "probability": 0.9, "presence": 0.95, "score": 1.5}
    return SimpleNamespace(verdict=verdict, **{**NOTHING, **own, **more})


def test_an_image_that_cannot_be_judged_is_told_also_without_a_probability() -> None:
    said = Result.describe(answer("unsure", blank="black", probability=None))  # type: ignore[arg-type]
    assert said == "box: unsure, the image cannot be judged"


def mark(one: SimpleNamespace) -> tuple[str, str]:
    given = {
        "pose": np.eye(4),
        "warnings": (),
        "probability_within": lambda tolerance: one.probability if tolerance is None else 0.3,
    }
    drawn = mark_result(SimpleNamespace(**{**given, **vars(one)}), None)  # type: ignore[arg-type]
    return drawn.label, drawn.tag


def test_among_several_a_score_is_not_taken_for_a_probability() -> None:
    assert mark(answer(None, probability=None)) == ("box (score 1.5)", "")
    assert mark(answer("found")) == ("box (0.90)", "box 0.90")


def test_among_several_the_probability_is_that_of_the_tolerance_that_was_given() -> None:
    own = answer("unsure", pose_tolerance=PoseTolerance(translation_mm=1))
    assert mark(own) == ("box (unsure 0.30, there 0.95)", "box 0.30")


@pytest.mark.parametrize("verdict", ["found", "unsure", "absent"])
def test_a_wrong_size_is_told_where_it_makes_unsure(verdict: str) -> None:
    said = Result.describe(answer(verdict, wrong_size=True, scale_ratio=1.25))  # type: ignore[arg-type]
    assert ("appears 1.25 times its size" in said) == (verdict == "unsure")


@pytest.mark.parametrize(
    ("verdict", "told"), [("found", ["size", "outside"]), ("absent", ["size"])]
)
def test_the_pose_of_what_is_absent_raises_no_doubts(
    verdict: str, told: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """They would blame intrinsics that are right."""
    pose = np.eye(4)
    pose[:3, 3] = [-0.0493, 0.014, 0.597]
    one = answer(
        verdict,
        pose=pose,
        seconds=0.5,
        describe=lambda: "box",
        calibration=None,
        belief_calibrated=True,
        belief=SimpleNamespace(uncertainty=lambda: SimpleNamespace(describe=lambda: "within 1 mm")),
        warnings=("size", "outside"),
        input_warnings=("size",),
    )
    print_result(one)  # type: ignore[arg-type]
    lines = capsys.readouterr().out.splitlines()
    at = "" if verdict == "absent" else ", at [-49.3  14.0 597.0] mm"  # a digit each
    assert lines[0] == f"box{at}, 0.50 s"
    assert [line for line in lines if line.startswith("warning")] == [
        f"warning: {one}" for one in told
    ]


def test_the_picture_of_a_belief_has_the_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    """It shows a pose, also of what is absent."""
    titles: list[str] = []
    monkeypatch.setattr(
        "posefilter.figures.belief.draw_belief", lambda *_, title, **__: titles.append(title)
    )
    one = answer(
        "absent",
        pose=np.eye(4),
        belief=SimpleNamespace(samples=np.eye(4)[None], weights=np.ones(1), draws=0),
        object_model=None,
        describe=lambda: Result.describe(one),  # type: ignore[arg-type]
    )
    Result.draw_belief(one, None, None)  # type: ignore[arg-type]
    assert titles == ["Belief\nbox: absent, probability 0.95 that it is there"]
