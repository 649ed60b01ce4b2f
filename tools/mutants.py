"""Mutants of a Python source: each changes one operator, number, condition or statement."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import NamedTuple

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
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
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
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
#: Functions and methods that are swapped; ``abs`` is dropped.
SWAPPED = {"min": "max", "any": "all", "ceil": "floor"}
SWAPPED |= {swapped: name for name, swapped in SWAPPED.items()}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


class Mutant(NamedTuple):
    """A change at one place of a source file."""

    function: str  #: qualified name of the function or class around it; "" at module level
    line: int
    original: str
    mutated: str
    start: int  #: byte offsets of the original in the source
    end: int
    #: Lines that a test must run to detect the change: those of the change itself, or of the body
    #: of the function whose default argument changes.
    lines: range
    #: Names of the constant or class attribute that changes outside a function.
    names: tuple[str, ...] = ()

    def apply(self, source: bytes) -> bytes:
        """Return the source with the change."""
        return source[: self.start] + self.mutated.encode() + source[self.end :]


class _Scope(NamedTuple):
    """Context of a node."""

    name: str = ""
    in_function: bool = False
    names: tuple[str, ...] = ()
    lines: range | None = None  # instead of those of the node
    is_condition: bool = False
    is_loop: bool = False  # a condition of ``while``: True would never end


def mutants(source: bytes) -> list[Mutant]:
    """Return all mutants of a source, in the order of their places.

    Annotations, docstrings, strings, ``__repr__``, decorators, error messages and the ``strict`` of
    ``zip`` are not changed.
    """
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node, scope in _visit(ast.parse(source), _Scope()):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        lines = scope.lines or range(node.lineno, (node.end_lineno or node.lineno) + 1)
        names = () if scope.in_function or scope.lines else scope.names
        for text in [*_mutations(node), *_conditions(node, scope)]:
            mutated = text if isinstance(node, ast.stmt) else f"({text})"
            found.append(
                Mutant(
                    scope.name, node.lineno, ast.unparse(node), mutated, start, end, lines, names
                )
            )
    return sorted(found, key=lambda mutant: (mutant.start, mutant.end, mutant.mutated))


def _visit(node: ast.AST, scope: _Scope) -> Iterator[tuple[ast.expr | ast.stmt, _Scope]]:
    """Yield the expressions and statements that may be changed."""
    if isinstance(node, (*FUNCTIONS, ast.Lambda)):
        yield from _visit_function(node, scope)
        return
    if isinstance(node, ast.ClassDef):
        inner = _Scope(_joined(scope.name, node.name))
        for statement in node.body:
            yield from _visit(statement, inner)
        return
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        named = {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
        if "__all__" in named:
            return
        scope = scope._replace(names=tuple(sorted(named)))
    if isinstance(node, ast.expr | ast.stmt):
        yield node, scope
    conditions = [getattr(node, "test", None), *getattr(node, "ifs", [])]
    for child in _children(node):
        is_condition = any(child is condition for condition in conditions)
        is_loop = is_condition and isinstance(node, ast.While)
        yield from _visit(child, scope._replace(is_condition=is_condition, is_loop=is_loop))


def _visit_function(
    node: ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda, scope: _Scope
) -> Iterator[tuple[ast.expr | ast.stmt, _Scope]]:
    name = "<lambda>" if isinstance(node, ast.Lambda) else node.name
    if name in ("__repr__", "__str__"):
        return
    body = [node.body] if isinstance(node, ast.Lambda) else node.body
    inner = _Scope(_joined(scope.name, name), in_function=True)
    lines = range(body[0].lineno, (body[-1].end_lineno or body[-1].lineno) + 1)
    for default in [*node.args.defaults, *node.args.kw_defaults]:
        if default is not None:
            yield from _visit(default, inner._replace(lines=lines))
    for part in body:
        yield from _visit(part, inner)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the children of a node that a mutant may change."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Global):
        return
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    for name, value in ast.iter_fields(node):
        if name == "annotation":
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not (
                isinstance(child, ast.keyword) and child.arg == "strict"
            ):
                yield child


def _mutations(node: ast.expr | ast.stmt) -> Iterator[str]:
    """Yield the texts that replace a node, one for each mutant."""
    match node:
        case ast.Compare(left, ops, right):
            for i, op in enumerate(ops):
                for other in COMPARISONS[type(op)]:
                    yield ast.unparse(ast.Compare(left, [*ops[:i], other(), *ops[i + 1 :]], right))
        case ast.BoolOp(op, values):
            swapped = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield ast.unparse(ast.BoolOp(swapped, values))
            for i in range(len(values)):
                rest = [*values[:i], *values[i + 1 :]]
                yield ast.unparse(ast.BoolOp(op, rest) if len(rest) > 1 else rest[0])
        case ast.BinOp(left, op, right) if type(op) in OPERATORS:
            yield ast.unparse(ast.BinOp(left, OPERATORS[type(op)](), right))
            if isinstance(op, ast.BitAnd | ast.BitOr):
                yield ast.unparse(left)
                yield ast.unparse(right)
        case ast.UnaryOp(_, operand):
            yield ast.unparse(operand)
        case ast.Constant(value):
            yield from _other_constants(value)
        case ast.Call(ast.Name("abs") | ast.Attribute(_, "abs"), [argument]):
            yield ast.unparse(argument)
        case ast.Call(ast.Name(name), arguments, keywords) if name in SWAPPED:
            yield ast.unparse(ast.Call(ast.Name(SWAPPED[name]), arguments, keywords))
        case ast.Attribute(value, name) if name in SWAPPED:
            yield ast.unparse(ast.Attribute(value, SWAPPED[name]))
        case ast.Return(value) if value is not None and ast.unparse(value) not in ("None", "False"):
            yield "return None"
        case ast.AugAssign(target, op, value):
            if type(op) in OPERATORS:
                yield ast.unparse(ast.AugAssign(target, OPERATORS[type(op)](), value))
            yield "pass"
        case ast.Assign(targets):
            if all(isinstance(target, ast.Attribute | ast.Subscript) for target in targets):
                yield "pass"
        case ast.Expr(ast.Call()) | ast.Raise() | ast.Delete() | ast.Continue() | ast.Break():
            yield "pass"
        case _:
            pass


def _other_constants(value: object) -> Iterator[str]:
    if isinstance(value, bool):
        yield str(not value)
    elif isinstance(value, int):
        yield from (str(other) for other in ((value + 1, value - 1) if value else (1,)))
    elif isinstance(value, float):
        yield from (str(other) for other in ((value * 10, value / 10) if value else (1.0,)))


def _conditions(node: ast.AST, scope: _Scope) -> Iterator[str]:
    """Yield the values that a condition may be replaced by."""
    if scope.is_condition and not isinstance(node, ast.Constant):
        yield "False"
        if not scope.is_loop:
            yield "True"


def _joined(scope: str, name: str) -> str:
    return f"{scope}.{name}" if scope else name
