"""DEFINE in queries: from expressions to what the matcher asks.

What a row and its neighbours decide is evaluated by DuckDB, over columns and once. What depends on the match becomes
a guard over the values of the row at hand and the registers. Guards compare and add plain values themselves, as
DuckDB would; for everything else they ask DuckDB, once for each combination of values.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from sqlglot import exp

from patterns.binding import guards
from patterns.binding.bound import How, Register
from patterns.binding.guards import Guard
from patterns.binding.registers import listed
from patterns.language.navigation import (
    AggregateReading,
    MatchNumber,
    Reading,
    RowReading,
    function_name,
    offset_of,
)
from patterns.language.syntax import Scalar
from patterns.querying.duck import Aggregated, Remembered, sql_of
from patterns.querying.ordered import OrderedRows
from patterns.querying.plain import (
    STRICT_FUNCTIONS,
    TIMES,
    WHOLE,
    NotAlike,
    Plain,
    common_number,
    number_as,
    operands,
    plain,
)
from patterns.querying.symbols import Symbols
from patterns.querying.values import compared, values_of

_COMPARED: dict[type[exp.Expr], Callable[[Any, Any], bool]] = {
    exp.EQ: lambda left, right: left == right, exp.NEQ: lambda left, right: left != right,
    exp.LT: lambda left, right: left < right, exp.LTE: lambda left, right: left <= right,
    exp.GT: lambda left, right: left > right, exp.GTE: lambda left, right: left >= right,
}  # fmt: skip
_STRICT: tuple[type[Any], ...] = (
    exp.Column, exp.Identifier, exp.Paren, exp.Neg, exp.Literal, exp.Interval, exp.Var, exp.IntervalSpan,
    exp.Add, exp.Sub, exp.Mul, exp.Div, exp.IntDiv, exp.Mod, *_COMPARED,
)  # fmt: skip
_PLAIN = frozenset((*WHOLE, *TIMES, "DOUBLE", "FLOAT", "VARCHAR", "DATE", "TIME", "BOOLEAN"))
_LAZY = ("COALESCE", "IFNULL")
_NUMBER_NAME = "match_number"


@dataclass(frozen=True, slots=True)
class Conditions:
    """All of DEFINE, ready to ask.

    Attributes:
        predicates: For each variable the conditions that rows decide, over the leaves.
        guards: For each variable what else must be true.
        reads: For each variable the registers that its guard reads.
        registers: What a match remembers.
        number: The register of the match's number, after the others; None: nobody asks for it.
        leaves: Expressions over the input's columns, and how many rows further on they are read.
        slots: Expressions over the leaves, which registers and guards read.
        places: Where predicates, leaves and slots were written first, by their text.
    """

    predicates: tuple[tuple[str, ...], ...]
    guards: tuple[Guard | None, ...]
    reads: tuple[frozenset[int], ...]
    registers: tuple[Register, ...]
    number: int | None
    leaves: tuple[tuple[str, int], ...]
    slots: tuple[str, ...]
    places: Mapping[str, int]

    def evaluated(self, symbols: Symbols, rows: OrderedRows) -> tuple[list[NDArray[np.bool_]], list[tuple[Any, ...]]]:
        """For each variable the rows whose predicates hold, and for each row the values of the slots.

        Raises:
            MatchError: An expression fails on a row.
        """
        table = self.leaf_table(symbols, rows)
        asked = list(dict.fromkeys(each for every in self.predicates for each in every))
        answers = self.columns(symbols, table, asked, "coalesce(({}), false)")
        truths = {each: np.asarray(answer, dtype=bool) for each, answer in zip(asked, answers, strict=True)}
        true = np.ones(rows.table.num_rows, dtype=bool)
        able = [np.logical_and.reduce([true, *(truths[each] for each in every)]) for every in self.predicates]
        slots = [values_of(column) for column in self.columns(symbols, table, self.slots)]
        return able, list(zip(*slots, strict=True)) if slots else [()] * rows.table.num_rows

    def leaf_table(self, symbols: Symbols, rows: OrderedRows) -> pa.Table:
        """The leaves as columns."""
        texts = list(dict.fromkeys(text for text, _ in self.leaves))
        known = dict(zip(texts, self.columns(symbols, rows.table, texts), strict=True))
        columns = {f"r{index}": rows.shifted(known[text], shift) for index, (text, shift) in enumerate(self.leaves)}
        return pa.table({"rows": pa.array(np.arange(rows.table.num_rows)), **columns})

    def columns(
        self, symbols: Symbols, table: pa.Table, texts: Sequence[str], form: str = "{}"
    ) -> list[pa.ChunkedArray]:
        """The expressions, each in this form, over the table."""
        wanted = [form.format(text) for text in texts]
        return symbols.evaluated(table, wanted, "DEFINE", [self.places[text] for text in texts])


def conditions_of(symbols: Symbols) -> Conditions:
    """The conditions of all variables; those without DEFINE have none.

    Raises:
        RuleError: DEFINE is not right.
    """
    builder = _Builder(symbols)
    defines = {define.name.key: define.value for define in symbols.clause.defines}
    for index, variable in enumerate(symbols.variables):
        builder.define(index, defines.get(variable))
    return builder.built()


@dataclass(frozen=True, slots=True)
class _Place:
    """What a name in a taken-apart expression stands for: a type, how to read it, and where it comes from."""

    kind: str
    read: Guard
    registers: frozenset[int] = frozenset()
    leaf: exp.Expr | None = None
    anchor: tuple[Any, ...] | None = None


class _Builder:
    """Takes conditions apart; each part is kept once."""

    def __init__(self, symbols: Symbols) -> None:
        self.symbols = symbols
        self.leaves: dict[tuple[str, int], str] = {}
        self.leaf_types: dict[str, str] = {}
        self.slots: dict[str, int] = {}
        self.registers: dict[Register, int] = {}
        self.places: dict[str, _Place] = {}
        self.needs_number = False
        self.written: dict[str, int] = {}
        self.predicates: list[tuple[str, ...]] = []
        self.guards: list[Guard | None] = []
        self.reads: list[frozenset[int]] = []

    def built(self) -> Conditions:
        return Conditions(
            tuple(self.predicates), tuple(self.guards), tuple(self.reads), tuple(self.registers),
            len(self.registers) if self.needs_number else None, tuple(self.leaves), tuple(self.slots),
            self.written,
        )  # fmt: skip

    def define(self, variable: int, scalar: Scalar | None) -> None:
        if scalar is None:
            self.predicates.append(())
            self.guards.append(None)
            self.reads.append(frozenset())
            return
        self.variable, self.scalar = variable, scalar
        self.reader = self.symbols.reader("DEFINE", scalar)
        tree = self.taken_apart(self.symbols.checked("DEFINE", scalar))
        self.check_condition(tree)
        predicates: list[exp.Expr] = []
        dependent: list[exp.Expr] = []
        for part in _conjuncts(tree):
            is_row_local = all(name in self.leaf_types for name in _names(part))
            (predicates if is_row_local else dependent).append(part)
        whole = [self.lifted(part) for part in dependent]
        self.predicates.append(tuple(self.text(part) for part in predicates))
        self.reads.append(frozenset(at for part in whole for name in _names(part) for at in self.place(name).registers))
        self.guards.append(guards.every([self.compiled(part) for part in whole]) if whole else None)

    def check_condition(self, tree: exp.Expr) -> None:
        kind = self.symbols.check_types("DEFINE", self.scalar, tree, self.types())
        if kind != "BOOLEAN" and not isinstance(tree.unnest(), exp.Null):
            raise self.symbols.clause.passage.error(f"DEFINE: wanted a condition, got {kind}", self.scalar.at)

    def types(self) -> dict[str, str]:
        return {**self.leaf_types, **{name: place.kind for name, place in self.places.items()}}

    # From readings to places.

    def taken_apart(self, tree: exp.Expr) -> exp.Expr:
        def placed(node: exp.Expr) -> exp.Expr:
            reading = self.reader.reading(node)
            return node if reading is None else self.placed(reading)

        return tree.transform(placed)

    def placed(self, reading: Reading) -> exp.Expr:
        if isinstance(reading, MatchNumber):
            return self.number()
        if isinstance(reading, AggregateReading):
            return self.aggregate(reading)
        if _has(reading.operand, "MATCH_NUMBER"):
            return self.pushed_down(reading)
        if _has(reading.operand, "CLASSIFIER"):
            return self.classified(reading)
        if self.is_current(reading):
            return self.leaf(reading.operand, reading.shift)
        return self.remembered(reading)

    def is_current(self, reading: RowReading) -> bool:
        """Whether it starts from the row at hand: the last one of its frame is that."""
        own = self.symbols.variables[self.variable]
        return reading.which == "last" and reading.offset == 0 and (reading.frame is None or own in reading.frame)

    def number(self) -> exp.Expr:
        self.needs_number = True
        self.places[_NUMBER_NAME] = _Place("BIGINT", lambda values, registers: registers[-1])
        return exp.column(_NUMBER_NAME)

    def pushed_down(self, reading: RowReading) -> exp.Expr:
        """The operand with each of its columns read by itself: the match's number is none of a row."""

        def each(node: exp.Expr) -> exp.Expr:
            if function_name(node) == "MATCH_NUMBER":
                return self.number()
            if isinstance(node, exp.Column) or function_name(node) == "CLASSIFIER":
                return self.placed(replace(reading, operand=node))
            return node

        return reading.operand.transform(each)

    def classified(self, reading: RowReading) -> exp.Expr:
        if reading.shift < 0 and reading.frame is None and reading.which == "last":
            # The rows of a match follow each other: n rows back from its last is its last but n.
            reading = replace(reading, offset=reading.offset - reading.shift, shift=0)
        if reading.shift != 0:
            return self.label_near(reading)
        if self.is_current(reading):
            return self.leaf(_labelled(reading.operand, self.symbols.variables[self.variable]), 0)
        slots = tuple(self.slot(self.leaf(_labelled(reading.operand, each), 0)) for each in self.symbols.variables)
        leaf = self.leaf(_labelled(reading.operand, self.symbols.variables[0]), 0)
        register = Register(self.symbols.indices(reading.frame), reading.which, slots[0], reading.offset, slots)
        return self.register(register, self.leaf_types[leaf.name])

    def label_near(self, reading: RowReading) -> exp.Expr:
        """The variable of a row that lies some rows from one of the match; NULL where it is none of the match."""
        if function_name(reading.operand) != "CLASSIFIER":
            self.fail("CLASSIFIER stands by itself inside PREV and NEXT of a variable", reading.operand)
        index = self.register_of(Register(None, "list", None, 0, self.label_slots()))
        names = self.symbols.variables if reading.frame is None else reading.frame

        def read(values: Sequence[Any], registers: Sequence[Any]) -> Any:
            labels = listed(registers[index])
            mapped = [at for at, label in enumerate(labels) if label in names]
            wanted = reading.offset if reading.which == "first" else len(mapped) - 1 - reading.offset
            if not 0 <= wanted < len(mapped):
                return None
            at = mapped[wanted] + reading.shift
            return labels[at] if 0 <= at < len(labels) else None

        return self.new_place(_Place("VARCHAR", read, frozenset((index,))))

    def label_slots(self) -> tuple[int, ...]:
        return tuple(self.slot(exp.Literal.string(variable)) for variable in self.symbols.variables)

    def leaf(self, operand: exp.Expr, shift: int) -> exp.Expr:
        """The name of the operand's value at a row so many rows further on."""
        resolved = self.symbols.over_columns(operand, "DEFINE", self.scalar.at)
        key = (self.text(resolved), shift)
        if key not in self.leaves:
            name = f"r{len(self.leaves)}"
            self.leaf_types[name] = self.symbols.check_types("DEFINE", self.scalar, resolved, self.symbols.types)
            self.leaves[key] = name
        return exp.column(self.leaves[key])

    def slot(self, expression: exp.Expr) -> int:
        return self.slots.setdefault(self.text(expression), len(self.slots))

    def text(self, expression: exp.Expr) -> str:
        """The expression in SQL; where it was written is remembered."""
        found = sql_of(expression)
        self.written.setdefault(found, self.scalar.at)
        return found

    def remembered(self, reading: RowReading) -> exp.Expr:
        leaf = self.leaf(reading.operand, reading.shift)
        anchor = (self.symbols.indices(reading.frame), reading.which, reading.offset)
        return self.remembered_at(anchor, leaf, self.leaf_types[leaf.name])

    def remembered_at(self, anchor: tuple[Any, ...], leaf: exp.Expr, kind: str) -> exp.Expr:
        variables, which, offset = anchor
        register = Register(variables, which, self.slot(leaf), offset)
        return self.register(register, kind, leaf, anchor)

    def register(
        self, register: Register, kind: str, leaf: exp.Expr | None = None, anchor: tuple[Any, ...] | None = None
    ) -> exp.Expr:
        index = self.register_of(register)
        return self.new_place(
            _Place(kind, guards.register(register.how, register.offset, index), frozenset((index,)), leaf, anchor)
        )

    def register_of(self, register: Register) -> int:
        return self.registers.setdefault(register, len(self.registers))

    def new_place(self, place: _Place) -> exp.Expr:
        name = f"g{len(self.places)}"
        self.places[name] = place
        return exp.column(name)

    def place(self, name: str) -> _Place:
        """What the name stands for; a leaf is the value of a slot."""
        if name in self.places:
            return self.places[name]
        return _Place(self.leaf_types[name], _read_slot(self.slot(exp.column(name))))

    # Aggregates.

    def aggregate(self, reading: AggregateReading) -> exp.Expr:
        call = reading.call
        variables = self.symbols.indices(reading.frame)
        if isinstance(call, exp.Anonymous) and not _has(call, "MATCH_NUMBER"):
            if function_name(call) == "COUNT" and (not call.expressions or _is_star(call.expressions[0])):
                return self.register(Register(variables, "rows", None), "BIGINT")
            plain = self.plain_aggregate(call, variables)
            if plain is not None:
                return plain
        return self.listed_aggregate(reading)

    def plain_aggregate(self, call: exp.Anonymous, variables: tuple[int, ...] | None) -> exp.Expr | None:
        """COUNT, SUM, MIN, MAX and AVG of plain values, kept up row by row; None: not one of these."""
        name = function_name(call)
        if len(call.expressions) != 1 or isinstance(call.expressions[0], exp.Distinct | exp.Order):
            return None
        leaves = [self.leaf(_labelled(call.expressions[0], each), 0) for each in self.symbols.variables]
        slots = tuple(self.slot(leaf) for leaf in leaves)
        kind = self.leaf_types[leaves[0].name]
        if not _can_keep_up(name, kind):
            return None

        def kept(how: How) -> int:
            return self.register_of(Register(variables, how, slots[0], 0, slots if len(set(slots)) > 1 else None))

        given = self.symbols.check_types("DEFINE", self.scalar, exp.Anonymous(this=name, expressions=[leaves[0]]),
                                         self.types())  # fmt: skip
        if name in ("AVG", "MEAN"):
            total, count = kept("sum"), kept("values")
            return self.new_place(_Place(given, _average(total, count), frozenset((total, count))))
        hows: dict[str, How] = {"COUNT": "values", "SUM": "sum", "MIN": "min", "MAX": "max"}
        index = kept(hows[name])
        return self.new_place(_Place(given, lambda values, registers: registers[index], frozenset((index,))))

    def listed_aggregate(self, reading: AggregateReading) -> exp.Expr:
        """Any aggregate: what it reads is listed row by row, and DuckDB is asked."""
        variables = self.symbols.indices(reading.frame)
        lists: list[tuple[int, str]] = []

        def each(node: exp.Expr) -> exp.Expr:
            if function_name(node) == "MATCH_NUMBER":
                self.number()
                return exp.column(_NUMBER_NAME)
            if isinstance(node, exp.Column) and isinstance(node.this, exp.Star):
                return exp.Star()
            if isinstance(node, exp.Column) or function_name(node) == "CLASSIFIER":
                lists.append(self.listed(node, variables))
                return exp.column(f"a{len(lists) - 1}")
            return node

        call = reading.call.transform(each)
        if not lists:
            lists.append((self.register_of(Register(variables, "list", None, 0, self.label_slots())), "VARCHAR"))
        kinds = {f"a{index}": kind for index, (_, kind) in enumerate(lists)}
        number = {_NUMBER_NAME: "BIGINT"}
        given = self.symbols.check_types("DEFINE", self.scalar, call, kinds | number)
        ask = Aggregated(self.symbols.duck, sql_of(call), kinds | number)
        indices = [index for index, _ in lists]
        at = self.scalar.at

        def read(values: Sequence[Any], registers: Sequence[Any]) -> Any:
            number = registers[-1] if self.needs_number else 0
            columns = [listed(registers[index]) for index in indices]
            with self.symbols.placed("DEFINE", at):
                return ask([*columns, [number] * len(columns[0])])

        return self.new_place(_Place(given, read, frozenset(indices)))

    def listed(self, node: exp.Expr, variables: tuple[int, ...] | None) -> tuple[int, str]:
        if isinstance(node, exp.Column):
            leaf = self.leaf(node, 0)
            return self.register_of(Register(variables, "list", self.slot(leaf))), self.leaf_types[leaf.name]
        return self.register_of(Register(variables, "list", None, 0, self.label_slots())), "VARCHAR"

    # From trees to guards.

    def lifted(self, node: exp.Expr) -> exp.Expr:
        """The tree with its largest parts that one row decides as one value each, evaluated over columns."""
        names = _names(node)
        if isinstance(node, exp.Column) or not names:
            return node
        if all(name in self.leaf_types for name in names):
            slot = self.slot(node)
            kind = self.symbols.check_types("DEFINE", self.scalar, node, self.types())
            return self.new_place(_Place(kind, _read_slot(slot)))
        anchors = {self.places[name].anchor if name in self.places else None for name in names}
        if len(anchors) == 1 and None not in anchors and all(_is_strict(part) for part in node.walk()):
            leaf = node.transform(self.as_leaf)
            kind = self.symbols.check_types("DEFINE", self.scalar, leaf, self.types())
            (anchor,) = anchors
            assert anchor is not None, "checked"
            return self.remembered_at(anchor, leaf, kind)
        changed = node.copy()
        for child in list(changed.iter_expressions()):
            child.replace(self.lifted(child))
        return changed

    def as_leaf(self, node: exp.Expr) -> exp.Expr:
        leaf = self.places[node.name].leaf if isinstance(node, exp.Column) else None
        return node if leaf is None else leaf.copy()

    def compiled(self, node: exp.Expr) -> Guard:
        if isinstance(node, exp.Paren):
            return self.compiled(node.this)
        if isinstance(node, exp.Column):
            return self.place(node.name).read
        if not _names(node):
            return guards.constant(self.symbols.duck.value(sql_of(node)))
        if isinstance(node, exp.And | exp.Or):
            parts = [self.compiled(node.this), self.compiled(node.expression)]
            return guards.every(parts) if isinstance(node, exp.And) else guards.some(parts)
        if isinstance(node, exp.Not):
            return _negation(self.compiled(node.this))
        if isinstance(node, exp.Is) and isinstance(node.expression, exp.Null):
            return guards.is_null(self.compiled(node.this))
        if isinstance(node, exp.Between) and not node.args.get("symmetric"):
            low = exp.GTE(this=node.this.copy(), expression=node.args["low"].copy())
            high = exp.LTE(this=node.this.copy(), expression=node.args["high"].copy())
            return guards.every([self.compiled(low), self.compiled(high)])
        if isinstance(node, exp.In) and node.expressions:
            return guards.some([self.compiled(exp.EQ(this=node.this.copy(), expression=item.copy()))
                         for item in node.expressions])  # fmt: skip
        if type(node) in _COMPARED:
            kinds = self.kinds([node.this, node.expression])
            if any(kind.startswith("ENUM") for kind in kinds):
                return self.asked(node)
            left, right = self.comparable([node.this, node.expression], kinds)
            return _comparison(_COMPARED[type(node)], left, right, self.asked(node))
        if isinstance(node, exp.Case) and node.this is None and self.has_one_type(node):
            return self.case(node)
        return self.computed(node)

    def kinds(self, nodes: Sequence[exp.Expr]) -> list[str]:
        return self.symbols.duck.types([sql_of(node) for node in nodes], self.types())

    def comparable(self, nodes: Sequence[exp.Expr], kinds: Sequence[str]) -> list[Guard]:
        """What is compared; of numbers of several types, as DuckDB makes one type of them."""
        common = common_number(kinds)
        below = []
        for node, kind in zip(nodes, kinds, strict=True):
            guard = self.compiled(node)
            make = number_as(kind, common) if common not in (None, kind) else None
            if make is not None:
                guard = _applied(Plain(make), [guard], guard)
            below.append(guard if _names(node) else guards.constant(guard((), ())))
        return below

    def has_one_type(self, case: exp.Case) -> bool:
        """Whether each branch has the type that CASE has, so that none is converted."""
        branches = [part.args["true"] for part in case.args["ifs"]]
        default = case.args.get("default")
        return len(set(self.kinds([case, *branches, *([] if default is None else [default])]))) == 1

    def case(self, node: exp.Case) -> Guard:
        branches = [(self.compiled(part.this), self.compiled(part.args["true"])) for part in node.args["ifs"]]
        default = node.args.get("default")
        otherwise = guards.constant(None) if default is None else self.compiled(default)

        def chosen(values: Sequence[Any], registers: Sequence[Any]) -> Any:
            for condition, value in branches:
                if condition(values, registers) is True:
                    return value(values, registers)
            return otherwise(values, registers)

        return chosen

    def computed(self, node: exp.Expr) -> Guard:
        """What Python computes as DuckDB does; else what DuckDB says."""
        parts = operands(node)
        if not parts:
            return self.asked(node)
        *kinds, given = self.kinds([*parts, node])
        known = plain(node, kinds, given)
        if known is None:
            return self.asked(node)
        applied = _first_known if function_name(node) in _LAZY else _applied
        return applied(known, [self.compiled(part) for part in parts], self.asked(node))

    def asked(self, node: exp.Expr) -> Guard:
        """What DuckDB says of the node, for these values."""
        names = sorted(_names(node))
        places = [self.place(name) for name in names]
        kinds = {name: place.kind for name, place in zip(names, places, strict=True)}
        ask = Remembered(self.symbols.duck, sql_of(node), kinds)
        reads = [place.read for place in places]
        at = self.scalar.at

        def answer(values: Sequence[Any], registers: Sequence[Any]) -> Any:
            with self.symbols.placed("DEFINE", at):
                return ask([read(values, registers) for read in reads])

        return answer

    def fail(self, message: str, node: exp.Expr) -> NoReturn:
        raise self.symbols.clause.passage.error(f"DEFINE: {message}", offset_of(node, self.scalar.at))


