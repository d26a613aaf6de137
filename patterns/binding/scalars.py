"""From sqlglot's scalar trees to ours: names resolved, types checked, the rest refused.

What a column name means depends on where it stands (`Scope`): in DEFINE the row
at hand, or the last row mapped to another variable; in MEASURES the last row of
the variable, or of the match.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, NoReturn

from sqlglot import exp

from patterns.binding import metric
from patterns.binding.expressions import (
    Aggregate,
    Call,
    Classifier,
    Column,
    Const,
    Crosses,
    Expr,
    InZone,
    Kind,
    MatchNumber,
    OneOf,
    OnGround,
    Reference,
    Shift,
    is_constant,
    operands,
    rebuilt,
    walk,
)
from patterns.binding.guards import constant_value
from patterns.binding.literals import VARIABLE_UNITS, interval, number
from patterns.binding.scope import Scope, constant
from patterns.binding.typing_rules import TypeMismatch, as_float, typed_call
from patterns.errors import NotInRules, RuleError
from patterns.language import navigation
from patterns.language.navigation import (
    NAVIGATION,
    AggregateReading,
    Names,
    Reader,
    Reading,
    RowReading,
    function_name,
)
from patterns.language.syntax import Scalar
from patterns.language.text import did_you_mean
from patterns.language.tokens import canonical_name
from patterns.scene.geometry import DIRECTIONS
from patterns.scene.ground import GroundValue
from patterns.scene.quantities import Quantity

PREV_MOST = 1_000

_BINARY: dict[type[exp.Expr], str] = {
    exp.Add: "+", exp.Sub: "-", exp.Mul: "*", exp.Div: "/", exp.Mod: "%", exp.EQ: "=", exp.NEQ: "<>",
    exp.LT: "<", exp.LTE: "<=", exp.GT: ">", exp.GTE: ">=", exp.And: "and", exp.Or: "or",
}  # fmt: skip
_UNARY: dict[type[exp.Expr], str] = {exp.Neg: "neg", exp.Not: "not"}
_FUNCTIONS = ("ABS", "SQRT", "LEAST", "GREATEST", "COALESCE")
_AGGREGATES = frozenset(("COUNT", "SUM", "MIN", "MAX", "AVG"))


def translate(scalar: Scalar, scope: Scope) -> Expr:
    """The expression with its names resolved in this scope.

    Raises:
        RuleError: A name that is not there, or operands of wrong types.
        NotInRules: SQL that a rule does not have.
    """
    return _Translator(scope, scalar.at).expr(scalar.node)


class _Translator:
    """One method for each kind of node; `at` is where to point when a node knows no place."""

    def __init__(self, scope: Scope, at: int) -> None:
        self.scope = scope
        self.at = at
        self.is_at_row = False

    def expr(self, node: exp.Expr) -> Expr:
        handler = _HANDLERS.get(type(node))
        if handler is not None:
            return handler(self, node)
        if type(node) in _BINARY:
            return self.call(_BINARY[type(node)], node, (node.this, node.expression))
        if type(node) in _UNARY:
            return self.call(_UNARY[type(node)], node, (node.this,))
        raise self.refusal(_named(node), _why_not(node), node)

    def call(self, op: str, node: exp.Expr, parts: tuple[exp.Expr, ...]) -> Expr:
        return self.typed(op, node, tuple(self.expr(part) for part in parts))

    def typed(self, op: str, node: exp.Expr, operands: tuple[Expr, ...]) -> Expr:
        try:
            return typed_call(op, operands)
        except TypeMismatch as error:
            is_of_time = any(each.kind in (Kind.TIME, Kind.DURATION) for each in operands)
            self.fail(f"{error}{self.no_durations(node, is_of_time)}", node)

    def no_durations(self, node: exp.Expr, is_of_time: bool) -> str:
        """What is to be said of parameters that were meant as durations and are not."""
        names = {str(each.this or "") for each in node.find_all(exp.Placeholder)}
        values = {name: self.scope.params.get(name) for name in sorted(names)}
        said = [f":{name} is {_no_duration(value, is_of_time)}" for name, value in values.items()
                if _no_duration(value, is_of_time)]  # fmt: skip
        return f"; {', '.join(said)}, where a duration is written as in 10 s" if said else ""

    # Names.

    def column(self, node: exp.Expr) -> Expr:
        if node.args.get("db") or node.args.get("catalog"):
            self.refuse("column name of more than two parts", "Next: write variable.column", node)
        self.check_variable(node)
        if node.name.lower() == metric.SPEED and metric.SPEED not in self.scope.columns and not metric.is_quoted(node):
            return self.expr(metric.speed_kmh(node))
        if self.is_at_row or not self.scope.has_match:
            return self.bare_column(node.this)
        return self.of_row(self.reader.reading(node), node)

    def bare_column(self, identifier: exp.Expr) -> Column:
        name = identifier.name if identifier.args.get("quoted") else identifier.name.lower()
        kind = self.scope.columns.get(name)
        if kind is not None:
            return Column(name, kind)
        if name in self.scope.unreadable:
            self.fail(f"column {name} has the Arrow type {self.scope.unreadable[name]}, which rules cannot read",
                      identifier)  # fmt: skip
        have = ", ".join(sorted(self.scope.columns))
        like = did_you_mean(identifier.name, self.scope.columns)
        raise self.error(f"unknown column {identifier.name!r}; there are: {have}{like}", identifier)

    def check_variable(self, node: exp.Expr) -> None:
        """Checks that what stands before the dot, if anything does, is a variable."""
        table = node.args.get("table")
        if table is None or canonical_name(table.name, bool(table.args.get("quoted"))) in self.scope.frames:
            return
        have = ", ".join(self.scope.frames) or "none here"
        like = did_you_mean(table.name, self.scope.frames)
        self.fail(f"unknown pattern variable {table.name!r}; there are: {have}{like}", table)

    def placeholder(self, node: exp.Expr) -> Expr:
        name = str(node.this or "")
        if name not in self.scope.params:
            have = ", ".join(sorted(self.scope.params)) or "none"
            like = did_you_mean(name, self.scope.params)
            message = f"{self.scope.clause}: unknown parameter :{name}; params has: {have}{like}"
            raise self.scope.passage.error(message, self.param_offset(name))
        value = self.scope.params[name]
        if isinstance(value, tuple):
            message = f"{self.scope.clause}: :{name} is a list; it stands after IN only, as in `plate IN :{name}`"
            raise self.scope.passage.error(message, self.param_offset(name))
        return self.constant_of(name, value)

    def constant_of(self, name: str, value: Any) -> Const:
        """What the parameter, or an item of its list, is."""
        try:
            return constant(value)
        except TypeMismatch as error:
            message = f"{self.scope.clause}: :{name}: {error}"
            raise self.scope.passage.error(message, self.param_offset(name)) from error

    def param_offset(self, name: str) -> int:
        found = self.scope.passage.text.find(f":{name}", self.at)
        return found if found >= 0 else self.at

    # What is read of the match.

    @cached_property
    def reader(self) -> Reader:
        scope = self.scope
        names = Names(scope.passage, scope.clause, scope.frames, _AGGREGATES, self.whole_number, PREV_MOST)
        return Reader(names, self.at)

    def whole_number(self, node: exp.Expr) -> int | None:
        value = constant_value(expr) if is_constant(expr := self.expr(node)) else None
        return value if type(value) is int and expr.kind is Kind.INT else None

    def of_match(self, node: exp.Expr) -> Expr:
        """What a navigation function, CLASSIFIER, MATCH_NUMBER or an aggregate gives."""
        if not self.scope.has_match:
            self.fail(f"{_named(node)} has no meaning in {self.scope.clause}", node)
        if self.is_at_row and function_name(node) == "CLASSIFIER":
            return Classifier()
        reading = self.reader.reading(node)
        if isinstance(reading, AggregateReading):
            return self.aggregate(reading, node)
        if isinstance(reading, navigation.MatchNumber):
            return self.match_number(node)
        return self.of_row(reading, node)

    def match_number(self, node: exp.Expr) -> Expr:
        if self.scope.clause == "DEFINE":
            self.fail("MATCH_NUMBER is known once all matches before are decided, so that a rule would have to keep "
                      "the rows of a partition until then; it stands in MEASURES", node)  # fmt: skip
        return MatchNumber()

    def of_row(self, reading: Reading | None, node: exp.Expr) -> Expr:
        assert isinstance(reading, RowReading), "neither an aggregate nor the match's number"
        operand = self.at_row(reading.operand)
        if any(isinstance(part, MatchNumber) for part in walk(operand)):
            return self.spread(reading, operand, node)
        return self.read_at(reading, operand, node)

    def spread(self, reading: RowReading, operand: Expr, node: exp.Expr) -> Expr:
        """The operand with each of its columns read by itself: the match's number is none of a row."""
        if isinstance(operand, MatchNumber | Const):
            return operand
        if isinstance(operand, Column | Classifier):
            return self.read_at(reading, operand, node)
        return rebuilt(operand, lambda part: self.spread(reading, part, node))

    def read_at(self, reading: RowReading, operand: Expr, node: exp.Expr) -> Expr:
        """The operand's value at the row that the reading says."""
        if any(isinstance(part, Classifier) for part in walk(operand)):
            return self.classified(reading, operand, node)
        if reading.shift:
            operand = Shift(operand, -reading.shift)
        if self.is_current(reading):
            return operand
        return Reference(reading.frame, reading.which, operand, reading.offset)

    def is_current(self, reading: RowReading) -> bool:
        """Whether it reads the row at hand: the last one of its variables is that."""
        is_last = reading.which == "last" and reading.offset == 0
        return self.scope.has_row and is_last and (reading.frame is None or self.scope.own in reading.frame)

    def classified(self, reading: RowReading, operand: Expr, node: exp.Expr) -> Expr:
        if reading.shift and (reading.frame is not None or reading.which == "first"):
            self.fail("CLASSIFIER stands in PREV and NEXT of the match's rows only, as in PREV(CLASSIFIER())", node)
        if reading.shift > reading.offset:
            return self.beyond(operand, node)
        if reading.shift == 0 and self.is_current(reading):
            return labelled(
                operand, next(key for key, shown in self.scope.variables.items() if shown == self.scope.own)
            )
        # The rows of a match follow each other: n rows back from its last is its last but n.
        return Reference(reading.frame, reading.which, operand, reading.offset - reading.shift)

    def beyond(self, operand: Expr, node: exp.Expr) -> Expr:
        """What NEXT(CLASSIFIER()) is: no row after the match's last is mapped to a variable."""
        if not isinstance(operand, Classifier):
            self.fail("CLASSIFIER stands by itself inside NEXT of the match's last row", node)
        return Const(None, Kind.STRING)

    def at_row(self, operand: exp.Expr) -> Expr:
        """The operand over the columns of one row, whichever that is."""
        within = _Translator(self.scope, self.at)
        within.is_at_row = True
        return within.expr(operand)

    def aggregate(self, reading: AggregateReading, node: exp.Expr) -> Expr:
        call = reading.call
        name, arguments = function_name(call), call.expressions
        if not isinstance(call, exp.Anonymous) or any(isinstance(each, exp.Distinct | exp.Order) for each in arguments):
            self.refuse("aggregate with DISTINCT, FILTER or ORDER BY", _KEPT_FLAT, node)
        is_star = bool(arguments) and (isinstance(arguments[0], exp.Star) or isinstance(arguments[0].this, exp.Star))
        if name == "COUNT" and len(arguments) < 2 and (not arguments or is_star):
            return Aggregate(reading.frame, "rows", None, Kind.INT)
        if len(arguments) != 1:
            self.fail(f"{name} takes one value, got {len(arguments)}", node)
        operand = self.at_row(arguments[0])
        if any(isinstance(part, MatchNumber) for part in walk(operand)):
            self.fail(f"MATCH_NUMBER is none of a row's values; it stands outside of {name}", node)
        values = Aggregate(reading.frame, "values", operand, Kind.INT)
        if name == "COUNT":
            return values
        kinds = (Kind.INT, Kind.FLOAT, Kind.DURATION, *((Kind.TIME, Kind.STRING) if name in ("MIN", "MAX") else ()))
        if operand.kind not in kinds:
            wanted = ", ".join(kind.value for kind in kinds)
            self.fail(f"{name} takes a value of type {wanted}, got {operand.kind.value}", node)
        if name in ("MIN", "MAX"):
            return Aggregate(reading.frame, "min" if name == "MIN" else "max", operand, operand.kind)
        total = Aggregate(reading.frame, "sum", operand, operand.kind)
        if name == "SUM":
            return total
        is_number = operand.kind is not Kind.DURATION
        return self.typed("/", node, (as_float(total), as_float(values)) if is_number else (total, values))

    # Literals.

    def literal(self, node: exp.Expr) -> Expr:
        if node.args.get("is_string"):
            return Const(str(node.this), Kind.STRING)
        try:
            return number(str(node.this))
        except TypeMismatch as error:
            raise self.error(str(error), node) from error

    def boolean(self, node: exp.Expr) -> Expr:
        return Const(bool(node.this), Kind.BOOL)

    def null(self, node: exp.Expr) -> Expr:
        return Const(None, Kind.NULL)

    def interval(self, node: exp.Expr) -> Expr:
        unit = node.args.get("unit")
        if not isinstance(unit, exp.Var) or not isinstance(node.this, exp.Literal):
            self.refuse("INTERVAL other than of one number and one unit", "Next: write INTERVAL '90' SECOND", node)
        name = unit.name.upper().removesuffix("S")
        if name in VARIABLE_UNITS:
            self.refuse(f"INTERVAL in {name}", "none is as long as the next. Next: write it in days", node)
        try:
            return interval(str(node.this.this), name)
        except TypeMismatch as error:
            raise self.error(str(error), node) from error

    # Forms that are other forms in disguise.

    def paren(self, node: exp.Expr) -> Expr:
        return self.expr(node.this)

    def between(self, node: exp.Expr) -> Expr:
        if node.args.get("symmetric"):
            self.refuse("BETWEEN SYMMETRIC", "Next: write BETWEEN LEAST(a, b) AND GREATEST(a, b)", node)
        value, low, high = (self.expr(part) for part in (node.this, node.args["low"], node.args["high"]))
        bounds = self.typed(">=", node, (value, low)), self.typed("<=", node, (value, high))
        return self.typed("and", node, bounds)

    def member(self, node: exp.Expr) -> Expr:
        field = node.args.get("field")
        if isinstance(field, exp.Placeholder):
            return self.one_of(node, field)
        if node.args.get("query") or node.args.get("unnest") or field:
            self.refuse("IN with a sub-query", _OWN_ROWS, node)
        items = node.expressions
        if len(items) == 1 and isinstance(items[0], exp.Placeholder) and self.is_list(items[0]):
            return self.one_of(node, items[0])
        value = self.expr(node.this)
        equals = [self.typed("=", node, (value, self.expr(item))) for item in node.expressions]
        result = equals[0]
        for equal in equals[1:]:
            result = self.typed("or", node, (result, equal))
        return result

    def is_list(self, node: exp.Expr) -> bool:
        return isinstance(self.scope.params.get(str(node.this or "")), tuple)

    def one_of(self, node: exp.Expr, listed: exp.Expr) -> Expr:
        """`value IN :list`."""
        name = str(listed.this or "")
        if name in self.scope.params and not self.is_list(listed):
            message = f"{self.scope.clause}: IN takes a list, and the parameter :{name} is none; write IN (:{name})"
            raise self.scope.passage.error(message, self.param_offset(name))
        if name not in self.scope.params:
            return self.placeholder(listed)
        value = self.expr(node.this)
        items = [self.constant_of(name, each) for each in self.scope.params[name]]
        kinds = {value.kind, *(item.kind for item in items)} - {Kind.NULL}
        if kinds == {Kind.INT, Kind.FLOAT}:
            value, items = as_float(value), [Const(float(item.value or 0), Kind.FLOAT) for item in items]
        elif len(kinds) > 1:
            shown = " and ".join(sorted(kind.value for kind in kinds))
            message = f"{self.scope.clause}: IN compares values of one type, got {shown}"
            raise self.scope.passage.error(message, self.param_offset(name))
        return OneOf(frozenset(item.value for item in items if item.value is not None), (value,))

    def is_null(self, node: exp.Expr) -> Expr:
        if not isinstance(node.expression, exp.Null):
            self.refuse(
                "IS with anything but NULL", "Next: write the condition itself, or COALESCE(condition, FALSE)", node
            )
        return self.call("is_null", node, (node.this,))

    def case(self, node: exp.Expr) -> Expr:
        subject = node.this
        parts: list[Expr] = []
        for branch in node.args["ifs"]:
            condition = self.expr(branch.this)
            if subject is not None:
                condition = self.typed("=", node, (self.expr(subject), condition))
            parts += [condition, self.expr(branch.args["true"])]
        default = node.args.get("default")
        parts.append(self.expr(default) if default is not None else Const(None, Kind.NULL))
        return self.typed("case", node, tuple(parts))

    # Zones, lines, and names that sqlglot does not know.

    def anonymous(self, node: exp.Expr) -> Expr:
        name = str(node.this).upper()
        if name in NAVIGATION or name in _AGGREGATES:
            return self.of_match(node)
        if name in _FUNCTIONS:
            return self.call(name.lower(), node, tuple(node.expressions))
        if name == "IN_ZONE":
            return self.in_zone(node)
        if name == "CROSSES":
            return self.crosses(node)
        if name in _GROUND:
            return self.on_ground(node, name)
        if name == "DISTANCE_M":
            return self.distance_m(node)
        if name == "TIMER":
            return self.timer(node)
        like = did_you_mean(str(node.this), _FUNCTIONS_SHOWN.split(", "))
        raise self.error(f"unknown function {node.this}; there are: {_FUNCTIONS_SHOWN}{like}", node)

    def timer(self, node: exp.Expr) -> Expr:
        """Whether the row at hand is the virtual row that is due so long after the variable's last row."""
        if self.scope.clause != "DEFINE":
            self.fail("TIMER has a meaning in DEFINE only", node)
        above = node.parent
        while isinstance(above, exp.Paren | exp.And):
            above = above.parent
        if above is not None:
            self.fail("TIMER stands alone or beside other conditions with AND, not under another operator", node)
        if len(node.expressions) != 2:
            self.fail(f"wanted TIMER(variable.time, duration), got {len(node.expressions)} arguments", node)
        since, length = (self.expr(part) for part in node.expressions)
        if since == Column("time", Kind.TIME):
            self.fail("TIMER counts from a row of another variable, as in TIMER(other.time, duration)", node)
        if not isinstance(since, Reference) or since != replace(since, which="last", operand=Column("time", Kind.TIME)):
            self.fail("wanted TIMER(variable.time, duration): it counts from a variable's last row", node)
        if since.variables is None or self.scope.own in since.variables:
            self.fail("TIMER counts from a row of another variable, as in TIMER(other.time, duration)", node)
        us = constant_value(length) if is_constant(length) else None
        if length.kind is not Kind.DURATION or not isinstance(us, int) or us <= 0:
            self.fail("TIMER: wanted a constant duration above zero, such as :limit or INTERVAL '10' SECOND", node)
        due = replace(since, operand=self.typed("+", node, (since.operand, length)))
        return Call("timer", (Column("time", Kind.TIME), due), Kind.BOOL)

    def in_zone(self, node: exp.Expr) -> Expr:
        x, y, zone = self.arguments(node, "in_zone(x, y, 'zone')", 2, 1)
        name = self.name_in(zone, "zone", self.scope.zones)
        return InZone(name, self.with_source((self.number(x), self.number(y))))

    def crosses(self, node: exp.Expr) -> Expr:
        arguments = self.arguments(node, "crosses(x0, y0, x1, y1, 'line', 'direction')", 4, 2)
        line = self.name_in(arguments[4], "line", self.scope.lines)
        direction = arguments[5].this
        if direction not in DIRECTIONS:
            self.fail(f"unknown direction {direction!r}; there are: {', '.join(DIRECTIONS)}", arguments[5])
        return Crosses(line, direction, self.with_source(tuple(self.number(part) for part in arguments[:4])))

    def on_ground(self, node: exp.Expr, name: str) -> Expr:
        what, numbers, form = _GROUND[name]
        arguments = self.arguments(node, form, numbers, 0)
        return OnGround(what, self.with_source(tuple(self.number(part) for part in arguments)))

    def distance_m(self, node: exp.Expr) -> Expr:
        """Metres on the ground between the rows of two variables."""
        form = "wanted distance_m(a, b), the rows of two pattern variables"
        if len(node.expressions) != 2:
            self.fail(f"{form}, got {len(node.expressions)} arguments", node)
        for each in node.expressions:
            if not isinstance(each, exp.Column) or each.args.get("table"):
                self.fail(f"{form}, got {each.sql()}", each)
            variable = canonical_name(each.name, metric.is_quoted(each))
            if variable not in self.scope.frames:
                have = ", ".join(self.scope.frames) or "none here"
                self.fail(f"unknown pattern variable {each.name!r}; there are: {have}", each)
        return self.expr(metric.distance_m(*node.expressions))

    def with_source(self, coordinates: tuple[Expr, ...]) -> tuple[Expr, ...]:
        """The coordinates after the source of their row, or of the row at hand where they are of several."""
        source = Column("source", Kind.STRING)
        parts = [part for coordinate in coordinates for part in walk(coordinate)]
        frames = {(part.variables, part.which, part.offset) for part in parts if isinstance(part, Reference)}
        if len(frames) == 1 and not any(_has_free_column(coordinate) for coordinate in coordinates):
            variables, which, offset = frames.pop()
            return (Reference(variables, which, source, offset), *coordinates)
        is_row = self.scope.has_row or self.is_at_row
        return (source if is_row else Reference(None, "last", source), *coordinates)

    def arguments(self, node: exp.Expr, form: str, numbers: int, names: int) -> list[exp.Expr]:
        arguments: list[exp.Expr] = node.expressions
        if len(arguments) != numbers + names:
            self.fail(f"wanted {form}, got {len(arguments)} arguments", node)
        for argument in arguments[numbers:]:
            if not isinstance(argument, exp.Literal) or not argument.is_string:
                self.fail(f"wanted {form}, with names in single quotes", argument)
        return arguments

    def name_in(self, node: exp.Expr, what: str, names: frozenset[str]) -> str:
        name = str(node.this)
        if name not in names and name not in self.scope.shared:
            have = ", ".join(sorted(names)) or "none"
            shared = f"; shared has: {', '.join(sorted(self.scope.shared))}" if self.scope.shared else ""
            like = did_you_mean(name, names | self.scope.shared)
            self.fail(f"unknown {what} {name!r}; {what}s has: {have}{shared}{like}", node)
        return name

    def number(self, node: exp.Expr) -> Expr:
        value = self.expr(node)
        if value.kind not in (Kind.INT, Kind.FLOAT, Kind.NULL):
            self.fail(f"a coordinate is a number, got {value.kind.value}", node)
        return as_float(value)

    # Errors.

    def refuse(self, what: str, why: str, node: exp.Expr) -> NoReturn:
        raise self.refusal(what, why, node)

    def refusal(self, what: str, why: str, node: exp.Expr) -> RuleError:
        message = f"{self.scope.clause}: rules have no {what}: {why}"
        return self.scope.passage.error(message, self.offset(node), NotInRules)

    def fail(self, message: str, node: exp.Expr) -> NoReturn:
        raise self.error(message, node)

    def error(self, message: str, node: exp.Expr) -> RuleError:
        return self.scope.passage.error(f"{self.scope.clause}: {message}", self.offset(node))

    def offset(self, node: exp.Expr) -> int:
        """Where the node, or the first part of it that knows its place, stands."""
        if isinstance(node, exp.Query | exp.Exists):
            word = "EXISTS" if isinstance(node, exp.Exists) else "SELECT"
            return max(self.scope.passage.text.upper().find(word, self.at), self.at)
        places = [part.meta["start"] for part in node.walk() if "start" in part.meta]
        return min(places, default=self.at)


