"""The whole script of a rule: the table, its rows as the rule reads them, the pattern, what is held back.

Each step is a view on the one before, so that a reader can select from any of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pyarrow as pa

from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Call, Expr, conjuncts, is_constant
from patterns.durations import microseconds
from patterns.errors import RuleError
from patterns.files.rule import Rule
from patterns.flink.elements import check_decided, elements_of, ends_in_order
from patterns.flink.feeding import STREAM, Feed
from patterns.flink.holding import Held, held_sql
from patterns.flink.names import MILLISECOND_US, interval, later_sql, quoted
from patterns.flink.options import Options
from patterns.flink.portable import refusals
from patterns.flink.refusing import Refuser, refusal
from patterns.flink.scalars import Place, sql
from patterns.flink.shapes import Shapes
from patterns.flink.tables import ROWTIME
from patterns.flink.timers import timed, timer_of
from patterns.language.parser import parse
from patterns.language.pattern_variables import pattern_variables
from patterns.language.syntax import Query, SkipMode
from patterns.scene.geometry import FrameSize
from patterns.scene.ground import Calibration
from patterns.scene.places import Places
from patterns.scene.site import Site

FIRED = "fired_at_ms"
"""The time attribute of a match, for further steps in event time."""

_FOREVER = "INTERVAL '36500' DAY(5)"
"""In place of no WITHIN. Without one, Flink never puts out what waits behind an attempt that cannot end."""

_TABLE = "Where the events of type {} come from. Flink's event time has milliseconds; `time` keeps its microseconds."
_INPUT = "The events that {} reads, as it reads them."
_MATCHES = "{} version {}: its matches, each with its first and last event; durations are microseconds."
_HELD = "What `emit` lets through: the first of each key{}."


@dataclass(frozen=True, slots=True)
class Script:
    """Statements in order, each with what it is for before it; `result` is the view with the situations."""

    statements: tuple[tuple[str, str], ...]
    result: str

    @property
    def text(self) -> str:
        """The script as a person reads it."""
        parts = [f"-- {why}\n{statement};\n" for why, statement in self.statements]
        return "\n".join([*parts, f"SELECT * FROM {quoted(self.result)};\n"])


def translate(
    rule: Rule,
    schemas: Mapping[str, pa.Schema],
    frame_sizes: Mapping[str, FrameSize] | None = None,
    options: Options | None = None,
    site: Site | None = None,
) -> Script:
    """The rule as Flink SQL.

    Args:
        rule: The rule.
        schemas: The event types there are, and the columns of each.
        frame_sizes: For each source whose frame size is known, its (width, height) in pixels.
        options: How the script is to be.
        site: What else is known of the cameras; the script says it as it is now.

    Raises:
        RuleError: The rule is not right, or says what Flink SQL cannot say, or would mean something else there.
    """
    bound = bind(rule, schemas, frame_sizes, site=site)
    query = parse(rule.passage("match"))
    for refused in refusals(rule, query):
        raise RuleError(refused.message, refused.place)
    return _Translation(bound, query, schemas, options or Options()).script()


def check(rule: Rule, schemas: Mapping[str, pa.Schema]) -> None:
    """Looks whether there is a script for the rule, whatever its cameras are like.

    Raises:
        RuleError: As `translate`.
    """
    sources = {shape.source for shape in (*rule.zones.values(), *rule.lines.values())} | {"any"}
    plain = Calibration(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (1, 1))
    site = Site.of(dict.fromkeys(sources, (1, 1)), calibrations=dict.fromkeys(sources, plain))
    translate(rule, schemas, site=site)


class _Translation:
    """One method for each step of the script."""

    def __init__(self, bound: BoundRule, query: Query, schemas: Mapping[str, pa.Schema], options: Options) -> None:
        self.bound = bound
        self.rule = bound.rule
        self.clause = query.clause
        self.options = options
        self.refuse = Refuser(query.passage)
        self.shapes = Shapes(bound.rule, Places(bound.rule.zones, bound.rule.lines, bound.site))
        self.timer = timer_of(bound, self.clause.pattern_at, self.refuse)
        self.feed = Feed(bound, query, schemas, options, self.shapes, self.refuse, self.timer)
        names = pattern_variables(self.clause.pattern)
        self.shown = {name.key: shown for name in reversed(names) for shown in [name.name]}
        self.elements = elements_of(self.clause.pattern, self.shown)
        self.conditions: Mapping[str, Sequence[Expr]] = {
            name: self.own_conditions(index) for index, name in enumerate(bound.variables)
        }
        self.loops: frozenset[str] = frozenset()
        if self.timer is not None:
            made = timed(self.elements, self.conditions, self.timer, self.feed.place, self.refuse)
            self.elements, self.conditions, self.loops = made.elements, made.conditions, made.loops
        check_decided(self.elements, self.conditions, self.refuse)

    def script(self) -> Script:
        """The statements, in the order in which they must run."""
        name = self.rule.rule
        matches = self.matches()  # before the input, which has the zones that it asks for
        statements = [(_TABLE.format(event_type), made) for event_type, made in self.feed.tables()]
        view = f"CREATE TEMPORARY VIEW {quoted(self.input_name)} AS\n{self.feed.view()}"
        statements.append((_INPUT.format(name), view))
        statements.append((_MATCHES.format(name, self.rule.version), matches))
        if self.rule.emit.once_per is None and self.rule.emit.cooldown is None:
            return Script(tuple(statements), f"{name}_matches")
        after = ", and each that comes when the cooldown is over" if self.rule.emit.cooldown is not None else ""
        statements.append((_HELD.format(after), self.situations()))
        return Script(tuple(statements), f"{name}_situations")

    @property
    def input_name(self) -> str:
        return f"{self.rule.rule}_input"

    @property
    def matches_name(self) -> str:
        return f"{self.rule.rule}_matches"

    # The pattern.

    def matches(self) -> str:
        """CREATE VIEW with the rule's matches."""
        keys = ", ".join(quoted(name) for name in self.keys)
        pattern = " ".join(quoted(part.variable) + part.text for part in self.elements.parts)
        clauses = [
            *([f"PARTITION BY {keys}"] if keys else []),
            f"ORDER BY {', '.join(quoted(name) for name in self.feed.order)}",
            "MEASURES " + ",\n             ".join(self.measures()),
            "ONE ROW PER MATCH",
            f"AFTER MATCH SKIP {self.skip()}",
            f"PATTERN ({pattern}) WITHIN {self.within()}",
            "DEFINE " + ",\n           ".join(self.defines()),
        ]
        body = "\n    ".join(clauses)
        return (
            f"CREATE TEMPORARY VIEW {quoted(self.matches_name)} AS\n"
            f"SELECT * FROM {quoted(self.input_name)} MATCH_RECOGNIZE (\n    {body}\n)"
        )

    @property
    def keys(self) -> list[str]:
        """The partition columns in the input's order: Flink mixes up their types in any other."""
        return [name for name in self.bound.columns if name in self.bound.keys]

    @property
    def identity(self) -> dict[str, str]:
        """The columns that name a match's first and last event, and its time attribute."""
        written = {}
        for which in ("first", "last"):
            for name in ("sequence", "time") if self.feed.has_one_stream else (STREAM, "sequence", "time"):
                written[f"{which}_{name}"] = f"{which.upper()}({quoted(name)})"
        written[FIRED] = f"MATCH_ROWTIME({quoted(ROWTIME)})"
        return written

    def measures(self) -> list[str]:
        named = {measure.name.name: measure for measure in self.clause.measures}
        taken = {*self.bound.keys, *self.identity}
        written = {}
        for output in self.bound.measures:
            measure = named[output.name]
            if output.name in taken:
                self.refuse("measure of a column's name", measure.name.at, f"; {output.name!r} is one")
            place = self.place(measure.value.at, None)
            written[output.name] = sql(self.shapes.as_columns(output.value), place)
        return [f"{value} AS {quoted(name)}" for name, value in (written | self.identity).items()]

    def skip(self) -> str:
        mode, variables = self.bound.skip, self.bound.skip_variables
        if mode in (SkipMode.PAST_LAST_ROW, SkipMode.TO_NEXT_ROW):
            return str(mode.value)
        (variable,) = variables
        return f"{mode.value} {quoted(self.bound.variables[variable])}"

    def within(self) -> str:
        """A bound in milliseconds that no match exceeds; `in_time` is the exact one."""
        within_us = self.bound.within_us
        if within_us is None:
            return _FOREVER
        spare_us = (-within_us) % MILLISECOND_US + (0 if self.options.whole_milliseconds else MILLISECOND_US)
        return interval(within_us + spare_us) or _FOREVER

    def in_time(self, variable: str) -> list[str]:
        """The condition that the row lies within WITHIN, to the microsecond; nothing where it always does."""
        within_us = self.bound.within_us
        first = self.elements.parts[0]
        is_first_row = variable == first.variable and first.most == 1
        if within_us is None or self.options.whole_milliseconds or is_first_row:
            return []
        began = f"{quoted(first.variable)}.`time`" if (first.least, first.most) == (1, 1) else "FIRST(`time`)"
        return [f"{quoted(variable)}.`time` < {later_sql(began, within_us)}"]

    def defines(self) -> list[str]:
        places = {self.shown[define.name.key]: define.value.at for define in self.clause.defines}
        written = []
        for variable in (part.variable for part in self.elements.parts):
            at = places.get(variable, self.clause.pattern_at)
            place = self.place(at, variable)
            parts = [_anded(condition, place) for condition in self.conditions[variable]] + self.in_time(variable)
            if parts:
                written.append(f"{quoted(variable)} AS {' AND '.join(parts)}")
        return written or [f"{quoted(self.elements.parts[0].variable)} AS TRUE"]

    def place(self, at: int, own: str | None) -> Place:
        """Where an expression of MEASURES, or of a variable's DEFINE, stands."""
        return Place(at, self.refuse, self.shapes, self.elements, own, self.timer is not None, self.loops)

    def own_conditions(self, index: int) -> list[Expr]:
        condition = self.bound.conditions[index]
        found = [self.bound.predicates[at] for at in condition.predicates]
        found += [] if condition.guard is None else conjuncts(condition.guard)
        return [self.shapes.as_columns(each) for each in sorted(found, key=is_constant)]

    # What is held back.

    def situations(self) -> str:
        """CREATE VIEW with the matches that `emit` lets through."""
        emit = self.rule.emit
        if not ends_in_order(self.elements, self.conditions):
            raise self.rule.error(refusal("emit of matches that overlap"), "emit")
        columns = [*self.keys, *(output.name for output in self.bound.measures), *self.identity]
        once_per = self.bound.keys if emit.once_per is None else emit.once_per
        order = [name for name in (FIRED, "last_time", "last_stream", "last_sequence") if name in columns]
        cooldown_us = None if emit.cooldown is None else microseconds(emit.cooldown)
        keys = [name for name in columns if name in once_per]
        held = Held(self.matches_name, columns, keys, order, cooldown_us)
        return f"CREATE TEMPORARY VIEW {quoted(self.rule.rule + '_situations')} AS\n{held_sql(held)}"


def _anded(condition: Expr, place: Place) -> str:
    written = sql(condition, place)
    return f"({written})" if isinstance(condition, Call) and condition.op == "or" else written
