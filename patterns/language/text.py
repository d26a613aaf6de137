"""Texts that know where they stand, so that an error can point at its place in the file.

A `Document` is a whole file. A `Passage` is a text inside one (the SQL of a
YAML block, one value), whose offsets it turns into the file's lines and
columns. Neither reads files nor understands what it holds.
"""

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property

from patterns.errors import Place, RuleError

_WIDTH = 160


@dataclass(frozen=True)
class Document:
    """One file's name and whole text."""

    name: str
    text: str

    @cached_property
    def lines(self) -> tuple[str, ...]:
        """The lines without their ends; at least one."""
        return tuple(self.text.split("\n")) or ("",)

    def place(self, line: int, column: int) -> Place:
        """The place at this 0-based line and column, with its excerpt."""
        line = min(max(line, 0), len(self.lines) - 1)
        shown = self.lines[line].rstrip("\r").replace("\t", " ")
        column = min(max(column, 0), len(shown))
        left = max(0, column - _WIDTH // 2)
        number = f"{line + 1:5d} | "
        window = shown[left : left + _WIDTH]
        excerpt = f"{number}{window}\n{' ' * (len(number) + column - left)}^"
        return Place(self.name, line + 1, column + 1, excerpt)


@dataclass(frozen=True)
class Passage:
    """A text inside a document.

    Attributes:
        document: Where it stands.
        text: What it says, without the document's indentation.
        starts: For each line of `text`, its 0-based (line, column) in the document.
            A text that the file writes in another form (escaped, folded) has one
            entry: every offset then points at its beginning.
    """

    document: Document
    text: str
    starts: tuple[tuple[int, int], ...]

    @classmethod
    def alone(cls, text: str, name: str = "<rule>") -> "Passage":
        """The passage of a text that is a document of its own."""
        document = Document(name, text)
        return cls(document, text, tuple((line, 0) for line in range(len(document.lines))))

    def place(self, offset: int) -> Place:
        """The place of the character at this offset of the text."""
        breaks = self._breaks
        line = bisect_right(breaks, offset) - 1
        if len(self.starts) < len(breaks):
            return self.document.place(*self.starts[0])
        file_line, file_column = self.starts[line]
        return self.document.place(file_line, file_column + offset - breaks[line])

    def error(self, message: str, offset: int, kind: type[RuleError] = RuleError) -> RuleError:
        """The error that points at the character at this offset."""
        return kind(message, self.place(offset))

    @cached_property
    def _breaks(self) -> list[int]:
        breaks = [0]
        for line in self.text.split("\n"):
            breaks.append(breaks[-1] + len(line) + 1)
        return breaks[:-1]


def did_you_mean(written: str, known: Iterable[str]) -> str:
    """`; did you mean 'yard'?` where a known name is like the written one, else nothing."""
    by_folded = {name.casefold(): name for name in known}
    like = get_close_matches(written.casefold(), by_folded, n=1)
    return f"; did you mean {by_folded[like[0]]!r}?" if like else ""
