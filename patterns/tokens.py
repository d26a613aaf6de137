"""The words of a rule's SQL, with their places.

sqlglot's tokenizer splits; this module adds where each word stands and turns
its complaints into errors that point at the file.
"""

import re
from dataclasses import dataclass

from sqlglot.errors import TokenError
from sqlglot.tokenizer_core import Token, TokenType
from sqlglot.tokens import Tokenizer

from patterns.text import Passage

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_$]*")
_CLOSED = re.compile(r"'(?:[^']|'')*'|\"(?:[^\"]|\"\")*\"|--[^\n]*|/\*.*?\*/", re.DOTALL)
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


def tokenise(passage: Passage) -> list[Word]:
    """The words of the SQL, comments left out.

    Raises:
        RuleError: A string, a quoted name or a comment is not closed, or a character starts no word.
    """
    _check_closed(passage)
    try:
        tokens = Tokenizer().tokenize(passage.text)
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


def _check_closed(passage: Passage) -> None:
    blanked = _CLOSED.sub(lambda found: " " * len(found[0]), passage.text)
    opening = _OPENING.search(blanked)
    if opening is not None:
        what = {"'": "string", '"': "quoted name", "/*": "comment"}[opening[0]]
        raise passage.error(f"this {what} is not closed", opening.start())
