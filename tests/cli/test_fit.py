"""Choices are matched by what classes declare, before torch is imported, and a refusal names what
fits.
"""

import re
from pathlib import Path

import pytest
from tests.cli.conftest import Cold
from tests.models.toy import square

from posefilter.capabilities import MEANINGS, Declared, find_missing, read_declared
from posefilter.cli.choices import check_choices
from posefilter.cli.command import compose_job
from posefilter.cli.fit import check_fit, read_attribute
from posefilter.cli.instantiate import locate
from posefilter.cli.trust import Scope
from posefilter.errors import UserError
from posefilter.filters.agreement import Agreement
from posefilter.models.base import PoseEstimator

CONF = Path(__file__).parents[2] / "conf"


def refuse(tmp_path: Path, *overrides: str) -> str:
    job = compose_job("train", CONF, list(overrides), tmp_path)
    with pytest.raises(UserError) as refusal:
        check_fit(job.cfg, job.choices, Scope.CONFIG)
    return str(refusal.value)


def test_source_and_class_declare_the_same() -> None:
    """What is read before torch is imported is what the imported class has."""
    names = {
        name
        for file in CONF.rglob("*.yaml")
        for name in re.findall(r"_target_: *[\"']?(posefilter\.[\w.]+)", file.read_text())
    }
    names = {name for name in names if not name.startswith("posefilter.cli.")}  # Hydra builds these
    declaring = 0
    for name in names:
        kind = locate(name, "x")
        if isinstance(kind, type):
            module, _, attribute = name.rpartition(".")
            told = Declared(
                *(frozenset(read_attribute(module, attribute, w) or ()) for w in Declared._fields)
            )
            assert told == read_declared(kind), name
            assert told.provides | told.requires <= set(MEANINGS), name
            declaring += told != Declared()
    assert declaring > 25


def test_every_name_is_provided_by_someone() -> None:
    source = "\n".join(
        file.read_text()
        for file in (CONF.parent / "src" / "posefilter").rglob("*.py")
        if file.name != "capabilities.py"
    )
    found = re.findall(r"provides: ClassVar\[Capabilities\] = \(([^)]*)\)", source)
    provided = set(re.findall(r'"(\w+)"', " ".join(found)))
    assert provided == set(MEANINGS)


def test_what_is_missing_is_what_nobody_provides() -> None:
    pose, judge = Declared(frozenset({"pose"})), Declared(requires=frozenset({"pose", "rollout"}))
    assert find_missing([judge, pose]) == [(0, "rollout")]
    assert find_missing([judge]) == [(0, "pose"), (0, "rollout")]
    assert find_missing([pose]) == []


REFUSED = {
    # which refers to a setting of the methods that see patches
    "model=pose_pf loss=bce": ("loss=bce does not fit model=pose_pf", "choose loss=contrastive"),
    "model=pose_pf loss=add": ("loss=add does not fit model=pose_pf", "choose loss=contrastive"),
    "model=pose_pf loss=regression": (
        "labeled rays",
        "choose loss=contrastive, or model/candidate_sampler=labeled_rays with "
        "model/likelihood=paper",
    ),
    "model=patch_pf loss=contrastive": (
        "candidate poses",
        "choose loss=add, add_s, balanced_bce, bce, belief_nll, belief_nll_pose, chamfer, "
        "chamfer_rgbd, confidence, focal or offset",
    ),
    "model=cnn_patch loss=add": (
        "loss=balanced_bce, bce, belief_nll, chamfer, chamfer_rgbd, focal or offset",
    ),
    "model=patch_pf filter/refine=rescore": (
        "filter/refine=rescore",
        "choose filter/refine=icp, icp_texture or none",
    ),
    "model=pose_pf model/proposals=none": (
        "filter/initialize=from_depth",
        "or model/proposals=dense",
    ),
    "model=patch_pf model/box_head=votes": (
        "model/box_head=pose or quantiles",
        "or model/net=patch",
    ),
    "model=patch_pf loss/aux/pose=none model/pose_head=fragments": (
        "model/pose_head=fragments",
        "loss/aux/pose=surface_point",
    ),
}


