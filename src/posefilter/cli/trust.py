"""What a `_target_` may name: an explicit list, and the plug-ins that the user trusts.

A name is allowed before its module is imported, and must then be defined where it is named, so that
nothing is reached through another module's imports (`posefilter.cli.command.os.system`). There are
two scopes. `CONFIG` is for settings that the user composes: components, data, callbacks, the
trainer and loggers. `RECIPE` is for settings that a checkpoint carries: components alone, the
components that a method is made of. They are classes that compute; none writes a file or starts a
process.

A plug-in is trusted by the user alone: `plugins=[my_package]` on the command line,
`trust("my_package")` in Python, or an installed distribution with an entry point of the group
`posefilter.plugins`. What is trusted may be built in both scopes, and the folder `conf` inside the
package adds its files to the choices.
"""

import sys
from collections.abc import Iterable
from enum import Enum
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from posefilter.errors import UserError

ENTRY_POINTS = "posefilter.plugins"
# packages of posefilter whose classes a recipe may name
COMPONENTS = ("filters", "labels", "losses", "models", "nets")
# packages of posefilter whose classes the user's own settings may name as well
_LOOKING = ("callbacks",)
_OPTIMIZERS = (
    *("ASGD", "Adadelta", "Adafactor", "Adagrad", "Adam", "AdamW", "Adamax", "NAdam", "RAdam"),
    *("RMSprop", "Rprop", "SGD"),
)
_LAYERS = ("ELU", "GELU", "Identity", "LeakyReLU", "Linear", "ReLU", "SiLU", "Tanh")
_SCHEDULES = (
    *("ConstantLR", "CosineAnnealingLR", "CosineAnnealingWarmRestarts", "CyclicLR"),
    *("ExponentialLR", "LinearLR", "MultiStepLR", "OneCycleLR", "PolynomialLR", "StepLR"),
)
_RECIPE_NAMES = frozenset(
    {
        "posefilter.models.lr_schedulers.warmup_cosine",
        *(f"torch.optim.{name}" for name in _OPTIMIZERS),
        *(f"torch.optim.lr_scheduler.{name}" for name in _SCHEDULES),
        *(f"torch.nn.{name}" for name in _LAYERS),
    }
)
DATA_NAMES = frozenset(
    {"posefilter.data.module.PoseDataModule", "posefilter.synthetic.generate.generate"}
)
_AUGMENTATIONS = ("posefilter.data.augmentation", "posefilter.data.photometric")
_CALLBACKS = (
    *("DeviceStatsMonitor", "EarlyStopping", "LearningRateMonitor", "ModelCheckpoint"),
    *("ModelSummary", "Timer"),
)
_LOGGERS = ("CSVLogger", "MLFlowLogger", "TensorBoardLogger", "WandbLogger")
_PROFILERS = ("AdvancedProfiler", "PyTorchProfiler", "SimpleProfiler")
_CONFIG_NAMES = _RECIPE_NAMES | DATA_NAMES | {
    "lightning.Trainer",
    "posefilter.cli.best.Best",
    "posefilter.cli.best.Last",
    *(f"lightning.pytorch.callbacks.{name}" for name in _CALLBACKS),
    *(f"lightning.pytorch.loggers.{name}" for name in _LOGGERS),
    *(f"lightning.pytorch.profilers.{name}" for name in _PROFILERS),
}  # fmt: skip
_FOREIGN = ("hydra", "lightning", "omegaconf", "posefilter", "torch")  # that are no plug-ins
_trusted: set[str] = set()


class Scope(Enum):
    """Where a `_target_` stands: in the user's own settings, or in a checkpoint's."""

    CONFIG = "your settings"
    RECIPE = "a checkpoint"


_NAMES = {Scope.CONFIG: _CONFIG_NAMES, Scope.RECIPE: _RECIPE_NAMES}


