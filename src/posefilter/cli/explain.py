"""From a mistake in a command line to one readable line."""

import difflib
import errno
import re
import shlex
import traceback
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import MarkedYAMLError

from posefilter.cli.arguments import quote
from posefilter.cli.choices import config_folders, list_choices, say_no_choice
from posefilter.cli.instantiate import GIVEN, hint, tell_given
from posefilter.cli.plain import key_of, to_plain
from posefilter.cli.renamed import rename_argument, rename_missing
from posefilter.errors import find_reason, printable
from posefilter.ranges import list_nodes

# settings of Lightning's Trainer, which is not imported to tell a mistake
LIGHTNINGS = (
    *("accelerator", "accumulate_grad_batches", "benchmark", "check_val_every_n_epoch"),
    *("default_root_dir", "detect_anomaly", "deterministic", "devices", "enable_model_summary"),
    *("gradient_clip_val", "inference_mode", "limit_predict_batches", "limit_test_batches"),
    *("limit_train_batches", "limit_val_batches", "log_every_n_steps", "max_epochs", "max_steps"),
    *("max_time", "min_epochs", "min_steps", "num_nodes", "num_sanity_val_steps"),
    *("overfit_batches", "precision", "profiler", "reload_dataloaders_every_n_epochs", "strategy"),
    *("sync_batchnorm", "use_distributed_sampler", "val_check_interval"),
)
# settings of others' programs that train with Lightning and Hydra, and what is typed here
_CHECKPOINT = "type checkpoint=RUN"
_TEMPLATES = {
    "train": {
        "ckpt_path": "type resume=RUN to go on with a run, or warm_start=FILE for its weights",
        "hparams_search": "type -m hydra/sweeper=optuna, and what is to be searched",
        "task_name": "type tags=[NAME], or out=DIR",
        "test": "a training ends with a test of its best checkpoint",
        "train": "a checkpoint is tested by evaluate",
    },
    "evaluate": {"ckpt_path": _CHECKPOINT},
    "predict": {"ckpt_path": _CHECKPOINT},
    "track": {"ckpt_path": _CHECKPOINT},
}
_FORMS = {"intrinsics": "fx,fy,cx,cy", "distortion": "k1,k2,p1,p2,k3"}  # of lists of numbers
# what Hydra says of a choice that is made already, and of a setting that there is
_THERE = re.compile(r"(?:Multiple values for |.* already at ')(\S+?)(?:\. |')")
# a setting that a class does not take
_NOT_TAKEN = re.compile(r"((?:model|loss)\.[\w.]+): \w+ takes no such setting$")
# choices that packages of others bring
_EXTRA = ("optuna", "joblib", "submitit_local", "submitit_slurm")


def explain(error: BaseException, name: str, conf: Path, arguments: list[str]) -> str:
    """Return a mistake as one line that names the key and the nearest valid one."""
    text = str(error)
    if isinstance(error, BrokenPipeError):
        return "has ended, since what it prints to was closed (as by `| head`)"
    if isinstance(error, OSError) and error.strerror:
        if error.filename is None and error.errno == errno.ENOSPC:
            return f"the disk is full: a file cannot be written ({error.strerror})"
        place = "a file" if error.filename is None else str(error.filename)
        return f"{place}: cannot be read or written ({error.strerror})"
    if isinstance(error, MarkedYAMLError):
        return _explain_yaml(error)
    if isinstance(error, MemoryError):
        return "out of memory: fewer particles, smaller batches or images take less"
    if (
        isinstance(error, MissingConfigException)
        and error.options is not None
        and error.missing_cfg_file
    ):
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if choice in _EXTRA:
            return f"{group}={choice}: its package is missing; pip install 'posefilter[sweep]'"
        options = sorted(one for one in error.options if not one.startswith("_"))
        return say_no_choice(group, choice, options)
    if isinstance(error, ConfigCompositionException):
        if found := re.search(r"Could not override '([^']+)'", text):
            # within a mapping, the cause names the key: tracker={rounds: 2}
            key = str(getattr(error.__cause__, "full_key", None) or found[1])
            return _explain_missing(key, found[1], name, conf, arguments)
        if found := _THERE.match(text):
            added = [a for a in arguments if a.startswith(f"+{found[1]}=")]
            if added:  # else a file's list of defaults lacks `override`, as Hydra says
                return f"{added[0]}: + adds what is not there yet; type {added[0][1:]}"
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override}: cannot be read ({first_line(error)}){_tell_quotes(error.override)}"
        )
    if found := re.match(r"Ambiguous value for argument '(.*)'$", first_line(error)):
        typed = found[1].lstrip("+")  # which `loosen` may have added
        listed = typed.replace("=", "=[", 1) + "]"
        return (
            f"{typed}: is a list of values, which only a sweep takes (-m); one setting that is "
            f"a list is typed '{listed}'{_tell_quotes(typed)}"
        )
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: is missing; give {error.full_key}=..."
    if isinstance(error, OmegaConfBaseException) and getattr(error, "full_key", None):
        return f"{error.full_key}: {first_line(error)}"
    if (found := _NOT_TAKEN.match(text)) and found[1] not in map(key_of, arguments):
        # a preset sets it for another choice
        return f"{first_line(error)}; '~{found[1]}' leaves it out"
    return first_line(error)


