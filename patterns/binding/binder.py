"""Binding: a parsed rule against the columns of its event type.

Here names become columns, variables and registers, and conditions are taken
apart: what a row and its predecessors decide becomes a predicate that is
evaluated over columns, once however many variables use it; what depends on the
match becomes a guard over registers. Cheap: a rule is bound in milliseconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import pyarrow as pa

from patterns.binding.bound import BoundRule, Condition, Output, Register
from patterns.binding.expressions import (
    Aggregate,
    Call,
    Column,
    Const,
    Expr,
    Kind,
    MatchNumber,
    Reference,
    ahead,
    column_names,
    conjuncts,
    is_constant,
    is_row_local,
    is_strict,
    operands,
    reach,
    rebuilt,
    walk,
)
from patterns.binding.guards import constant_value
from patterns.binding.inputs import Readable, bind_arms
from patterns.binding.program import ProgramTooLarge, Tables, compile_pattern, tabulate
from patterns.binding.scalars import labelled, translate
from patterns.binding.scope import Scope
from patterns.binding.titles import check_formats, title_fields
from patterns.durations import microseconds
from patterns.errors import NotInRules, RuleError
from patterns.files.rule import Rule
from patterns.language.frames import frames_of
from patterns.language.parser import parse
from patterns.language.pattern_variables import pattern_variables
from patterns.language.syntax import (
    Identifier,
    Query,
    RowsPerMatch,
    Scalar,
)
from patterns.language.text import did_you_mean
from patterns.limits import Limits
from patterns.scene.geometry import FrameSize
from patterns.scene.site import Site

PREDICATES_MOST = 63
DURATION_MOST_US = 2**62
"""a time that lies so much before or after any other still has 64 bits"""
_DURATION_MOST = "2^62 microseconds (53375995 d)"


def bind(
    rule: Rule,
    schemas: Mapping[str, pa.Schema],
    frame_sizes: Mapping[str, FrameSize] | None = None,
    limits: Limits | None = None,
    site: Site | None = None,
) -> BoundRule:
    """The rule, ready to run.

    Args:
        rule: The rule.
        schemas: The event types there are, and the columns of each; the envelope's need not be among them.
        frame_sizes: For each source whose frame size is known, its (width, height) in pixels.
        limits: What the rule may use.
        site: What else is known of the cameras: shared zones and lines, calibrations, frame sizes.

    Raises:
        RuleError: A name that is not there, operands of wrong types, a pattern that can never match.
        NotInRules: SQL that a rule does not have.
    """
    query = parse(rule.passage("match"))
    return _Binder(rule, query, schemas, limits or Limits()).bound(_site(site, frame_sizes))


def _site(site: Site | None, frame_sizes: Mapping[str, FrameSize] | None) -> Site:
    known = Site() if site is None else site.copy()
    known.frame_sizes.update(frame_sizes or {})
    return known


@dataclass(slots=True)
class _Parts:
    """What conditions and measures were taken apart into, each part once."""

    predicates: dict[Expr, int] = field(default_factory=dict)
    slots: dict[Expr, int] = field(default_factory=dict)
    registers: dict[Register, int] = field(default_factory=dict)
    register_of: dict[Expr, int] = field(default_factory=dict)
    timers: dict[int, None] = field(default_factory=dict)


class _Binder:
    """One method for each clause."""

    def __init__(self, rule: Rule, query: Query, schemas: Mapping[str, pa.Schema], limits: Limits) -> None:
        self.rule = rule
        self.query = query
        self.clause = query.clause
        self.limits = limits
        self.parts = _Parts()
        self.variables: dict[str, str] = {}
        self.frames: dict[str, tuple[str, ...]] = {}
        self.readable = Readable({}, {})
        self.arms = bind_arms(query.arms, schemas, rule.rule, query.passage, self.of_event)
        self.readable = self.arms.readable
        shown: dict[str, str] = {}
        for name in pattern_variables(query.clause.pattern):
            shown.setdefault(name.key, name.key if name.name in shown.values() else name.name)
        self.variables = shown
        self.frames = {
            name: tuple(shown[member] for member in members) for name, members in frames_of(query.clause).items()
        }
        self.indices = {name: index for index, name in enumerate(shown.values())}

    def bound(self, site: Site) -> BoundRule:
        query, clause = self.query, self.clause
        self.check_order()
        self.check_rows()
        self.check_durations()
        keys = tuple(self.key(column) for column in clause.partition_by)
        conditions = self.conditions()
        measures = self.measures()
        title_columns = self.title_columns(measures, keys)
        within_us = self.within(clause.within) if clause.within else None
        skip_variables = self.skip_variables()
        try:
            program = compile_pattern(clause.pattern, tuple(self.variables), self.limits.positions)
            tables = tabulate(program)
        except ProgramTooLarge as error:
            raise query.passage.error(f"PATTERN: {error}", clause.pattern_at) from error
        self.check_once_per(measures, keys)
        parts = self.parts
        read = (*parts.predicates, *parts.slots)
        names = sorted(column_names(read) | set(keys) | {"source"})
        bound = BoundRule(
            rule=self.rule,
            timers=tuple(parts.timers),
            inputs=self.arms.inputs(names),
            variables=tuple(self.variables.values()),
            program=program,
            tables=tables,
            columns={name: self.readable.columns[name] for name in names},
            keys=keys,
            predicates=tuple(parts.predicates),
            slots=tuple(parts.slots),
            registers=tuple(parts.registers),
            register_of=dict(parts.register_of),
            conditions=conditions,
            measures=measures,
            title_columns=title_columns,
            within_us=within_us,
            skip=clause.skip.mode,
            skip_variables=skip_variables,
            reach=max((reach(expr) for expr in read), default=0),
            ahead=tuple(
                max((ahead(expr) for expr in self.read_at(*each)), default=0) for each in enumerate(conditions)
            ),
            is_numbered=any(isinstance(part, MatchNumber) for each in measures for part in walk(each.value)),
            looks_back=self.looks_back(tables, conditions),
            site=site,
            limits=self.limits,
        )
        self.check_can_match(bound)
        self.check_timers(bound)
        return bound

    # Names.

    def of_event(self, scalar: Scalar, clause: str, readable: Readable) -> Expr:
        """The expression over the columns of one event, in an arm of FROM."""
        scope = self.scope(clause, None, has_row=True)
        return translate(scalar, replace(scope, columns=readable.columns, unreadable=readable.unreadable))

    def key(self, column: Identifier) -> str:
        for name in (column.name, column.name.lower()):
            if name in self.readable.columns:
                return name
        have = ", ".join(sorted(self.readable.columns))
        like = did_you_mean(column.name, self.readable.columns)
        raise self.error(f"PARTITION BY: unknown column {column.name!r}; there are: {have}{like}", column.at)

    def check_order(self) -> None:
        """Checks that events stand in the one order that a rule has."""
        order = self.clause.order_by
        for index, ordering in enumerate(order):
            name, at = ordering.column.name, ordering.column.at
            if index > 1:
                raise self.refusal("ORDER BY more than time and sequence", at)
            if ordering.column.key != ("TIME", "SEQUENCE")[index]:
                raise self.refusal(f"ORDER BY {name}", at)
            if ordering.is_descending or ordering.nulls_first is not None:
                raise self.refusal("ORDER BY ... " + ("DESC" if ordering.is_descending else "NULLS"), at)
        if not order:
            raise self.error("a rule needs ORDER BY time", self.clause.at)

    def check_rows(self) -> None:
        if self.clause.rows is not RowsPerMatch.ONE:
            message = "ALL ROWS PER MATCH: a situation is one row, so a rule has ONE ROW PER MATCH"
            raise self.error(message, self.clause.rows_at)

    def refusal(self, what: str, at: int) -> RuleError:
        message = (
            f"rules have no {what}: events come by time, stream and sequence, the one order that a replay has too. "
            "Next: write ORDER BY time, sequence"
        )
        return self.query.passage.error(message, at, NotInRules)

    def scope(self, clause: str, own: str | None, has_row: bool) -> Scope:
        return Scope(
            passage=self.query.passage,
            clause=clause,
            columns=self.readable.columns,
            unreadable=self.readable.unreadable,
            variables=self.variables,
            frames=self.frames,
            own=own,
            has_row=has_row,
            params=self.rule.params,
            zones=frozenset(self.rule.zones),
            lines=frozenset(self.rule.lines),
            shared=frozenset(self.rule.shared),
        )

    # Clauses.

    def conditions(self) -> tuple[Condition, ...]:
        defined = {
            (shown := self.variables[define.name.key]): self.condition_of(define.value, "DEFINE", shown)
            for define in self.clause.defines
        }
        true = Const(True, Kind.BOOL)
        return tuple(self.taken_apart(defined.get(shown, true)) for shown in self.variables.values())

    def condition_of(self, scalar: Scalar, clause: str, own: str | None) -> Expr:
        expr = translate(scalar, self.scope(clause, own, has_row=True))
        if expr.kind not in (Kind.BOOL, Kind.NULL):
            raise self.error(f"{clause}: wanted a condition, got {expr.kind.value}", scalar.at)
        return lifted(expr)

    def taken_apart(self, condition: Expr) -> Condition:
        parts = self.parts
        predicates: dict[int, None] = {}
        guards = []
        for part in conjuncts(condition):
            if not is_row_local(part):
                guards.append(part)
                self.remember(part)
            elif not (is_constant(part) and constant_value(part) is True):
                predicates[parts.predicates.setdefault(part, len(parts.predicates))] = None
        if len(parts.predicates) > PREDICATES_MOST:
            message = f"DEFINE: more than {PREDICATES_MOST} different row-local conditions"
            raise self.error(message, self.clause.pattern_at)
        guard = Call("and", tuple(guards), Kind.BOOL) if len(guards) > 1 else guards[0] if guards else None
        dues = [part.operands[1] for part in guards if isinstance(part, Call) and part.op == "timer"]
        parts.timers |= dict.fromkeys(parts.register_of[due] for due in dues)
        return Condition(tuple(predicates), guard, is_timed=bool(dues))

    def measures(self) -> tuple[Output, ...]:
        outputs: dict[str, Output] = {}
        for measure in self.clause.measures:
            name = measure.name.name
            if name in outputs:
                raise self.error(f"MEASURES: {name!r} is named twice", measure.name.at)
            value = lifted(translate(measure.value, self.scope("MEASURES", None, has_row=False)))
            self.remember(value)
            outputs[name] = Output(name, value)
        return tuple(outputs.values())

    def within(self, scalar: Scalar) -> int:
        expr = translate(scalar, self.scope("WITHIN", None, has_row=True))
        value = constant_value(expr) if is_constant(expr) else None
        if expr.kind is not Kind.DURATION or not isinstance(value, int) or value <= 0:
            raise self.error("WITHIN: wanted a constant duration above zero", scalar.at)
        if value > DURATION_MOST_US:
            raise self.error(f"WITHIN: wanted at most {_DURATION_MOST}, got {value} us", scalar.at)
        return value

    def check_durations(self) -> None:
        """Checks that what is added to a time stays a time."""
        time, emit = self.rule.time, self.rule.emit
        settings = {
            ("time", "lateness"): time.lateness,
            ("time", "idle"): time.idle,
            ("emit", "cooldown"): emit.cooldown,
        }
        for (part, name), value in settings.items():
            if value is not None and microseconds(value) > DURATION_MOST_US:
                raise self.rule.error(f"{name}: wanted at most {_DURATION_MOST}, got {value.days} d", part, name)

    def skip_variables(self) -> tuple[int, ...]:
        variable = self.clause.skip.variable
        return () if variable is None else tuple(sorted(self.indices[name] for name in self.frames[variable.key]))

    def title_columns(self, measures: tuple[Output, ...], keys: tuple[str, ...]) -> tuple[Output, ...]:
        """What the title shows beside measures and partition columns: columns of the match's last row."""
        known = {*keys, *(measure.name for measure in measures)}
        outputs: dict[str, Output] = {}
        for name in title_fields(self.rule):
            if name in known:
                continue
            if name not in self.readable.columns:
                have = ", ".join(sorted(known | set(self.readable.columns)))
                like = did_you_mean(name, known | set(self.readable.columns))
                raise self.rule.error(f"title: unknown name {{{name}}}; there are: {have}{like}", "title")
            value = Reference(None, "last", Column(name, self.readable.columns[name]))
            self.remember(value)
            outputs[name] = Output(name, value)
        kinds = {key: self.readable.columns[key] for key in keys}
        kinds |= {output.name: output.value.kind for output in (*measures, *outputs.values())}
        check_formats(self.rule, kinds)
        return tuple(outputs.values())

    def check_once_per(self, measures: tuple[Output, ...], keys: tuple[str, ...]) -> None:
        known = {*keys, *(measure.name for measure in measures)}
        for name in self.rule.emit.once_per or ():
            if name not in known:
                have = ", ".join(sorted(known)) or "none"
                message = f"once_per: {name!r} is neither a partition column nor a measure; there are: {have}"
                raise self.rule.error(message, "emit", "once_per")

    # Taking expressions apart.

    def remember(self, expr: Expr) -> None:
        """Gives each part that reads the match a register, and each that reads the row a slot."""
        if isinstance(expr, Reference | Aggregate):
            self.parts.register_of[expr] = self.register(expr)
        elif is_row_local(expr) and not is_constant(expr):
            self.slot(expr)
        else:
            for operand in operands(expr):
                self.remember(operand)

    def register(self, expr: Reference | Aggregate) -> int:
        variables = None
        if expr.variables is not None:
            variables = tuple(sorted(self.indices[variable] for variable in expr.variables))
        slots: tuple[int, ...] = ()
        if expr.operand is not None:
            slots = tuple(self.slot(labelled(expr.operand, variable)) for variable in self.variables)
        slot = slots[0] if slots else None
        slot_of = slots if len(set(slots)) > 1 else None
        if isinstance(expr, Reference):
            register = Register(variables, expr.which, slot, expr.offset, slot_of)
        else:
            register = Register(variables, expr.how, slot, 0, slot_of)
        registers = self.parts.registers
        return registers.setdefault(register, len(registers))

    def slot(self, expr: Expr) -> int:
        return self.parts.slots.setdefault(expr, len(self.parts.slots))

    # What the whole comes to.

    def looks_back(self, tables: Tables, conditions: tuple[Condition, ...]) -> bool:
        """Whether a position can look further back than its distance from the match's first row."""
        own_reach = [
            max((reach(expr) for expr in self.read_at(index, condition)), default=0)
            for index, condition in enumerate(conditions)
        ]
        if tables.has_start_anchor:
            return True
        distance = dict.fromkeys(tables.firsts(), 0)
        queue = list(distance)
        for position in queue:
            for after in tables.follow[position]:
                if after not in distance:
                    distance[after] = distance[position] + 1
                    queue.append(after)
        return any(own_reach[tables.variables[at]] > far for at, far in distance.items())

    def read_at(self, variable: int, condition: Condition) -> list[Expr]:
        """What a row alone decides, and the variable's condition, or what is remembered of its rows, reads."""
        predicates, slots = tuple(self.parts.predicates), tuple(self.parts.slots)
        read = [predicates[index] for index in condition.predicates]
        read += [] if condition.guard is None else _row_local_parts(condition.guard)
        read += [
            slots[slot]
            for register in self.parts.registers
            if register.takes(variable) and (slot := register.slot_for(variable)) is not None
        ]
        return read

    def check_can_match(self, bound: BoundRule) -> None:
        tables = bound.tables
        hopeless = {
            index for index, condition in enumerate(bound.conditions)
            if any(is_constant(bound.predicates[at]) for at in condition.predicates)
        }  # fmt: skip
        if not tables.firsts():
            message = "PATTERN: it can only match no row at all, which is never a situation"
            raise self.error(message, self.clause.pattern_at)
        queue = [at for at in tables.firsts() if tables.variables[at] not in hopeless]
        reached = set(queue)
        for position in queue:
            if tables.accepts_end[position]:
                return
            for after in tables.follow[position]:
                if tables.variables[after] not in hopeless and after not in reached:
                    reached.add(after)
                    queue.append(after)
        names = ", ".join(bound.variables[index] for index in sorted(hopeless)) or "its anchors"
        raise self.error(f"PATTERN: it can never match, because {names} can never be true", self.clause.pattern_at)

    def check_timers(self, bound: BoundRule) -> None:
        """Checks that nothing in the rule asks for what virtual rows do not have: a place among the real ones."""
        timed = [name for name, is_timed in zip(bound.variables, bound.timed, strict=True) if is_timed]
        if not timed:
            return
        clause = self.clause
        skipped = [bound.variables[at] for at in bound.skip_variables if bound.timed[at]]
        if skipped and clause.skip.variable is not None:
            message = f"AFTER MATCH SKIP: {skipped[0]} has TIMER, and no match begins at a virtual row"
            raise self.error(message, clause.skip.variable.at)
        if bound.tables.accepts != bound.tables.accepts_end:
            message = f"PATTERN: $ asks for the partition's last row, and {timed[0]} has TIMER: no row is the last then"
            raise self.error(message, clause.pattern_at)
        if all(bound.timed[bound.tables.variables[at]] for at in bound.tables.firsts()):
            message = f"PATTERN: no match begins at a virtual row, and {timed[0]} has TIMER"
            raise self.error(message, clause.pattern_at)

    def error(self, message: str, at: int) -> RuleError:
        return self.query.passage.error(message, at)


def _row_local_parts(guard: Expr) -> list[Expr]:
    if is_row_local(guard):
        return [guard]
    if isinstance(guard, Reference | Aggregate):
        return []
    return [part for operand in operands(guard) for part in _row_local_parts(operand)]


def lifted(expr: Expr) -> Expr:
    """The expression with references around the largest parts that one row of the match decides.

    `entry.time + :dwell` becomes one remembered value instead of an addition for every row. Only
    strict operators may be lifted: NULL before the variable's first row must stay NULL.
    """
    expr = rebuilt(expr, lifted)
    if isinstance(expr, Reference | Aggregate) or not is_strict(expr):
        return expr
    below = operands(expr)
    frames = {(part.variables, part.which, part.offset) for part in below if isinstance(part, Reference)}
    if len(frames) != 1 or not all(isinstance(part, Reference) or is_constant(part) for part in below):
        return expr
    variables, which, offset = frames.pop()
    inner = rebuilt(expr, lambda part: part.operand if isinstance(part, Reference) else part)
    return Reference(variables, which, inner, offset)