def _has_free_column(expr: Expr) -> bool:
    if isinstance(expr, Reference):
        return False
    if isinstance(expr, Column):
        return True
    return any(_has_free_column(operand) for operand in operands(expr))


def labelled(operand: Expr, variable: str) -> Expr:
    """The operand at a row of this variable."""
    if isinstance(operand, Classifier):
        return Const(variable, Kind.STRING)
    return rebuilt(operand, lambda part: labelled(part, variable))


def _no_duration(value: object, is_of_time: bool) -> str:
    """What a value is that may have been meant as a duration; nothing if it is one, or cannot have been."""
    if isinstance(value, str):
        return f"the text {value!r}" if re.match(r"[-+]?[0-9.]", value) else ""
    if not is_of_time or isinstance(value, bool):
        return ""
    if isinstance(value, Quantity):
        return f"a value in {value.base_unit}"
    return f"the number {value}" if isinstance(value, int | float) else ""


def _named(node: exp.Expr) -> str:
    """What to call the node in an error."""
    if isinstance(node, exp.Anonymous):
        return str(node.this).upper()
    if isinstance(node, exp.Func):
        return node.sql_name()
    if isinstance(node, exp.Query | exp.Subquery):
        return "sub-query"
    return f"{type(node).__name__} ({node.sql()[:40]})"


