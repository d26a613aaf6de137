"""The words of a rule's SQL, with their places.

sqlglot's tokenizer splits; this module adds where each word stands and turns
its complaints into errors that point at the file.
"""

import re
from dataclasses import dataclass

from sqlglot.dialects.dialect import Dialect
from sqlglot.errors import TokenError
from sqlglot.tokenizer_core import Token, TokenType

from patterns.language.text import Passage

_IDENTIFIER = re.compile(r"[^\W\d][\w$]*")
_CLOSED = re.compile(r"'(?:[^']|'')*'|\"(?:[^\"]|\"\")*\"|--[^\n]*|/\*.*?\*/", re.DOTALL)
_BLANK = re.compile(r"[^\n]")
_PATTERN = re.compile(r"\bPATTERN\s*\(", re.IGNORECASE)
_OPENING = re.compile(r"'|\"|/\*")


@dataclass(frozen=True, slots=True)
class Word:
    """One word as written.

    sqlglot makes one token of some pairs of words (ORDER BY); they are two words here, of which the
    first holds the token.

    Attributes:
        text: As written, quotes included.
        start: Offset of its first character.
        end: Offset after its last character.
        kind: What the tokenizer took it for.
        token: The token that begins here.
    """

    text: str
    start: int
    end: int
    kind: TokenType
    token: Token | None

    @property
    def key(self) -> str:
        """What keywords are compared with."""
        return "" if self.is_quoted else self.text.upper()

    @property
    def is_quoted(self) -> bool:
        """Whether it is a quoted identifier or a string."""
        return self.kind in (TokenType.IDENTIFIER, TokenType.STRING)

    @property
    def is_identifier(self) -> bool:
        """Whether it can name something: a quoted identifier, or a word of letters and digits."""
        return self.kind is TokenType.IDENTIFIER or _IDENTIFIER.fullmatch(self.text) is not None

    @property
    def name(self) -> str:
        """The name as shown: without its quotes."""
        return self.token.text if self.token is not None and self.is_quoted else self.text


def tokenise(passage: Passage, dialect: Dialect | None = None, skips_patterns: bool = False) -> list[Word]:
    """The words of the SQL, comments left out.

    Args:
        passage: The SQL.
        dialect: Whose words; None: sqlglot's own.
        skips_patterns: Whether to leave out what stands in PATTERN (...), which need not be SQL.

    Raises:
        RuleError: A string, a quoted name or a comment is not closed, or a character starts no word.
    """
    blanked = _CLOSED.sub(lambda found: _BLANK.sub(" ", found[0]), passage.text)
    _check_closed(passage, blanked)
    text = _without_patterns(passage.text, blanked) if skips_patterns else passage.text
    try:
        tokens = (dialect or Dialect.get_or_raise(None)).tokenize(text)
    except TokenError as error:
        raise passage.error(f"not SQL: {error}", 0) from error
    return [word for token in tokens for word in _words(token, passage.text)]


def canonical_name(name: str, is_quoted: bool) -> str:
    """What names are compared by: SQL folds those that are not quoted to upper case."""
    return name if is_quoted else name.upper()


def _words(token: Token, text: str) -> list[Word]:
    start, end = token.start, token.end + 1
    if token.token_type in (TokenType.STRING, TokenType.IDENTIFIER):
        return [Word(text[start:end], start, end, token.token_type, token)]
    parts = list(re.finditer(r"\S+", text[start:end]))
    return [
        Word(part[0], start + part.start(), start + part.end(), token.token_type, None if index else token)
        for index, part in enumerate(parts)
    ]


def _without_patterns(text: str, blanked: str) -> str:
    for found in _PATTERN.finditer(blanked):
        depth = 0
        for at in range(found.end() - 1, len(blanked)):
            depth += (blanked[at] == "(") - (blanked[at] == ")")
            if depth == 0:
                text = text[: found.end()] + _BLANK.sub(" ", text[found.end() : at]) + text[at:]
                break
    return text


def _check_closed(passage: Passage, blanked: str) -> None:
    opening = _OPENING.search(blanked)
    if opening is not None:
        what = {"'": "string", '"': "quoted name", "/*": "comment"}[opening[0]]
        raise passage.error(f"this {what} is not closed", opening.start())
