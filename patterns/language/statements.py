"""Statements for DuckDB, made of pieces of a user's query: above all the input of a MATCH_RECOGNIZE clause.

An input stands in the middle of a query; here it becomes a query of its own, behind the common table
expressions that it can see from where it stands. Only words are looked at, never meaning: DuckDB
says what is wrong with a statement, and the statement knows where in the user's text that is.
"""

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from patterns.language.lexemes import Kind, Lexeme, lexemes
from patterns.language.text import Passage

BEFORE_INPUT = ("FROM", "JOIN", ",", "SELECT", ";")
"""What an input stands after, unless it is first in parentheses."""


@dataclass(frozen=True, slots=True)
class Statement:
    """SQL for DuckDB, made of pieces of the user's.

    Attributes:
        sql: The text.
        starts: Where each piece begins in `sql`, ascending.
        origins: For each piece, the span of the user's text that it stands for.
    """

    sql: str
    starts: tuple[int, ...]
    origins: tuple[tuple[int, int], ...]

    def origin(self, offset: int) -> int:
        """The place in the user's text of the character at this offset of `sql`."""
        piece = max(bisect_right(self.starts, offset) - 1, 0)
        if not self.origins:
            return 0
        start, end = self.origins[piece]
        return min(start + offset - self.starts[piece], max(end - 1, start))


def first_of_input(words: Sequence[Lexeme]) -> int:
    """The index of the word with which the input begins that ends with the last of the words."""
    index, depth = len(words), 0
    while index > 0:
        word = words[index - 1]
        if word.key == ")":
            depth += 1
        elif word.key == "(":
            if depth == 0:
                break
            depth -= 1
        elif depth == 0 and word.key in BEFORE_INPUT and not (word.key == "," and _lists_values(words, index - 1)):
            break
        index -= 1
    return index


def _lists_values(words: Sequence[Lexeme], comma: int) -> bool:
    """Whether the comma parts two rows of a VALUES list without parentheses of its own."""
    index = comma
    while index > 0 and words[index].key == "," and words[index - 1].key == ")":
        index = _opening(words, index - 1) - 1
        if index >= 0 and words[index].key == "VALUES":
            return True
    return False


def _opening(words: Sequence[Lexeme], closing: int) -> int:
    """The index of the parenthesis that opens what this one closes; 0 if there is none."""
    depth = 0
    for index in range(closing, -1, -1):
        depth += (words[index].key == ")") - (words[index].key == "(")
        if depth == 0:
            return index
    return 0


# The input as a query of its own.


def input_of(passage: Passage, words: Sequence[Lexeme], first: int, at: int, columns: str = "*") -> Statement:
    """`SELECT * FROM` the input, or of some of its columns, behind the common table expressions that it can see."""
    lead = _made(f"SELECT {columns} FROM", at)
    pieces = [lead, *words[first:]]
    for start, end in reversed(_levels(words, first)):
        seen = _common_tables(passage, words, start, end, words[first:])
        if seen:
            body = pieces if pieces[0] is lead else [lead, _made("(", at), *pieces, _made(")", at)]
            pieces = [*seen, *body]
    return statement(passage, pieces)


def name_of_input(words: Sequence[Lexeme], first: int) -> str | None:
    """What the input that begins with this word is called: its alias, or the last name of a table or function."""
    last = len(words) - 1
    if words[last].key == ")":
        last = _opening(words, last) - 1
    return words[last].name if last >= first and words[last].is_name else None


def without_alias(words: Sequence[Lexeme], first: int) -> Sequence[Lexeme]:
    """The words without the name that an input in parentheses, which begins with this one, bears behind them."""
    end = len(words) - 1
    if words[first].key != "(" or not words[end].is_name:
        return words
    end -= words[end - 1].key == "AS"
    return words[:end] if words[end - 1].key == ")" else words


def _made(text: str, at: int) -> Lexeme:
    """A piece that the user did not write."""
    return Lexeme(Kind.SIGN, text, at, at)


def _levels(words: Sequence[Lexeme], end: int) -> list[tuple[int, int]]:
    """For each query that is open before `end`, outermost first, the words of it that stand before the next."""
    starts = [0]
    for index in range(end):
        key = words[index].key
        if key == "(":
            starts.append(index + 1)
        elif key == ")" and len(starts) > 1:
            starts.pop()
        elif key == ";" and len(starts) == 1:
            starts = [index + 1]
    return list(zip(starts, [*starts[1:], end], strict=True))


def _common_tables(
    passage: Passage, words: Sequence[Lexeme], start: int, end: int, source: Sequence[Lexeme]
) -> list[Lexeme]:
    """The WITH clause of one level, as far as its tables are complete: `WITH a AS (...), b AS (...)`."""
    depth = 0
    for index in range(start, end):
        key = words[index].key
        depth += (key == "(") - (key == ")")
        if depth == 0 and key == "WITH":
            seen = _complete(passage, words, index, end, source)
            if seen is not None:
                return seen
    return []


def _complete(
    passage: Passage, words: Sequence[Lexeme], with_at: int, end: int, source: Sequence[Lexeme]
) -> list[Lexeme] | None:
    """The words of the tables that are complete; None where WITH begins no list of tables."""
    index = with_at + 1
    is_recursive = index < end and words[index].key == "RECURSIVE"
    index += is_recursive
    last = with_at
    while True:
        name = words[index] if index < end and words[index].is_name else None
        body = _body_of(words, index, end)
        if name is None or body is None:
            return None
        closing = _matching(words, body, end)
        if closing is None:
            if is_recursive:
                _refuse_recursion(passage, name, source)
            break
        last = closing
        if closing + 1 >= end or words[closing + 1].key != ",":
            break
        index = closing + 2
    return list(words[with_at : last + 1]) if last > with_at else []


def _body_of(words: Sequence[Lexeme], name: int, end: int) -> int | None:
    """The index of the parenthesis in which the table of this name is defined: `name (columns) AS MATERIALIZED (`."""
    for index in range(name + 1, end):
        if words[index].key == "AS":
            after = index + 1
            while after < end and words[after].key in ("NOT", "MATERIALIZED"):
                after += 1
            return after if after < end and words[after].key == "(" else None
        if not (words[index].is_name or words[index].key in ("(", ")", ",")):
            return None
    return None


def _matching(words: Sequence[Lexeme], opening: int, end: int) -> int | None:
    """The index of the parenthesis that closes this one, before `end`."""
    depth = 0
    for index in range(opening, end):
        depth += (words[index].key == "(") - (words[index].key == ")")
        if depth == 0:
            return index
    return None


def _refuse_recursion(passage: Passage, name: Lexeme, source: Sequence[Lexeme]) -> None:
    for word in source:
        if word.is_name and word.name == name.name:
            raise passage.error(
                f"MATCH_RECOGNIZE cannot read the recursive table {name.text} inside its own definition", word.start
            )


def statement(passage: Passage, words: Iterable[Lexeme]) -> Statement:
    """The words as text again, with the spaces and comments that stood between them."""
    text, starts, origins = "", [], []
    before: Lexeme | None = None
    for word in words:
        if before is not None:
            gap = passage.text[before.end : word.start] if before.end <= word.start else ""
            text += gap if _is_gap(before, word, gap) else " "
        starts.append(len(text))
        origins.append((word.start, word.end))
        text += word.text
        before = word
    return Statement(text, tuple(starts), tuple(origins))


def _is_gap(before: Lexeme, word: Lexeme, gap: str) -> bool:
    """Whether nothing but spaces and comments stands between these two in the user's text."""
    return before.end > before.start and word.end > word.start and next(lexemes(Passage.alone(gap)), None) is None
