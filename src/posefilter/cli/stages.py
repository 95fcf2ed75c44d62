"""Work in stages that is resumed where it was interrupted: what is done is kept in a file."""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from posefilter.cli.old_names import COMMANDS
from posefilter.cli.renamed import update
from posefilter.cli.results import write_json
from posefilter.errors import UserError
from posefilter.forms import NUMBER, Each, Record, check_form, parse_json
from posefilter.limits import read_json

_LONGEST = 1 << 20  # of the file [bytes]
_STAGE = Record({"settings": {}, "seconds": NUMBER})

_RENAMED = COMMANDS["onboard"]  # settings in records of earlier versions


class Stages:
    """Which stages are done, with what settings, and how long each took.

    Args:
        file: Where it is kept, as JSON.
        form: Of what the stages find out, as `check_form` has it; None for anything.

    Raises:
        UserError: The file is there and is no such record.
    """

    def __init__(self, file: Path, form: Mapping[str, Any] | None = None) -> None:
        self.file = file
        self.values: dict[str, Any] = {}  # what stages have found out, by name; `keep` writes it
        self._stages: dict[str, Any] = {}
        if file.is_file():
            try:
                found = read_json(file, _LONGEST, parse_json)
                check_form(found, Record({"stages": Each(_STAGE), "values": form or {}}), file)
            except UserError as error:
                raise UserError(
                    f"{file}: is no record of an onboarding any more; choose another out= ({error})"
                ) from error
            self._stages, self.values = found["stages"], found["values"]
            for stage in self._stages.values():
                stage["settings"] = _with_todays_names(stage["settings"])

    @property
    def seconds(self) -> dict[str, float]:
        """How long each stage took, in all its sittings [s]."""
        return {name: one["seconds"] for name, one in self._stages.items()}

    def keep(self, **values: Any) -> None:
        """Write down what a stage has found out."""
        self.values.update(values)
        self._write()

    def is_done(self, name: str, settings: Mapping[str, Any]) -> bool:
        """Tell whether a stage was finished with these settings."""
        one = self._stages.get(name)
        return bool(one and one.get("done") and not _differing(one["settings"], settings))

    def was_finished(self, name: str) -> bool:
        """Tell whether a stage was finished, with whatever settings."""
        return bool(self._stages.get(name, {}).get("done"))

    def check(self, name: str, settings: Mapping[str, Any]) -> None:
        """Refuse settings that differ from those that a costly stage was begun with.

        Raises:
            UserError: They do.
        """
        before = self._stages.get(name)
        others = [] if before is None else _differing(before["settings"], settings)
        if others:
            raise UserError(
                f"out={self.file.parent}: its stage '{name}' was begun with other settings "
                f"({', '.join(others)}); choose another out="
            )

    def run(
        self, name: str, settings: Mapping[str, Any], work: Callable[[], None], costly: bool = False
    ) -> None:
        """Do a stage; those that come later are to be done again.

        Args:
            name: Of the stage.
            settings: All that decides its result.
            work: Does it; interrupted, it is called again.
            costly: Refuse to begin it anew with other settings.

        Raises:
            UserError: It was begun with other settings, and is costly.
        """
        if costly:
            self.check(name, settings)
        stages = self._stages
        before = stages.get(name)
        same = before is not None and not _differing(before["settings"], settings)
        names = list(stages)
        for later in names[names.index(name) + 1 :] if before is not None else ():
            stages[later]["done"] = False
        spent = stages[name]["seconds"] if same else 0.0
        stages[name] = {"settings": _plain(settings), "done": False, "seconds": spent}
        self._write()
        began = time.perf_counter()
        try:
            work()
            stages[name]["done"] = True
        finally:
            stages[name]["seconds"] = spent + time.perf_counter() - began
            self._write()

    def _write(self) -> None:
        write_json(self.file, {"stages": self._stages, "values": self.values})


def _with_todays_names(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's settings by today's names; so are those that the training was given."""
    named = {_RENAMED.get(key, key): value for key, value in settings.items()}
    words = named.get("train_overrides")
    if isinstance(words, list):
        named["train_overrides"] = [update(str(one), "train") for one in words]
    return named


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as a JSON file gives them back."""
    return dict(json.loads(json.dumps(dict(settings), default=str)))


def _differing(before: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return the settings that are others than before; one that is null may be missing there."""
    now = _plain(settings)
    return sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
