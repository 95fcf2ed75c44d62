"""A recipe is data: it calls nothing, reads no environment, chooses no place, and is no larger than
a method's.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from posefilter.cli import run_command
from posefilter.cli.checkpoints import build_method, method_of, read_checkpoint, recipe
from posefilter.cli.command import compose_job, register_resolvers
from posefilter.cli.evaluate import data_settings
from posefilter.cli.job import Job
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
Save = Callable[[dict[str, Any]], Path]


def deep(levels: int) -> Any:
    return {"a": deep(levels - 1)} if levels else 1


LAUGHS = {"l0": 1} | {f"l{i}": [f"${{l{i - 1}}}"] * 8 for i in range(1, 9)}
SETTINGS: dict[str, dict[str, Any]] = {
    "environment": {"loss": {"_target_": "${oc.env:HOSTILE}"}},
    "environment within text": {"variant": "x ${oc.env:HOSTILE} y"},
    "environment within a reference": {"variant": "${oc.select:${oc.env:HOSTILE},0}"},
    "environment, by default": {"variant": "${oc.select:a,${oc.env:HOSTILE}}"},
    "decoding": {"variant": "${oc.decode:'[1,2]'}"},
    "creating": {"variant": "${oc.create:{a: 1}}"},
    "our own resolver": {"variant": "${run_of:/etc}"},
    "relative reference": {"variant": {"a": "${.b}", "b": 1}},
    "depth": {"variant": deep(60)},
    "number of settings": {"variant": [0] * 30_000},
    "length of a text": {"variant": "x" * 5000},
    "letters that a terminal obeys": {"variant": "\x1b]0;hostile\x07"},
    "key that is none": {"${oc.env:HOSTILE}": 1},
    "references without end": {"variant": "${seed}", "seed": "${variant}"},
    "references that multiply": {**LAUGHS, "loss": "${l8}"},
    "particles": {"filter": {"particles": 10**9}},
    "whole number": {"variant": 10**12},
    "infinite number": {"variant": float("inf")},
    "what is no setting": {"variant": torch.zeros(2)},
    "trainer": {"trainer": {"_target_": "lightning.Trainer", "default_root_dir": "/tmp"}},
    "callbacks": {"callbacks": {}},
    "logger": {"logger": {}},
    "plug-ins": {"plugins": ["hostile_plugin"]},
    "folder": {"out": "/tmp/x"},
    "hydra": {"hydra": {"run": {"dir": "/tmp"}}},
}


@pytest.mark.parametrize("what", SETTINGS)
def test_a_hostile_recipe_is_refused(
    what: str, content: dict[str, Any], save: Save, watch: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    register_resolvers()
    monkeypatch.setenv("HOSTILE", "posefilter.losses.likelihood.Bce")
    content["recipe"]["settings"] |= SETTINGS[what]
    path = save(content)
    with watch, pytest.raises(UserError, match=r"checkpoint=.*recipe") as told:
        method_of(read_checkpoint(path))
    assert "\n" not in str(told.value)
    assert os.environ["HOSTILE"] not in str(told.value)


@pytest.mark.parametrize("key", ["widths", "blocks"])
def test_a_method_larger_than_its_weights_is_not_allocated(
    key: str, content: dict[str, Any], save: Save
) -> None:
    """Nothing is filled before the weights are seen not to fit: 8 GB here, and a million blocks
    there.
    """
    settings = content["recipe"]["settings"]
    large = {
        "widths": {"in_features": 50_000, "out_features": 40_000},
        "blocks": {"in_features": 1000, "out_features": 900},
    }
    node = {"_target_": "torch.nn.Linear", **large[key]}
    settings["model"] = {**settings["model"], "loss": [node] * (1 if key == "widths" else 50)}
    path = save(content)
    with pytest.raises(UserError, match="larger than the weights"):
        method_of(read_checkpoint(path))


NUMBERS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a million steps": (lambda s: s["filter"].update(steps=1_000_000), "filter.steps=1000000"),
    "a million steps, by reference": (
        lambda s: (s.update(variant=1_000_000), s["filter"].update(steps="${variant}")),
        "variant=1000000",
    ),
    "a million steps in training": (
        lambda s: s["model"]["train_rollout"].update(steps=1_000_000),
        "model.train_rollout.steps=1000000",
    ),
    "widths below zero": (lambda s: s["model"]["encoder"].update(widths=[-1] * 4), "widths="),
    "a spacing beyond all images": (
        lambda s: s["model"]["glimpse"].update(spacing=1e30),
        "model.glimpse.spacing=1e\\+30",
    ),
    "a loss that is none": (
        lambda s: s["model"]["aux_losses"].update(sides=[]),
        "describes no method",
    ),
}


@pytest.mark.parametrize("what", NUMBERS)
def test_what_a_method_is_built_of_is_in_range(
    what: str, content: dict[str, Any], save: Save, watch: Any
) -> None:
    """A step more than any search needs would have a prediction go on for hours."""
    change, said = NUMBERS[what]
    change(content["recipe"]["settings"])
    path = save(content)
    with watch, pytest.raises(UserError, match=said) as refusal:
        method_of(read_checkpoint(path))
    assert "\n" not in str(refusal.value)


SPECIAL: dict[str, Any] = {
    "_args_": [1],
    "args": [1],
    **dict.fromkeys(("_recursive_", "_convert_", "self", "__class__", "__init__"), "object"),
    "_partial_": True,
    "_target_": ["posefilter.models.cnn_patch.CnnPatch"],
}
UNREACHED = (  # by attributes of what may be built, or in letters that Python takes for others
    "posefilter.losses.likelihood.Bce.__init__.__globals__",
    "posefilter.losses.likelihood.Bce.__class__",
    "posefilter.losses.likelihood.Bce.load_state_dict",
    "posefilter.losses.likelihood.Bce.forward.__code__",
    "posefilter.losses.likelihood.\uff22ce",
    "posefilter.losses.likelihood..Bce",
    "posefilter.losses.likelihood.Bce\u00a0",
)


@pytest.mark.parametrize("key", SPECIAL)
def test_a_node_has_no_special_arguments(
    key: str, content: dict[str, Any], save: Save, watch: Any
) -> None:
    content["recipe"]["settings"]["model"][key] = SPECIAL[key]
    path = save(content)
    with watch, pytest.raises(UserError) as refusal:
        method_of(read_checkpoint(path))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", UNREACHED)
def test_no_attribute_is_reached(
    name: str, content: dict[str, Any], save: Save, watch: Any
) -> None:
    settings = content["recipe"]["settings"]
    settings["variant"] = name
    settings["model"]["loss"] = {"_target_": "${variant}"}
    path = save(content)
    with watch, pytest.raises(UserError) as refusal:
        method_of(read_checkpoint(path))
    assert "\n" not in str(refusal.value)


def test_the_good_checkpoint_is_read(good: Path, watch: Any) -> None:
    with watch:
        method = method_of(read_checkpoint(good))
    assert method.object_model.name == "carton"


def test_what_the_user_resolves_is_resolved_before_it_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE", "0.125")
    job = compose_job("train", HOME / "conf", [], tmp_path)
    job.cfg.optimizer.lr = "${oc.decode:${oc.env:HOSTILE}}"
    kept = recipe(job)
    assert kept["settings"]["optimizer"]["lr"] == 0.125
    assert kept["settings"]["model"]["filter"] == "${filter}"
    build_method(kept)


def test_older_checkpoints_select(content: dict[str, Any], save: Save) -> None:
    settings = content["recipe"]["settings"]
    settings["variant"] = {
        "there": "${oc.select:filter.particles,0}",
        "absent": "${oc.select:no.such,7}",
    }
    kept = read_checkpoint(save(content))["recipe"]["settings"]["variant"]
    assert kept == {"there": "${filter.particles}", "absent": 7}


DATA: dict[str, dict[str, Any]] = {
    "absolute root": {"root": "{secret}"},
    "root above": {"root": "../secret"},
    "root within": {"root": "outputs/../../secret"},
    "root in the home": {"root": "~/x"},
    "root that is to be made": {"root": "src"},
    "linked root": {"root": "link"},
    "absolute meshes": {"meshes": "{secret}"},
    "absolute points": {"model_points_dir": "{secret}"},
    "cache above": {"cache_dir": "../secret"},
    "cache on disk": {"cache": "disk"},
    "list of frames": {"options": {"frames": "{secret}/file.txt"}},
    "generator's place": {
        "generate": {"_target_": "posefilter.synthetic.generate.generate", "out": "{secret}/x"}
    },
    "another target": {
        "_target_": "posefilter.cli.command.os.system",
        "command": "touch {secret}/x",
    },
    "another generator": {"generate": {"_target_": "posefilter.cli.command.os.system"}},
    "an address": {"meshes": "http://127.0.0.1:9/x"},
    "a share": {"meshes": "\\\\host\\share"},
}


def filled(node: Any, secret: Path) -> Any:
    if isinstance(node, dict):
        return {key: filled(value, secret) for key, value in node.items()}
    return node.replace("{secret}", str(secret)) if isinstance(node, str) else node


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Job:
    return compose_job("evaluate", HOME / "conf", [], tmp_path_factory.mktemp("job"))


@pytest.mark.parametrize("what", DATA)
def test_a_recipe_chooses_no_folder(
    what: str,
    evaluation: Job,
    content: dict[str, Any],
    save: Save,
    secret: Path,
    watch: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    work = tmp_path / "work"
    work.mkdir()
    (work / "outputs" / "data" / "mine").mkdir(parents=True)
    (work / "link").symlink_to(secret)
    monkeypatch.chdir(work)
    own = {
        "_target_": "posefilter.data.module.PoseDataModule",
        "source": "fat",
        "root": "outputs/data/mine",
    }
    content["recipe"]["settings"]["data"] = own | filled(DATA[what], secret)
    path = save(content)
    checkpoint = read_checkpoint(path)
    job = Job(evaluation.cfg, {}, [], work, "evaluate", False)
    with watch, pytest.raises(UserError, match=r"^data\.") as told:
        data_settings(job, checkpoint["recipe"]["settings"], "carton")
    assert "\n" not in str(told.value)
    if what == "absolute root":  # the command says the same line
        assert (
            run_command(
                "evaluate", HOME, [f"checkpoint={path}", "console=json", f"out={tmp_path / 'out'}"]
            )
            == 2
        )
        assert capfd.readouterr().err.strip().splitlines()[-1] == f"evaluate: {told.value}"


def test_the_users_own_run_and_what_the_user_types_count(
    content: dict[str, Any],
    save: Save,
    secret: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "disk").mkdir()
    # a larger disk's, of the user's own making
    (tmp_path / "outputs").symlink_to(tmp_path / "disk")
    monkeypatch.chdir(tmp_path)
    own = {
        "_target_": "posefilter.data.module.PoseDataModule",
        "source": "fat",
        "object": "can",
        "root": "outputs/data/${data.object}",
    }
    settings = content["recipe"]["settings"] = {**content["recipe"]["settings"], "data": own}
    job = compose_job("evaluate", HOME / "conf", [], tmp_path)
    assert data_settings(job, settings, "carton").root == "outputs/data/can"
    settings["data"] = {**own, "root": "/foreign", "generate": {"meshes": "${data.root}"}}
    job = compose_job("evaluate", HOME / "conf", [f"++data.root={secret}"], tmp_path)
    assert data_settings(job, settings, "carton").root == str(secret)


RESUMED = {
    "hydra.searchpath=[file:///tmp]": "not a setting of a training run",
    "+hydra.callbacks.x._target_=os.system": "not a setting of a training run",
    "hydra/launcher=submitit_local": "not a setting of a training run",
    "--config-dir=/tmp": "not a setting of a training run",
    "--multirun": "not a setting of a training run",
    "data.root={secret}": "type it as well",
    "data.root=../secret": "type it as well",
    "data.meshes='{secret}'": "type it as well",
    "data.options={frames: '{secret}/file.txt'}": "type it as well",
    "model.encoder.trunk.weights=http://127.0.0.1:9/x": "type it as well",
    "callbacks.figures.folder=src": "type it as well",
    "logger.tensorboard.save_dir=src": "type it as well",
    "trainer.default_root_dir=src": "type it as well",
    "optimizer.lr=${oc.env:HOSTILE}": "calls a function",
    "optimizer.lr=${${seed}:HOSTILE}": "calls a function",
}


@pytest.mark.parametrize("override", RESUMED)
def test_a_resumed_run_brings_settings_alone(
    override: str,
    secret: Path,
    watch: Any,
    tmp_path: Path,
    good: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    (run / ".hydra").mkdir(parents=True)
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "last.ckpt").write_bytes(good.read_bytes())
    typed = override.replace("{secret}", str(secret))
    (run / ".hydra" / "overrides.yaml").write_text(json.dumps(["model=cnn_patch", typed]))
    with watch:
        assert run_command("train", HOME, [f"resume={run}", "console=json"]) == 2
    said = capfd.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert RESUMED[override] in said[0]


def test_what_a_resumed_run_brings_may_be_typed_again(tmp_path: Path, good: Path) -> None:
    from posefilter.cli.resume import with_resumed

    (tmp_path / ".hydra").mkdir()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").write_bytes(good.read_bytes())
    brought = [
        "model=cnn_patch",
        "data.root=/foreign",
        "plugins=[hostile_plugin]",
        "data.split={train: 0.6, val: 0.4}",
    ]
    (tmp_path / ".hydra" / "overrides.yaml").write_text(json.dumps(brought))
    found = with_resumed([f"resume={tmp_path}", "data.root=/mine"])
    assert found == [
        brought[0],
        brought[3],
        f"resume={tmp_path}",
        "data.root=/mine",
        f"out={tmp_path}",
    ]


def test_a_run_whose_files_are_links_is_not_written_to(
    content: dict[str, Any], secret: Path, watch: Any, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / ".metrics.json.part").symlink_to(secret / "x")
    torch.save(content, run / "checkpoints" / "best.ckpt")
    watch.own = run
    with watch:
        assert (
            run_command(
                "evaluate", HOME, [f"checkpoint={run}/checkpoints/best.ckpt", "console=json"]
            )
            == 2
        )
    (run / "metrics.json").write_text("{}")
    (run / "report").symlink_to(secret)
    with watch:
        assert run_command("report", HOME, [f"run={run}", "console=json"]) == 2


def test_a_lock_that_is_a_link_is_not_written_to(
    content: dict[str, Any], secret: Path, watch: Any, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / ".lock").symlink_to(secret / "file.txt")
    torch.save(content, run / "checkpoints" / "best.ckpt")
    watch.own = run
    with watch:
        words = [f"checkpoint={run}/checkpoints/best.ckpt", "console=json"]
        assert run_command("evaluate", HOME, words) == 2
    assert (secret / "file.txt").read_text() == "private"


@pytest.mark.parametrize("where", ["dirpath told", "dirpath left out"])
def test_a_resumed_checkpoint_names_no_file_to_delete(
    where: str, tmp_path: Path, secret: Path
) -> None:
    from lightning import Trainer

    from posefilter.cli.best import Last
    from posefilter.cli.instantiate import instantiate

    folder = tmp_path / "run" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / "old.ckpt").write_text("")
    conf = HOME / "conf" / "callbacks" / "checkpoints.yaml"
    job = compose_job("train", HOME / "conf", ["callbacks=checkpoints"], tmp_path / "run")
    job.cfg.folder = str(tmp_path / "run")
    victims = [f"{folder}/../../secret/file.txt", str(secret / "file.txt"), "memory://x/y.ckpt"]
    for callback in instantiate(job.cfg.callbacks, "callbacks").values():
        if isinstance(callback, Last):  # keeps no list of files
            assert not callback.state_dict()
            continue
        callback.setup(
            Trainer(logger=False, accelerator="cpu", enable_progress_bar=False), None, "fit"
        )  # type: ignore[arg-type]
        for victim in victims:
            state = {
                "best_model_score": torch.tensor(-1.0),
                "best_model_path": victim,
                "last_model_path": victim,
                "kth_best_model_path": victim,
                "kth_value": torch.tensor(-1.0),
                "best_k_models": {
                    victim: torch.tensor(-1.0),
                    str(folder / "old.ckpt"): torch.tensor(-1.0),
                },
            }
            callback.load_state_dict(
                state | ({"dirpath": str(folder)} if where == "dirpath told" else {})
            )
            kept = [
                callback.best_model_path,
                callback.last_model_path,
                callback.kth_best_model_path,
                *callback.best_k_models,
            ]
            assert victim not in kept, conf
            assert str(folder / "old.ckpt") in kept
