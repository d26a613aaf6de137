"""What the parser makes of a rule's SQL: names not yet resolved, places kept.

`at` is always an offset into the passage that was parsed.
"""

from dataclasses import dataclass
from enum import Enum

from sqlglot import exp

from patterns.text import Passage


@dataclass(frozen=True, slots=True)
class Identifier:
    """A name as written. `key` is what it is compared by: unquoted names are folded to upper case."""

    name: str
    key: str
    at: int


@dataclass(frozen=True, slots=True)
class Scalar:
    """A scalar expression as sqlglot parsed it, `at` its first character and up to `end`."""

    node: exp.Expression
    at: int
    end: int


@dataclass(frozen=True, slots=True)
class Variable:
    """A pattern variable: one row."""

    name: Identifier


@dataclass(frozen=True, slots=True)
class Concatenation:
    """Parts one after the other; without parts, the empty pattern."""

    parts: tuple["Pattern", ...]


@dataclass(frozen=True, slots=True)
class Alternation:
    """One of the choices; the one further left is preferred."""

    choices: tuple["Pattern", ...]


@dataclass(frozen=True, slots=True)
class Repetition:
    """`least` to `most` (None: any number) times the body; greedy prefers more."""

    body: "Pattern"
    least: int
    most: int | None
    greedy: bool
    at: int


Pattern = Variable | Concatenation | Alternation | Repetition


class SkipMode(Enum):
    """Where the search goes on after a match."""

    PAST_LAST_ROW = "PAST LAST ROW"
    TO_NEXT_ROW = "TO NEXT ROW"
    TO_FIRST = "TO FIRST"
    TO_LAST = "TO LAST"


@dataclass(frozen=True, slots=True)
class Skip:
    """AFTER MATCH SKIP; `variable` for TO_FIRST and TO_LAST (of which plain `TO v` is one)."""

    mode: SkipMode
    variable: Identifier | None = None


@dataclass(frozen=True, slots=True)
class Named:
    """An expression and the name that it defines: a measure, or a variable's condition."""

    name: Identifier
    value: Scalar


@dataclass(frozen=True, slots=True)
class Query:
    """One SELECT * FROM type MATCH_RECOGNIZE (...).

    Attributes:
        passage: The SQL, for errors.
        source_type: The event type after FROM.
        where: The filter of a FROM sub-query.
        partition_by: In order; may be empty.
        measures: In order.
        skip: AFTER MATCH SKIP.
        pattern: The tree of PATTERN.
        pattern_at: Where PATTERN stands.
        within: The expression after WITHIN, of type duration.
        defines: In order; variables of the pattern that have none are always true.
    """

    passage: Passage
    source_type: Identifier
    where: Scalar | None
    partition_by: tuple[Identifier, ...]
    measures: tuple[Named, ...]
    skip: Skip
    pattern: Pattern
    pattern_at: int
    within: Scalar | None
    defines: tuple[Named, ...]
