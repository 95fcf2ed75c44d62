"""The names of a sweep's folders."""

from posefilter.cli.job import plain_name


def test_a_folder_is_called_what_was_chosen() -> None:
    assert plain_name("model=patch_pf,seed=0") == "model=patch_pf,seed=0"
    assert plain_name("++filter.steps=3,data.root=/a/b") == "filter.steps=3,data.root=_a_b"
    assert plain_name("") == plain_name("//") == "run"


def test_jobs_that_differ_only_at_the_end_of_a_long_name_have_folders_of_their_own() -> None:
    long = "model.loss_schedule=[{until: 1.0, loss_weights: {loss: 0.0, likelihood: 0.0}}]," * 3
    names = {plain_name(f"{long}seed={seed}") for seed in range(5)}
    assert len(names) == 5
    assert all(len(name) == 120 for name in names)
    assert plain_name("x" * 120) == "x" * 120
