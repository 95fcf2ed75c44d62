"""Every choice that conf/ offers composes and builds; every experiment and sweep does; mistakes end
in one good line.
"""

import re
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
import torch
import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf
from tests.conf.conftest import compose_once

from posefilter.cli import run_command
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.choices import check_choices, list_choices
from posefilter.cli.command import compose_config, compose_job
from posefilter.cli.comparing import leaves
from posefilter.cli.explain import explain
from posefilter.cli.fit import check_fit
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.cli.trust import Scope
from posefilter.errors import UserError
from posefilter.models.pose_pf import PosePF

HOME = Path(__file__).parents[2]
CONF = HOME / "conf"
MODELS = list_choices(CONF / "model")
VARIANTS = list_choices(CONF / "variant")
COMPARISONS = ("dense_coordinates", "keypoints", "parts_pf", "rotation_grid")  # not of the paper
PRESETS = [
    (model, variant) for model in MODELS for variant in list_choices(CONF / "preset" / model)
]
EXPERIMENTS = list_choices(CONF / "experiment")
ABLATIONS = ("ablation", "ablation_detect", "ablation_pose_pf")
SWEEPS = [
    *list_choices(CONF / "sweep"),
    *(pytest.param(name, marks=pytest.mark.slow) for name in ABLATIONS),
]
BUILT = (
    *(f"filter/{step}" for step in ("initialize", "schedule", "reweight", "resample")),
    *(f"filter/{step}" for step in ("propagate", "estimate", "refine")),
    "loss",
    "model/candidate_sampler",
    "model/likelihood",
)


def compose(tmp_path: Path, *overrides: str, name: str = "train") -> Job:
    return compose_job(name, CONF, list(overrides), tmp_path)


@pytest.mark.parametrize(("model", "variant"), PRESETS)
def test_every_variant_of_every_model_builds_with_a_legal_loss(model: str, variant: str) -> None:
    job = compose_once(f"model={model}", f"variant={variant}")
    method = build_method(recipe(job))
    assert any(p.requires_grad for p in method.parameters())
    assert method.filter.particles == job.cfg.filter.particles