def _explain_missing(key: str, typed: str, name: str, conf: Path, arguments: list[str]) -> str:
    """Return what a setting that there is not is called today, or which is the nearest."""
    key = re.sub(r"\[(\d+)\]", r".\1", key)
    if new := rename_missing(key, name):
        return f"{key}: is now {new}"
    if key in GIVEN:
        return tell_given(key)
    if instead := _TEMPLATES.get(name, {}).get(key):
        return f"{key}: there is no such setting; {instead}"
    cfg = compose_without(typed, name, conf, arguments)
    section, _, last = key.rpartition(".")
    target = OmegaConf.select(cfg, f"{section}._target_", throw_on_resolution_failure=False)
    if new := rename_argument(target, last):
        return f"{key}: is now {section}.{new}"
    return f"{key}: there is no such setting{near(key, known_keys(cfg, key))}"


def _explain_yaml(error: MarkedYAMLError) -> str:
    """Return which file of settings cannot be read, and where."""
    mark = error.problem_mark
    place = "the settings" if mark is None else f"{mark.name}, line {mark.line + 1}"
    return f"{place}: cannot be read as YAML ({error.problem})"


def _tell_quotes(argument: str) -> str:
    """Return how an argument is typed whose value is one text, with signs that Hydra reads."""
    key, found, value = argument.partition("=")
    if not found:
        return (
            "; settings are typed key=value, without blanks about =, a path with blanks in quotes"
        )
    if form := _FORMS.get(key):
        return f"; it is typed {key}={form}"
    text = f"{key}={quote(value)}"
    typed = shlex.quote(text) if re.search(r'["$`\\!]', text) else f'"{text}"'
    return f"; as one text it is typed {typed}"


def explain_hydra(error: BaseException, conf: Path, arguments: list[str]) -> str:
    """Return in one line what Hydra's own code, or a launcher or sweeper of it, stumbled over."""
    if isinstance(error, MarkedYAMLError):
        return _explain_yaml(error)
    frames = traceback.extract_tb(error.__traceback__)
    if any("hydra_plugins" in Path(frame.filename).parts for frame in frames):
        chosen = [a for a in arguments if a.startswith(("hydra/launcher=", "hydra/sweeper="))]
        return f"{', '.join(chosen) or 'the sweep'}: has failed ({first_line(error)})"
    # a choice that is null or a number, and the like
    groups = [a for a in arguments if "=" in a and (conf / key_of(a)).is_dir()]
    wrong = next((a for a in groups if a.partition("=")[2].lower() in ("true", "false")), None)
    if wrong is not None:
        known = list_choices(conf / key_of(wrong))
        return f"{wrong}: choose {', '.join(known)}"
    return f"{', '.join(groups) or 'the settings'}: cannot be read ({first_line(error)})"


def is_launchers(error: BaseException) -> bool:
    """Tell whether a launcher or sweeper of Hydra has raised an error itself, rather than a job."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and bool({"hydra_plugins", "optuna"} & {*Path(frames[-1].filename).parts})


def first_line(error: BaseException) -> str:
    """Return an error's first line, or its kind where it says nothing.

    What a terminal would obey rather than show is replaced: names in files of others are quoted.
    """
    return printable(find_reason(error))


def near(wrong: str, known: list[str]) -> str:
    """Return the nearest keys of the same last name; else the nearest of the same depth; else what
    the wrong key's section has.
    """
    if wrong.startswith("trainer.") and wrong.removeprefix("trainer.") in LIGHTNINGS:
        return f", by default; it is one of Lightning's: type +{wrong}=..."
    elsewhere = [key for key in known if re.split("[./]", key)[-1] == wrong.rpartition(".")[2]]
    if elsewhere:
        nearest = difflib.get_close_matches(wrong, elsewhere, n=2, cutoff=0)
        return f"; did you mean {' or '.join(map(repr, nearest))}?"
    told = hint(wrong, [key for key in known if key.count(".") == wrong.count(".")])
    section = wrong.rpartition(".")[0]
    if told or section not in known:
        return told or hint(wrong, known)
    own = [key for key in known if key.rpartition(".")[0] == section]
    return f"; {section} has {', '.join(own)}" if own else f"; {section} has no settings"


def compose_without(wrong: str, name: str, conf: Path, arguments: list[str]) -> DictConfig:
    """Compose a command's settings without a wrong argument; without any where others are, too."""
    good = [a for a in arguments if "=" in a and not a.startswith(("-", wrong)) and "," not in a]
    folders = ",".join(f"'file://{folder.resolve()}'" for folder in config_folders(arguments))
    good += [f"hydra.searchpath=[{folders}]"] if folders else []
    with initialize_config_dir(str(conf.resolve()), version_base="1.3"):
        try:
            return compose(name, good, return_hydra_config=True)
        except HydraException:
            return compose(name, return_hydra_config=True)


def known_keys(cfg: DictConfig, wrong: str) -> list[str]:
    """Return every key and group that would have been valid, nearest depth first."""
    groups = [str(k) for k in cfg.hydra.runtime.choices if not str(k).startswith("hydra/")]
    settings = {k: v for k, v in to_plain(cfg).items() if k != "hydra"}
    keys = [key for key, _, _ in list_nodes(settings) if "[" not in key]  # of lists, no entry
    depth = wrong.count(".")
    return sorted({*groups, *keys}, key=lambda k: (abs(k.count(".") - depth), k))
