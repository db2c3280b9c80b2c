"""Small changes of a program's source (*mutants*), one at a time, that its tests should notice.

A mutant is an edit of the syntax tree. Not changed: annotations, decorators, docstrings, imports, the text
of messages, and what only a type checker reads.
"""

from __future__ import annotations

import ast
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

OTHER_FLOAT = 1.1  # a constant is changed by a tenth: a small error, as a misread number would be

BINARY: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
CALLED = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "sin": "cos",
    "cos": "sin",
    "floor": "ceil",
    "ceil": "floor",
    "any": "all",
    "all": "any",
}
LEFT_OUT = {"abs", "fabs", "sqrt", "float", "sorted"}  # calls that are replaced by their argument
TYPES = {"tuple", "list", "int", "float", "bool", "str", "dict", "type", "ufunc", "ndarray"}
EXCHANGED = {"atan2", "arctan2", "copysign"}  # calls whose two arguments are exchanged

Edit = tuple[str, Callable[[], ast.AST]]  # its kind, and what takes the node's place


class Mutant(NamedTuple):
    """One change: the ``edit``-th of the ``node``-th place of a file."""

    file: str  # from the root of the project
    node: int
    edit: int
    line: int
    function: (
        str  # qualified name of the function, or of the class; empty at the level of the module
    )
    inside: bool  # of a function
    compiled: bool  # the function is a law or a driver, or the change is at the level of the module
    kind: str
    before: str
    after: str

    @property
    def key(self) -> str:
        """What names it in files."""
        return f"{self.file}:{self.line}:{self.node}.{self.edit}"


class Place(NamedTuple):
    """A node that may be changed, and where it hangs."""

    parent: ast.AST
    field: str
    index: int | None  # in a list of the parent
    node: ast.AST
    function: str
    inside: bool
    compiled: bool

    def put(self, node: ast.AST) -> None:
        """Put another node in its place."""
        ast.copy_location(node, self.node)
        if self.index is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.index] = node


def places(tree: ast.Module, compiling: frozenset[str]) -> list[Place]:
    """All nodes of a file in a fixed order, without those that are never changed."""
    found: list[Place] = []

    def walk(node: ast.AST, name: str, inside: bool, compiled: bool) -> None:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = f"{name}.{node.name}" if name else node.name
            inside = not isinstance(node, ast.ClassDef)
            if inside:
                compiled = bool({_name(one) for one in node.decorator_list} & compiling)
        for field, value in ast.iter_fields(node):
            if field in (
                "annotation",
                "returns",
                "decorator_list",
                "bases",
                "exc",
                "cause",
                "type",
            ):
                continue
            if isinstance(value, ast.AST):
                step(Place(node, field, None, value, name, inside, compiled))
            elif isinstance(value, list):
                for i, one in enumerate(value):
                    if isinstance(one, ast.AST):
                        step(Place(node, field, i, one, name, inside, compiled))

    def step(place: Place) -> None:
        node = place.node
        if _is_docstring(node) or isinstance(node, ast.Import | ast.ImportFrom | ast.JoinedStr):
            return
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.Assign) and "__all__" in ast.unparse(node.targets[0]):
            return
        found.append(place)
        walk(node, place.function, place.inside, place.compiled)

    walk(tree, "", False, True)
    return found


