"""Scalar expressions with every name resolved and every type known.

A tree is made by `patterns.binding.scalars` and evaluated in two ways that must agree:
over columns by `patterns.binding.columns`, over single values by `patterns.binding.guards`.
Times are microseconds since 1970 UTC and durations microseconds, both whole
numbers. All operators but the ones of `LENIENT` are strict: NULL in, NULL out.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal

from patterns.scene.geometry import Direction
from patterns.scene.ground import GroundValue

Value = bool | int | float | str | None
Which = Literal["first", "last"]
AggregateHow = Literal["rows", "values", "sum", "min", "max"]

LENIENT = frozenset({"and", "or", "is_null", "case", "coalesce"})
COMPARISONS = frozenset({"=", "<>", "<", "<=", ">", ">="})


class Kind(Enum):
    """The types of the language."""

    BOOL = "boolean"
    INT = "integer"
    FLOAT = "number"
    STRING = "string"
    TIME = "time"
    DURATION = "duration"
    NULL = "NULL"


@dataclass(frozen=True, slots=True)
class Const:
    """A literal or a parameter."""

    value: Value
    kind: Kind


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the row at hand."""

    name: str
    kind: Kind


@dataclass(frozen=True, slots=True)
class Shift:
    """The operand's value `rows` rows earlier in the partition, matched or not: PREV; negative: later, NEXT."""

    operand: "Expr"
    rows: int

    @property
    def kind(self) -> Kind:
        """The operand's type."""
        return self.operand.kind


@dataclass(frozen=True, slots=True)
class Reference:
    """The operand's value at the first or last row mapped to any of the variables; None: to any variable.

    `offset`: how many of these rows further on from the first, or back from the last.
    """

    variables: tuple[str, ...] | None
    which: Which
    operand: "Expr"
    offset: int = 0

    @property
    def kind(self) -> Kind:
        """The operand's type."""
        return self.operand.kind


@dataclass(frozen=True, slots=True)
class Aggregate:
    """What the rows mapped to any of the variables (None: to any variable) come to.

    `how`: how many `rows`; how many `values` of the operand that are not NULL; their `sum`, `min` or `max`.
    """

    variables: tuple[str, ...] | None
    how: AggregateHow
    operand: "Expr | None"
    kind: Kind


@dataclass(frozen=True, slots=True)
class Classifier:
    """The name of the variable that the row is mapped to."""

    kind: Kind = Kind.STRING


@dataclass(frozen=True, slots=True)
class MatchNumber:
    """The number of the match in its partition, from 1."""

    kind: Kind = Kind.INT


@dataclass(frozen=True, slots=True)
class Call:
    """An operator or function over its operands."""

    op: str
    operands: tuple["Expr", ...]
    kind: Kind


@dataclass(frozen=True, slots=True)
class InZone:
    """Whether a point lies in the zone; false for another source than the zone's.

    Operands: the source, then x and y in pixels.
    """

    zone: str
    operands: tuple["Expr", ...]
    kind: Kind = Kind.BOOL


@dataclass(frozen=True, slots=True)
class Crosses:
    """Whether a step crosses the line; false for another source than the line's.

    Operands: the source, then x0, y0, x1 and y1 in pixels.
    """

    line: str
    direction: Direction
    operands: tuple["Expr", ...]
    kind: Kind = Kind.BOOL


@dataclass(frozen=True, slots=True)
class OnGround:
    """Where a point lies on the ground (m to the east or north), or how fast it moves there (m/s).

    Operands: the source, then x and y in pixels, and for the speed vx and vy in pixels a second.
    """

    what: GroundValue
    operands: tuple["Expr", ...]
    kind: Kind = Kind.FLOAT


@dataclass(frozen=True, slots=True)
class OneOf:
    """Whether the operand, the only one, is among the values of a list, none of which is NULL."""

    values: frozenset[bool | int | float | str]
    operands: tuple["Expr", ...]
    kind: Kind = Kind.BOOL


Expr = (
    Const
    | Column
    | Classifier
    | MatchNumber
    | Shift
    | Reference
    | Aggregate
    | Call
    | InZone
    | Crosses
    | OnGround
    | OneOf
)


def operands(expr: Expr) -> tuple[Expr, ...]:
    """The expressions directly below this one."""
    if isinstance(expr, Call | InZone | Crosses | OnGround | OneOf):
        return expr.operands
    if isinstance(expr, Shift | Reference):
        return (expr.operand,)
    if isinstance(expr, Aggregate) and expr.operand is not None:
        return (expr.operand,)
    return ()


def walk(expr: Expr) -> Iterator[Expr]:
    """The expression and all below it."""
    yield expr
    for operand in operands(expr):
        yield from walk(operand)


def rebuilt(expr: Expr, change: Callable[[Expr], Expr]) -> Expr:
    """The expression with each of its direct operands changed."""
    if isinstance(expr, Call | InZone | Crosses | OnGround | OneOf):
        return replace(expr, operands=tuple(change(operand) for operand in expr.operands))
    if isinstance(expr, Shift | Reference):
        return replace(expr, operand=change(expr.operand))
    if isinstance(expr, Aggregate) and expr.operand is not None:
        return replace(expr, operand=change(expr.operand))
    return expr


def is_row_local(expr: Expr) -> bool:
    """Whether the row at hand and its neighbours alone decide the value."""
    return not any(isinstance(node, Reference | Aggregate | Classifier | MatchNumber) for node in walk(expr))


def is_constant(expr: Expr) -> bool:
    """Whether no row decides the value."""
    return all(isinstance(node, Const | Call) for node in walk(expr))


def is_strict(expr: Expr) -> bool:
    """Whether a NULL anywhere among its columns makes the whole NULL."""
    return not any(isinstance(node, Call) and node.op in LENIENT for node in walk(expr))


def reach(expr: Expr) -> int:
    """How many rows before the row at hand the expression looks at."""
    below = max((reach(operand) for operand in operands(expr)), default=0)
    return below + max(expr.rows, 0) if isinstance(expr, Shift) else below


def ahead(expr: Expr) -> int:
    """How many rows after the row at hand the expression looks at."""
    below = max((ahead(operand) for operand in operands(expr)), default=0)
    return below + max(-expr.rows, 0) if isinstance(expr, Shift) else below


def conjuncts(expr: Expr) -> tuple[Expr, ...]:
    """The conditions that must all be true for the expression to be true."""
    if isinstance(expr, Call) and expr.op == "and":
        return tuple(part for operand in expr.operands for part in conjuncts(operand))
    return (expr,)


def column_names(exprs: tuple[Expr, ...]) -> frozenset[str]:
    """The columns that any of the expressions reads."""
    return frozenset(node.name for expr in exprs for node in walk(expr) if isinstance(node, Column))
