"""Scalar expressions as Flink SQL, value for value as the engine computes them.

Times stay times (microseconds), durations are whole microseconds in a BIGINT. A division by zero, the root of
a negative number and a point that is not finite are NULL, as everywhere. PREV, which Flink lacks, becomes the
match's own earlier row where that is the same row: a match's rows follow each other without a gap.
"""

from dataclasses import dataclass, replace
from typing import NoReturn

from patterns.binding.expressions import (
    Aggregate,
    Call,
    Classifier,
    Column,
    Const,
    Expr,
    Kind,
    OneOf,
    Reference,
    Shift,
    is_strict,
)
from patterns.flink.elements import Elements
from patterns.flink.names import constant, interval, microseconds_sql, quoted
from patterns.flink.refusing import Refuse
from patterns.flink.shapes import Placed, Shapes

_INFIX = {
    "+": "+", "-": "-", "*": "*", "=": "=", "<>": "<>", "<": "<", "<=": "<=", ">": ">", ">=": ">=",
    "and": "AND", "or": "OR",
}  # fmt: skip
_FUNCTIONS = {"coalesce": "COALESCE", "least": "LEAST", "greatest": "GREATEST", "abs": "ABS"}
_FORMS = {
    "not": "NOT {}",
    "is_null": "{} IS NULL",
    "neg": "-{}",
    "float": "CAST({} AS DOUBLE)",
    "sqrt": "CASE WHEN {0} < 0 THEN CAST(NULL AS DOUBLE) ELSE SQRT({0}) END",
    "ratio": "CAST({} AS DOUBLE) / NULLIF(CAST({} AS DOUBLE), 0E0)",
}
_CLOSED = frozenset({*_FUNCTIONS, "float", "sqrt", "case", "%"})
_AGGREGATES = {"rows": "COUNT", "values": "COUNT", "sum": "SUM", "min": "MIN", "max": "MAX"}
_SEQUENCE = Column("sequence", Kind.INT)


@dataclass(frozen=True, slots=True)
class Place:
    """Where an expression stands.

    Attributes:
        at: Its offset in the rule's SQL, for refusals.
        refuse: Raises.
        shapes: Zones and lines.
        elements: The pattern; None outside MATCH_RECOGNIZE, where columns are plain.
        own: The variable that DEFINE is defining; None in MEASURES.
        has_timer: Whether virtual rows may stand among the match's rows.
        loops: Variables that take virtual rows that are not the match's own.
    """

    at: int
    refuse: Refuse
    shapes: Shapes
    elements: Elements | None = None
    own: str | None = None
    has_timer: bool = False
    loops: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class _Row:
    """The row whose columns are read.

    Attributes:
        is_here: Whether it is the row at hand.
        variable: Else whose row it is; None: any variable's.
        which: Its first or last.
        offset: How many of its rows further on, or back.
        back: How many rows before that one, in the partition.
    """

    is_here: bool = True
    variable: str | None = None
    which: str = "last"
    offset: int = 0
    back: int = 0


def sql(expr: Expr, place: Place) -> str:
    """The expression as text."""
    return _Writer(place).text(expr, _Row())


def operand_sql(expr: Expr, place: Place) -> str:
    """The expression as text, in parentheses where something beside it could take it apart."""
    return _Writer(place).operand(expr, _Row())


