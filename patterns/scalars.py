"""From sqlglot's scalar trees to ours: names resolved, types checked, the rest refused.

What a column name means depends on where it stands (`Scope`): in DEFINE the row
at hand, or the last row mapped to another variable; in MEASURES the last row of
the variable, or of the match.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NoReturn

from sqlglot import exp

from patterns.errors import NotSupportedYet, RuleError
from patterns.expressions import (
    Aggregate,
    Call,
    Column,
    Const,
    Crosses,
    Expr,
    InZone,
    Kind,
    OneOf,
    OnGround,
    Reference,
    Shift,
    Which,
    is_constant,
    operands,
    rebuilt,
    walk,
)
from patterns.geometry import DIRECTIONS
from patterns.ground import GroundValue
from patterns.guards import constant_value
from patterns.literals import VARIABLE_UNITS, interval, number
from patterns.scope import Scope, constant
from patterns.syntax import Scalar
from patterns.text import did_you_mean
from patterns.tokens import canonical_name
from patterns.typing_rules import TypeMismatch, as_float, typed_call

PREV_MOST = 1_000

_BINARY: dict[type[exp.Expression], str] = {
    exp.Add: "+", exp.Sub: "-", exp.Mul: "*", exp.Div: "/", exp.Mod: "%", exp.EQ: "=", exp.NEQ: "<>",
    exp.LT: "<", exp.LTE: "<=", exp.GT: ">", exp.GTE: ">=", exp.And: "and", exp.Or: "or",
}  # fmt: skip
_FUNCTIONS: dict[type[exp.Expression], str] = {
    exp.Abs: "abs", exp.Sqrt: "sqrt", exp.Least: "least", exp.Greatest: "greatest",
    exp.Coalesce: "coalesce", exp.Neg: "neg", exp.Not: "not",
}  # fmt: skip


def translate(scalar: Scalar, scope: Scope) -> Expr:
    """The expression with its names resolved in this scope.

    Raises:
        RuleError: A name that is not there, or operands of wrong types.
        NotSupportedYet: SQL outside the subset.
    """
    return _Translator(scope, scalar.at).expr(scalar.node)


class _Translator:
    """One method for each kind of node; `at` is where to point when a node knows no place."""

    def __init__(self, scope: Scope, at: int) -> None:
        self.scope = scope
        self.at = at

    def expr(self, node: exp.Expression) -> Expr:
        handler = _HANDLERS.get(type(node))
        if handler is not None:
            return handler(self, node)
        if type(node) in _BINARY:
            return self.call(_BINARY[type(node)], node, (node.this, node.expression))
        if type(node) in _FUNCTIONS:
            return self.call(_FUNCTIONS[type(node)], node, (node.this, *node.expressions))
        raise self.refusal(_named(node), node)

    def call(self, op: str, node: exp.Expression, parts: tuple[exp.Expression, ...]) -> Expr:
        return self.typed(op, node, tuple(self.expr(part) for part in parts))

    def typed(self, op: str, node: exp.Expression, operands: tuple[Expr, ...]) -> Expr:
        try:
            return typed_call(op, operands)
        except TypeMismatch as error:
            self.fail(str(error), node)

    # Names.

    def column(self, node: exp.Expression) -> Expr:
        if isinstance(node.this, exp.Star):
            self.fail("v.* stands in COUNT only", node)
        if node.args.get("db") or node.args.get("catalog"):
            self.refuse("a column name of more than two parts", node)
        variable = self.variable(node)
        column = self.bare_column(node.this)
        if variable is None:
            return column if self.scope.has_row else Reference(None, "last", column)
        if variable == self.scope.own:
            return column
        return Reference((variable,), "last", column)

    def bare_column(self, identifier: exp.Expression) -> Column:
        name = identifier.name if identifier.args.get("quoted") else identifier.name.lower()
        kind = self.scope.columns.get(name)
        if kind is not None:
            return Column(name, kind)
        if name in self.scope.unreadable:
            self.fail(f"column {name} has the Arrow type {self.scope.unreadable[name]}, which rules cannot read",
                      identifier)  # fmt: skip
        have = ", ".join(sorted(self.scope.columns))
        raise self.error(f"unknown column {identifier.name!r}; there are: {have}", identifier)

    def variable(self, node: exp.Expression) -> str | None:
        """The shown name of the variable before the dot."""
        table = node.args.get("table")
        if table is None:
            return None
        key = canonical_name(table.name, bool(table.args.get("quoted")))
        if key not in self.scope.variables:
            have = ", ".join(self.scope.variables.values()) or "none here"
            self.fail(f"unknown pattern variable {table.name!r}; there are: {have}", table)
        return self.scope.variables[key]

    def placeholder(self, node: exp.Expression) -> Expr:
        name = str(node.this or "")
        if name not in self.scope.params:
            have = ", ".join(sorted(self.scope.params)) or "none"
            message = f"{self.scope.clause}: unknown parameter :{name}; params has: {have}"
            raise self.scope.passage.error(message, self.param_offset(name))
        value = self.scope.params[name]
        if isinstance(value, tuple):
            message = f"{self.scope.clause}: :{name} is a list; it stands after IN only, as in `plate IN :{name}`"
            raise self.scope.passage.error(message, self.param_offset(name))
        return constant(value)

    def param_offset(self, name: str) -> int:
        found = self.scope.passage.text.find(f":{name}", self.at)
        return found if found >= 0 else self.at

    # Navigation and counting.

    def prev(self, node: exp.Expression) -> Expr:
        rows = 1
        if self.scope.clause == "WHERE":
            self.fail("PREV has no meaning in WHERE", node)
        if len(node.expressions) not in (1, 2):
            self.fail("PREV takes a column and, if wanted, a number of rows", node)
        if len(node.expressions) == 2:
            rows = self.whole_number(node.expressions[1])
        inner = self.framed(node, self.expr(node.expressions[0]))
        if isinstance(inner, Reference):
            return replace(inner, operand=Shift(inner.operand, rows))
        return Shift(inner, rows)

    def whole_number(self, node: exp.Expression) -> int:
        value = self.expr(node)
        if not isinstance(value, Const) or value.kind is not Kind.INT or not 0 <= int(value.value or 0) <= PREV_MOST:
            self.fail(f"PREV goes back by a whole number of 0 to {PREV_MOST} rows", node)
        return int(value.value or 0)

    def framed(self, node: exp.Expression, expr: Expr) -> Expr:
        """The expression as one over a single row: row-local, or one reference around it all."""
        frames = {(part.variables, part.which) for part in walk(expr) if isinstance(part, Reference)}
        if any(isinstance(part, Aggregate) for part in walk(expr)):
            self.refuse(f"COUNT inside {_named(node)}", node)
        if is_constant(expr):
            self.fail(f"{_named(node)} needs a column", node)
        if not frames:
            return expr
        if len(frames) > 1 or _has_free_column(expr):
            self.fail(f"{_named(node)} must read columns of one variable", node)
        variables, which = frames.pop()
        return Reference(variables, which, _without_references(expr))

    def first(self, node: exp.Expression) -> Expr:
        return self.navigation(node, "first")

    def last(self, node: exp.Expression) -> Expr:
        return self.navigation(node, "last")

    def navigation(self, node: exp.Expression, which: Which) -> Expr:
        name = which.upper()
        if node.args.get("expression") or node.args.get("expressions"):
            self.refuse(f"{name} with an offset", node)
        if self.scope.clause == "WHERE":
            self.fail(f"{name} has no meaning in WHERE", node)
        for part in node.this.walk():
            if isinstance(part, exp.First | exp.Last | exp.Count) or _is_prev(part):
                self.refuse(f"{_named(part)} inside {name}", part)
        operand = self.framed(node, self.expr(node.this))
        if isinstance(operand, Reference):
            return replace(operand, which=which)
        qualified = {self.variable(column) for column in node.this.find_all(exp.Column)}
        if len(qualified) > 1:
            self.fail(f"{name} must read columns of one variable", node)
        if which == "last":
            return operand
        variable = qualified.pop()
        return Reference(None if variable is None else (variable,), "first", operand)

    def count(self, node: exp.Expression) -> Expr:
        counted = node.this
        if self.scope.clause == "WHERE":
            self.fail("COUNT has no meaning in WHERE", node)
        if isinstance(counted, exp.Star) and not node.expressions:
            return Aggregate(None, "rows", None, Kind.INT)
        if not isinstance(counted, exp.Column) or node.expressions:
            self.refuse("COUNT of anything but *, v.* or v.column", node)
        variable = self.variable(counted)
        variables = None if variable is None else (variable,)
        if isinstance(counted.this, exp.Star):
            return Aggregate(variables, "rows", None, Kind.INT)
        return Aggregate(variables, "values", self.bare_column(counted.this), Kind.INT)

    # Literals.

    def literal(self, node: exp.Expression) -> Expr:
        if node.args.get("is_string"):
            return Const(str(node.this), Kind.STRING)
        try:
            return number(str(node.this))
        except TypeMismatch as error:
            raise self.error(str(error), node) from error

    def boolean(self, node: exp.Expression) -> Expr:
        return Const(bool(node.this), Kind.BOOL)

    def null(self, node: exp.Expression) -> Expr:
        return Const(None, Kind.NULL)

    def interval(self, node: exp.Expression) -> Expr:
        unit = node.args.get("unit")
        if not isinstance(unit, exp.Var) or not isinstance(node.this, exp.Literal):
            self.refuse("an INTERVAL other than of one number and one unit", node)
        name = unit.name.upper().removesuffix("S")
        if name in VARIABLE_UNITS:
            self.refuse(f"INTERVAL in {name}", node)
        try:
            return interval(str(node.this.this), name)
        except TypeMismatch as error:
            raise self.error(str(error), node) from error

    # Forms that are other forms in disguise.

    def paren(self, node: exp.Expression) -> Expr:
        return self.expr(node.this)

    def between(self, node: exp.Expression) -> Expr:
        if node.args.get("symmetric"):
            self.refuse("BETWEEN SYMMETRIC", node)
        value, low, high = (self.expr(part) for part in (node.this, node.args["low"], node.args["high"]))
        bounds = self.typed(">=", node, (value, low)), self.typed("<=", node, (value, high))
        return self.typed("and", node, bounds)

    def member(self, node: exp.Expression) -> Expr:
        field = node.args.get("field")
        if isinstance(field, exp.Placeholder):
            return self.one_of(node, field)
        if node.args.get("query") or node.args.get("unnest") or field:
            self.refuse("IN with a sub-query", node)
        items = node.expressions
        if len(items) == 1 and isinstance(items[0], exp.Placeholder) and self.is_list(items[0]):
            return self.one_of(node, items[0])
        value = self.expr(node.this)
        equals = [self.typed("=", node, (value, self.expr(item))) for item in node.expressions]
        result = equals[0]
        for equal in equals[1:]:
            result = self.typed("or", node, (result, equal))
        return result

    def is_list(self, node: exp.Expression) -> bool:
        return isinstance(self.scope.params.get(str(node.this or "")), tuple)

    def one_of(self, node: exp.Expression, listed: exp.Expression) -> Expr:
        """`value IN :list`."""
        name = str(listed.this or "")
        if name in self.scope.params and not self.is_list(listed):
            message = f"{self.scope.clause}: IN takes a list, and the parameter :{name} is none; write IN (:{name})"
            raise self.scope.passage.error(message, self.param_offset(name))
        if name not in self.scope.params:
            return self.placeholder(listed)
        value = self.expr(node.this)
        items = [constant(each) for each in self.scope.params[name]]
        kinds = {value.kind, *(item.kind for item in items)} - {Kind.NULL}
        if kinds == {Kind.INT, Kind.FLOAT}:
            value, items = as_float(value), [Const(float(item.value or 0), Kind.FLOAT) for item in items]
        elif len(kinds) > 1:
            shown = " and ".join(sorted(kind.value for kind in kinds))
            message = f"{self.scope.clause}: IN compares values of one type, got {shown}"
            raise self.scope.passage.error(message, self.param_offset(name))
        return OneOf(frozenset(item.value for item in items if item.value is not None), (value,))

    def is_null(self, node: exp.Expression) -> Expr:
        if not isinstance(node.expression, exp.Null):
            self.refuse("IS with anything but NULL", node)
        return self.call("is_null", node, (node.this,))

    def case(self, node: exp.Expression) -> Expr:
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

    def anonymous(self, node: exp.Expression) -> Expr:
        name = str(node.this).upper()
        if name == "PREV":
            return self.prev(node)
        if name == "IN_ZONE":
            return self.in_zone(node)
        if name == "CROSSES":
            return self.crosses(node)
        if name in _GROUND:
            return self.on_ground(node, name)
        if name == "TIMER":
            return self.timer(node)
        if name in _NOT_YET:
            self.refuse(name, node)
        raise self.error(f"unknown function {node.this}; there are: {_FUNCTIONS_SHOWN}", node)

    def timer(self, node: exp.Expression) -> Expr:
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

    def in_zone(self, node: exp.Expression) -> Expr:
        x, y, zone = self.arguments(node, "in_zone(x, y, 'zone')", 2, 1)
        name = self.name_in(zone, "zone", self.scope.zones)
        return InZone(name, self.with_source((self.number(x), self.number(y))))

    def crosses(self, node: exp.Expression) -> Expr:
        arguments = self.arguments(node, "crosses(x0, y0, x1, y1, 'line', 'direction')", 4, 2)
        line = self.name_in(arguments[4], "line", self.scope.lines)
        direction = arguments[5].this
        if direction not in DIRECTIONS:
            self.fail(f"unknown direction {direction!r}; there are: {', '.join(DIRECTIONS)}", arguments[5])
        return Crosses(line, direction, self.with_source(tuple(self.number(part) for part in arguments[:4])))

    def on_ground(self, node: exp.Expression, name: str) -> Expr:
        what, numbers, form = _GROUND[name]
        arguments = self.arguments(node, form, numbers, 0)
        return OnGround(what, self.with_source(tuple(self.number(part) for part in arguments)))

    def with_source(self, coordinates: tuple[Expr, ...]) -> tuple[Expr, ...]:
        """The coordinates after the source of their row, or of the row at hand where they are of several."""
        source = Column("source", Kind.STRING)
        parts = [part for coordinate in coordinates for part in walk(coordinate)]
        frames = {(part.variables, part.which) for part in parts if isinstance(part, Reference)}
        if len(frames) == 1 and not any(_has_free_column(coordinate) for coordinate in coordinates):
            return (Reference(*frames.pop(), source), *coordinates)
        return (source if self.scope.has_row else Reference(None, "last", source), *coordinates)

    def arguments(self, node: exp.Expression, form: str, numbers: int, names: int) -> list[exp.Expression]:
        arguments: list[exp.Expression] = node.expressions
        if len(arguments) != numbers + names:
            self.fail(f"wanted {form}, got {len(arguments)} arguments", node)
        for argument in arguments[numbers:]:
            if not isinstance(argument, exp.Literal) or not argument.is_string:
                self.fail(f"wanted {form}, with names in single quotes", argument)
        return arguments

    def name_in(self, node: exp.Expression, what: str, names: frozenset[str]) -> str:
        name = str(node.this)
        if name not in names and name not in self.scope.shared:
            have = ", ".join(sorted(names)) or "none"
            shared = f"; shared has: {', '.join(sorted(self.scope.shared))}" if self.scope.shared else ""
            like = did_you_mean(name, names | self.scope.shared)
            self.fail(f"unknown {what} {name!r}; {what}s has: {have}{shared}{like}", node)
        return name

    def number(self, node: exp.Expression) -> Expr:
        value = self.expr(node)
        if value.kind not in (Kind.INT, Kind.FLOAT, Kind.NULL):
            self.fail(f"a coordinate is a number, got {value.kind.value}", node)
        return as_float(value)

    # Errors.

    def refuse(self, what: str, node: exp.Expression) -> NoReturn:
        raise self.refusal(what, node)

    def refusal(self, what: str, node: exp.Expression) -> RuleError:
        message = f"{self.scope.clause}: {what} is not supported yet"
        return self.scope.passage.error(message, self.offset(node), NotSupportedYet)

    def fail(self, message: str, node: exp.Expression) -> NoReturn:
        raise self.error(message, node)

    def error(self, message: str, node: exp.Expression) -> RuleError:
        return self.scope.passage.error(f"{self.scope.clause}: {message}", self.offset(node))

    def offset(self, node: exp.Expression) -> int:
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


def _without_references(expr: Expr) -> Expr:
    if isinstance(expr, Reference):
        return expr.operand
    return rebuilt(expr, _without_references)


def _is_prev(node: exp.Expression) -> bool:
    return isinstance(node, exp.Anonymous) and str(node.this).upper() in ("PREV", "NEXT")


def _named(node: exp.Expression) -> str:
    """What to call the node in an error."""
    if isinstance(node, exp.Anonymous):
        return str(node.this).upper()
    if isinstance(node, exp.Func):
        return node.sql_name()
    if isinstance(node, exp.Query | exp.Subquery):
        return "a sub-query"
    return f"{type(node).__name__} ({node.sql()[:40]})"


_NOT_YET = frozenset(("NEXT", "CLASSIFIER", "MATCH_NUMBER", "RUNNING", "FINAL", "PERMUTE", "CURRENT_TIMESTAMP", "NOW"))
_GROUND: dict[str, tuple[GroundValue, int, str]] = {
    "GROUND_X": ("x", 2, "ground_x(x, y)"),
    "GROUND_Y": ("y", 2, "ground_y(x, y)"),
    "GROUND_SPEED": ("speed", 4, "ground_speed(x, y, vx, vy)"),
}
_FUNCTIONS_SHOWN = (
    "PREV, FIRST, LAST, COUNT, ABS, SQRT, LEAST, GREATEST, COALESCE, TIMER, in_zone, crosses, "
    "ground_x, ground_y, ground_speed"
)
_HANDLERS: dict[type[exp.Expression], Callable[[_Translator, Any], Expr]] = {
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
    exp.First: _Translator.first,
    exp.Last: _Translator.last,
    exp.Count: _Translator.count,
    exp.Anonymous: _Translator.anonymous,
}
