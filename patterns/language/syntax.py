"""What the parser makes of a rule's SQL: names not yet resolved, places kept.

`at` is always an offset into the passage that was parsed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from sqlglot import exp

from patterns.language.text import Passage


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


@dataclass(frozen=True, slots=True)
class Permutation:
    """PERMUTE: all parts, in any order; the order that comes first by the parts' numbers is preferred."""

    parts: tuple["Pattern", ...]
    at: int


@dataclass(frozen=True, slots=True)
class Exclusion:
    """`{- body -}`: its rows belong to the match, but ALL ROWS PER MATCH leaves them out."""

    body: "Pattern"
    at: int


@dataclass(frozen=True, slots=True)
class Anchor:
    """No row; true before the partition's first row (`^`) or after its last (`$`)."""

    is_start: bool
    at: int


Pattern = Variable | Concatenation | Alternation | Repetition | Permutation | Exclusion | Anchor


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


class RowsPerMatch(Enum):
    """What each match puts out."""

    ONE = "ONE ROW PER MATCH"
    ALL_SHOW_EMPTY = "ALL ROWS PER MATCH SHOW EMPTY MATCHES"
    ALL_OMIT_EMPTY = "ALL ROWS PER MATCH OMIT EMPTY MATCHES"
    ALL_WITH_UNMATCHED = "ALL ROWS PER MATCH WITH UNMATCHED ROWS"


@dataclass(frozen=True, slots=True)
class Ordering:
    """One column of ORDER BY; `nulls_first` None: not said."""

    column: Identifier
    is_descending: bool = False
    nulls_first: bool | None = None


@dataclass(frozen=True, slots=True)
class Subset:
    """SUBSET name = (members): a variable that stands for any of its members."""

    name: Identifier
    members: tuple[Identifier, ...]


@dataclass(frozen=True, slots=True)
class Clause:
    """What stands in the parentheses of one MATCH_RECOGNIZE (...).

    Attributes:
        passage: The SQL, for errors.
        at: Where MATCH_RECOGNIZE stands.
        partition_by: In order; may be empty.
        order_by: In order; may be empty.
        measures: In order.
        rows: What each match puts out.
        rows_at: Where that is said.
        skip: AFTER MATCH SKIP.
        pattern: The tree of PATTERN.
        pattern_at: Where PATTERN stands.
        within: The expression after WITHIN, of type duration.
        subsets: In order.
        defines: In order; variables of the pattern that have none are always true.
        keys: What PARTITION BY and ORDER BY hold that is no plain name, by where it stands.
        source: What the query calls the input; a column may have it before it.
    """

    passage: Passage
    at: int
    partition_by: tuple[Identifier, ...]
    order_by: tuple[Ordering, ...]
    measures: tuple[Named, ...]
    rows: RowsPerMatch
    rows_at: int
    skip: Skip
    pattern: Pattern
    pattern_at: int
    within: Scalar | None
    subsets: tuple[Subset, ...]
    defines: tuple[Named, ...]
    keys: Mapping[int, Scalar] = field(default_factory=dict)
    source: str | None = None


@dataclass(frozen=True, slots=True)
class Item:
    """One column of an arm's SELECT list: its name, where that stands, and its value."""

    column: str
    at: int
    value: Scalar


@dataclass(frozen=True, slots=True)
class Arm:
    """One SELECT of FROM.

    Attributes:
        source_type: The event type after FROM.
        situation_of: The rule in FROM situation('rule').
        has_star: Whether all columns of the type are taken; it is so where FROM names a type alone.
        items: The other columns, in order.
        where: The filter.
    """

    source_type: Identifier
    situation_of: str | None
    has_star: bool
    items: tuple[Item, ...]
    where: Scalar | None


@dataclass(frozen=True, slots=True)
class Query:
    """One SELECT * FROM input MATCH_RECOGNIZE (...).

    Attributes:
        passage: The SQL, for errors.
        arms: What FROM names, or unites by name; at least one.
        clause: The MATCH_RECOGNIZE.
    """

    passage: Passage
    arms: tuple[Arm, ...]
    clause: Clause
