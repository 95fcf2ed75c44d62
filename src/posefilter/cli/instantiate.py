"""Build objects of settings: the one place where a name in a YAML file becomes code."""

import difflib
import functools
import importlib
import inspect
import pkgutil
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from posefilter.cli.plain import resolve
from posefilter.cli.renamed import rename_argument, rename_class
from posefilter.cli.trust import Scope, check_name, is_component, is_listed, is_plugin, listed_in
from posefilter.errors import UserError, find_reason

Variant = Callable[[Any], Callable[..., Any]]
_LIBRARIES = ("torch.", "lightning.")
_PLAIN = (bool, int, float, str)
# arguments of Lightning's trainer that no file can hold, and what is typed for them
GIVEN = {
    "trainer.callbacks": "type +callbacks.NAME._target_=CLASS",
    "trainer.enable_progress_bar": "console=json shows no bar",
    "trainer.logger": "type logger=NAME",
    "trainer.plugins": "leave it out",
}
_CALLED_LATER = ("optimizer", "scheduler")  # with what only a trainer knows


def instantiate(node: Any, where: str, **given: Any) -> Any:
    """Build what a node of the user's settings describes.

    `_target_` names a class or function, `_partial_: true` leaves it to be called later. Lists and
    dictionaries are built element by element; a dictionary without a `_target_` stays one, an empty
    one (the choice `none`) becomes None.

    Args:
        node: The settings.
        where: The node's place in the configuration, for messages.
        given: Arguments that no file can hold.

    Raises:
        UserError: The key, for a target that may not be built (see `trust`), or arguments that are
            unknown, missing or of the wrong type.
    """
    return _build(node, where, Scope.CONFIG, given)


def instantiate_recipe(node: Any, where: str, variant: Variant | None = None) -> Any:
    """Build what a node of a checkpoint's recipe describes: as `instantiate`, but components
    alone.

    Args:
        node: The settings.
        where: The node's place in the configuration, for messages.
        variant: Given the node's own class; returns the class that is built in its place.
    """
    return _build(node, where, Scope.RECIPE, {}, variant)


