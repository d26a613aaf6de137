"""What an expression reads of a match: which row, of which variables, or an aggregate of many.

SQL:2016 lets an expression of MEASURES or DEFINE look at other rows of the match by navigation (FIRST, LAST, PREV,
NEXT), by a column of a variable, by CLASSIFIER, MATCH_NUMBER and aggregates. Here each such part of an expression
becomes a `Reading`, and whatever the standard forbids is refused at its place. What the parts are computed from and
how, is not known here.

Source: ISO/IEC TR 19075-5, sections 4.13 to 4.17; Trino's documentation of MATCH_RECOGNIZE.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NoReturn

from sqlglot import exp

from patterns.errors import RuleError
from patterns.language.text import Passage
from patterns.language.tokens import canonical_name

Frame = tuple[str, ...] | None
"""The compared names of the variables whose rows count; None: every row of the match."""

_LOGICAL = ("FIRST", "LAST")
_PHYSICAL = {"PREV": -1, "NEXT": 1}
_SEMANTICS = ("RUNNING", "FINAL")
_OTHER = ("CLASSIFIER", "MATCH_NUMBER")
NAVIGATION = frozenset((*_LOGICAL, *_PHYSICAL, *_SEMANTICS, *_OTHER))


@dataclass(frozen=True, slots=True)
class RowReading:
    """The operand's value at one row.

    Attributes:
        frame: Whose rows count.
        which: From which end of them.
        offset: How many of them further on from the first, or back from the last.
        shift: How many rows of the partition further on from there; negative: back.
        is_final: Whether the whole match is looked at, and not only what came up to the row at hand.
        operand: The expression at that row; its columns still have their variables before them.
    """

    frame: Frame
    which: Literal["first", "last"]
    offset: int
    shift: int
    is_final: bool
    operand: exp.Expr


@dataclass(frozen=True, slots=True)
class AggregateReading:
    """An aggregate over the rows of some variables; `call` is it as written, FILTER included."""

    frame: Frame
    is_final: bool
    call: exp.Expr


@dataclass(frozen=True, slots=True)
class MatchNumber:
    """The number of the match in its partition, from 1."""


Reading = RowReading | AggregateReading | MatchNumber


@dataclass(frozen=True, slots=True)
class Names:
    """What may stand in the expressions of one clause.

    Attributes:
        passage: The SQL, for errors.
        clause: `DEFINE` or `MEASURES`, for errors.
        frames: For each variable and each SUBSET the variables that it means, by compared name.
        aggregates: The aggregate functions, in upper case.
        number: The value of an expression that must be a whole number, None if it is none.
        offset_most: How many rows navigation may go.
    """

    passage: Passage
    clause: str
    frames: Mapping[str, tuple[str, ...]]
    aggregates: Collection[str]
    number: Callable[[exp.Expr], int | None]
    offset_most: int = 100_000


def function_name(node: exp.Expr) -> str:
    """The name of the function that is called here, in upper case; empty if none is."""
    return str(node.this).upper() if isinstance(node, exp.Anonymous) else ""


def column_parts(column: exp.Expr) -> list[exp.Expr]:
    """The identifiers of a column, from left to right."""
    return [column.args[key] for key in ("catalog", "db", "table", "this") if column.args.get(key) is not None]


def identifier_key(identifier: exp.Expr) -> str:
    """What the identifier is compared by."""
    return canonical_name(identifier.name, bool(identifier.args.get("quoted")))


class Reader:
    """Finds the readings in expressions of one clause; `at` is where to point when a node knows no place."""

    def __init__(self, names: Names, at: int) -> None:
        self.names = names
        self.at = at

    def reading(self, node: exp.Expr) -> Reading | None:
        """What the node reads of the match; None: it is no reading itself, though parts of it may be."""
        name = function_name(node)
        if isinstance(node, exp.Column):
            return self._of_row(node)
        if name == "CLASSIFIER":
            self._check_classifier(node)
            return self._of_row(node)
        if name == "MATCH_NUMBER":
            if node.expressions:
                self._fail("MATCH_NUMBER takes nothing in its parentheses", node)
            return MatchNumber()
        if name in _LOGICAL:
            return self._logical(node, is_final=False)
        if name in _PHYSICAL:
            return self._physical(node)
        if name in _SEMANTICS:
            return self._with_semantics(node)
        if self.is_aggregate(node):
            return self._aggregate(node, is_final=False)
        return None

    # Navigation.

    def _of_row(self, node: exp.Expr) -> RowReading:
        return RowReading(self.frame_of(node, node), "last", 0, 0, is_final=False, operand=node)

    def _logical(self, node: exp.Expr, is_final: bool) -> RowReading:
        operand, offset = self._arguments(node, default=0)
        for part in self._functions(operand):
            self._fail(f"{_shown(part)} must not stand inside {function_name(node)}", part)
        which: Literal["first", "last"] = "first" if function_name(node) == "FIRST" else "last"
        return RowReading(self.frame_of(operand, node), which, offset, 0, is_final, operand)

    def _physical(self, node: exp.Expr) -> RowReading:
        operand, offset = self._arguments(node, default=1)
        shift = offset * _PHYSICAL[function_name(node)]
        inner = operand.unnest()
        name = function_name(inner)
        if name in _SEMANTICS and function_name(_only(inner)) in _LOGICAL:
            reading = self._with_semantics(inner)
            assert isinstance(reading, RowReading), "a semantics before FIRST or LAST"
        elif name in _LOGICAL:
            reading = self._logical(inner, is_final=False)
        else:
            for part in self._functions(operand):
                alone = ", unless by itself" if function_name(part) in _LOGICAL else ""
                self._fail(f"{_shown(part)} must not stand inside {function_name(node)}{alone}", part)
            return RowReading(self.frame_of(operand, node), "last", 0, shift, is_final=False, operand=operand)
        return RowReading(reading.frame, reading.which, reading.offset, shift, reading.is_final, reading.operand)

    def _with_semantics(self, node: exp.Expr) -> Reading:
        semantics, inner = function_name(node), _only(node)
        is_final = semantics == "FINAL"
        if is_final and self.names.clause == "DEFINE":
            self._fail("FINAL has no meaning in DEFINE: the match is not complete there", node)
        if function_name(inner) in _LOGICAL:
            return self._logical(inner, is_final)
        if not self.is_aggregate(inner):
            self._fail(f"{semantics} stands before FIRST, LAST or an aggregate function only", node)
        return self._aggregate(inner, is_final)

    def _arguments(self, node: exp.Expr, default: int) -> tuple[exp.Expr, int]:
        name = function_name(node)
        if len(node.expressions) not in (1, 2):
            self._fail(f"{name} takes a value and, if wanted, a number of rows", node)
        if isinstance(node.expressions[0], exp.Distinct):
            self._fail(f"{name} reads one row: DISTINCT has no meaning in it", node)
        if len(node.expressions) == 1:
            return node.expressions[0], default
        offset = self.names.number(node.expressions[1])
        most = self.names.offset_most
        if offset is None or not 0 <= offset <= most:
            self._fail(f"{name} goes by a whole number of 0 to {most} rows, written as a constant", node)
        return node.expressions[0], offset

    # Aggregates.

    def is_aggregate(self, node: exp.Expr) -> bool:
        """Whether an aggregate function is called here, with FILTER or without."""
        call = node.this if isinstance(node, exp.Filter) else node
        return isinstance(call, exp.Expr) and function_name(call) in self.names.aggregates

    def _aggregate(self, node: exp.Expr, is_final: bool) -> AggregateReading:
        call = node.this if isinstance(node, exp.Filter) else node
        for argument in [*call.expressions, *([node.expression] if node is not call else [])]:
            for part in self._functions(argument):
                self._fail(f"{_shown(part)} must not stand inside the aggregate function {_shown(call)}", part)
        return AggregateReading(self.frame_of(node, node, needs_column=False), is_final, node)

    # What an operand may hold.

    def _functions(self, operand: exp.Expr) -> Iterator[exp.Expr]:
        """The navigation and aggregate functions in the operand; CLASSIFIER and MATCH_NUMBER are none."""
        for part in operand.walk():
            name = function_name(part)
            if (name in NAVIGATION and name not in _OTHER) or name in self.names.aggregates:
                yield part

    def frame_of(self, operand: exp.Expr, node: exp.Expr, needs_column: bool = True) -> Frame:
        """The one frame that all columns and CLASSIFIER calls of the operand are of."""
        frames: dict[Frame, exp.Expr] = {}
        for part in operand.walk():
            if function_name(part) == "CLASSIFIER":
                self._check_classifier(part)
                frames.setdefault(self._classifier_frame(part), part)
            elif isinstance(part, exp.Column) and not _is_classified(part):
                self._check_star(part, operand)
                frames.setdefault(self._column_frame(part), part)
        if not frames and needs_column:
            self._fail(f"{_shown(node)} needs a column or CLASSIFIER() in it", node)
        if len(frames) > 1:
            self._fail(f"{_shown(node)} must read columns of one variable", list(frames.values())[1])
        return next(iter(frames), None)

    def _column_frame(self, column: exp.Expr) -> Frame:
        first = column_parts(column)[0]
        qualifies = len(column_parts(column)) > 1 or isinstance(column.this, exp.Star)
        return self.names.frames.get(identifier_key(first)) if qualifies else None

    def _classifier_frame(self, call: exp.Expr) -> Frame:
        if not call.expressions:
            return None
        return self.names.frames[identifier_key(call.expressions[0].this)]

    def _check_classifier(self, call: exp.Expr) -> None:
        arguments = call.expressions
        if not arguments:
            return
        is_name = len(arguments) == 1 and isinstance(arguments[0], exp.Column) and len(column_parts(arguments[0])) == 1
        if not is_name:
            self._fail("CLASSIFIER takes one pattern variable or nothing", call)
        name = arguments[0].this
        if identifier_key(name) not in self.names.frames:
            have = ", ".join(self.names.frames) or "none"
            self._fail(f"unknown pattern variable {name.name!r}; there are: {have}", name)

    def _check_star(self, column: exp.Expr, operand: exp.Expr) -> None:
        if not isinstance(column.this, exp.Star):
            return
        table = column.args["table"]
        if identifier_key(table) not in self.names.frames:
            have = ", ".join(self.names.frames) or "none"
            self._fail(f"unknown pattern variable {table.name!r}; there are: {have}", table)
        call = operand.this if isinstance(operand, exp.Filter) else operand
        if function_name(call) != "COUNT" or list(call.expressions) != [column]:
            self._fail(f"{table.name}.* stands in COUNT only", column)

    # Errors.

    def _fail(self, message: str, node: exp.Expr) -> NoReturn:
        raise self.error(message, node)

    def error(self, message: str, node: exp.Expr) -> RuleError:
        """The error at the node's place, or at the first part of it that knows one."""
        return self.names.passage.error(f"{self.names.clause}: {message}", offset_of(node, self.at))


def offset_of(node: exp.Expr, default: int) -> int:
    """Where the node, or the first part of it that knows its place, stands."""
    return min((part.meta["start"] for part in node.walk() if "start" in part.meta), default=default)


def _only(node: exp.Expr) -> exp.Expr:
    inner: exp.Expr = node.expressions[0]
    return inner.unnest()


def _is_classified(column: exp.Expr) -> bool:
    return column.parent is not None and function_name(column.parent) == "CLASSIFIER"


def _shown(node: exp.Expr) -> str:
    call = node.this if isinstance(node, exp.Filter) else node
    return function_name(call) or node.sql()[:40]