def _names(node: exp.Expr) -> frozenset[str]:
    """The places that the tree reads."""
    return frozenset(part.name for part in node.walk() if isinstance(part, exp.Column))


def _conjuncts(node: exp.Expr) -> list[exp.Expr]:
    node = node.unnest()
    if isinstance(node, exp.And):
        return [*_conjuncts(node.this), *_conjuncts(node.expression)]
    return [node]


def _has(operand: exp.Expr, function: str) -> bool:
    return any(function_name(part) == function for part in operand.walk())


def _labelled(operand: exp.Expr, variable: str) -> exp.Expr:
    """The operand at a row of this variable."""

    def each(node: exp.Expr) -> exp.Expr:
        return exp.Literal.string(variable) if function_name(node) == "CLASSIFIER" else node

    return operand.transform(each)


def _is_star(node: exp.Expr) -> bool:
    return isinstance(node, exp.Star) or (isinstance(node, exp.Column) and isinstance(node.this, exp.Star))


def _can_keep_up(name: str, kind: str) -> bool:
    if name == "COUNT":
        return True
    if name in ("MIN", "MAX"):
        return kind in _PLAIN or kind.startswith("DECIMAL")
    if name == "SUM":
        return kind in WHOLE or kind == "DOUBLE" or kind.startswith("DECIMAL")
    return name in ("AVG", "MEAN") and (kind in WHOLE or kind == "DOUBLE")


