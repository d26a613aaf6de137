"""PATTERN (...): the regular expression over rows, from text to tree.

sqlglot keeps this part as raw text, so its grammar is ours:

    pattern     = sequence { "|" sequence }
    sequence    = { primary [ quantifier [ "?" ] ] }
    primary     = identifier | "^" | "$" | "(" [ pattern ] ")" | "{-" pattern "-}"
                | "PERMUTE" "(" pattern { "," pattern } ")"
    quantifier  = "*" | "+" | "?" | "{" n "}" | "{" [ n ] "," [ m ] "}"
"""

import re
from typing import NoReturn

from patterns.language.syntax import (
    Alternation,
    Anchor,
    Concatenation,
    Exclusion,
    Identifier,
    Pattern,
    Permutation,
    Repetition,
    Variable,
)
from patterns.language.text import Passage
from patterns.language.tokens import canonical_name

REPETITIONS_MOST = 10_000
DEPTH_MOST = 100

_SPACE = re.compile(r"(?:\s|--[^\n]*(?:\n|$)|/\*.*?\*/)*", re.DOTALL)
_NAME = re.compile(r'[^\W\d]\w*|"(?:[^"]|"")+"')
_BOUNDS = re.compile(r"\{\s*(?:(\d+)\s*(?:(,)\s*(\d+)?\s*)?|,\s*(\d+)?\s*)\}")
_PERMUTE = re.compile(r"PERMUTE(?=\s*\()", re.IGNORECASE)
_CLAUSE = re.compile(
    rf"DEFINE\s+(?:{_NAME.pattern})\s+AS\b|SUBSET\s+(?:{_NAME.pattern})\s*=|WITHIN\s+(?:INTERVAL\b|:|')", re.IGNORECASE
)
"""The clauses that may follow PATTERN: no pattern goes on like that."""
_ENDS = ("", "|", ")", ",")


def parse_pattern(passage: Passage, opening: int) -> tuple[Pattern, int]:
    """The tree of the pattern whose opening parenthesis stands at this offset, and the offset after its closing one.

    Raises:
        RuleError: Not a pattern.
    """
    reader = _Reader(passage, opening)
    tree = reader.group(0)
    return tree, reader.at