@pytest.mark.parametrize("typed", REFUSED)
@pytest.mark.slow
def test_a_refusal_names_the_choices_that_fit(typed: str, tmp_path: Path) -> None:
    said = refuse(tmp_path, *typed.split())
    assert "\n" not in said
    for word in REFUSED[typed]:
        assert word in said
    # and what it names, fits
    group, names = re.search(r"choose ([\w/]+)=([\w, ]+?)(?:, or|$)", said).groups()  # type: ignore[union-attr]
    kept = [t for t in typed.split() if not t.startswith(f"{group}=")]
    for name in re.split(r", | or ", names):
        job = compose_job("train", CONF, [*kept, f"{group}={name}"], tmp_path)
        check_fit(job.cfg, job.choices, Scope.CONFIG)
    if pair := re.search(r" or (\S+=\S+) with (\S+=\S+)$", said):
        job = compose_job("train", CONF, [*typed.split(), *pair.groups()], tmp_path)
        check_fit(job.cfg, job.choices, Scope.CONFIG)


def test_a_class_that_is_typed_by_itself_is_named_so(tmp_path: Path) -> None:
    said = refuse(tmp_path, "model=pose_pf", "loss._target_=posefilter.losses.pose_loss.Confidence")
    assert "Confidence" in said or "loss=confidence" in said


def test_torch_is_not_imported_for_it(cold: Cold, tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path;"
        "from posefilter.cli.command import compose_job; from posefilter.cli.fit import check_fit;"
        "from posefilter.cli.trust import Scope;"
        f"job = compose_job('train', Path({str(CONF)!r}), ['model=patch_pf'], Path());"
        "check_fit(job.cfg, job.choices, Scope.CONFIG); sys.exit('torch' in sys.modules)"
    )
    assert cold.run(code, tmp_path).returncode == 0


def test_parts_put_together_in_python_are_matched_too(tmp_path: Path) -> None:
    from posefilter.cli.checkpoints import build_method, recipe

    method = build_method(recipe(compose_job("train", CONF, ["model=cnn_patch"], tmp_path)))
    assert isinstance(method, PoseEstimator)
    assert "pose" not in method.capabilities
    method.set_object(square())
    method.filter.estimate = Agreement()
    with pytest.raises(UserError, match=r"CnnPatch: its Agreement needs .*pose"):
        method.set_object(square())


def test_what_each_name_obliges_to_is_written_down() -> None:
    text = (CONF.parent / "docs" / "architecture.md").read_text()
    table = text.split("## Capabilities")[1]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == set(MEANINGS)


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("ablation=c1_normalization", "is a step of model=patch_pf or .*, not of model=pose_pf"),
        ("model=pose_pf ablation=s1_glimpse", "is a step of .*, not of model=pose_pf"),
        ("model=patch_pf ablation=box_c11_votes", "of model=cnn_patch or downsized, not of"),
        ("model=cnn_patch ablation=paper,pose_c14_fragments", "of model=patch_pf or pixel_pf, not"),
        ("model=downsized ablation=pose_pf_c2_network", "is a step of model=pose_pf, not of"),
        (
            "model=patch_pf ablation=c3_bounded variant=working",
            "from variant=paper; leave variant=",
        ),
        ("model=patch_pf variant=paper,working ablation=m9_context", "from variant=working; leave"),
    ],
)
def test_a_step_between_variants_is_of_a_method_and_of_a_variant(typed: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        check_choices(typed.split(), CONF, "train")


@pytest.mark.parametrize(
    "typed",
    ["", "variant=paper", "experiment=cracker_box_pixels", "model=my_own", "model=cnn_patch"],
)
def test_a_step_that_fits_is_none_of_them(typed: str) -> None:
    name = "box_c11_votes" if typed == "model=cnn_patch" else "paper"
    check_choices([*typed.split(), f"ablation={name}"], CONF, "train")
