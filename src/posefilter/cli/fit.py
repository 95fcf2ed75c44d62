"""Whether the chosen components fit each other, by what their classes declare (see `capabilities`).

Torch is not imported for it: components of posefilter are read from their source, plug-ins
(imported by then) as they are.
"""

import ast
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from posefilter.capabilities import MEANINGS, Declared, find_missing, read_declared
from posefilter.cli.instantiate import locate
from posefilter.cli.options import Groups, Option, list_places, list_targets, open_groups
from posefilter.cli.plain import find, map_values
from posefilter.cli.trust import Scope, check_name, is_component, is_listed, is_plugin
from posefilter.errors import UserError

_LINK = re.compile(r"\$\{([\w.]+)\}")
_DEEPEST = 16  # reference to a reference


class Component(NamedTuple):
    """A node of the settings that names a class."""

    key: str  # as one types it
    target: str
    declared: Declared


def check_fit(settings: DictConfig, choices: Mapping[str, str], scope: Scope) -> None:
    """Match what the components of a model require with what all of them provide.

    Args:
        settings: The whole configuration; its `model` is what would be built.
        choices: Which file of each group was chosen.
        scope: Where the settings come from.

    Raises:
        UserError: One line: the choice that does not fit, what it needs, and the choices that fit.
    """
    model = settings.get("model")
    if not isinstance(model, DictConfig):
        return
    tree = OmegaConf.to_container(settings, resolve=False)
    broken: InterpolationResolutionError | None = None
    try:
        node = OmegaConf.to_container(model, resolve=True)
    except InterpolationResolutionError as error:
        # a choice may refer to what another method has: the pair is the mistake
        node, broken = resolve_known(tree, "model"), error
    components = [
        Component(key, target, declared_by(target, key, scope))
        for place, target in list_targets(node, "model")
        for key in [typed_key(tree, place)]
    ]
    missing = find_missing(component.declared for component in components)
    if missing:
        number, need = missing[0]
        keys = {typed_key(tree, place) for place, _ in list_places(node, "model")}
        tops = {key.partition(".")[0] for key in keys}
        near = {g: name for g, name in choices.items() if g.partition("/")[0] in tops}
        with open_groups() as groups:
            told = Advice(groups, near, components, scope).explain(components[number], need, keys)
        raise UserError(told)
    if broken is not None:
        raise broken


def resolve_known(tree: Any, place: str, depth: int = 0) -> Any:
    """Return the part of plain settings at a place, all references in it replaced that can be."""

    def follow(value: Any, _: str) -> Any:
        link = _LINK.fullmatch(value) if isinstance(value, str) else None
        if link is None or depth == _DEEPEST:  # settings that refer to themselves have no end
            return value
        found = resolve_known(tree, link[1], depth + 1)
        return value if found is None else found

    return map_values(find(tree, place), follow)


def declared_by(target: str, key: str, scope: Scope) -> Declared:
    """Return what the class that a `_target_` names declares; nothing where it is none of ours.

    Args:
        target: The dotted name.
        key: Where it stands, for messages.
        scope: Where the settings come from.

    Raises:
        UserError: It may not be built from there, or is not there.
    """
    check_name(target, key, scope)
    module, _, name = target.rpartition(".")
    unknown = is_component(module, scope) and name not in parse_module(module)
    if is_plugin(target) or (unknown and not is_listed(target, scope)):  # told if it is not there
        found = locate(target, key, scope)
        return read_declared(found) if isinstance(found, type) else Declared()
    return Declared(
        *(frozenset(read_attribute(module, name, which) or ()) for which in Declared._fields)
    )


def read_attribute(module: str, name: str, attribute: str) -> tuple[str, ...] | None:
    """Return a class's attribute, a literal, from the source of posefilter, or its parent's."""
    kind = parse_module(module).get(name)
    if isinstance(kind, ast.ImportFrom):
        return read_attribute(kind.module or "", name, attribute)
    if not isinstance(kind, ast.ClassDef):
        return None
    for line in kind.body:
        match line:
            case ast.AnnAssign(target=ast.Name(id=own), value=ast.expr() as value):
                if own == attribute:
                    return tuple(ast.literal_eval(value))
    for base in kind.bases:
        found = read_attribute(module, base.id, attribute) if isinstance(base, ast.Name) else None
        if found is not None:
            return found
    return None


@cache
def parse_module(module: str) -> dict[str, ast.ClassDef | ast.ImportFrom]:
    """Return the classes of a module of posefilter, and what it imports, by name."""
    try:
        spec = find_spec(module) if module.startswith("posefilter.") else None
    except ModuleNotFoundError:  # told where it is built
        spec = None
    if spec is None or spec.origin is None:
        return {}
    out: dict[str, ast.ClassDef | ast.ImportFrom] = {}
    for line in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(line, ast.ClassDef):
            out[line.name] = line
        elif isinstance(line, ast.ImportFrom):
            out |= {alias.asname or alias.name: line for alias in line.names}
    return out


