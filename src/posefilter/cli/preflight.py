"""Whether the files that a command is told to read are there; torch is not needed for it."""

import math
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from posefilter.cli.arguments import TYPED
from posefilter.cli.choices import read_settings
from posefilter.cli.plain import find, unresolved
from posefilter.errors import UserError, missing_package
from posefilter.paths import find_conf
from posefilter.weights import ALL, expand_weights, find_weights, is_several

# by command: settings that name a file to be read
_FILES = {"predict": ("rgb", "depth"), "evaluate": ("estimates",)}
# by command: settings that name a folder to be read
_FOLDERS = {
    "calibrate": ("data.root", "data.meshes", "absent"),
    "check_data": ("data.root", "meshes", "data.meshes"),
    "evaluate": ("data.root", "data.meshes"),
    "generate": ("meshes",),
    "predict": ("meshes",),
    "report": ("run", "sweep_folder"),
    "track": ("frames", "meshes", "data.root", "data.meshes"),
    "train": ("data.root", "data.meshes"),
}
_ONE_IMAGE = "is a folder; predict takes one image, and track frames=DIR a folder of them"
_IS_FOLDER = {"rgb": _ONE_IMAGE, "depth": _ONE_IMAGE, "estimates": "is a folder; name a file in it"}
# by command: a setting and its value that need packages, and the extra that has these
_PACKAGES = {
    "export": (("format", "onnx", ("onnx", "onnxscript"), "export"),),
    "generate": (
        ("settle", True, ("mujoco",), "sim"),
        ("renderer", "opengl", ("moderngl",), "moderngl"),
    ),
}
# by the class of a logger: the package that it needs, which is an extra of ours by the same name
_LOGGERS = {
    "lightning.pytorch.loggers.MLFlowLogger": "mlflow",
    "lightning.pytorch.loggers.WandbLogger": "wandb",
}
_VIDEOS = ("mp4", "gif", "none")  # as figures/video.py writes them
# by command: settings that must be given, and how
_NEEDED = {
    "convert_bag": (
        ("bag", "out", "checkpoint"),
        "type convert_bag in.mcap out.mcap checkpoint=...",
    ),
    "export": (("out",), "name the file to write, such as out=weights/carton.ckpt"),
    "onboard": (("mesh",), "name an .obj, .ply or .glb file"),
    "predict": (
        ("rgb", "depth", "intrinsics"),
        "predict needs rgb=, depth= and intrinsics=fx,fy,cx,cy",
    ),
}


def check_files(command: str, cfg: DictConfig) -> None:
    """Check what a command is to read before torch is imported, which takes seconds.

    Raises UserError, naming the setting, where a file or folder is missing.
    """
    for key, default in read_settings(find_conf(), command).items():
        # a text such as "no" would count as true
        if isinstance(default, bool) and not isinstance(cfg[key], bool):
            raise UserError(f"{key}={cfg[key]}: choose true or false")
    if command == "predict":
        _check_rerun(cfg)
        _find_all(cfg.checkpoint)
    if command == "track":
        _check_video(cfg)
    if command == "train":
        _check_loggers(cfg.get("logger"))
    if command in ("export", "calibrate") or (command == "evaluate" and cfg.checkpoint):
        _check_single(command, cfg.checkpoint)
        find_weights(cfg.checkpoint)
    if command in ("train", "onboard") and cfg.warm_start and not cfg.get("resume"):
        try:
            _find_all(cfg.warm_start)
        except UserError as error:
            raise UserError(str(error).replace("checkpoint=", "warm_start=")) from error
    keys, how = _NEEDED.get(command, ((), ""))
    for key in keys:
        if cfg[key] is None:
            raise UserError(f"{key}: is missing; {how}")
    if command in ("predict", "track") and cfg.intrinsics is not None:
        parse_intrinsics(cfg.intrinsics)
    if command == "convert_bag":
        _check_bag(cfg)
    if command == "onboard":
        mesh = Path(str(cfg.mesh))
        if not mesh.is_file() and mesh.suffix:  # a name without an ending may be a builtin one's
            raise UserError(f"mesh={mesh}: no such file")
        more = unresolved(cfg.train_overrides)  # interpolations are the training's
        if not (isinstance(more, list) and all(isinstance(one, str) for one in more)):
            raise UserError(
                f"train_overrides={more}: must be a list, such as ['filter.particles=200']"
            )
    for key, value, packages, extra in _PACKAGES.get(command, ()):
        missing = [one for one in packages if cfg[key] == value and find_spec(one) is None]
        if missing:
            raise missing_package(f"{key}={str(value).lower()}", missing[0], extra)
    if command == "check_data" and cfg.data.meshes is None:
        raise UserError("meshes: is missing; choose builtin, or name a folder of meshes")
    for key in (*_FILES.get(command, ()), *_FOLDERS.get(command, ())):
        _take_as_text(cfg, key)
    for key in _FILES.get(command, ()):
        if cfg[key] is not None and not Path(str(cfg[key])).is_file():
            is_folder = Path(str(cfg[key])).is_dir()
            raise UserError(f"{key}={cfg[key]}: {_IS_FOLDER[key] if is_folder else 'no such file'}")
    for key in _FOLDERS.get(command, ()):
        folder = find(cfg, key)
        if folder is None or folder == "builtin" or Path(str(folder)).is_dir():
            continue
        if key == "data.root" and find(cfg, "data.generate") is not None:
            continue  # it is rendered
        found = "is a file, and no folder" if Path(str(folder)).exists() else "no such folder"
        raise UserError(f"{TYPED.get(key, key)}={folder}: {found}")


