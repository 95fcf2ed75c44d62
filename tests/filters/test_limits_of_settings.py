"""Settings at the ends of their ranges are taken, and those beyond are refused."""

from typing import Any

import pytest

from posefilter.errors import UserError
from posefilter.filters.agreement import Agreement
from posefilter.filters.candidates import PersistentParticles
from posefilter.filters.importance import ImportanceSampling
from posefilter.filters.initialize import FromDepth
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.refine import MeanShift
from posefilter.filters.resample import Islands, Soft, Systematic
from posefilter.filters.resample_move import ResampleMove
from posefilter.filters.schedule import Geometric
from posefilter.models.candidate_samplers import CandidatePoses


def make_filter(**settings: Any) -> ParticleFilter:
    return ParticleFilter(
        **{"particles": 2, "steps": 2} | settings,
        **dict.fromkeys(
            ("initialize", "schedule", "reweight", "resample", "propagate", "estimate", "refine")
        ),  # type: ignore[arg-type]
    )


def make_islands(size: int) -> Islands:
    return Islands(Systematic(), size)


@pytest.mark.parametrize(
    ("make", "legal", "wrong"),
    [
        (make_filter, {"particles": 1, "initial_particles": 2}, {"particles": 0}),
        (make_filter, {"initial_particles": 1}, {"initial_particles": 0}),
        (make_filter, {"steps": 1}, {"steps": 0}),
        (Agreement, {"hypotheses": 1}, {"hypotheses": 0}),
        (Agreement, {"top_fragments": 1}, {"top_fragments": 0}),
        (Agreement, {"scale_m": 1e-6}, {"scale_m": 0.0}),
        (PersistentParticles, {"particles": 1}, {"particles": 0}),
        (FromDepth, {"depth_offset": (-0.1, -0.1)}, {"depth_offset": (0.9, 0.1)}),
        (FromDepth, {"depth_offset": (0, 1)}, {"depth_offset": (0.1,)}),
        (CandidatePoses, {"sigma_range": (0.1, 0.1)}, {"sigma_range": (0.25, 0.004)}),
        (CandidatePoses, {"sigma_range": (0.1, 0.2)}, {"sigma_range": (0.0, 0.25)}),
        (PersistentParticles, {"levels": 2}, {"levels": 1}),
        (ImportanceSampling, {"samples": 1}, {"samples": 0}),
        (ImportanceSampling, {"rounds": 1}, {"rounds": 0}),
        (ImportanceSampling, {"widening": 1.0}, {"widening": 0.99}),
        (ImportanceSampling, {"temperature": 1e-6}, {"temperature": 0.0}),
        (MeanShift, {"iterations": 1}, {"iterations": 0}),
        (MeanShift, {"antithetic_pairs": 1}, {"antithetic_pairs": 0}),
        (
            MeanShift,
            {"initial_scale": 0.01, "final_scale": 0.01},
            {"initial_scale": 0.01, "final_scale": 0.011},
        ),
        (MeanShift, {"final_scale": 1e-6}, {"final_scale": 0.0}),
        (make_islands, {"size": 1}, {"size": 0}),
        (Soft, {"alpha": 0.0}, {"alpha": -0.01}),
        (Soft, {"alpha": 1.0}, {"alpha": 1.01}),
        (ResampleMove, {"sweeps": 0}, {"sweeps": -1}),
        (ResampleMove, {"rotation_probability": 0.0}, {"rotation_probability": -0.01}),
        (ResampleMove, {"rotation_probability": 1.0}, {"rotation_probability": 1.01}),
        (ResampleMove, {"uniform_angle_probability": 0.0}, {"uniform_angle_probability": -0.01}),
        (ResampleMove, {"uniform_angle_probability": 1.0}, {"uniform_angle_probability": 1.01}),
        (ResampleMove, {"temperature": 1e-6}, {"temperature": 0.0}),
        (
            Geometric,
            {"initial_sigma": 1e-6, "final_sigma": 0.1},
            {"initial_sigma": 0.0, "final_sigma": 0.1},
        ),
        (
            Geometric,
            {"initial_sigma": 0.1, "final_sigma": 1e-6},
            {"initial_sigma": 0.1, "final_sigma": 0.0},
        ),
    ],
)
def test_the_end_of_a_range_is_legal_and_what_lies_beyond_is_not(
    make: Any, legal: dict[str, float], wrong: dict[str, float]
) -> None:
    make(**legal)
    with pytest.raises(UserError) as caught:
        make(**wrong)
    assert "\n" not in str(caught.value)