def test_tests_compose_what_hydra_alone_composes(
    composing_by_hydra_alone: Callable[[pytest.MonkeyPatch], None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """`preset` is interpolated, and an ablation comes from the store."""
    overrides = ("model=patch_pf", "ablation=c5_displacement_loss", "seed=3")
    ours = compose(tmp_path, *overrides)
    composing_by_hydra_alone(monkeypatch)
    theirs = compose(tmp_path, *overrides)
    assert theirs.cfg == ours.cfg
    assert theirs.choices == ours.choices


@pytest.mark.parametrize(("model", "variant"), PRESETS)
def test_what_a_preset_sets_holds(model: str, variant: str) -> None:
    """No choice later in the list of defaults may undo it."""
    cfg = compose_once(f"model={model}", f"variant={variant}").cfg
    body = OmegaConf.load(CONF / "preset" / model / f"{variant}.yaml")
    del body["defaults"]
    settings = dict(leaves(OmegaConf.to_container(body)))
    assert settings
    for key, value in settings.items():
        assert OmegaConf.select(cfg, key) == value, key


def test_all_but_comparisons_have_both_variants() -> None:
    both = set(product(set(MODELS) - {*COMPARISONS}, VARIANTS))
    assert {*PRESETS} == both | {(model, "working") for model in COMPARISONS}


@pytest.mark.parametrize("model", COMPARISONS)
@pytest.mark.parametrize("typed", ["model={} variant=paper", "-m model=patch_pf,{} variant=paper"])
def test_a_comparison_has_no_variant_of_the_paper(
    model: str, typed: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, [*typed.format(model).split(), f"out={tmp_path / 'x'}"]) == 2
    said = capfd.readouterr().err.strip().splitlines()
    assert said == [
        f"train: variant=paper: model={model} has no such variant; choose variant=working"
    ]
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("model", sorted({*MODELS} - {"pose_pf", *COMPARISONS}))
def test_a_papers_choices_are_had_at_the_working_size(model: str) -> None:
    """`preset/size` changes numbers alone, and makes them those of the working preset."""
    paper = compose_once(f"model={model}", "variant=paper")
    small = compose_once(f"model={model}", "variant=paper", f"preset/size={model}")
    working = compose_once(f"model={model}", "variant=working")
    ignored = {"preset/size", "hydra/launcher"}
    assert {k: v for k, v in small.choices.items() if k not in ignored} == {
        k: v for k, v in paper.choices.items() if k not in ignored
    }
    for key in ("filter.particles", "filter.steps", "data.batch_size", "data.image_width"):
        assert OmegaConf.select(small.cfg, key) == OmegaConf.select(working.cfg, key), key
    assert small.cfg.model.net.width == working.cfg.model.net.width
    assert small.cfg.model.truncate is working.cfg.model.truncate is None


def read_comments(preset: Path) -> dict[str, list[str]]:
    """Return what comments of a preset, and of those that it includes, call the paper's choices."""
    found = {}
    for line in preset.read_text().splitlines():
        inner = re.match(r"  - (?:/preset/)?(_\w+)$", line)
        if inner and inner[1] != "_self_":
            found |= read_comments(CONF / "preset" / f"{inner[1]}.yaml")
        said = re.match(r"  - /([\w/]+): \w+ #.*\bpaper: ([\w, .=]+)", line)
        if said:
            found[said[1]] = [word.strip() for word in said[2].split(",")]
    return found


@pytest.mark.parametrize("model", sorted({*MODELS} - {*COMPARISONS}))
def test_a_presets_comments_name_the_papers_choices(model: str) -> None:
    paper = compose_once(f"model={model}", "variant=paper")
    comments = read_comments(CONF / "preset" / model / "working.yaml")
    assert len(comments) > 9
    for group, words in comments.items():
        for word in words:
            if "=" in word:
                key, value = word.split("=")
                assert OmegaConf.select(paper.cfg, key) == value, word
            elif not word.isdigit():
                assert word in list_choices(CONF / group), f"{group}: {word}"
        if words[0] in list_choices(CONF / group):
            assert paper.choices[group] in words, group


def test_the_papers_pose_filter_has_the_papers_figures(tmp_path: Path) -> None:
    method = build_method(recipe(compose(tmp_path, "variant=paper")))
    assert isinstance(method, PosePF)
    assert (method.filter.particles, method.filter.steps, method.proposals) == (1000, 100, None)


def test_the_page_on_the_pose_filter_names_all_that_leaves_the_paper() -> None:
    """With what the table's last column names, the working variant is the paper's."""
    paper = compose_once("variant=paper")
    page = (HOME / "docs" / "pose_pf.md").read_text()
    section = page.split("## Differences from the paper")[1].split("What each is worth")[0]
    rows = [line.split(" | ")[-1] for line in section.splitlines() if line.startswith("| ")]
    named = [
        word for row in rows for code in re.findall(r"`([^`]+)`", row) for word in code.split()
    ]
    restored = []
    for word in dict.fromkeys(named):
        key, value = word.split("=", 1)
        own = paper.choices.get(key, OmegaConf.select(paper.cfg, key))
        if str(own).lower() == value.replace("null", "none"):  # others are steps on the way
            restored.append(word)
    # of the batch, whose size and length are not of the method
    found = compose_once(*restored, "model.likelihood_batch_size=null")
    for part in ("model", "loss", "filter", "optimizer", "scheduler", "data.augment"):
        assert OmegaConf.select(found.cfg, part) == OmegaConf.select(paper.cfg, part), part


@pytest.mark.parametrize("experiment", EXPERIMENTS)
@pytest.mark.parametrize("model", MODELS)
def test_every_experiment_builds(experiment: str, model: str, tmp_path: Path) -> None:
    chosen = (
        []
        if "override /model" in (CONF / "experiment" / f"{experiment}.yaml").read_text()
        else [f"model={model}"]
    )
    job = compose(tmp_path, *chosen, f"experiment={experiment}", "data.meshes=somewhere")
    build_method(recipe(job))
    job.cfg.folder = str(tmp_path)
    assert OmegaConf.to_container(job.cfg.data, resolve=True)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_point_of_every_sweep_composes(sweep: str) -> None:
    kinds = {"ablation_detect": "cnn_patch", "ablation_pose_pf": "pose_pf"}
    model = kinds.get(sweep, "patch_pf")
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        swept = hydra_compose(
            "train", [f"model={model}", f"sweep={sweep}"], return_hydra_config=True
        )
    points = [
        f"{key}={value}"
        for key, values in swept.hydra.sweeper.params.items()
        for value in str(values).split(",")
    ]
    assert points
    for point in points:
        job = compose_once(f"model={model}", point)
        check_fit(job.cfg, job.choices, Scope.CONFIG)


@pytest.mark.parametrize("group", BUILT)
def test_every_piece_builds_by_itself(group: str, tmp_path: Path) -> None:
    for path in sorted((CONF / group).glob("*.yaml")):
        cfg = OmegaConf.load(path)
        if "${" not in path.read_text():
            assert instantiate(cfg, group) is not None, path


@pytest.mark.parametrize("data", sorted(path.stem for path in (CONF / "data").glob("[!_]*.yaml")))
def test_every_data_choice_builds(data: str, tmp_path: Path) -> None:
    module = instantiate(compose(tmp_path, f"data={data}", "data.root=somewhere").cfg.data, "data")
    assert module.source == data


def test_callbacks_loggers_and_trainer_build(tmp_path: Path) -> None:
    cfg = compose(tmp_path).cfg
    cfg.folder = str(tmp_path)
    assert "best" in instantiate(cfg.callbacks, "callbacks")
    assert instantiate(cfg.trainer, "trainer", logger=False).max_steps == cfg.trainer.max_steps


MISTAKES = {
    "model=pose_fp": ("model=pose_fp", "pose_pf"),
    "modle=pose_pf": ("modle", "model"),
    "filter.partcles=5": ("filter.partcles", "filter.particles"),
    "data=scene": ("data=scene", "scenes"),
    "trainer.max_step=3": ("trainer.max_step", "trainer.max_steps"),
    "experiment=memorise": ("experiment=memorise", "is now experiment=memorize"),
    "loss=add": ("loss=add", "choose loss=contrastive"),
    "filter.particles=many": ("filter.particles=many: must be a whole number",),
    "filter.particles=0": ("filter.particles=0: must be a whole number, at least 1",),
    "optimizer.lr=fast": ("optimizer.lr=fast: must be a number",),
    "+filter.foo=1": ("filter.foo", "no such setting"),
    "+experiment=memorize": ("+experiment=memorize: + adds", "type experiment=memorize"),
    "+trainer.max_steps=3": ("+trainer.max_steps=3: + adds", "type trainer.max_steps=3"),
    "seed=x": ("seed=x", "whole number"),
    "console=loud": ("console=loud", "json"),
    "resume=nowhere": ("resume=nowhere", "not a run's folder"),
    "filter.initialize.x=1": ("filter.initialize.x", "no such setting"),
    "filter.refine=none": ("filter.refine=none", "type filter/refine=none"),
    "filter/refine=non": ("filter/refine=non", "none"),
    "x=[1": ("[1",),
    "loss=[bce,add]": ("loss=[bce,add]", "takes the name of a choice", "add, add_s"),
    "loss/schedule=[{until: 1.0}]": (
        "loss/schedule=[{until: 1.0}]",
        "takes the name of a choice",
        "three_stages_displacement",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_one_line_that_names_the_key_and_the_nearest(
    mistake: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    status = run_command("train", HOME, [f"out={tmp_path}", "console=json", mistake])
    said = capfd.readouterr().err.strip().splitlines()
    assert status == 2
    assert len(said) == 1, said
    assert said[0].startswith("train: ")
    for part in MISTAKES[mistake]:
        assert part in said[0]


def test_what_is_required_is_asked_for(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, words in {
        "evaluate": "checkpoint=",
        "predict": "checkpoint",
        "generate": "out",
        "export": "checkpoint",
    }.items():
        assert run_command(name, HOME, [] if name != "predict" else [f"out={tmp_path}"]) == 2
        assert words in capfd.readouterr().err


def test_a_trace_is_shown_only_when_asked_for(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, [f"out={tmp_path}", "loss=add", "debug=traceback"]) == 2
    assert "Traceback" in capfd.readouterr().err


class TestBuilding:
    """The one place that turns names into objects."""

    @pytest.mark.parametrize(
        "name", ["os.system", "builtins.eval", "subprocess.run", "posefilterx.y"]
    )
    def test_only_names_of_ours_torch_and_lightning(self, name: str) -> None:
        with pytest.raises(UserError, match="may not be built"):
            instantiate({"_target_": name}, "x")

    def test_misspelt_names_are_refused(self) -> None:
        with pytest.raises(UserError, match="did you mean 'Adam'"):
            instantiate({"_target_": "torch.optim.AdamV"}, "optimizer")
        node = {
            "_target_": "posefilter.filters.resample.AdaptiveResampling",
            "resampler": {},
            "threshhold": 1,
        }
        with pytest.raises(UserError, match=r"resample.threshhold.*did you mean 'threshold'"):
            instantiate(node, "resample")

    def test_missing_and_wrong_arguments_are_refused(self) -> None:
        with pytest.raises(UserError, match=r"schedule.sigma: is missing"):
            instantiate({"_target_": "posefilter.filters.schedule.Constant"}, "schedule")
        with pytest.raises(UserError, match=r"schedule.sigma=True: must be a number"):
            instantiate(
                {"_target_": "posefilter.filters.schedule.Constant", "sigma": True}, "schedule"
            )

    def test_partial_lists_nesting_and_nothing(self) -> None:
        node = {
            "a": [{"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3}],
            "none": {},
        }
        made = instantiate(node, "x")
        assert made["none"] is None
        assert made["a"][0](torch.zeros(1, 2)).shape == (1, 3)
        later = instantiate(
            {"_target_": "torch.optim.SGD", "_partial_": True, "lr": 0.5}, "optimizer"
        )
        assert later([torch.nn.Parameter(torch.zeros(1))]).param_groups[0]["lr"] == 0.5


@pytest.mark.parametrize("entry", list_choices(CONF))
def test_no_setting_is_called_as_a_group_that_its_command_does_not_compose(entry: str) -> None:
    """Hydra would take `size=[320,240]` for the choice of a group `size`, and say that there is no
    such setting.
    """
    page = OmegaConf.load(CONF / f"{entry}.yaml")
    composed = {
        str(key).split()[-1].lstrip("/")
        for item in page.get("defaults", [])
        if OmegaConf.is_dict(item)
        for key in item
    }
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    handled = {"debug"}  # it is read before Hydra
    assert not (set(page) & groups) - composed - handled


def test_a_choice_that_is_not_there_names_the_nearest(tmp_path: Path) -> None:
    typed = "model/encoder=unett"
    with pytest.raises(MissingConfigException) as caught:
        compose_job("train", CONF, ["model=patch_pf", typed], tmp_path)
    told = explain(caught.value, "train", CONF, [typed])
    assert told.startswith(f"{typed}: there is no such choice; did you mean 'unet'; there are ")
    assert "\n" not in told


@pytest.mark.parametrize(
    ("typed", "now"),
    [
        ("model=pose_pf filter.refine.pieces=[]", "filter.refine.components"),
        ("model=patch_pf filter.estimate.rounds=3", "filter.estimate.iterations"),
        ("model=patch_pf loss=chamfer loss.most=null", "loss.max_pixels"),
        ("data/augment=camera data.augment.steps.1.about=center", "data.augment.steps.1.pivot"),
    ],
)
def test_an_argument_by_its_old_name_is_answered_by_the_new_one(typed: str, now: str) -> None:
    old = typed.split()[-1].partition("=")[0]
    with pytest.raises(UserError) as caught:
        compose_config("train", typed.split())
    assert str(caught.value) == f"{old}: is now {now}"


def test_a_preset_that_is_not_there_is_refused_though_a_method_need_not_have_one(
    tmp_path: Path,
) -> None:
    with pytest.raises(UserError, match=r"preset=patch_pf/wrking.*'patch_pf/working'"):
        check_choices(["preset=patch_pf/wrking"], CONF)
    own = tmp_path / "preset" / "patch_pf" / "wrking.yaml"
    own.parent.mkdir(parents=True)
    own.write_text("# @package _global_\n{}\n")
    check_choices(["preset=patch_pf/wrking", "--config-dir", str(tmp_path)], CONF)
    check_choices(["preset=null"], CONF)


def test_magnified_images_are_those_of_camera_but_for_their_size() -> None:
    plain, magnified = (
        yaml.safe_load((CONF / "data" / "augment" / f"{name}.yaml").read_text())["steps"]
        for name in ("camera", "camera_magnified")
    )
    own = {key: magnified[1].pop(key) for key in ("object_size", "object_size_probability")}
    assert own == {"object_size": [0.16, 0.32], "object_size_probability": 0.6}
    assert magnified == plain