def typed_key(tree: Any, where: str) -> str:
    """Return a place in the model's tree as one types it: `model.filter.initialize.depth_offset` is
    `initialize.depth_offset`, if that is what it refers to.

    Args:
        tree: The whole configuration, plain and not resolved.
        where: The place.
    """
    path: list[str] = []
    for part in where.split("."):
        path.append(part)
        node = find(tree, ".".join(path))
        if isinstance(node, str) and (link := _LINK.fullmatch(node)):
            path = link[1].split(".")
    return ".".join(path)


def _name_missing(declared: Iterable[Declared]) -> set[str]:
    return {name for _, name in find_missing(declared)}


@dataclass(frozen=True)
class Advice:
    """What could be chosen instead of a component that does not fit.

    Args:
        groups: Where choices are read.
        choices: Which file of each group was chosen; another may have been since.
        components: All that is chosen.
        scope: Where the settings come from.
    """

    groups: Groups
    choices: Mapping[str, str]  # which file of each group; others may have been typed since
    components: Sequence[Component]
    scope: Scope

    def explain(self, component: Component, need: str, keys: set[str]) -> str:
        """Return the line that names the component that does not fit, what it needs, and what fits.

        Args:
            component: It does not fit.
            need: What it needs.
            keys: Places of all settings of the model, as one types them.
        """
        group, name = self.find_choice(component) or (component.key, component.target)
        advice, others = list[str](), list[str]()
        if group in self.choices and group != "model":
            fitting = self.list_fitting(group)
            advice += [f"{group}={_either(fitting)}"] if fitting else []
        for option in self.list_chosen():
            if option.group not in ("model", group) and keys & {
                place for place, _ in list_places(option.settings, "")
            }:
                fitting = self.list_fitting(option.group, need)
                advice += [f"{option.group}={_either(fitting)}"] if fitting else []
                others.append(option.group)
        if not any(one.partition("=")[0] in others for one in advice):
            advice += self.list_pairs(others, need)
        kinds = [one.target.rpartition(".")[2] for one in self.components if one.key == "model"]
        chosen = self.choices.get("model") or "".join(kinds)
        model = "" if group == "model" else f" does not fit model={chosen}, as it"
        choose = f"; choose {', or '.join(advice)}" if advice else ""
        return f"{group}={name}{model} needs {MEANINGS.get(need, need)} ({need}){choose}"

    def list_chosen(self) -> list[Option]:
        """Return the choices that were made."""
        return [self.groups.load(*choice) for choice in self.choices.items()]

    def find_choice(self, component: Component) -> tuple[str, str] | None:
        """Return the (group, name) of the choice that puts a class at its place; None where there
        is none.
        """
        others = []
        for option in self.list_chosen():
            named = option.targets()
            if named.get(component.key) == component.target:
                return option.group, option.name
            if component.key in named:
                others.append(option.group)
        for group in others:
            for option in self.groups.list_options(group):
                if option.targets().get(component.key) == component.target:
                    return group, option.name
        return None

    def list_fitting(self, group: str, need: str | None = None) -> list[str]:
        """Return the choices of a group that find all they require elsewhere, and take nothing
        away; with a need, those that provide it as well.
        """
        others, found = self._list_others(group), _name_missing(c.declared for c in self.components)
        fitting = []
        for name, own in self._list_declared(group):
            own_needs = frozenset().union(*(declared.requires for declared in own))
            fits = _name_missing([*others, *own]) <= found - own_needs
            if fits and (need is None or _provide(own, need)):
                fitting.append(name)
        return fitting

    def list_pairs(self, names: Sequence[str], need: str) -> list[str]:
        """Return the choices of groups that provide what is needed where another group's choice
        changes too, as they are typed.
        """
        left = _name_missing(c.declared for c in self.components) - {need}
        return [
            f"{first}={one} with {second}={two}"
            for first, second in permutations(names, 2)
            for one, own in self._list_declared(first)
            if _provide(own, need)
            for two, more in self._list_declared(second)
            if _name_missing([*self._list_others(first, second), *own, *more]) <= left
        ]

    def _list_declared(self, group: str) -> Iterator[tuple[str, list[Declared]]]:
        """Yield a group's choices with what their classes declare; drafts cannot be chosen."""
        for option in self.groups.list_options(group):
            with suppress(UserError):
                targets = option.targets().items()
                yield option.name, [declared_by(name, key, self.scope) for key, name in targets]

    def _list_others(self, *groups: str) -> list[Declared]:
        """Return what those components declare that no choice of these groups replaces."""
        options = [option for group in groups for option in self.groups.list_options(group)]
        places = {place for option in options for place in option.targets()}
        return [
            one.declared
            for one in self.components
            if not any(f"{one.key}.".startswith((f"{p}.", f"{p}[")) for p in places)
        ]


def _provide(declared: Iterable[Declared], need: str) -> bool:
    return any(need in one.provides for one in declared)


def _either(names: Sequence[str]) -> str:
    return " or ".join(([", ".join(names[:-1])] if names[1:] else []) + [names[-1]])