def _why_not(node: exp.Expr) -> str:
    """Why rules do not have this part of SQL, and what to write instead."""
    if isinstance(node, exp.Query | exp.Subquery | exp.Exists):
        return _OWN_ROWS
    if isinstance(node, exp.Cast):
        return "columns and parameters have their types, and numbers mix. Next: compare values of one type"
    operators = ", ".join((*_BINARY.values(), *_UNARY.values()))
    return f"there are: {operators}, IN, BETWEEN, IS NULL, CASE, {_FUNCTIONS_SHOWN}"


_OWN_ROWS = (
    "a condition is decided by the rows of its partition alone, so that a replay decides the same. Next: write value "
    "IN :list with a list parameter, or read the other events as an arm of FROM"
)
_KEPT_FLAT = (
    "what a match remembers must not grow with its length. Next: let a variable of its own, or a SUBSET, take the rows "
    "that count"
)
_GROUND: dict[str, tuple[GroundValue, int, str]] = {
    "GROUND_X": ("x", 2, "ground_x(x, y)"),
    "GROUND_Y": ("y", 2, "ground_y(x, y)"),
    "GROUND_SPEED": ("speed", 4, "ground_speed(x, y, vx, vy)"),
}
_FUNCTIONS_SHOWN = (
    "FIRST, LAST, PREV, NEXT, CLASSIFIER, MATCH_NUMBER, COUNT, SUM, MIN, MAX, AVG, ABS, SQRT, LEAST, GREATEST, "
    "COALESCE, TIMER, in_zone, crosses, ground_x, ground_y, ground_speed, distance_m"
)
_HANDLERS: dict[type[exp.Expr], Callable[[_Translator, Any], Expr]] = {
    exp.Column: _Translator.column,
    exp.Placeholder: _Translator.placeholder,
    exp.Literal: _Translator.literal,
    exp.Boolean: _Translator.boolean,
    exp.Null: _Translator.null,
    exp.Interval: _Translator.interval,
    exp.Paren: _Translator.paren,
    exp.Between: _Translator.between,
    exp.In: _Translator.member,
    exp.Is: _Translator.is_null,
    exp.Case: _Translator.case,
    exp.Filter: _Translator.of_match,
    exp.Anonymous: _Translator.anonymous,
}