def _read_slot(slot: int) -> Guard:
    return lambda values, registers: values[slot]


def _average(total: int, count: int) -> Guard:
    return lambda values, registers: None if not registers[count] else registers[total] / registers[count]


def _negation(part: Guard) -> Guard:
    def negated(values: Sequence[Any], registers: Sequence[Any]) -> Any:
        value = part(values, registers)
        return None if value is None else not value

    return negated


def _is_strict(node: exp.Expr) -> bool:
    """Whether the node is NULL where a part of it is, and fails for no value."""
    return isinstance(node, _STRICT) or function_name(node) in STRICT_FUNCTIONS


def _comparison(compare: Callable[[Any, Any], bool], left: Guard, right: Guard, ask: Guard) -> Guard:
    def holds(values: Sequence[Any], registers: Sequence[Any]) -> Any:
        first = left(values, registers)
        second = right(values, registers)
        if first is None or second is None:
            return None
        answer = compared(compare, first, second)
        return ask(values, registers) if answer is None else answer

    return holds


def _first_known(known: Plain, below: Sequence[Guard], ask: Guard) -> Guard:
    """The first value that is not NULL, as the operator makes it; what comes after it may fail."""

    def chosen(values: Sequence[Any], registers: Sequence[Any]) -> Any:
        found: list[Any] = [None] * len(below)
        for at, part in enumerate(below):
            found[at] = part(values, registers)
            if found[at] is not None:
                break
        try:
            return known.operator(*found)
        except (ArithmeticError, ValueError, NotAlike):
            return ask(values, registers)

    return chosen


def _applied(known: Plain, below: Sequence[Guard], ask: Guard) -> Guard:
    """The operator over the parts' values; where Python cannot say, what DuckDB says."""

    def computed(values: Sequence[Any], registers: Sequence[Any]) -> Any:
        found = [part(values, registers) for part in below]
        if None in found and not known.takes_null:
            return None
        try:
            return known.operator(*found)
        except (ArithmeticError, ValueError, NotAlike):
            return ask(values, registers)

    return computed