class _Writer:
    """One method for each kind of node."""

    def __init__(self, place: Place) -> None:
        self.place = place

    def text(self, expr: Expr, row: _Row) -> str:
        if isinstance(expr, Const):
            return constant(expr)
        if isinstance(expr, Column):
            return self.column(expr.name, row)
        if isinstance(expr, Shift):
            if expr.rows < 0:
                self.refuse("NEXT")
            return self.text(expr.operand, replace(row, back=row.back + expr.rows))
        if isinstance(expr, Reference):
            return self.reference(expr)
        if isinstance(expr, Aggregate):
            return self.aggregate(expr)
        if isinstance(expr, Placed):
            return self.place.shapes.sql(expr, [self.operand(part, row) for part in expr.operands])
        if isinstance(expr, OneOf):
            listed = ", ".join(sorted(constant(Const(each, expr.operands[0].kind)) for each in expr.values))
            return f"{self.operand(expr.operands[0], row)} IN ({listed})"
        if isinstance(expr, Call):
            return self.call(expr, row)
        assert isinstance(expr, Classifier), f"no kind of expression: {expr}"
        return self.refuse("CLASSIFIER")

    def operand(self, expr: Expr, row: _Row) -> str:
        written = self.text(expr, row)
        is_open = isinstance(expr, OneOf) or (isinstance(expr, Call) and expr.op not in _CLOSED)
        if isinstance(expr, Reference):
            is_open = isinstance(expr.operand, OneOf) or (
                isinstance(expr.operand, Call) and expr.operand.op not in _CLOSED
            )
        return f"({written})" if is_open else written

    def refuse(self, construct: str, detail: str = "") -> NoReturn:
        self.place.refuse(construct, self.place.at, detail)

    # Rows.

    def reference(self, expr: Reference) -> str:
        variable = self.variable(expr)
        elements = self.place.elements
        counts_all = variable is None and (expr.offset > 0 or expr.which == "last") and self.place.own is not None
        if self.place.has_timer and (variable in self.place.loops or counts_all):
            self.refuse("rows beside a TIMER")
        if not is_strict(expr.operand) and not self.has_row(expr, variable, elements):
            self.refuse("value in place of NULL", f"; here of {variable or 'the match'}")
        return self.text(expr.operand, _Row(False, variable, expr.which, expr.offset))

    def has_row(self, expr: Reference, variable: str | None, elements: Elements | None) -> bool:
        """Whether the row that is referred to is there for sure."""
        if elements is None or (variable is None and not expr.offset):
            return True
        return variable is not None and not expr.offset and elements.is_sure(variable, self.place.own)

    def variable(self, expr: Reference | Aggregate) -> str | None:
        if expr.variables is None:
            return None
        if len(expr.variables) > 1:
            self.refuse("SUBSET")
        return expr.variables[0]

    def column(self, name: str, row: _Row) -> str:
        elements, own = self.place.elements, self.place.own
        if elements is None:
            return quoted(name)
        if row.back:
            return self.earlier(name, row, elements)
        if row.is_here:
            assert own is not None, "MEASURES reads mapped rows only"
            return f"{quoted(own)}.{quoted(name)}"
        of = quoted(name) if row.variable is None else f"{quoted(row.variable)}.{quoted(name)}"
        if row.variable is not None and row.which == "last" and not row.offset:
            return of
        return f"{row.which.upper()}({of}{f', {row.offset}' if row.offset else ''})"

    def earlier(self, name: str, row: _Row, elements: Elements) -> str:
        """The column some rows before the row, by counting in the match."""
        if self.place.has_timer:
            self.refuse("rows beside a TIMER")
        own = self.place.own
        is_at_hand = row.is_here or (row.variable == own and row.which == "last" and not row.offset)
        if own is not None and is_at_hand and elements.least_rows_before(own) >= row.back:
            return f"LAST({quoted(name)}, {row.back})"
        is_end = row.variable is None or elements.is_last(row.variable)
        if own is None and row.which == "last" and not row.offset and is_end and elements.least_rows > row.back:
            return f"LAST({quoted(name)}, {row.back})"
        variable = own if row.is_here else row.variable
        at = None if variable is None or row.offset else elements.only_place(variable)
        if at is None or at < row.back:
            self.refuse("PREV out of reach")
        return f"FIRST({quoted(name)}, {at - row.back})"

    def aggregate(self, expr: Aggregate) -> str:
        variable = self.variable(expr)
        if expr.how not in _AGGREGATES:
            self.refuse("other aggregate")
        counted = _SEQUENCE if expr.operand is None else expr.operand
        if self.place.has_timer and variable is None:
            self.refuse("rows beside a TIMER")
        if variable is not None and variable in self.place.loops:
            real = f"{quoted(variable)}.`timer` = 0"
            return f"{_AGGREGATES[expr.how]}(CASE WHEN {real} THEN {self.text(counted, _Row(False, variable))} END)"
        if variable is None and not isinstance(counted, Column):
            self.refuse("aggregate of an expression over all rows")
        of = quoted(counted.name) if variable is None and isinstance(counted, Column) else None
        return f"{_AGGREGATES[expr.how]}({of or self.text(counted, _Row(False, variable))})"

    # Operators.

    def call(self, expr: Call, row: _Row) -> str:
        op, parts = expr.op, expr.operands
        if op in ("+", "-") and any(part.kind is Kind.TIME for part in parts):
            return self.time(expr, row)
        if op in _INFIX:
            return f" {_INFIX[op]} ".join(self.operand(part, row) for part in parts)
        if op in _FUNCTIONS:
            return f"{_FUNCTIONS[op]}({', '.join(self.text(part, row) for part in parts)})"
        if op == "case":
            return self.case(expr, row)
        if op in ("/", "%"):
            return self.quotient(expr, row)
        if op not in _FORMS:
            self.refuse("other function", f"; here {op!r}")
        return _FORMS[op].format(*(self.operand(part, row) for part in parts))

    def quotient(self, expr: Call, row: _Row) -> str:
        left, right = (self.operand(part, row) for part in expr.operands)
        divisor = expr.operands[1]
        if not (isinstance(divisor, Const) and divisor.value):
            right = f"NULLIF({right}, {'0E0' if divisor.kind is Kind.FLOAT else '0'})"
        return f"{left} / {right}" if expr.op == "/" else f"MOD({left}, {right})"

    def case(self, expr: Call, row: _Row) -> str:
        pairs = zip(expr.operands[:-1:2], expr.operands[1:-1:2], strict=True)
        branches = " ".join(f"WHEN {self.text(when, row)} THEN {self.text(then, row)}" for when, then in pairs)
        return f"CASE {branches} ELSE {self.text(expr.operands[-1], row)} END"

    def time(self, expr: Call, row: _Row) -> str:
        left, right = expr.operands
        if left.kind is Kind.TIME and right.kind is Kind.TIME:
            return " - ".join(f"({microseconds_sql(self.text(part, row))})" for part in (left, right))
        time, duration = (left, right) if left.kind is Kind.TIME else (right, left)
        if isinstance(duration, Const) and isinstance(duration.value, int):
            written = interval(abs(duration.value))
            if written is not None:
                sign = "-" if (duration.value < 0) != (expr.op == "-") else "+"
                return f"{self.operand(time, row)} {sign} {written}"
        whole = f"{microseconds_sql(self.text(time, row))} {expr.op} {self.operand(duration, row)}"
        return f"TO_TIMESTAMP_LTZ({whole}, 6)"
