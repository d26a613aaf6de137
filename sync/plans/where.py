"""The language of a plan's `where`: one SQL condition over the fields of an event.

Contract: pure; nothing is run here. `parse` takes what may stand in a plan: comparison, arithmetic, AND, OR, NOT,
IN, BETWEEN, LIKE, IS NULL, and the functions of `FUNCTIONS`. Everything else is refused by name: a subquery, another
function, a parameter. Errors say line and column and show the place. Which fields there are, and what can be compared
with what, is looked at when the condition is bound to a type (`sync.plans.filters`).
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NoReturn

import sqlglot
from sqlglot import exp
from sqlglot.errors import ParseError, TokenError
from sqlglot.tokenizer_core import Token, TokenType

FUNCTIONS = ("abs", "coalesce", "length", "lower", "round", "upper")
DEPTH_MAX = 150
DIALECT = "duckdb"

_NOT_HERE: Mapping[TokenType, str] = {
    TokenType.SELECT: "a subquery",
    TokenType.WITH: "a subquery",
    TokenType.FROM: "a subquery",
    TokenType.EXISTS: "a subquery",
    TokenType.PARAMETER: "a parameter",
    TokenType.PLACEHOLDER: "a parameter",
    TokenType.COLON: "a parameter",
    TokenType.SEMICOLON: "a second statement",
    TokenType.CASE: "CASE",
    TokenType.DCOLON: "a cast",
    TokenType.OVER: "a window",
}
_COMPARISONS = (exp.EQ, exp.NEQ, exp.LT, exp.LTE, exp.GT, exp.GTE)
ARITHMETIC = (exp.Add, exp.Sub, exp.Mul, exp.Div, exp.Mod)
_TIMES = (exp.DataType.Type.TIMESTAMP, exp.DataType.Type.TIMESTAMPTZ, exp.DataType.Type.TIMESTAMPNTZ)


class WhereError(ValueError):
    """A condition that cannot be one; the message says where and why."""


@dataclass(frozen=True, slots=True)
class Where:
    """A condition that reads."""

    text: str
    tree: exp.Expr

    def refuse(self, node: exp.Expr, what: str) -> NoReturn:
        """Refuse a part of the condition.

        Raises:
            WhereError: Always, with the place.
        """
        raise WhereError(_placed(self.text, _offset(self.text, node), what))


def parse(text: str) -> Where:
    """The condition that a text says.

    Raises:
        WhereError: It says none, or something that a plan must not say.
    """
    try:
        tokens = sqlglot.tokenize(text, read=DIALECT)
        _check_tokens(text, tokens)
        trees = sqlglot.parse(text, read=DIALECT)
    except ParseError as error:
        first = error.errors[0] if error.errors else {}
        place = _offset_of(text, first.get("line") or 1, first.get("col") or 1)
        raise WhereError(_placed(text, place, _without_names(first.get("description")))) from error
    except TokenError as error:
        raise WhereError(_placed(text, 0, "a quote or a bracket is not closed")) from error
    except RecursionError as error:
        raise WhereError(_placed(text, 0, "this is nested too deep")) from error
    (tree,) = trees or [None]
    if not isinstance(tree, exp.Expr):
        raise WhereError(_placed(text, 0, "there is no condition here"))
    where = Where(text, tree)
    if _depth(tree) > DEPTH_MAX:
        raise WhereError(_placed(text, 0, f"this is nested deeper than {DEPTH_MAX}; shorten it, with IN perhaps"))
    _check_nodes(where)
    return where


def _without_names(said: object) -> str:
    """What the parser said, unless it names its own classes."""
    text = str(said or "this is no condition")
    return "something is missing here" if text.startswith("Required keyword") else text


def _check_tokens(text: str, tokens: list[Token]) -> None:
    """Refuse what no condition of a plan has, where its place is known to the letter."""
    for token, following in zip(tokens, [*tokens[1:], None], strict=False):
        what = _NOT_HERE.get(token.token_type)
        if what is None and following is not None and following.token_type is TokenType.L_PAREN:
            what = _called(token)
        if what is not None:
            raise WhereError(_placed(text, token.start, f"{what} cannot stand here; functions are {_listed()}"))


def _called(token: Token) -> str | None:
    """What is called by a word before a bracket, unless it may be."""
    is_word = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", token.text) is not None
    is_operator = token.token_type in (TokenType.AND, TokenType.OR, TokenType.NOT, TokenType.IN, TokenType.BETWEEN)
    is_operator = is_operator or token.token_type in (TokenType.LIKE, TokenType.IS, TokenType.STRING)
    if not is_word or is_operator or token.text.lower() in FUNCTIONS:
        return None
    return f"the function {token.text[:40]}"


def _listed() -> str:
    return ", ".join(FUNCTIONS)


_ALLOWED: tuple[type[exp.Expr], ...] = (
    *_COMPARISONS,
    *ARITHMETIC,
    exp.And,
    exp.Or,
    exp.Not,
    exp.Paren,
    exp.In,
    exp.Between,
    exp.Like,
    exp.Is,
    exp.Null,
    exp.Boolean,
    exp.Literal,
    exp.Column,
    exp.Identifier,
    exp.Neg,
    exp.Abs,
    exp.Coalesce,
    exp.Length,
    exp.Lower,
    exp.Round,
    exp.Upper,
    exp.Cast,
    exp.DataType,
)
_KEYS: Mapping[type[exp.Expr], frozenset[str]] = {
    exp.Column: frozenset({"this"}),
    exp.In: frozenset({"this", "expressions"}),
    exp.Between: frozenset({"this", "low", "high"}),
    exp.Round: frozenset({"this", "decimals"}),
    exp.Length: frozenset({"this"}),
}
"""What a node may have, where sqlglot gives it more than a condition here may say: a table, a query, an encoding."""


def _check_nodes(where: Where) -> None:
    for node in where.tree.walk():
        if type(node) not in _ALLOWED:
            where.refuse(node, f"{type(node).__name__.upper()} cannot stand here; functions are {_listed()}")
        allowed = _KEYS.get(type(node))
        extra = sorted(k for k, v in node.args.items() if v and allowed is not None and k not in allowed)
        extra = [key for key in extra if isinstance(node.args[key], exp.Expr | list | str)]
        if extra:
            where.refuse(node, "a field stands alone here, without a table or further words")
        if isinstance(node, exp.Is) and not isinstance(node.expression, exp.Null):
            where.refuse(node, "after IS stands NULL or NOT NULL")
        is_time = isinstance(node, exp.Cast) and node.to.this in _TIMES and isinstance(node.this, exp.Literal)
        if isinstance(node, exp.Cast) and not is_time:
            where.refuse(node, "a cast cannot stand here; a time is written TIMESTAMP '2026-11-01T00:00:00Z'")


def _depth(tree: exp.Expr) -> int:
    """How deep the tree is, found without recursion."""
    deepest, level = 0, [tree]
    while level:
        deepest += 1
        level = [child for node in level for child in node.iter_expressions()]
    return deepest


def _starts(node: exp.Expr) -> Iterator[int]:
    for each in node.walk():
        start = each.meta.get("start")
        if isinstance(start, int):
            yield start


def _offset(text: str, node: exp.Expr) -> int:
    """Where the node stands in the text; where it does not say it, its value is looked for."""
    start = min(_starts(node), default=None)
    if start is not None:
        return start
    literal = node if isinstance(node, exp.Literal) else node.find(exp.Literal)
    return max(0, text.find(str(literal.this))) if literal is not None else 0


def _offset_of(text: str, line: int, column: int) -> int:
    lines = text.splitlines(keepends=True)
    return min(len(text), sum(map(len, lines[: line - 1])) + max(0, column - 1))


def _placed(text: str, offset: int, what: str) -> str:
    """The message with line and column, and the line with a caret below."""
    before = text[:offset]
    line, column = before.count("\n") + 1, offset - (before.rfind("\n") + 1) + 1
    lines = text.split("\n")
    shown = lines[line - 1] if line <= len(lines) else ""
    begin = max(0, column - 60)
    excerpt = shown[begin : begin + 100]
    return f"line {line}, column {column}: {what}\n    {excerpt}\n    {' ' * (column - 1 - begin)}^"
