"""The words of a whole DuckDB query, with their places.

A rule's SQL is split by `patterns.language.tokens`; what stands around MATCH_RECOGNIZE in a query
is DuckDB's, with dollar quotes, nested comments and characters that sqlglot takes for something
else. Nothing is understood here: a word is a name, a text, or one sign.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from patterns.language.text import Passage

_LEXEME = re.compile(
    r"""
      (?P<space>\s+|--[^\n]*)
    | (?P<comment>/\*)
    | (?P<string>[eE]'(?:[^'\\]|\\.|'')*' | '(?:[^']|'')*' | \$(?P<tag>(?:[^\W\d]\w*)?)\$.*?\$(?P=tag)\$)
    | (?P<quoted>"(?:[^"]|"")*")
    | (?P<word>[^\W\d][\w$]*)
    | (?P<sign>\d[\w.]*|.)
    """,
    re.DOTALL | re.VERBOSE,
)
_COMMENT_EDGE = re.compile(r"/\*|\*/")


class Kind(Enum):
    """What a word is."""

    WORD = "word"
    QUOTED = "quoted"
    STRING = "string"
    SIGN = "sign"


@dataclass(frozen=True, slots=True)
class Lexeme:
    """One word as it is to be handed on.

    Attributes:
        kind: What it is.
        text: What it says, quotes included.
        start: Where in the user's text it stands, or what it stands for.
        end: Offset after its last character there.
    """

    kind: Kind
    text: str
    start: int
    end: int

    @property
    def key(self) -> str:
        """What keywords and signs are compared with; nothing for quoted words and strings."""
        return self.text.upper() if self.kind in (Kind.WORD, Kind.SIGN) else ""

    @property
    def is_name(self) -> bool:
        """Whether it can name something."""
        return self.kind in (Kind.WORD, Kind.QUOTED)

    @property
    def name(self) -> str:
        """The name that it is, folded as DuckDB compares names."""
        bare = self.text[1:-1].replace('""', '"') if self.kind is Kind.QUOTED else self.text
        return bare.lower()


def lexemes(passage: Passage, at: int = 0) -> Iterator[Lexeme]:
    """The words from this offset on, without spaces and comments.

    Raises:
        RuleError: A string, a quoted name or a comment is not closed.
    """
    while at < len(passage.text):
        found = _LEXEME.match(passage.text, at)
        assert found is not None  # the last alternative takes any character
        group = str(found.lastgroup) if found.lastgroup != "tag" else "string"
        end = found.end() if group != "comment" else _comment_end(passage, at)
        if group == "sign" and found[0] in ("'", '"'):
            what = "string" if found[0] == "'" else "quoted name"
            raise passage.error(f"this {what} is not closed", at)
        if group not in ("space", "comment"):
            yield Lexeme(Kind(group), passage.text[at:end], at, end)
        at = end


def _comment_end(passage: Passage, at: int) -> int:
    """Comments nest."""
    depth = 0
    for edge in _COMMENT_EDGE.finditer(passage.text, at):
        depth += 1 if edge[0] == "/*" else -1
        if depth == 0:
            return edge.end()
    raise passage.error("this comment is not closed", at)