def trust(package: str) -> None:
    """Let settings, and recipes of checkpoints, name what a plug-in package defines, until this
    process ends.

    Args:
        package: The dotted name of the package; it is not imported yet.

    Raises:
        UserError: The name is none, or one of the standard library, posefilter, torch or lightning;
            or there is no such package.
    """
    parts = package.split(".") if isinstance(package, str) else [""]
    if not all(part.isidentifier() for part in parts):
        near = " (an import name has `_`, not `-`)" if "-" in str(package) else ""
        raise UserError(f"plugins={package!r}: not the name of a package{near}")
    if not _may_be_plugin(parts[0]):
        raise UserError(f"plugins={package}: only a package of your own can be a plug-in")
    if not _is_there(package):
        raise UserError(f"plugins={package}: there is no package '{package}' (is it installed?)")
    _trusted.add(package)


def _is_there(package: str) -> bool:
    """Tell whether a package can be found; it is not imported, but those around it."""
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError as error:  # one around it, or what that one imports
        return not f"{package}.".startswith(f"{error.name}.")
    except (Exception, SystemExit):  # told where it is imported
        return True


def _may_be_plugin(package: str) -> bool:
    return package not in sys.stdlib_module_names and package not in _FOREIGN


def trusted() -> frozenset[str]:
    """Return the plug-ins that the user trusts, installed ones included."""
    return named() | installed().keys()


def named() -> frozenset[str]:
    """Return the plug-ins that the user has named himself."""
    return frozenset(_trusted)


@cache
def installed() -> dict[str, str]:
    """Return the packages of installed plug-ins, each with the name of its entry point."""
    return {point.value.partition(":")[0]: point.name for point in entry_points(group=ENTRY_POINTS)}


def find_folders(packages: Iterable[str]) -> list[Path]:
    """Return the folders of settings inside packages that have one; the packages are not imported,
    but those around them.
    """
    found = []
    for package in sorted(packages):
        try:
            spec = find_spec(package)
        except (Exception, SystemExit):  # told where it is imported
            continue
        places = spec.submodule_search_locations if spec is not None else None
        found += [Path(place).resolve() / "conf" for place in places or ()]
    return [folder for folder in found if folder.is_dir()]


def is_plugin(name: str) -> bool:
    """Tell whether a dotted name lies in a plug-in that the user trusts."""
    return any(name.startswith(f"{package}.") for package in trusted())


def is_listed(name: str, scope: Scope) -> bool:
    """Tell whether a dotted name is in the explicit list of a scope."""
    return name in _NAMES[scope]


def is_component(module: str, scope: Scope) -> bool:
    """Tell whether the classes that a module of posefilter defines may be built in a scope."""
    top, _, rest = module.partition(".")
    packages = COMPONENTS if scope is Scope.RECIPE else (*COMPONENTS, *_LOOKING)
    own = top == "posefilter" and rest.split(".")[0] in packages and "." in rest
    return own or (scope is Scope.CONFIG and module in _AUGMENTATIONS)


def check_name(name: str, where: str, scope: Scope) -> None:
    """Raise UserError unless a dotted name may be built in a scope, before anything is imported."""
    module = name.rpartition(".")[0]
    plain = all(
        part.isidentifier() and part.isascii() and not part.startswith("_")
        for part in name.split(".")
    )
    if plain and (
        is_listed(name, scope)
        or is_component(module, scope)
        # a misspelt name may then be told: it is built only if listed itself
        or listed_in(module, scope)
        or is_plugin(name)
    ):
        return
    top = name.partition(".")[0]
    own = plain and "." in name and _may_be_plugin(top)
    how = f"plugins=[{top}], in Python posefilter.trust('{top}')" if own else "plugins=[...]"
    raise UserError(
        f"{where}._target_={name[:100]!r}: may not be built from {scope.value}; allowed are "
        f"posefilter's own components, "
        f"a list of torch and lightning classes, and packages that you trust: {how}"
    )


def listed_in(module: str, scope: Scope) -> list[str]:
    """Return the names of a module that are in the explicit list of a scope."""
    places = (name.rpartition(".") for name in _NAMES[scope])
    return sorted(name for home, _, name in places if home == module)
