"""Changed places of a module: what `mutants.py` draws from."""

import ast
import copy
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

_LEAST = 1e-5  # a smaller constant guards a division

_SWAPPED: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
    ast.And: (ast.Or,), ast.Or: (ast.And,),
}  # fmt: skip
_PAIRS = (
    ("min", "max"), ("amin", "amax"), ("minimum", "maximum"), ("argmin", "argmax"),
    ("any", "all"), ("sin", "cos"), ("floor", "ceil"), ("sum", "mean"), ("zeros", "ones"),
    ("zeros_like", "ones_like"), ("isfinite", "isnan"),
)  # fmt: skip
_OPPOSITE = dict(_PAIRS) | {b: a for a, b in _PAIRS}


class Mutant(NamedTuple):
    """One changed place."""

    file: Path
    index: int  # of the node, in the order of ast.walk
    new: ast.AST  # what takes its place
    lines: frozenset[int]  # that run it; none: it runs when the module is imported
    line: int
    before: str
    after: str


def list_mutants(file: Path) -> list[Mutant]:
    """Return every mutant of a file."""
    tree = ast.parse(file.read_text())
    index = {id(node): number for number, node in enumerate(ast.walk(tree))}
    found = []
    for node, path in walk(tree, ()):
        for new in vary(node, path):
            before, after = show(node, new, path)
            if before != after:
                line = getattr(node, "lineno", 0)
                lines = find_lines(node, path)
                found.append(Mutant(file, index[id(node)], new, lines, line, before, after))
    return found


def walk(node: ast.AST, path: tuple[ast.AST, ...]) -> Iterator[tuple[ast.AST, tuple[ast.AST, ...]]]:
    """Return the nodes that may change, each with those around it, the outermost first."""
    yield node, path
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_params", "bases", "msg"):
            continue
        for child in value if isinstance(value, list) else [value]:
            left = isinstance(child, ast.Raise | ast.JoinedStr) or _is_for_speed(child)
            if isinstance(child, ast.AST) and not left and not _is_unseen(child):
                yield from walk(child, (*path, node))


def vary(node: ast.AST, path: tuple[ast.AST, ...]) -> Iterator[ast.AST]:
    """Return what may take a node's place."""
    around = path[-1] if path else None
    match node:
        case ast.Compare(ops=ops):
            for at, op in enumerate(ops):
                for other in _SWAPPED[type(op)]:
                    yield with_change(
                        node, lambda new, at=at, o=other: new.ops.__setitem__(at, o())
                    )
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op):
            for other in _SWAPPED.get(type(op), ()):
                yield with_change(node, lambda new, o=other: setattr(new, "op", o()))
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)) if value == 0 or _LEAST <= abs(value) < math.inf:
            yield ast.Constant(2 * value if value else 1.0)
        case ast.Return(value=ast.expr() as value) if _is_number(path):
            yield ast.Return(ast.UnaryOp(ast.USub(), value))
        case ast.Attribute(attr=name) if name in _OPPOSITE:
            yield with_change(node, lambda new: setattr(new, "attr", _OPPOSITE[name]))
        case ast.Name(id=name) if name in _OPPOSITE and isinstance(around, ast.Call):
            if around.func is node:
                yield ast.Name(_OPPOSITE[name], ast.Load())
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            negated = ast.UnaryOp(ast.Not(), test)
            yield with_change(node, lambda new: setattr(new, "test", negated))
        case ast.Expr(value=ast.Call()):
            yield ast.Pass()
    if isinstance(node, ast.Call):
        for at, keyword in enumerate(node.keywords):
            if keyword.arg is not None and not _is_unseen(keyword):
                yield with_change(node, lambda new, at=at: new.keywords.pop(at))
            if keyword.arg == "dim" and (other := _other_dim(keyword.value)) is not None:
                yield with_change(node, lambda new, at=at, o=other: _set(new.keywords[at], o))
            if keyword.arg in ("min", "max"):
                other = _OPPOSITE[keyword.arg]
                yield with_change(node, lambda new, at=at, o=other: _name(new.keywords[at], o))


