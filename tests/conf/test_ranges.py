"""Settings that make no sense are refused in one line with their key, before anything is built."""

import math
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from posefilter.cli import run_command
from posefilter.cli.command import compose_job
from posefilter.cli.job import check_settings
from posefilter.cli.main import COMMANDS
from posefilter.cli.options import open_groups
from posefilter.cli.recipe import LIMITS, MOST_WHOLE, NOT_KEPT
from posefilter.errors import UserError
from posefilter.ranges import RANGES, check_ranges, find_range, list_nodes

HOME = Path(__file__).parents[2]
CONF = HOME / "conf"


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def find_numbers() -> dict[str, Any]:
    """Return every number that a file of conf/ sets, by its place, the command's name first."""
    found = {}
    for name in COMMANDS:
        plain = OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml"), resolve=False)
        found |= {f"{name}.{key}": (value, ours) for key, value, ours in list_nodes(plain)}
    with open_groups() as groups:
        folders = {file.parent for file in CONF.rglob("*/*.yaml")}
        for folder in folders:
            for option in groups.list_options(folder.relative_to(CONF).as_posix()):
                values = list_nodes(option.settings)
                found |= {f"train.{key}": (value, ours) for key, value, ours in values}
    return {key: value for key, (value, ours) in found.items() if ours and is_number(value)}


def test_every_number_has_a_range_and_lies_in_it() -> None:
    numbers = {
        key: value
        for key, value in find_numbers().items()
        # shares of the scenes are checked together, hydra's own keys by Hydra
        if ".split." not in key and ".hydra." not in key
    }
    assert len(numbers) > 150
    ranges = {key: find_range(key) for key in numbers}
    assert [key for key, known in ranges.items() if known is None] == []
    assert [k for k, known in ranges.items() if known and not known.holds(numbers[k])] == []


def test_what_a_training_may_have_its_checkpoint_may_hold() -> None:
    """Else a run would train, and its best checkpoint be refused before the test."""
    no_part = tuple(f"{name}." for name in (*NOT_KEPT, "onboard", "check_data"))
    wide = {
        key: known.maximum
        for key, known in RANGES.items()
        if known.whole and not key.startswith(no_part)
    }
    assert len(wide) > 30
    for key, most in wide.items():
        assert most <= LIMITS.get(key.rpartition(".")[2], MOST_WHOLE), key


def test_no_range_holds_what_is_no_number() -> None:
    for key, allowed in RANGES.items():
        for value in (math.nan, math.inf, -math.inf, True, "text", -1e30):
            assert not allowed.holds(value) or value == allowed.maximum, (key, value)


REFUSED = {
    "train": {
        "optimizer.lr": (-1, math.nan, math.inf, "fast"),
        "optimizer.weight_decay": (-1, math.nan),
        "trainer.gradient_clip_val": (-1,),
        "trainer.max_steps": (-7, 0, 2.5),
        "trainer.val_check_interval": (0, -1, 1.5),
        "trainer.log_every_n_steps": (-1,),
        "trainer.devices": (0, -2, "many"),
        "trainer.accelerator": ("warp", 3),
        "data.min_visibility": (math.nan, -1, 1.5),
        "data.num_model_points": (0,),
        "data.batch_size": (0, -3, 1.5),
        "data.batch_size_test": (0,),
        "data.workers": (-1, 1_000_000),
        "data.limit_train": (-1, 0, 10**21),
        "data.limit_val": (0, 10**21),
        "data.generate.frames": (0,),
        "filter.particles": (0, 10**9),
        "filter.initial_particles": (0,),
        "filter.steps": (0,),
        "filter.schedule.initial_sigma": (0, -1, math.nan),
        "model.likelihood.width": (0, 10**9),
        "threads": (0, 1_000_000, -1),
        "seed": (-1, 4294967296, 0.5, None),
        "loss": (None,),
    },
    "predict": {
        "depth_scale": (0, -1, 1e-9, 0.1, math.nan, None),
        "seed": (-1,),
        "threads": (0,),
    },
    "track": {"depth_scale": (0.1, 0)},
    "generate": {"frames": (0, -1), "workers": (0,), "max_occlusion": (1, math.nan), "size": (8,)},
    "check_data": {"max_frames": (0, -1, 10**21)},
    "export": {"points": (0,), "max_mb": (0, None)},
    "onboard": {"budget_minutes": (0, None, math.nan), "steps": (0,), "workers": (0,)},
    "evaluate": {"threads": (0,), "trainer.devices": (2, [0, 1])},  # tests in one process
}
CASES = [
    (command, key, value)
    for command, settings in REFUSED.items()
    for key, values in settings.items()
    for value in values
]


@pytest.fixture(scope="module")
def composed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, DictConfig]:
    """Return each command's settings, as they are by default."""
    folder = tmp_path_factory.mktemp("composed")
    return {name: compose_job(name, CONF, [], folder).cfg for name in REFUSED}


def test_defaults_pass(composed: dict[str, DictConfig]) -> None:
    for name, cfg in composed.items():
        check_settings(cfg, name)


def test_the_folder_of_a_run_is_given_as_out(composed: dict[str, DictConfig]) -> None:
    cfg = composed["train"].copy()
    OmegaConf.update(cfg, "folder", "mine")
    with pytest.raises(UserError, match=r"^folder=mine: is set by the run; choose .* out=$"):
        check_settings(cfg, "train")


