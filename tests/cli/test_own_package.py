"""What the author of a plug-in gets wrong is told in one line, and what he typed is told again."""

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.models.toy import square

import posefilter
from posefilter.cli import console, run_command, trust
from posefilter.cli.checkpoints import build_method, method_of, recipe
from posefilter.cli.command import compose_job
from posefilter.cli.fit import check_fit
from posefilter.cli.instantiate import instantiate
from posefilter.cli.running import note_plugin
from posefilter.cli.trust import Scope
from posefilter.data.splits import split_records
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
CONF = HOME / "conf"
METHOD = """
from posefilter.models.patch_pf import PatchPF
class OwnScore(PatchPF):
    pass
class OwnLabel(PatchPF):
    def __init__(self, label, **base):
        super().__init__(**base)
def own_loss(trace, batch, object_model):
    pass
class Misspelt:
    requires = ("pixelspace",)
class Text:
    provides = "rollout"
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a plug-in that is trusted."""
    folder = tmp_path / "site" / "ownpf"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "method.py").write_text(METHOD)
    (folder / "broken.py").write_text("import ownpf.method\n1 / 0\n")
    monkeypatch.syspath_prepend(folder.parent)
    monkeypatch.setattr(trust, "_trusted", {"ownpf"})
    for name in ("ownpf", "ownpf.method", "ownpf.broken", "ownpf.loss"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return folder


TARGETS = {
    "ownpf.method.OwnScor": ("no 'OwnScor' defined in ownpf.method", "did you mean 'OwnScore'?"),
    "ownpf.metod.OwnScore": ("no module ownpf.metod", "did you mean 'ownpf.method'?"),
    "ownpf.broken.OwnScore": ("ownpf.broken could not be imported", "division by zero"),
    "posefilter.models.patch_pf.PatchP": ("no 'PatchP' defined", "did you mean 'PatchPF'?"),
}


@pytest.mark.parametrize("scope", Scope)
@pytest.mark.parametrize("target", TARGETS)
def test_a_class_that_is_not_there_is_told_before_what_does_not_fit(
    target: str, scope: Scope, package: Path, tmp_path: Path
) -> None:
    job = compose_job("train", CONF, ["model=patch_pf", f"model._target_={target}"], tmp_path)
    with pytest.raises(UserError) as told:
        check_fit(job.cfg, job.choices, scope)
    assert f"model._target_={target}" in str(told.value)
    assert "\n" not in str(told.value)
    for words in TARGETS[target]:
        assert words in str(told.value)
    own, there = target.startswith("ownpf"), "imported" in TARGETS[target][0]
    renamed = own and scope is Scope.RECIPE and not there
    assert ("was it renamed after the checkpoint?" in str(told.value)) is renamed


@pytest.mark.parametrize("target", ["ownpf.method.OwnScore", "posefilter.models.patch_pf.PatchPF"])
def test_an_old_argument_of_a_parent_is_answered_by_the_new_one(target: str, package: Path) -> None:
    with pytest.raises(UserError) as refused:
        instantiate({"_target_": target, "train_filter": None}, "model")
    assert str(refused.value) == "model.train_filter: is now train_rollout"


@pytest.mark.parametrize(
    ("node", "told"),
    [
        ({"_target_": "ownpf.method.OwnLabel"}, "loss.label: is missing, and has no default"),
        (
            {"_target_": "ownpf.method.own_loss"},
            "loss.trace: is missing, and has no default; where it is to be called later, add "
            "`_partial_: true`",
        ),
        (
            {"_target_": "posefilter.losses.likelihood.Bce", "label": {"size": 1}},
            "loss.label: has no _target_, and must be a Label",
        ),
    ],
)
def test_a_setting_that_is_left_out_of_a_file_is_told(
    node: dict[str, object], told: str, package: Path
) -> None:
    with pytest.raises(UserError) as refused:
        instantiate(node, "loss")
    assert str(refused.value) == told
    made = instantiate({"_target_": "ownpf.method.own_loss", "_partial_": True}, "loss")
    assert made(None, None, None) is None


def test_a_draft_that_is_not_chosen_is_left_out(
    package: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own" / "loss"
    own.mkdir(parents=True)
    (own / "draft.yaml").write_text("_target_: ownpf.loss.NotWritten\n")
    (own / "strange.yaml").write_text("_target_: some.body.Elses\n")
    (own / "unreadable.yaml").write_text("_target_: [\n")
    typed = ["--config-dir", str(own.parent), "model=pose_pf", "loss=add", f"out={tmp_path}/run"]
    assert run_command("train", HOME, [*typed, "console=json"]) == 2
    (said,) = capfd.readouterr().err.strip().splitlines()
    assert "loss=add does not fit model=pose_pf" in said
    assert said.endswith("choose loss=contrastive")


@pytest.mark.parametrize(
    ("name", "told"),
    {
        "Misspelt": "ownpf.method.Misspelt.requires: there is no capability 'pixelspace'; did you "
        "mean 'pixel_space'?",
        "Text": "ownpf.method.Text.provides='rollout': must be a tuple, such as provides = "
        "('rollout',)",
    }.items(),
)
def test_a_capability_that_is_none_is_told(
    name: str, told: str, package: Path, tmp_path: Path
) -> None:
    job = compose_job("train", CONF, ["model=patch_pf"], tmp_path)
    job.cfg.loss = {"_target_": f"ownpf.method.{name}"}
    with pytest.raises(UserError) as error:
        check_fit(job.cfg, job.choices, Scope.CONFIG)
    assert str(error.value) == told


@pytest.fixture
def own_folder(tmp_path: Path) -> Path:
    """Return a folder of settings with the one choice loss=own."""
    file = tmp_path / "my own" / "loss" / "own.yaml"
    file.parent.mkdir(parents=True)
    file.write_text((CONF / "loss" / "bce.yaml").read_text() + "\ngama: 2.0\n")
    return file.parents[1]


def test_a_method_whose_file_chooses_no_loss_is_told(
    package: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "own" / "model" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(
        "# @package _global_\n"
        "defaults: [/model/_base, /preset/_pixels, /filter/resample: none, _self_]\n"
        "model: {_target_: ownpf.method.OwnScore}\n"
    )
    typed = ["--config-dir", str(tmp_path / "own"), "model=mine", f"out={tmp_path}/run"]
    assert run_command("train", HOME, [*typed, "console=json"]) == 2
    (said,) = capfd.readouterr().err.strip().splitlines()
    assert said == (
        "train: loss: nothing chooses one; type loss=NAME, or add `- /loss: NAME` to the defaults "
        "in the file of model=mine"
    )


@pytest.mark.parametrize("chosen", ["/loss: offset", "/filter/resample: none"])
@pytest.mark.parametrize("under", ["", "model:"])
def test_a_method_whose_file_lacks_its_first_line_is_told(
    chosen: str, under: str, package: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "own" / "model" / "mine.yaml"
    file.parent.mkdir(parents=True)
    bases = f"defaults: [/model/_base, /preset/_pixels, {{{chosen}}}, _self_]\n"
    file.write_text(f"{bases}{under} {{_target_: ownpf.method.OwnScore}}\n" if under else bases)
    typed = ["--config-dir", str(tmp_path / "own"), "model=mine", f"out={tmp_path}/run"]
    assert run_command("train", HOME, [*typed, "console=json"]) == 2
    (said,) = capfd.readouterr().err.strip().splitlines()
    first = "model=mine: the first line of its file must be `# @package _global_`; without it"
    assert said.startswith(f"train: {first}")


def test_the_bases_of_a_method_of_ones_own_choose_all_but_what_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(HOME / "examples" / "plugin")
    monkeypatch.setattr(trust, "_trusted", {"posefilter_example"})
    for name, more in {"color_walk": [], "depth_fit": ["data/augment=strong"]}.items():
        job = compose_job("train", CONF, [f"model={name}", "optimizer=adamw", *more], tmp_path)
        check_fit(job.cfg, job.choices, Scope.CONFIG)
        assert job.choices["optimizer"] == "adamw"
        assert job.choices["data/augment"] == ("strong" if more else "none")


def test_a_choice_with_the_name_of_another_is_refused(
    own_folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    same = own_folder / "loss" / "add.yaml"
    same.write_text((CONF / "loss" / "add.yaml").read_text())
    typed = ["--config-dir", str(own_folder), "--cfg", "job", "model=patch_pf", "loss=own"]
    assert run_command("train", HOME, typed) == 0  # the same file twice
    capfd.readouterr()
    same.write_text("_target_: ownpf.method.Own\n")
    assert run_command("train", HOME, typed) == 2
    (said,) = capfd.readouterr().err.strip().splitlines()
    assert str(same) in said
    assert str(CONF / "loss" / "add.yaml") in said


def test_a_hint_knows_the_choices_of_ones_own(
    own_folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["--config-dir", str(own_folder), "model=patch_pf", "loss=own", "loss.gamma=3"]
    assert run_command("train", HOME, typed) == 2
    said = capfd.readouterr().err
    assert "loss.gamma: there is no such setting; did you mean 'loss.gama'?" in said


def test_advice_has_what_was_typed_of_plug_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = ["train.py", "--config-dir", "my own", "plugins=[ownpf,more]", "loss=own"]
    monkeypatch.setattr(sys, "argv", typed)
    line = "python train.py --config-dir 'my own' resume=run 'plugins=[ownpf,more]'"
    assert console.typed("train", resume="run") == line
    assert console.typed("train", resume="run", plugins=["ownpf", "more"]) == line
    assert "--config-dir 'my own'" in console.typed_prediction(Path("a.ckpt"))
    monkeypatch.setattr(sys, "argv", ["train.py", "loss=own", "plugins=[]"])
    assert console.typed("train", resume="run") == "python train.py resume=run"


@pytest.mark.parametrize("kind", ["List", "Sequence", "Tuple", "MutableSequence"])
def test_a_list_may_be_annotated_without_what_is_in_it(kind: str, package: Path) -> None:
    (package / "loss.py").write_text(
        f"import typing\nclass Own:\n    def __init__(self, sizes: typing.{kind}) -> None:\n"
        "        self.sizes = sizes\n"
    )
    node = {"_target_": "ownpf.loss.Own", "sizes": [1, "a"]}
    assert instantiate(node, "loss").sizes == [1, "a"]
    with pytest.raises(UserError, match=r"^loss\.sizes=3: must be a (list|tuple|\w*Sequence)$"):
        instantiate(node | {"sizes": 3}, "loss")


@pytest.fixture
def with_choices(package: Path) -> Path:
    """Return the folder of the plug-in with the choice loss=own inside."""
    file = package / "conf" / "loss" / "own.yaml"
    file.parent.mkdir(parents=True)
    file.write_text((CONF / "loss" / "bce.yaml").read_text())
    return package


@pytest.fixture
def entry_point(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have the plug-in installed rather than named."""

    class Point:
        name, value = "mine", "ownpf"

    trust.installed.cache_clear()
    monkeypatch.setattr(trust, "_trusted", set())
    monkeypatch.setattr(trust, "entry_points", lambda group: [Point()])
    yield
    trust.installed.cache_clear()


def test_an_error_of_a_plug_ins_code_names_it(package: Path) -> None:
    """Its traceback passes through the program, and may end in a library that it called."""
    (package / "raising.py").write_text(
        "import json\n\n\ndef loss():\n    return json.loads('{')\n"
    )
    with pytest.raises(ValueError, match="property name") as own:
        importlib.import_module("ownpf.raising").loss()
    sys.modules.pop("ownpf.raising")
    note_plugin(own.value)
    place = f"{package / 'raising.py'}, line 5, in loss"
    assert own.value.__notes__ == [f"plugins=ownpf: the error is of this plug-in's code, {place}"]
    with pytest.raises(ValueError, match="property name") as other:
        json.loads("{")
    note_plugin(other.value)
    assert not hasattr(other.value, "__notes__")


def test_a_trusted_package_brings_its_choices(
    with_choices: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed = ["model=patch_pf", "loss=own"]
    assert posefilter.compose(typed).loss._target_ == "posefilter.losses.likelihood.Bce"
    monkeypatch.setattr(trust, "_trusted", set())
    with pytest.raises(posefilter.UserError, match="loss=own: there is no such choice"):
        posefilter.compose(typed)
    posefilter.trust("ownpf")
    assert posefilter.compose(typed).loss._target_ == "posefilter.losses.likelihood.Bce"


@pytest.mark.parametrize("named", [True, False])
def test_so_it_does_on_the_command_line(
    named: bool,
    with_choices: Path,
    entry_point: None,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    plugins = ["plugins=[ownpf]"] if named else []
    if named:
        monkeypatch.setattr(trust, "entry_points", lambda group: [])
    typed = [*plugins, "model=patch_pf", "loss=own"]
    assert run_command("train", HOME, [*typed, "--cfg", "job"]) == 0
    assert run_command("train", HOME, [*plugins, "--help"]) == 0
    assert " own " in capfd.readouterr().out


def test_a_file_that_cannot_be_read_is_named_with_its_line(
    with_choices: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = with_choices / "conf" / "loss" / "own.yaml"
    file.write_text("_target_: ownpf.method.own_loss\n  label: 1\n")
    told = f"{file.resolve()}, line 2: cannot be read as YAML (mapping values"
    with pytest.raises(UserError) as refused:
        posefilter.compose(["loss=own"])
    assert str(refused.value).startswith(told)
    assert run_command("train", HOME, ["plugins=[ownpf]", "loss=own"]) == 2
    assert f"train: {told}" in capfd.readouterr().err


def test_an_installed_plug_in_that_cannot_be_used_is_warned_of(
    with_choices: Path, entry_point: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """It stops those commands alone that use it."""
    (with_choices / "__init__.py").write_text("import no_such_package_at_all\n")
    run_command("report", HOME, [f"run={tmp_path}"])
    first, *others = capfd.readouterr().err.strip().splitlines()
    assert first == (
        "warning: installed plug-in ownpf (entry point mine): there is no package "
        "'no_such_package_at_all' (is it installed?)"
    )
    assert not any("ownpf" in line for line in others)
    with pytest.raises(UserError, match="needs the package 'no_such_package_at_all'"):
        instantiate({"_target_": "ownpf.method.OwnScore"}, "loss")


def test_so_is_one_whose_choice_has_the_name_of_another(
    with_choices: Path, entry_point: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (with_choices / "conf" / "loss" / "add.yaml").write_text("_target_: ownpf.method.Own\n")
    run_command("report", HOME, [f"run={tmp_path}"])
    assert "which would be read in its place" in capfd.readouterr().err
    posefilter.trust("ownpf")
    with pytest.raises(UserError, match="which would be read in its place"):
        posefilter.compose()


@pytest.mark.parametrize("named", ["", "another", "ownpf"])
def test_so_are_two_plug_ins_that_have_the_same_choice(
    named: str,
    with_choices: Path,
    entry_point: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The one that is hidden is refused where it was named, and warned of where it is installed."""

    class Second:
        name, value = "second", "another"

    points = [*trust.entry_points(group=trust.ENTRY_POINTS), Second()]
    monkeypatch.setattr(trust, "entry_points", lambda group: points)
    monkeypatch.delitem(sys.modules, "another", raising=False)
    first = with_choices.parent / "another" / "conf" / "loss" / "own.yaml"
    first.parent.mkdir(parents=True)
    (with_choices.parent / "another" / "__init__.py").write_text("")
    first.write_text("_target_: another.Loss\n")
    hidden = with_choices / "conf" / "loss" / "own.yaml"
    run_command("report", HOME, [f"run={tmp_path}", *([f"plugins=[{named}]"] if named else [])])
    line, *others = capfd.readouterr().err.strip().splitlines()
    warned = "warning: installed plug-in ownpf (entry point mine)"
    start = "report" if named == "ownpf" else warned
    assert line.startswith(f"{start}: {hidden.resolve()}: has the name of {first.resolve()}, which")
    assert not any("has the name" in one for one in others)


@pytest.mark.parametrize(
    ("name", "more"), [("own-pf", " (an import name has `_`, not `-`)"), ("7", "")]
)
def test_a_plug_in_that_is_no_package_is_told_before_its_choices(
    name: str, more: str, with_choices: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """`pip` knows a package by another name than `import`."""
    assert run_command("train", HOME, [f"plugins=[{name}]", "loss=own"]) == 2
    told = f"train: plugins={name!r}: not the name of a package{more}"
    assert capfd.readouterr().err.strip() == told


def test_a_package_that_is_not_trusted_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError) as told:
        instantiate({"_target_": "somebodys.method.Own"}, "model")
    assert str(told.value).endswith(
        "packages that you trust: plugins=[somebodys], in Python posefilter.trust('somebodys')"
    )
    with pytest.raises(UserError, match=r"plugins=\[\.\.\.\]$"):
        instantiate({"_target_": "os.system"}, "model")


def test_what_is_there_but_not_on_the_list_is_told_so() -> None:
    name = "torch.optim.lr_scheduler.ReduceLROnPlateau"
    with pytest.raises(UserError) as told:
        instantiate({"_target_": name, "_partial_": True}, "scheduler")
    assert f"scheduler._target_={name}: is not on the list" in str(told.value)
    assert "StepLR" in str(told.value)
    assert "a function of a plug-in of yours" in str(told.value)
    with pytest.raises(UserError, match=r"there is no .StepL. defined .*; did you mean .StepLR."):
        instantiate({"_target_": "torch.optim.lr_scheduler.StepL", "_partial_": True}, "scheduler")


def test_weights_of_another_width_name_the_first(tmp_path: Path) -> None:
    job = compose_job("train", CONF, ["model=cnn_patch"], tmp_path)
    method = build_method(recipe(job))
    method.set_object(square())
    checkpoint = {
        "recipe": method.recipe,
        "object_model": dict(square()._asdict()),
        "state_dict": dict(method.state_dict()),
    }
    assert method_of(checkpoint, lightning=False).latent_width == method.latent_width
    name = next(key for key, value in checkpoint["state_dict"].items() if value.dim() > 1)
    shape = tuple(checkpoint["state_dict"][name].shape)
    checkpoint["state_dict"][name] = checkpoint["state_dict"][name][:1, :1]
    with pytest.raises(UserError) as told:
        method_of(checkpoint, lightning=False)
    other = (1, 1, *shape[2:])
    assert f"({name} is {other} there, and {shape} here)" in str(told.value)


def test_a_dataset_without_any_frame_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"data.root: no frames in {tmp_path}$"):
        split_records([], {"train": 0.8, "val": 0.1, "test": 0.1}, 0, tmp_path)
