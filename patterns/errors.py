"""What can go wrong with rules.

PatternError
├── RuleError            a rule file that is not right; knows its file, line and column
│   ├── NotInRules  right SQL:2016 that a rule does not have
│   └── QueryError       DuckDB refuses the SQL around a clause, or cannot go on with it
├── MatchError           a rule that cannot go on with the rows it was given
│   ├── SkipError        AFTER MATCH SKIP has no row to go to
│   ├── LimitError       a limit of `Limits` was reached; names it
│   ├── RuleTooSlow      a rule took longer for its events than it may
│   └── FrameSizeUnknown a normalised zone or line met a row of a source of unknown frame size
└── StateError           bytes that are not the saved state of this rule
"""

from dataclasses import dataclass


class PatternError(Exception):
    """Base of every error that the package `patterns` raises."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where in a file: 1-based line and column, and the line's text with a caret below it."""

    file: str
    line: int
    column: int
    excerpt: str


class RuleError(PatternError):
    """A rule file that is not right.

    Attributes:
        message: What is wrong, what was got, what was wanted.
        file: The rule's file, or `<rule>` for one built in a program.
        line: 1-based line in that file.
        column: 1-based column in that line.
        excerpt: The line with a caret under the column.
    """

    def __init__(self, message: str, place: Place) -> None:
        super().__init__(f"{place.file}:{place.line}:{place.column}: {message}\n{place.excerpt}")
        self.message = message
        self.file = place.file
        self.line = place.line
        self.column = place.column
        self.excerpt = place.excerpt


class NotInRules(RuleError):
    """Right SQL:2016 that a rule does not have; the message says why, and what to write instead."""


class QueryError(RuleError):
    """SQL around a MATCH_RECOGNIZE clause that DuckDB refuses, or cannot go on with; the message is DuckDB's."""


class MatchError(PatternError):
    """A rule that cannot go on with the rows it was given."""


class SkipError(MatchError):
    """AFTER MATCH SKIP has no row to go to: the standard's run-time error."""


class LimitError(MatchError):
    """A limit of `Limits` was reached; the message names it."""


class RuleTooSlow(MatchError):
    """A rule took longer for its events than it may; the message names the limit."""


class FrameSizeUnknown(MatchError):
    """A normalised zone or line met a row of a source whose frame size is not known.

    Attributes:
        shape: Name of the zone or line.
        source: Its source.
    """

    def __init__(self, shape: str, source: str) -> None:
        super().__init__(
            f"{shape!r} is in normalised coordinates of source {source!r}, whose frame size is not known: no "
            "video_added of it came before. Next: write the coordinates with `units: pixels`"
        )
        self.shape = shape
        self.source = source


class StateError(PatternError):
    """Bytes that are not the saved state of this rule."""