@pytest.mark.parametrize(("command", "key", "value"), CASES)
def test_a_value_that_makes_no_sense_is_named(
    command: str, key: str, value: Any, composed: dict[str, DictConfig]
) -> None:
    cfg = composed[command].copy()
    OmegaConf.set_readonly(cfg, False)
    OmegaConf.update(cfg, key, value)
    shown = "null" if value is None else value
    with pytest.raises(UserError) as caught:
        check_settings(cfg, command)
    assert str(caught.value).startswith(f"{key}={shown}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("command", ["predict", "track"])
def test_a_depth_scale_of_bop_is_told_from_ours(
    command: str, composed: dict[str, DictConfig]
) -> None:
    cfg = composed[command].copy()
    OmegaConf.set_readonly(cfg, False)
    for scale in (0.1, "${seed}"):  # which is 0
        OmegaConf.update(cfg, "depth_scale", scale)
        with pytest.raises(UserError, match=r"1000 for millimeters; .*BOP.* 0\.1 is 10000 here$"):
            check_settings(cfg, command)


@pytest.mark.parametrize("command", ["train", "onboard", "generate"])
@pytest.mark.parametrize(
    ("value", "told"),
    [({"a": 1}, "is a mapping"), ({}, "is a mapping"), ([1], "is a list")],
)
def test_a_number_is_neither_a_mapping_nor_a_list(
    command: str, value: Any, told: str, composed: dict[str, DictConfig]
) -> None:
    cfg = composed[command].copy()
    OmegaConf.set_readonly(cfg, False)
    OmegaConf.update(cfg, "seed", value, merge=False)
    with pytest.raises(UserError, match=f"^seed.*{told}"):
        check_settings(cfg, command)


@pytest.mark.parametrize(
    ("command", "key"),
    [
        ("export", "max_mb"),
        ("train", "optimizer.lr"),
        ("train", "data.min_visibility"),
        ("train", "filter.particles"),
        ("train", "model.likelihood.width"),
    ],
)
@pytest.mark.parametrize("value", [[], [1], [0.5, 0.5], [[1]], [-1], [{"a": 1}]])
def test_one_number_is_no_list(
    command: str, key: str, value: Any, composed: dict[str, DictConfig]
) -> None:
    cfg = composed[command].copy()
    OmegaConf.set_readonly(cfg, False)
    OmegaConf.update(cfg, key, value, merge=False)
    with pytest.raises(UserError) as caught:
        check_settings(cfg, command)
    assert str(caught.value) == f"{key}={value}: must be one number, and is a list"


def test_lists_are_of_the_settings_that_are_said_to_have_them() -> None:
    numbers = [key for key in find_numbers() if ".split." not in key and ".hydra." not in key]
    listed = {key.rpartition("[")[0] for key in numbers if key.endswith("]")}
    refused = [key for key in listed if not getattr(find_range(key), "many", False)]
    assert len(listed) > 15
    assert refused == []
    many = {"data": {"generate": {"size": [640, 480]}}, "optimizer": {"betas": [0.9, 0.99]}}
    check_ranges(many, "train")
    check_ranges(
        {"tracker": {"motion": {"translation_mm": [5.0, 5.0, 9.0], "rotation_deg": 2.0}}}, "track"
    )
    with pytest.raises(UserError, match=r"^optimizer\.betas=1\.5: must be a number"):
        check_ranges({"optimizer": {"betas": [0.9, 1.5]}}, "train")
    with pytest.raises(UserError, match=r"^data\.generate\.size\[0\]=\[640\]: must be one number"):
        check_ranges({"data": {"generate": {"size": [[640], 480]}}}, "train")


def test_devices_are_a_count_or_a_list_that_names_them_from_0() -> None:
    for devices in (2, [0], [0, 1], "auto", -1):
        check_ranges({"trainer": {"devices": devices}}, "train")
    for devices in (0, [-1], [0.5], [[0]]):
        with pytest.raises(UserError, match=r"^trainer\.devices"):
            check_ranges({"trainer": {"devices": devices}}, "train")


@pytest.mark.parametrize("command", ["train", "onboard", "predict"])
def test_a_number_that_is_made_of_other_settings_is_checked(
    command: str, composed: dict[str, DictConfig]
) -> None:
    cfg = composed[command].copy()
    OmegaConf.set_readonly(cfg, False)
    for typed, told in (("${seed}.5", r"threads=3\.5: must be"), ("${seed}", None)):
        OmegaConf.update(cfg, "seed", 3)
        OmegaConf.update(cfg, "threads", typed)
        if told is None:
            check_settings(cfg, command)
        else:
            with pytest.raises(UserError, match=told):
                check_settings(cfg, command)


@pytest.mark.parametrize(
    ("command", "typed"), [("train", "optimizer.lr=nan"), ("predict", "threads=0")]
)
def test_a_command_says_so_in_one_line(
    command: str, typed: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command(command, HOME, [typed, f"out={tmp_path / 'run'}"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{command}: {typed}: must be a ")
    assert not (tmp_path / "run").exists()


def test_the_settings_of_a_plug_in_may_mean_anything() -> None:
    own = {"model": {"likelihood": {"_target_": "my_package.Own", "width": -1}}}
    check_ranges(own, "train")
    with pytest.raises(UserError, match="width=nan: must be a finite number"):
        check_ranges(
            {"model": {"likelihood": {"_target_": "my_package.Own", "width": math.nan}}}, "train"
        )
    with pytest.raises(UserError, match="width=-1: must be a whole number"):
        check_ranges({"model": {"likelihood": {"width": -1}}}, "train")