def _name(node: ast.AST) -> str:
    if isinstance(node, ast.Call):
        node = node.func
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def _is_docstring(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _has_text(node: ast.AST) -> bool:
    return any(
        isinstance(one, ast.JoinedStr)
        or (isinstance(one, ast.Constant) and isinstance(one.value, str))
        for one in ast.walk(node)
    )


def _is_union(node: ast.BinOp) -> bool:
    """Whether it is a union of types, which Python itself would refuse to change."""
    leaves = [
        one
        for side in (node.left, node.right)
        for one in ([side] if not isinstance(side, ast.BinOp) else [side.left, side.right])
    ]
    names = [_name(one) for one in leaves]
    return isinstance(node.op, ast.BitOr) and any(
        name in TYPES or (name[:1].isupper() and not name.isupper()) for name in names
    )


def edits(place: Place) -> list[Edit]:
    """All changes of a node."""
    return list(_edits(place))


def _edits(place: Place) -> Iterator[Edit]:
    node = place.node
    match node:
        case ast.BinOp() if type(node.op) in BINARY and not _has_text(node) and not _is_union(node):
            other = BINARY[type(node.op)]
            yield "operator", lambda: ast.BinOp(node.left, other(), node.right)
        case ast.AugAssign() if type(node.op) in BINARY:
            swapped = BINARY[type(node.op)]
            yield "operator", lambda: ast.AugAssign(node.target, swapped(), node.value)
            yield "statement", ast.Pass
        case ast.Compare(ops=[op]):
            for one in COMPARED[type(op)]:
                yield (
                    "comparison",
                    lambda one=one: ast.Compare(node.left, [one()], node.comparators),
                )
        case ast.BoolOp():
            junction = ast.Or if isinstance(node.op, ast.And) else ast.And
            yield "and/or", lambda: ast.BoolOp(junction(), node.values)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield "sign", lambda: node.operand
        case ast.Constant(value=bool()):
            yield "constant", lambda: ast.Constant(not node.value)
        case ast.Constant(value=int()):
            yield "constant", lambda: ast.Constant(node.value + 1)
        case ast.Constant(value=float()):
            changed = OTHER_FLOAT * node.value or 1.0
            yield "constant", lambda: ast.Constant(changed)
        case ast.Call(args=[_, *_], keywords=[]):
            yield from _call_edits(node)
        case ast.If() | ast.While():
            against = ast.UnaryOp(ast.Not(), node.test)
            yield "condition", lambda: type(node)(against, node.body, node.orelse)
        case ast.IfExp():
            yield "condition", lambda: ast.IfExp(node.test, node.orelse, node.body)
        case ast.Expr(value=ast.Call()) | ast.Raise():
            yield "statement", ast.Pass
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield "statement", ast.Pass
        case ast.Continue():
            yield "statement", ast.Break
        case ast.Break():
            yield "statement", ast.Continue


def _call_edits(node: ast.Call) -> Iterator[Edit]:
    name = _name(node.func)
    if name in CALLED:
        new = CALLED[name]
        function: ast.expr = (
            ast.Attribute(node.func.value, new, ast.Load())
            if isinstance(node.func, ast.Attribute)
            else ast.Name(new, ast.Load())
        )
        yield "call", lambda: ast.Call(function, node.args, [])
    elif name in LEFT_OUT and len(node.args) == 1:
        yield "call", lambda: node.args[0]
    elif name in EXCHANGED and len(node.args) == 2:
        yield "call", lambda: ast.Call(node.func, node.args[::-1], [])


def mutants_of(root: Path, file: str, compiling: frozenset[str]) -> list[Mutant]:
    """All mutants of a file, in a fixed order."""
    tree = ast.parse((root / file).read_text(encoding="utf-8"))
    found = []
    for number, place in enumerate(places(tree, compiling)):
        for edit, (kind, make) in enumerate(edits(place)):
            found.append(
                Mutant(
                    file=file,
                    node=number,
                    edit=edit,
                    line=getattr(place.node, "lineno", 0),
                    function=place.function,
                    inside=place.inside,
                    compiled=place.compiled,
                    kind=kind,
                    before=_short(place.node),
                    after=_short(make()),
                )
            )
    return found


def _short(node: ast.AST) -> str:
    text = ast.unparse(ast.fix_missing_locations(node))
    return text.splitlines()[0][:100] if text else ""


def source_of(root: Path, mutant: Mutant, compiling: frozenset[str]) -> str:
    """The file's source with the change in it, without comments."""
    tree = ast.parse((root / mutant.file).read_text(encoding="utf-8"))
    place = places(tree, compiling)[mutant.node]
    place.put(edits(place)[mutant.edit][1]())
    return ast.unparse(ast.fix_missing_locations(tree))


def sample(
    pools: dict[str, list[Mutant]], lines: dict[str, int], count: int, seed: int
) -> list[Mutant]:
    """Mutants drawn at random, from every file in proportion to its lines (largest remainders).

    The order is random, too, so that a run that is stopped has seen all files.
    """
    rng = random.Random(seed)
    total = sum(lines[file] for file in pools)
    exact = {file: count * lines[file] / total for file in sorted(pools)}
    shares = {file: min(int(share), len(pools[file])) for file, share in exact.items()}
    by_rest = sorted(exact, key=lambda file: (shares[file] - exact[file], file))
    for file in by_rest[: max(count - sum(shares.values()), 0)]:
        shares[file] = min(shares[file] + 1, len(pools[file]))
    drawn = [one for file in shares for one in rng.sample(pools[file], shares[file])]
    rng.shuffle(drawn)
    return drawn