def parse_intrinsics(typed: Any) -> list[float] | Path:
    """Return the numbers of `intrinsics=`, four or the nine of a matrix, or the file that it names.

    Raises UserError where it is none of these.
    """
    parts = list(typed) if isinstance(typed, ListConfig | list) else str(typed).split(",")
    try:
        values = [float(part) for part in parts]
    except (TypeError, ValueError) as error:
        file = Path(str(parts[0]))
        if len(parts) == 1 and file.exists():
            return file
        if len(parts) == 1 and file.suffix:
            raise UserError(f"intrinsics={typed}: no such file") from error
        raise UserError(
            f"intrinsics={typed}: expected four numbers, fx,fy,cx,cy [px], or a camera's file"
        ) from error
    if len(values) not in (4, 9):
        raise UserError(f"intrinsics={typed}: expected four numbers, fx,fy,cx,cy [px]")
    if not all(map(math.isfinite, values)):
        raise UserError(f"intrinsics={typed}: hold NaN or infinity")
    return values


def _check_bag(cfg: DictConfig) -> None:
    """Raise UserError where there is no bag to be read, or nothing that reads it."""
    if not Path(str(cfg.bag)).exists():
        raise UserError(f"bag={cfg.bag}: no such file")
    _check_on_error(cfg.on_error)
    _find_all(cfg.checkpoint)
    if find_spec("rosbags") is None:
        raise missing_package(f"bag={cfg.bag}", "rosbags", "bags")


def _check_on_error(typed: Any) -> None:
    if typed not in ("raise", "skip"):
        raise UserError(f"on_error={typed}: choose raise or skip")


def _check_video(cfg: DictConfig) -> None:
    """Raise UserError where there is no video to be tracked, or none that can be written."""
    if cfg.save_video not in _VIDEOS:
        raise UserError(f"save_video={cfg.save_video}: choose {', '.join(_VIDEOS)}")
    _check_on_error(cfg.on_error)
    _find_all(cfg.checkpoint)
    data = cfg.get("data")
    if bool(cfg.frames) == bool(data):
        raise UserError("give either frames=DIR, or data=ycb_video|bop|fat and data.root=DIR")
    if cfg.frames and cfg.scene is not None:
        raise UserError(f"scene={cfg.scene}: is one of a dataset; frames=DIR is one video")
    for key in ("intrinsics", "depth_scale"):
        if data and cfg[key] is not None:
            raise UserError(
                f"{key}: only valid with frames=DIR; a dataset has its own {key}, leave it out"
            )
    if data and cfg.distortion is not None:
        raise UserError("distortion: only valid with frames=DIR; a dataset's images are rectified")
    if cfg.frames and cfg.intrinsics is None:
        raise UserError("intrinsics: is missing; frames=DIR needs intrinsics=fx,fy,cx,cy [px]")
    if data and data.root is None:
        raise UserError("data.root: is missing; name the dataset's folder")


def _check_loggers(loggers: Any) -> None:
    """Raise UserError where a logger's package is not installed."""
    for name, node in (loggers or {}).items():
        package = _LOGGERS.get(node.get("_target_", "")) if isinstance(node, DictConfig) else None
        if package is not None and find_spec(package) is None:
            raise missing_package(f"logger={name}", package, package)


def _check_rerun(cfg: DictConfig) -> None:
    """Raise UserError where the 3-D view cannot be written."""
    if cfg.save_rerun:
        if is_several(cfg.checkpoint) or cfg.instances is not None:
            raise UserError("save_rerun=true: shows one object; give one checkpoint")
        from posefilter.figures.recording import check_viewer  # slow to import, rarely asked for

        check_viewer()


def _take_as_text(cfg: DictConfig, key: str) -> None:
    """Make a text of a path that YAML reads as a number, such as 2024.

    Raises UserError for what is neither.
    """
    value = find(cfg, key)
    if isinstance(value, int | float) and not isinstance(value, bool):
        OmegaConf.update(cfg, key, str(value))
    elif not isinstance(value, str | None):
        raise UserError(f"{TYPED.get(key, key)}={value}: must be the name of a file or folder")


def _check_single(command: str, weights: Any) -> None:
    """Raise UserError where a command that takes one checkpoint is given a list of them."""
    if is_several(weights) and (weights == ALL or not isinstance(weights, str)):
        typed = weights if isinstance(weights, str) else f"[{','.join(map(str, weights))}]"
        sweep = ", in a sweep: -m checkpoint=A,B" if command == "evaluate" else ""
        raise UserError(f"checkpoint={typed}: {command} takes one; give them one by one{sweep}")


def _find_all(weights: Any) -> None:
    """Raise UserError where a checkpoint of those that a setting stands for is not there."""
    for one in expand_weights(weights) if is_several(weights) else [weights]:
        find_weights(one)