class _Reader:
    """A cursor over the passage, one method for each rule of the grammar."""

    def __init__(self, passage: Passage, at: int) -> None:
        self.passage = passage
        self.at = at

    def group(self, depth: int) -> Pattern:
        """What stands in parentheses; nothing is the empty pattern."""
        opening = self.at
        self.at += 1
        inner = Concatenation(()) if self.peek() == ")" else self.alternation(depth)
        self.close(opening)
        return inner

    def alternation(self, depth: int) -> Pattern:
        if depth > DEPTH_MOST:
            self.fail(f"a pattern nests at most {DEPTH_MOST} deep")
        choices = [self.sequence(depth)]
        while self.peek() == "|":
            self.at += 1
            choices.append(self.sequence(depth))
        return choices[0] if len(choices) == 1 else Alternation(tuple(choices))

    def sequence(self, depth: int) -> Pattern:
        parts: list[Pattern] = []
        while self.peek() not in _ENDS and not self.stands("-}") and not self.follows():
            parts.append(self.factor(depth))
        if not parts:
            self.fail(f"PATTERN: wanted a variable or '(', got {self.shown()}")
        return parts[0] if len(parts) == 1 else Concatenation(tuple(parts))

    def factor(self, depth: int) -> Pattern:
        body = self.primary(depth)
        self.peek()
        start = self.at
        bounds = self.quantifier()
        if bounds is None:
            return body
        greedy = self.peek() != "?"
        if not greedy:
            self.at += 1
        if self.peek() in ("*", "+", "?") or self.bounds() is not None:
            self.fail("PATTERN: a quantifier follows a quantifier; put the first in parentheses")
        return Repetition(body, *bounds, greedy=greedy, at=start)

    def primary(self, depth: int) -> Pattern:
        sign = self.peek()
        if sign == "(":
            return self.group(depth + 1)
        if self.stands("{-"):
            return self.exclusion(depth)
        if sign in ("^", "$"):
            self.at += 1
            return Anchor(sign == "^", self.at - 1)
        if _PERMUTE.match(self.passage.text, self.at):
            return self.permutation(depth)
        name = _NAME.match(self.passage.text, self.at)
        if name is None:
            self.fail(f"PATTERN: wanted a variable or '(', got {self.shown()}")
        self.at = name.end()
        return Variable(_identifier(name))

    def exclusion(self, depth: int) -> Pattern:
        opening = self.at
        self.at += 2
        body = self.alternation(depth + 1)
        if not self.stands("-}"):
            if self.peek() in ("", ";") or self.follows():
                self.at = opening
                self.fail("PATTERN: this {- is not closed")
            self.fail(f"PATTERN: wanted '-}}', got {self.shown()}")
        self.at += 2
        return Exclusion(body, opening)

    def permutation(self, depth: int) -> Pattern:
        start = self.at
        self.at += len("PERMUTE")
        self.peek()
        opening = self.at
        self.at += 1
        parts = [self.alternation(depth + 1)]
        while self.peek() == ",":
            self.at += 1
            parts.append(self.alternation(depth + 1))
        self.close(opening)
        return parts[0] if len(parts) == 1 else Permutation(tuple(parts), start)

    def quantifier(self) -> tuple[int, int | None] | None:
        sign = self.peek()
        simple = {"*": (0, None), "+": (1, None), "?": (0, 1)}.get(sign)
        if simple is not None:
            self.at += 1
            return simple
        if sign != "{" or self.stands("{-"):
            return None
        found = self.bounds()
        if found is None:
            self.fail("PATTERN: wanted {n}, {n,}, {,m} or {n,m}")
        least = int(found[1] or 0)
        is_open = found[0].rstrip("} \t\n").endswith(",")
        most = None if is_open else int(found[3] or found[4] or least)
        if most == 0:
            self.fail(f"PATTERN: a quantifier's upper bound must be at least 1, got {found[0]}")
        if most is not None and most < least:
            self.fail(f"PATTERN: a quantifier's upper bound must be at least its lower bound, got {found[0]}")
        if max(least, most or 0) > REPETITIONS_MOST:
            self.fail(f"PATTERN: a quantifier's bound is at most {REPETITIONS_MOST}, got {found[0]}")
        self.at = found.end()
        return least, most

    def bounds(self) -> re.Match[str] | None:
        return _BOUNDS.match(self.passage.text, self.at)

    def close(self, opening: int) -> None:
        if self.peek() != ")":
            if self.peek() in ("", ";") or self.follows():
                self.at = opening
                self.fail("PATTERN: this parenthesis is not closed")
            self.fail(f"PATTERN: wanted ')', got {self.shown()}")
        self.at += 1

    def follows(self) -> bool:
        """Whether the clause after PATTERN begins here."""
        return _CLAUSE.match(self.passage.text, self.at) is not None

    def stands(self, sign: str) -> bool:
        """Whether this sign is next."""
        self.peek()
        return self.passage.text.startswith(sign, self.at)

    def peek(self) -> str:
        space = _SPACE.match(self.passage.text, self.at)
        assert space is not None
        self.at = space.end()
        return self.passage.text[self.at : self.at + 1]

    def shown(self) -> str:
        return repr(self.peek()) if self.peek() else "the end"

    def fail(self, message: str) -> NoReturn:
        raise self.passage.error(message, self.at)


def _identifier(name: re.Match[str]) -> Identifier:
    is_quoted = name[0].startswith('"')
    plain = name[0][1:-1].replace('""', '"') if is_quoted else name[0]
    return Identifier(plain, canonical_name(plain, is_quoted), name.start())
