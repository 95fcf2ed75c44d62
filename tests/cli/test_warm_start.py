"""A run may begin with the weights of another object's filter: the weights, and nothing that
describes the object.
"""

from pathlib import Path

import pytest
import torch

from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.cli.warm_start import name_modules, read_starts, warm_start
from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore, object_model
from posefilter.models.base import PoseEstimator
from posefilter.models.quantization import pack
from posefilter.weights import list_shipped

CONF = Path(__file__).parents[2] / "conf"


def build(folder: Path, name: str, seed: int, *overrides: str) -> PoseEstimator:
    """Return an untrained method for a builtin object."""
    torch.manual_seed(seed)
    small = (
        ["model.net.width=16", "model.net.latent_width=8"] if "model=patch_pf" in overrides else []
    )
    method = build_method(recipe(compose_job("train", CONF, [*overrides, *small], folder)))
    method.set_object(object_model(MeshStore("builtin").load(name), count=200))
    return method


@pytest.mark.parametrize("model", ["patch_pf", "pose_pf"])
def test_weights_are_copied_and_the_object_stays(model: str, tmp_path: Path) -> None:
    old, new = (
        build(tmp_path, "carton", 0, f"model={model}"),
        build(tmp_path, "mug", 1, f"model={model}"),
    )
    own = {
        name: value.clone()
        for name, value in new.named_buffers()
        if name.endswith(("centers", "reach"))
    }
    assert own
    with torch.no_grad():
        for name, value in old.named_buffers():
            if name.endswith("running_mean"):
                value.fill_(0.25)
    copied, left = warm_start(new, [{"state_dict": old.state_dict()}])
    assert (copied > 20, left) == (True, [])
    theirs = dict(old.named_parameters())
    for name, value in new.named_parameters():
        assert torch.equal(value, theirs[name]), name
    for name, value in new.named_buffers():
        if name in own:
            assert torch.equal(value, own[name]), name
        if name.endswith("running_mean"):
            assert bool((value == 0.25).all()), name
    assert new.object_model.name == "mug"


def test_what_begins_at_random_is_named(tmp_path: Path) -> None:
    old, new = (build(tmp_path, "carton", seed, "model=pose_pf") for seed in (0, 1))
    there = old.state_dict()
    lacking = {name for name, _ in new.named_parameters() if name.startswith("likelihood.surface.")}
    _, left = warm_start(
        new, [{"state_dict": {k: v for k, v in there.items() if k not in lacking}}]
    )
    assert set(left) == lacking
    assert name_modules(left) == f"likelihood.surface ({len(lacking)} tensors)"


def test_exported_weights_are_read_too(tmp_path: Path) -> None:
    old, new = (
        build(tmp_path, "carton", 0, "model=pose_pf"),
        build(tmp_path, "carton", 1, "model=pose_pf"),
    )
    warm_start(new, [{"state_dict": pack(old.state_dict())}])
    there = old.state_dict()
    for name, value in new.named_parameters():
        off = (value.detach() - there[name]).abs().max()
        assert float(off) <= 0.01 * float(there[name].abs().max()) + 1e-6, name


def test_weights_of_another_method_are_refused(tmp_path: Path) -> None:
    old, new = (
        build(tmp_path, "carton", 0, "model=pose_pf"),
        build(tmp_path, "carton", 1, "model=patch_pf"),
    )
    with pytest.raises(UserError, match="warm_start: only"):
        warm_start(new, [{"state_dict": old.state_dict()}])


def test_several_start_as_their_mean_and_what_one_lacks_is_of_the_others(tmp_path: Path) -> None:
    one, two, new = (build(tmp_path, "carton", seed, "model=pose_pf") for seed in (0, 1, 2))
    there = {name: value.clone() for name, value in two.state_dict().items()}
    lacking = next(name for name, _ in one.named_parameters() if "likelihood" in name)
    del there[lacking]
    copied, left = warm_start(new, [{"state_dict": one.state_dict()}, {"state_dict": there}])
    assert (copied > 20, left) == (True, [])
    for name, value in new.named_parameters():
        first = dict(one.named_parameters())[name]
        mean = first if name == lacking else (first + there[name]) / 2
        torch.testing.assert_close(value, mean, msg=name)


def test_of_several_the_one_of_the_same_object_is_left_out() -> None:
    def names(weights: object, own: str) -> list[str]:
        return [one["object_model"]["name"] for one in read_starts(weights, own)]

    pair = ["003_cracker_box", "011_banana"]
    assert names(pair, "025_mug") == pair
    assert names(pair, "011_banana") == ["003_cracker_box"]
    assert names("011_banana", "011_banana") == ["011_banana"]
    assert len(names("all", "025_mug")) == len(list_shipped()) - 1
    with pytest.raises(UserError, match="no_such_weights"):
        read_starts(["003_cracker_box", "no_such_weights"], "025_mug")


@pytest.mark.parametrize("weights", [5, "nothing", ["nothing"]])
def test_a_start_that_is_none_is_named_by_its_own_setting(weights: object) -> None:
    with pytest.raises(UserError, match=r"^warm_start="):
        read_starts(weights, "carton")
