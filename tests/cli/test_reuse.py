"""Which jobs of a sweep learn the same."""

from pathlib import Path

import pytest

from posefilter.cli.command import compose_job
from posefilter.cli.reuse import learned_from

CONF = Path(__file__).parents[2] / "conf"


@pytest.mark.parametrize(
    ("common", "changed", "same"),
    [
        ([], ["filter.particles=50"], True),
        ([], ["filter/refine=none", "data.limit_test=3", "threads=2", "out=elsewhere"], True),
        ([], ["train_pixels=32"], False),
        ([], ["seed=1"], False),
        ([], ["trainer.max_steps=7"], False),
        ([], ["data.limit_train=100"], False),
        (["model=patch_pf"], ["filter.particles=50"], False),
        (["model=patch_pf", "model/train_rollout=short"], ["filter/refine=mean_shift"], True),
        (["model=patch_pf", "model/train_rollout=short"], ["filter.particles=50"], False),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, list) else None,
)
def test_training_is_shared_where_no_setting_of_it_differs(
    common: list[str], changed: list[str], same: bool, tmp_path: Path
) -> None:
    """pose_pf scores candidates and rolls out no filter; a short roll-out has as many
    particles.
    """
    changed = [f"model.{c}" if c.startswith("train_pixels") else c for c in changed]
    one = compose_job("train", CONF, common, tmp_path / "one")
    other = compose_job("train", CONF, [*common, *changed], tmp_path / "other")
    assert (learned_from(one) == learned_from(other)) == same