def _is_unseen(node: object) -> bool:
    """Tell whether a keyword is one that no test on a CPU could notice, or a text for readers."""
    if not isinstance(node, ast.keyword):
        return False
    text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    words = text and " " in node.value.value  # type: ignore[attr-defined]
    return words or node.arg in ("strict", "device", "repr")


def _is_for_speed(node: object) -> bool:
    """Tell whether a node decides how much is held at once: `chunk`, and `max(1, chunk // n)`."""
    match node:
        case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
            return name.lower().endswith("chunk")
        case ast.Call(func=ast.Name(id="max"), args=[ast.Constant(value=1), ast.BinOp() as size]):
            names = [n.id for n in ast.walk(size) if isinstance(n, ast.Name)]
            names += [n.attr for n in ast.walk(size) if isinstance(n, ast.Attribute)]
            return any(name.lower().endswith("chunk") for name in names)
        case ast.BinOp(op=ast.LShift(), left=ast.Constant(value=1), right=ast.Constant()):
            return True
    return False


def _is_number(path: tuple[ast.AST, ...]) -> bool:
    """Tell whether the function around returns a tensor or a number, by its annotation."""
    functions = [node for node in path if isinstance(node, ast.FunctionDef)]
    return bool(functions) and ast.unparse(functions[-1].returns or ast.Constant(0)) in (
        "Tensor", "float", "int", "torch.Tensor", "np.ndarray", "Array",
    )  # fmt: skip


def _other_dim(value: ast.AST) -> ast.expr | None:
    """Return the dimension before or after a constant one."""
    with suppress(ValueError, TypeError):
        dim = ast.literal_eval(value)  # type: ignore[arg-type]
        if isinstance(dim, int):
            return ast.Constant(dim - 1 if dim < 0 else dim + 1)
    return None


def _set(keyword: ast.keyword, value: ast.expr) -> None:
    keyword.value = value


def _name(keyword: ast.keyword, name: str) -> None:
    keyword.arg = name


def with_change(node: ast.AST, change: Callable[[Any], object]) -> ast.AST:
    """Return a changed copy of a node."""
    new = copy.deepcopy(node)
    change(new)
    return new


def show(node: ast.AST, new: ast.AST, path: tuple[ast.AST, ...]) -> tuple[str, str]:
    """Return how the smallest part that can be read looks before and after."""
    outer = node
    for around in reversed(path):
        small = isinstance(outer, ast.Constant | ast.Name | ast.UnaryOp | ast.Slice | ast.Tuple)
        if not small or not isinstance(around, ast.expr | ast.keyword | ast.stmt):
            break
        if isinstance(around, ast.FunctionDef | ast.ClassDef | ast.If | ast.For | ast.While):
            break
        outer = around
    if isinstance(node, ast.If | ast.While):
        return ast.unparse(node.test), ast.unparse(new.test)  # type: ignore[attr-defined]
    changed = graft(copy.deepcopy(outer), list(ast.walk(outer)).index(node), new)
    return ast.unparse(outer), ast.unparse(changed)


def graft(tree: ast.AST, index: int, new: ast.AST) -> ast.AST:
    """Return a tree, changed in place, with another node at an index of ast.walk."""
    nodes = list(ast.walk(tree))
    old = nodes[index]
    if old is tree:
        return new
    for around in nodes:
        for field, value in ast.iter_fields(around):
            if value is old:
                setattr(around, field, new)
            elif isinstance(value, list):
                value[:] = [new if one is old else one for one in value]
    return tree


def find_lines(node: ast.AST, path: tuple[ast.AST, ...]) -> frozenset[int]:
    """Return the lines of which one runs where a node does; none for what an import runs."""
    whole = (*path, node)
    functions = [n for n in whole if isinstance(n, ast.FunctionDef | ast.Lambda)]
    if not functions or any(isinstance(n, ast.arguments) for n in whole):
        return frozenset()
    statement = [n for n in whole if isinstance(n, ast.stmt)][-1]
    compound = isinstance(statement, ast.If | ast.For | ast.While | ast.With | ast.Try)
    inner = whole[min(whole.index(statement) + 1, len(whole) - 1)]
    if inner is statement and isinstance(statement, ast.If | ast.While):
        inner = statement.test
    part: Any = inner if compound and hasattr(inner, "lineno") else statement
    return frozenset(range(part.lineno, part.end_lineno + 1))
