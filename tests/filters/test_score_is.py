"""Each estimate, and each refinement that scores anew, says what its score is."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from posefilter.cli.instantiate import instantiate
from posefilter.filters.estimate import Argmax, DensestMode
from posefilter.filters.importance import ImportanceSampling
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.refine import Compose, MeanShift, NoRefine, Rescore

GROUPS = Path(__file__).parents[2] / "conf" / "filter"


def make_filter(estimate: object, refine: object) -> ParticleFilter:
    return ParticleFilter(1, 1, *[None] * 5, estimate, refine)  # type: ignore[arg-type]


@pytest.mark.parametrize("choice", sorted(path.stem for path in (GROUPS / "estimate").glob("*")))
def test_every_estimate_says_what_its_score_is(choice: str) -> None:
    estimate = instantiate(
        OmegaConf.load(GROUPS / "estimate" / f"{choice}.yaml"), "filter.estimate"
    )
    said = make_filter(estimate, NoRefine()).score_is
    assert said == estimate.score_is
    assert said.endswith("no probability")
    assert ("log-likelihood" in said) == (choice in ("argmax", "mean"))


def test_a_refinement_that_scores_anew_has_the_last_word() -> None:
    densest = DensestMode(0.01)
    assert "kernel" in make_filter(densest, Compose([])).score_is
    assert "kernel" in make_filter(densest, ImportanceSampling()).score_is  # keeps the score
    refined = make_filter(densest, Compose([Rescore(), MeanShift(), ImportanceSampling()])).score_is
    assert refined == MeanShift.score_is
    assert refined != Argmax.score_is


def test_an_estimate_of_a_plugin_need_not_say_it() -> None:
    class Own: ...

    assert make_filter(Own(), NoRefine()).score_is == "as Own defines it"
