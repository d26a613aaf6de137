"""A rule bound to the columns of its event type: what the engine runs.

Made by `patterns.binding.binder`, which alone knows names; read by `patterns.engine.engine`,
which alone knows rows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from patterns.binding.expressions import Expr, Kind
from patterns.binding.inputs import Input
from patterns.binding.program import Instruction, Tables
from patterns.files.rule import Rule
from patterns.language.syntax import SkipMode
from patterns.limits import Limits
from patterns.scene.site import Site

How = Literal["first", "last", "rows", "values", "sum", "min", "max", "list"]


@dataclass(frozen=True, slots=True)
class Register:
    """What a match remembers of the rows mapped to some variables.

    Attributes:
        variables: Indices of the variables, ascending; None: any row of the match.
        how: `first`, `last`: a slot's value there; `rows`: how many; `values`: how many whose slot is
            not NULL; `sum`, `min`, `max`: of those; `list`: the slot's value at each, NULL too.
        slot: Which slot; None for `rows`.
        offset: For `first` and `last`: how many of the rows to go on, or back, from there.
        slot_of: Where the slot's value depends on the row's variable (CLASSIFIER): for each variable
            its slot; `slot` is then one of these.
    """

    variables: tuple[int, ...] | None
    how: How
    slot: int | None
    offset: int = 0
    slot_of: tuple[int, ...] | None = None

    def takes(self, variable: int) -> bool:
        """Whether a row of this variable counts."""
        return self.variables is None or variable in self.variables

    def slot_for(self, variable: int) -> int | None:
        """The slot that is read at a row of this variable."""
        return self.slot if self.slot_of is None else self.slot_of[variable]


@dataclass(frozen=True, slots=True)
class Condition:
    """One variable's DEFINE.

    Attributes:
        predicates: Row-local conditions that must all be true, as indices.
        guard: What else must be true; None: nothing.
        is_timed: Whether it has TIMER.
    """

    predicates: tuple[int, ...]
    guard: Expr | None
    is_timed: bool = False


@dataclass(frozen=True, slots=True)
class Output:
    """A named value of a situation: a measure, or a column of the last row that the title shows."""

    name: str
    value: Expr


@dataclass(frozen=True)
class BoundRule:
    """A rule, ready to run.

    Attributes:
        rule: The rule.
        timers: Registers that hold when a virtual row is due.
        inputs: The arms of FROM.
        variables: Pattern variables by index.
        program: The pattern.
        tables: The same, as the matcher takes it.
        columns: The columns read, with their types; `source` among them.
        keys: The partition columns.
        predicates: Row-local conditions, each once.
        slots: Row-local values that guards and registers read.
        registers: What a match remembers.
        register_of: Which register holds an expression.
        conditions: For each variable.
        measures: In order.
        title_columns: What the title shows beside measures and partition columns.
        within_us: WITHIN in microseconds.
        skip: AFTER MATCH SKIP, and the index of its variable.
        skip_variables: Indices of the variables that SKIP TO means; several, if it names a SUBSET.
        reach: How many rows before the row at hand any expression looks at.
        ahead: For each variable, how many rows after a row its condition, and what is remembered of it, looks at.
        is_numbered: Whether a measure asks for the match's number.
        looks_back: Whether a match's first rows look at rows before the match.
        site: What is known of the cameras when bound; a run goes on from a copy.
        limits: What the rule may use.
    """

    rule: Rule
    timers: tuple[int, ...]
    inputs: tuple[Input, ...]
    variables: tuple[str, ...]
    program: tuple[Instruction, ...]
    tables: Tables
    columns: Mapping[str, Kind]
    keys: tuple[str, ...]
    predicates: tuple[Expr, ...]
    slots: tuple[Expr, ...]
    registers: tuple[Register, ...]
    register_of: Mapping[Expr, int]
    conditions: tuple[Condition, ...]
    measures: tuple[Output, ...]
    title_columns: tuple[Output, ...]
    within_us: int | None
    skip: SkipMode
    skip_variables: tuple[int, ...]
    reach: int
    ahead: tuple[int, ...]
    is_numbered: bool
    looks_back: bool
    site: Site
    limits: Limits

    @property
    def timed(self) -> tuple[bool, ...]:
        """For each variable whether its condition has TIMER, so that it takes virtual rows and no others."""
        return tuple(each.is_timed for each in self.conditions)

    @property
    def remembers_all(self) -> bool:
        """Whether a partition is remembered when nothing of it is open."""
        return self.looks_back or self.is_numbered

    @property
    def types(self) -> frozenset[str]:
        """The event types that the rule reads."""
        return frozenset(each.type for each in self.inputs)

    @property
    def plain_input(self) -> Input | None:
        """The only arm, where a row is the event itself; None where rows are computed, or come from several arms."""
        return self.inputs[0] if len(self.inputs) == 1 and self.inputs[0].is_plain else None
