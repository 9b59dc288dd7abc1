# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The changes that make mutants of a module: one wrong thing each, as somebody might have typed it."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_SIGNS: dict[type[ast.operator], type[ast.operator]] = {ast.Add: ast.Sub, ast.Sub: ast.Add}
_CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}
_SAYS = ("counters", "failure", "reason", "text")
"""Names of what only a person reads: events that are counted, and texts."""


@dataclass(frozen=True)
class Change:
    """What is done to the tree by `apply`, at a line, in words."""

    line: int
    how: str
    apply: Callable[[], None]


def mutations(tree: ast.Module) -> Iterator[Change]:
    """Every change of the functions and methods of a module, always in the same order.

    Left out is what only a person reads, and what checks itself (`assert`).
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield from _in_body(node.body)


def _in_body(body: list[ast.stmt]) -> Iterator[Change]:
    for i, statement in enumerate(body):
        if isinstance(statement, ast.FunctionDef | ast.Assert) or _says(statement):
            continue
        if isinstance(statement, ast.If) and all(map(_says, statement.body + statement.orelse)):
            continue
        if _can_go(statement):
            yield _removed(body, i)
        for name in ("body", "orelse", "finalbody"):
            yield from _in_body(getattr(statement, name, []))
        for handler in getattr(statement, "handlers", []):
            yield from _in_body(handler.body)
        for field, value in ast.iter_fields(statement):
            if field not in ("body", "orelse", "finalbody", "handlers", "annotation"):
                for found in value if isinstance(value, list) else [value]:
                    if isinstance(found, ast.AST):
                        yield from _in_expression(found)
        if isinstance(statement, ast.If | ast.While):
            yield from _negated(statement)
        if isinstance(statement, ast.AugAssign) and type(statement.op) in _SIGNS:
            yield _other(statement, statement.op, _SIGNS)


def _says(statement: ast.stmt) -> bool:
    """True if it only counts an event or sets a text."""
    targets = getattr(statement, "targets", [getattr(statement, "target", None)])
    names = [getattr(n, "attr", getattr(n, "id", "")) for t in targets if t for n in ast.walk(t)]
    return isinstance(statement, ast.Assign | ast.AugAssign) and bool(set(names) & set(_SAYS))


def _can_go(statement: ast.stmt) -> bool:
    """True if the module still compiles without it, and something is different."""
    if isinstance(statement, ast.Expr):
        return "super" not in ast.unparse(statement) and not isinstance(
            statement.value,
            ast.Constant,  # a docstring
        )
    if isinstance(statement, ast.Assign | ast.AugAssign):
        targets = getattr(statement, "targets", None) or [statement.target]  # type: ignore[union-attr]
        return any(isinstance(target, ast.Attribute | ast.Subscript) for target in targets)
    return isinstance(statement, ast.Raise | ast.Return | ast.Delete | ast.Continue | ast.Break)


def _removed(body: list[ast.stmt], i: int) -> Change:
    def apply() -> None:
        body[i] = ast.copy_location(ast.Pass(), body[i])

    return Change(body[i].lineno, "removed", apply)


def _negated(holder: ast.If | ast.While | ast.IfExp) -> Iterator[Change]:
    """A condition is negated, unless that is what becomes of its only comparison."""
    test = holder.test
    if isinstance(test, ast.Compare) and len(test.ops) == 1 and not _boundary(test.ops[0]):
        return

    def apply() -> None:
        negated = ast.UnaryOp(ast.Not(), holder.test)
        holder.test = ast.copy_location(negated, holder.test)

    yield Change(test.lineno, f"not ({ast.unparse(test)})", apply)


def _boundary(operator: ast.cmpop) -> bool:
    return isinstance(operator, ast.Lt | ast.LtE | ast.Gt | ast.GtE)


def _other(holder: Any, operator: ast.AST, table: dict[Any, Any], place: int = -1) -> Change:
    """Another operator in `holder.op`, or in `holder.ops[place]`."""
    kind = table[type(operator)]

    def apply() -> None:
        if place < 0:
            holder.op = kind()
        else:
            holder.ops[place] = kind()

    return Change(holder.lineno, f"{type(operator).__name__} -> {kind.__name__}", apply)


def _in_expression(top: ast.AST) -> Iterator[Change]:
    if isinstance(top, ast.JoinedStr) or (isinstance(top, ast.keyword) and top.arg == "strict"):
        return  # a text; what checks itself
    if isinstance(top, ast.BoolOp):
        yield _other(top, top.op, {ast.And: ast.Or, ast.Or: ast.And})
    elif isinstance(top, ast.Compare):
        for i, operator in enumerate(top.ops):
            yield _other(top, operator, _COMPARISONS, i)
    elif isinstance(top, ast.BinOp) and type(top.op) in _SIGNS:
        yield _other(top, top.op, _SIGNS)
    elif isinstance(top, ast.IfExp):
        yield from _negated(top)
    elif isinstance(top, ast.UnaryOp) and isinstance(top.op, ast.Not):
        yield _without_not(top)
    elif isinstance(top, ast.Call) and isinstance(top.func, ast.Name) and top.func.id in _CALLS:
        yield _renamed(top.func)
    elif isinstance(top, ast.Constant) and type(top.value) in (bool, int):
        yield _one_off(top)
    for child in ast.iter_child_nodes(top):
        yield from _in_expression(child)


def _without_not(node: ast.UnaryOp) -> Change:
    def apply() -> None:
        node.operand = ast.copy_location(ast.UnaryOp(ast.Not(), node.operand), node.operand)

    return Change(node.lineno, f"not not {ast.unparse(node.operand)}", apply)


def _renamed(name: ast.Name) -> Change:
    there, instead = name.id, _CALLS[name.id]

    def apply() -> None:
        name.id = instead

    return Change(name.lineno, f"{there} -> {instead}", apply)


def _one_off(node: ast.Constant) -> Change:
    there: Any = node.value
    instead = (not there) if isinstance(there, bool) else there + 1

    def apply() -> None:
        node.value = instead

    return Change(node.lineno, f"{there} -> {instead}", apply)