def _build(
    node: Any, where: str, scope: Scope, given: Mapping[str, Any], variant: Variant | None = None
) -> Any:
    node = resolve(node)
    if isinstance(node, list):
        return [_build(item, f"{where}[{i}]", scope, {}) for i, item in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    if not node:
        return None
    inner = {str(k): v for k, v in node.items() if k not in ("_target_", "_partial_")}
    target = locate(str(node["_target_"]), where, scope) if "_target_" in node else None
    arguments = {k: _build(v, f"{where}.{k}", scope, {}) for k, v in inner.items()}
    if target is None:
        return arguments
    partial = bool(node.get("_partial_", False))
    if twice := sorted(arguments.keys() & given.keys()):
        raise UserError(tell_given(f"{where}.{twice[0]}"))
    check_arguments(target, arguments, given, where, partial)
    target = variant(target) if variant is not None else target
    made = functools.partial(target, **arguments, **given)
    if partial:
        return made
    try:
        return made()
    except Exception as error:  # a library refuses its arguments as it likes
        refused = type(error).__name__ == "MisconfigurationException"  # Lightning's, not imported
        if isinstance(error, UserError) or not (
            refused or target.__module__.startswith(_LIBRARIES)
        ):
            raise
        reason = " ".join(str(error).split())[:300]
        raise UserError(f"{where}: cannot be built ({reason})") from error


def tell_given(key: str) -> str:
    """Return that an argument is the program's own, and what is typed for it."""
    instead = f"; {GIVEN[key]}" if key in GIVEN else ""
    return f"{key}: is not a setting; the program gives it itself{instead}"


def locate(name: str, where: str, scope: Scope = Scope.CONFIG) -> Callable[..., Any]:
    """Import what a dotted name stands for: a class, or a listed or trusted function, defined in
    the module that it names.

    Raises UserError where it may not, or cannot, be imported. Nothing is imported for a name that
    is not allowed.
    """
    said, new = f"{where}._target_={name}", rename_class(name)
    if new is not None:
        raise UserError(f"{said}: is now {new}")
    check_name(name, where, scope)
    module, _, attribute = name.rpartition(".")
    listed, plugin = is_listed(name, scope), is_plugin(name)
    # a class of one's own changes its name more often than the files that name it
    old = "; was it renamed after the checkpoint?" if plugin and scope is Scope.RECIPE else ""
    try:
        home = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and not f"{module}.".startswith(f"{error.name}."):
            needed = f"needs the package '{error.name}', which is not installed"
            raise UserError(f"{said}: {needed}") from error
        absent = error.name or module
        near = hint(absent, _list_modules(absent))
        raise UserError(f"{said}: there is no module {absent}{near}{old}") from error
    except (Exception, SystemExit) as error:
        if not plugin:
            raise
        reason = f"{type(error).__name__}: {find_reason(error)}"
        raise UserError(f"{said}: {module} could not be imported ({reason})") from error
    own = plugin or is_component(module, scope)
    found = vars(home).get(attribute)
    if found is None or not (listed or (own and _defined_in(found, module, attribute))):
        known = listed_in(module, scope)
        if found is not None and not own:
            raise UserError(
                f"{said}: is not on the list of what may be built of {module} "
                f"({', '.join(known)}); a function of a plug-in of yours may return one"
            )
        real, own_name = (getattr(found, key, "") for key in ("__module__", "__qualname__"))
        if is_plugin(f"{real}.") and getattr(sys.modules.get(real), own_name, None) is found:
            raise UserError(f"{said}: is defined as {real}.{own_name}; name that")
        known += [
            key for key, value in vars(home).items() if own and _defined_in(value, module, key)
        ]
        near = hint(attribute, known)
        raise UserError(f"{said}: there is no '{attribute}' defined in {module}{near}{old}")
    if not (listed or inspect.isclass(found) or (plugin and inspect.isfunction(found))):
        raise UserError(f"{said}: is no class")
    return typing.cast(Callable[..., Any], found)


def _list_modules(module: str) -> list[str]:
    """Return the modules beside one that is not there."""
    package = module.rpartition(".")[0]
    folders = getattr(sys.modules.get(package), "__path__", [])
    return [f"{package}.{found.name}" for found in pkgutil.iter_modules(folders)]


def _defined_in(thing: Any, module: str, name: str) -> bool:
    """Tell whether a module defines a thing by this name, rather than importing it."""
    return (
        getattr(thing, "__module__", None) == module
        and getattr(thing, "__qualname__", None) == name
    )


def hint(name: str, known: Sequence[str] | Any) -> str:
    """Return `; did you mean 'x'?` for the nearest of the known names, "" where none is near."""
    near = difflib.get_close_matches(name, [str(k) for k in known], n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else ""


def accepted(target: Callable[..., Any]) -> tuple[dict[str, inspect.Parameter], bool]:
    """Return the named parameters of a callable, and whether it takes others too.

    A class that hands `**base` on to its parent takes the parent's parameters.
    """
    known: dict[str, inspect.Parameter] = {}
    kinds = target.__mro__[:-1] if inspect.isclass(target) else ()  # less `object`
    calls = [vars(kind)["__init__"] for kind in kinds if "__init__" in vars(kind)]
    for call in calls or [target]:
        parameters = inspect.signature(call).parameters.values()
        for parameter in parameters:
            if (
                parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
                and parameter.name != "self"
            ):
                known.setdefault(parameter.name, parameter)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return known, False
    return known, True


def check_arguments(
    target: Callable[..., Any],
    arguments: Mapping[str, Any],
    given: Mapping[str, Any],
    where: str,
    partial: bool,
) -> None:
    """Raise UserError unless a callable takes these arguments."""
    known, others = accepted(target)
    for name in arguments:  # before any value: a misspelt name often leaves a wrong value elsewhere
        if name not in known and not others:
            label = getattr(target, "__name__", str(target))
            kinds = (
                target.__mro__ if inspect.isclass(target) else (target,)
            )  # a parent's argument too
            places = (f"{kind.__module__}.{getattr(kind, '__name__', kind)}" for kind in kinds)
            if new := next(filter(None, (rename_argument(one, name) for one in places)), None):
                raise UserError(f"{where}.{name}: is now {new}")
            raise UserError(f"{where}.{name}: {label} takes no such setting{hint(name, known)}")
    for name, value in arguments.items():
        if name in known and not fits(value, known[name].annotation):
            wanted = describe(known[name].annotation)
            if isinstance(value, Mapping):
                raise UserError(f"{where}.{name}: has no _target_, and must be {wanted}")
            raise UserError(f"{where}.{name}={value!r}: must be {wanted}")
    if partial:
        return
    call, later = "", where.rpartition(".")[2] in _CALLED_LATER
    if later:
        call = "; it is called later: add `_partial_: true`"
    elif inspect.isfunction(target):
        call = "; where it is to be called later, add `_partial_: true`"
    if not (later or target.__module__.startswith("posefilter.")):
        # others' parents may be given what the child works out
        own = inspect.signature(target).parameters
        known = {name: parameter for name, parameter in known.items() if name in own}
    for name, parameter in known.items():
        if parameter.default is parameter.empty and name not in arguments and name not in given:
            raise UserError(f"{where}.{name}: is missing, and has no default{call}")


def fits(value: Any, wanted: Any) -> bool:
    """Tell whether a value may be what an annotation asks for, as far as it is plain."""
    if wanted in (inspect.Parameter.empty, Any) or isinstance(wanted, str | typing.TypeVar):
        return True
    origin, inner = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        return any(fits(value, option) for option in inner)
    if origin is Literal:
        return value in inner
    if wanted is None or wanted is type(None):
        return value is None
    if wanted in (int, float):
        return isinstance(value, int | wanted) and not isinstance(value, bool)
    if wanted in (bool, str, Path):
        return isinstance(value, str if wanted is Path else wanted)
    if origin is tuple and inner and inner[-1] is not Ellipsis:
        return (
            isinstance(value, list | tuple)
            and len(value) == len(inner)
            and all(map(fits, value, inner))
        )
    if isinstance(origin, type) and issubclass(origin, Sequence):
        element = inner[0] if inner else Any  # `List` of typing has no parameter
        return isinstance(value, list | tuple) and all(fits(item, element) for item in value)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping)
    if isinstance(value, list | tuple | Mapping):  # no component: that is built from a _target_
        kind = origin or wanted
        return inspect.isclass(kind) and not is_protocol(kind) and isinstance(value, kind)
    return not isinstance(value, _PLAIN) and (value is not None or wanted is object)


def is_protocol(kind: type) -> bool:
    """Tell whether a class is a protocol of ours, rather than one of the abstract containers."""
    return bool(getattr(kind, "_is_protocol", False)) and kind.__module__ != "collections.abc"


def describe(wanted: Any) -> str:
    """Return an annotation in words."""
    origin, inner = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        return " or ".join(map(describe, inner))
    if origin is Literal:
        return "one of " + ", ".join(map(str, inner))
    words = {
        None: "null",
        type(None): "null",
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "text",
        Path: "a path",
        Callable: "what a _target_ builds, to be called",
        Sequence: "a list",
        Mapping: "a mapping such as '{key: value}'",
    }
    if (kind := origin or wanted) in words:
        return words[kind]
    if inner:
        return str(wanted).replace("typing.", "")
    return f"a {getattr(kind, '__name__', kind)}"
