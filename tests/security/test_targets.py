"""No name in a configuration or a checkpoint reaches anything but what may be built."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.instantiate import instantiate
from posefilter.errors import UserError

Save = Callable[[dict[str, Any]], Path]
# Each would do harm if it were called: {secret} is the folder that nobody may touch.
ROUTES: dict[str, dict[str, Any]] = {
    "os.system": {"command": "touch {secret}/x"},
    "posefilter.cli.command.os.system": {"command": "touch {secret}/x"},
    "posefilter.cli.machine.subprocess.run": {"args": ["touch", "{secret}/x"]},
    "posefilter.cli.machine.subprocess.Popen": {"args": ["touch", "{secret}/x"]},
    "posefilter.cli.running.importlib.import_module": {"name": "hostile_module"},
    "posefilter.cli.instantiate.importlib.import_module": {"name": "hostile_module"},
    "posefilter.cli.instantiate.functools.partial": {},
    "posefilter.cli.evaluate.shutil.copy2": {"src": "{secret}/file.txt", "dst": "{secret}/x"},
    "posefilter.cli.results.write_json": {"path": "{secret}/x", "content": 1},
    "posefilter.limits.read_bytes": {"path": "{secret}/file.txt"},
    "posefilter.meshes.files.trimesh.load": {"file_obj": "{secret}/file.txt"},
    "posefilter.weights.fetch_weights": {
        "name": "x",
        "url": "http://127.0.0.1:9/x",
        "cache": "{secret}/x",
    },
    "posefilter.nets.resnet.torch.load": {"f": "{secret}/file.txt", "weights_only": False},
    "posefilter.nets.resnet.torch.hub.load": {
        "repo_or_dir": "{secret}",
        "model": "x",
        "source": "local",
    },
    "posefilter.models.pose_pf.PosePF.load_from_checkpoint": {
        "checkpoint_path": "{secret}/file.txt"
    },
    "posefilter.nets.mlp.__builtins__": {},
    "torch.os.system": {"command": "touch {secret}/x"},
    "torch.load": {"f": "{secret}/file.txt", "weights_only": False},
    "torch.save": {"obj": 1, "f": "{secret}/x"},
    "torch.hub.load": {"repo_or_dir": "{secret}", "model": "x", "source": "local"},
    "torch.hub.download_url_to_file": {"url": "http://127.0.0.1:9/x", "dst": "{secret}/x"},
    "torch.utils.cpp_extension.load_inline": {
        "name": "hostile",
        "cpp_sources": "int x;",
        "build_directory": "{secret}",
    },
    "torch.utils.collect_env.run": {"command": "touch {secret}/x"},
    "torch.package.PackageImporter": {"file_or_buffer": "{secret}/file.txt"},
    "lightning.pytorch.core.saving.os.system": {"command": "touch {secret}/x"},
    "lightning.fabric.utilities.cloud_io._load": {"path_or_url": "{secret}/file.txt"},
    "lightning.pytorch.core.saving.save_hparams_to_yaml": {
        "config_yaml": "{secret}/x",
        "hparams": {},
    },
    "posefilterx.hostile": {},
    "hostile_module.Thing": {},
    "builtins.exec": {"source": "1"},
}
ONLY_THE_USERS: dict[str, dict[str, Any]] = {  # that settings may build, and a checkpoint may not
    "posefilter.synthetic.generate.generate": {
        "out": "{secret}/x",
        "frames": 1,
        "object": "carton",
    },
    "posefilter.data.module.PoseDataModule": {"source": "fat", "root": "{secret}"},
    "lightning.Trainer": {"default_root_dir": "{secret}", "logger": False},
    "lightning.pytorch.loggers.TensorBoardLogger": {"save_dir": "{secret}"},
    "posefilter.callbacks.speed.Speed": {},
}


def filled(node: Any, secret: Path) -> Any:
    if isinstance(node, dict):
        return {key: filled(value, secret) for key, value in node.items()}
    if isinstance(node, list):
        return [filled(value, secret) for value in node]
    return node.format(secret=secret) if isinstance(node, str) else node


@pytest.fixture(autouse=True)
def hostile_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("hostile_module", "hostile_plugin"):
        (tmp_path / f"{name}.py").write_text("class Thing:\n    pass\n")
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", ROUTES)
def test_settings_reach_nothing_else(name: str, secret: Path, watch: Any) -> None:
    with watch, pytest.raises(UserError) as told:
        instantiate({"_target_": name, **filled(ROUTES[name], secret)}, "x")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", {**ROUTES, **ONLY_THE_USERS})
@pytest.mark.parametrize("place", ["model", "piece"])
def test_a_recipe_reaches_components_alone(
    name: str, place: str, content: dict[str, Any], save: Save, secret: Path, watch: Any
) -> None:
    settings = content["recipe"]["settings"]
    node = {"_target_": name, **filled({**ROUTES, **ONLY_THE_USERS}[name], secret)}
    settings["model"] = (
        node if place == "model" else {**settings["model"], "loss": [{"deep": node}]}
    )
    path = save(content)
    with watch, pytest.raises(UserError) as told:
        method_of(read_checkpoint(path))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("partial", [True, False])
def test_a_plug_in_is_not_trusted_because_a_checkpoint_says_so(
    partial: bool, content: dict[str, Any], save: Save, watch: Any
) -> None:
    content["recipe"]["settings"]["loss"] = {
        "_target_": "hostile_plugin.Thing",
        "_partial_": partial,
    }
    path = save(content)
    with watch, pytest.raises(UserError, match="plugins"):
        method_of(read_checkpoint(path))
    content["recipe"]["settings"]["plugins"] = ["hostile_plugin"]
    path = save(content)
    with watch, pytest.raises(UserError, match="plugins"):
        method_of(read_checkpoint(path))


def test_a_component_that_is_no_method_is_refused(content: dict[str, Any], save: Save) -> None:
    content["recipe"]["settings"]["model"] = {"_target_": "posefilter.losses.likelihood.Bce"}
    with pytest.raises(UserError, match="model"):
        method_of(read_checkpoint(save(content)))


def test_weights_that_a_recipe_names_are_not_read(secret: Path, watch: Any) -> None:
    """A trunk's own weights are in the checkpoint: the file, or address, that it was started from
    is not looked at.
    """
    from posefilter.cli.recipe import without_pretrained

    for weights in (f"{secret}/file.txt", "http://127.0.0.1:9/resnet.pth"):
        node = {"_target_": "posefilter.nets.resnet.ResNet", "kind": "resnet18", "weights": weights}
        with watch:
            made = instantiate(without_pretrained({"pieces": [node]}), "context")
        assert isinstance(made["pieces"][0], torch.nn.Module)


def test_what_a_plug_in_calls_weights_is_kept() -> None:
    """A loss that weighs its terms is built again as it was trained."""
    from posefilter.cli.recipe import without_pretrained

    loss = {"_target_": "hostile_plugin.Thing", "weights": [5.0, 1.0]}
    trunk = {"_target_": "posefilter.nets.resnet.ResNet", "weights": "a.pth"}
    made = without_pretrained({"loss": loss, "model": {"_target_": "own.Net", "trunk": trunk}})
    assert made["loss"] == loss
    assert made["model"]["trunk"]["weights"] is None
