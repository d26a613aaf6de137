"""The language of a plan's `where`: one SQL condition over the columns of one event type.

Contract: pure; nothing is run here. `parse` takes what may stand in a plan: comparison, arithmetic, AND, OR, NOT,
IN, BETWEEN, LIKE, IS NULL, and the functions of `FUNCTIONS`. Everything else is refused by name: a subquery, another
function, a parameter. `bind` looks the columns up in a type and checks that what is compared can be compared, so that
what is bound does not fail for its types when it runs. Errors say line and column and show the place.

What a condition means is what DuckDB means by it, as in `vian query`: three-valued, a row counts where it is true.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, NoReturn

import pyarrow as pa
import sqlglot
from sqlglot import exp
from sqlglot.errors import ParseError, TokenError
from sqlglot.tokenizer_core import Token, TokenType

from events import EventType, schema_of

FUNCTIONS = ("abs", "coalesce", "length", "lower", "round", "upper")
DEPTH_MAX = 150
_DIALECT = "duckdb"

Kind = Literal["number", "text", "time", "truth", "bytes", "null"]

_KINDS: tuple[tuple[Callable[[pa.DataType], bool], Kind], ...] = (
    (pa.types.is_boolean, "truth"),
    (pa.types.is_integer, "number"),
    (pa.types.is_floating, "number"),
    (pa.types.is_string, "text"),
    (pa.types.is_timestamp, "time"),
    (pa.types.is_binary, "bytes"),
)
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
_ORDERED: tuple[Kind, ...] = ("number", "text", "time")
_COMPARISONS = (exp.EQ, exp.NEQ, exp.LT, exp.LTE, exp.GT, exp.GTE)
_ARITHMETIC = (exp.Add, exp.Sub, exp.Mul, exp.Div, exp.Mod)
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


@dataclass(frozen=True, slots=True)
class Bound:
    """A condition over one type's columns, ready to run."""

    sql: str
    """in DuckDB's SQL, every column quoted"""
    columns: tuple[str, ...]
    """those that it reads"""


def parse(text: str) -> Where:
    """The condition that a text says.

    Raises:
        WhereError: It says none, or something that a plan must not say.
    """
    try:
        tokens = sqlglot.tokenize(text, read=_DIALECT)
        _check_tokens(text, tokens)
        trees = sqlglot.parse(text, read=_DIALECT)
    except ParseError as error:
        first = error.errors[0] if error.errors else {}
        place = _offset_of(text, first.get("line") or 1, first.get("col") or 1)
        raise WhereError(_placed(text, place, str(first.get("description") or "this is no condition"))) from error
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


def bind(where: Where, event_type: type[EventType]) -> Bound:
    """The condition over the type's columns.

    Raises:
        WhereError: The type has no such column, what is compared cannot be compared, or it is no condition.
    """
    binder = _Binder(where, event_type)
    tree = where.tree.copy()
    kind = binder.kind_of(tree)
    if kind != "truth":
        where.refuse(tree, f"a condition must be true or false, this is {_named(kind)}")
    root = exp.Paren(this=tree)
    for column in list(root.find_all(exp.Column)):
        column.replace(exp.column(exp.to_identifier(column.name.lower(), quoted=True)))
    for literal, time in binder.times:
        literal.replace(exp.cast(exp.Literal.string(time.isoformat()), exp.DataType.Type.TIMESTAMPTZ))
    return Bound(root.sql(_DIALECT, comments=False), tuple(sorted(binder.columns)))


class _Binder:
    """Looks up columns of one type, and says of each part of a condition what kind of value it is."""

    def __init__(self, where: Where, event_type: type[EventType]) -> None:
        self._where = where
        self._type = event_type
        self.columns: set[str] = set()
        self.times: list[tuple[exp.Expr, datetime]] = []
        """Literals that are times, and which."""

    def kind_of(self, node: exp.Expr) -> Kind:
        if isinstance(node, exp.Paren):
            return self.kind_of(node.this)
        if isinstance(node, exp.Column):
            return self._column(node)
        if isinstance(node, exp.Literal):
            return "text" if node.is_string else "number"
        if isinstance(node, exp.Boolean):
            return "truth"
        if isinstance(node, exp.Null):
            return "null"
        if isinstance(node, exp.Cast):
            return self._time(node, str(node.this.this))
        if isinstance(node, exp.Neg):
            return self._all((node.this,), "number")
        if isinstance(node, _ARITHMETIC):
            return self._all((node.this, node.expression), "number")
        if isinstance(node, exp.Abs | exp.Round):
            return self._all([each for each in (node.this, node.args.get("decimals")) if each is not None], "number")
        if isinstance(node, exp.Lower | exp.Upper):
            return self._all((node.this,), "text")
        if isinstance(node, exp.Length):
            self._all((node.this,), "text")
            return "number"
        if isinstance(node, exp.Coalesce):
            return self._alike((node.this, *node.expressions), (*_ORDERED, "truth"))
        return self._condition(node)

    def _condition(self, node: exp.Expr) -> Kind:
        if isinstance(node, exp.Not):
            self._all((node.this,), "truth")
        elif isinstance(node, exp.And | exp.Or):
            self._all((node.this, node.expression), "truth")
        elif isinstance(node, exp.Is):
            self.kind_of(node.this)  # of any kind
        elif isinstance(node, exp.Like):
            self._all((node.this, node.expression), "text")
        elif isinstance(node, exp.Between):
            self._alike((node.this, node.args["low"], node.args["high"]), _ORDERED)
        elif isinstance(node, exp.In):
            self._alike((node.this, *node.expressions), (*_ORDERED, "truth"))
        else:
            is_equality = isinstance(node, exp.EQ | exp.NEQ)
            self._alike((node.this, node.expression), (*_ORDERED, "truth") if is_equality else _ORDERED)
        return "truth"

    def _column(self, node: exp.Column) -> Kind:
        name = node.name if node.this.quoted else node.name.lower()
        schema = schema_of(self._type)
        if name not in schema.names:
            known = ", ".join(field.name for field in schema if _kind(field.type) is not None)
            self._where.refuse(node, f"{self._type.type_name} has no field {name[:60]!r}; it has {known}")
        kind = _kind(schema.field(name).type)
        if kind is None:
            self._where.refuse(node, f"{name} holds a list, which a condition cannot look into")
        self.columns.add(name)
        return kind

    def _all(self, nodes: "tuple[exp.Expr, ...] | list[exp.Expr]", wanted: Kind) -> Kind:
        for node in nodes:
            if (kind := self.kind_of(node)) != wanted:
                self._where.refuse(node, f"wanted {_named(wanted)} here, this is {_named(kind)}")
        return wanted

    def _alike(self, nodes: tuple[exp.Expr, ...], allowed: tuple[Kind, ...]) -> Kind:
        """The kind that all of them are; a text beside a time is read as a time."""
        kinds = [self.kind_of(node) for node in nodes]
        if "time" in kinds:
            kinds = [
                self._time(node, str(node.this)) if isinstance(node, exp.Literal) and node.is_string else kind
                for node, kind in zip(nodes, kinds, strict=True)
            ]
        for node, kind in zip(nodes, kinds, strict=True):
            if kind == "null":
                self._where.refuse(node, "nothing equals NULL; write IS NULL or IS NOT NULL")
            if kind not in allowed:
                self._where.refuse(node, f"{_named(kind)} cannot be compared like this")
            if kind != kinds[0]:
                self._where.refuse(node, f"{_named(kinds[0])} cannot be compared with {_named(kind)}")
        return kinds[0]

    def _time(self, node: exp.Expr, text: str) -> Kind:
        try:
            time = datetime.fromisoformat(text.strip())
            time = time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
        except (ValueError, OverflowError):
            self._where.refuse(node, f"{text[:40]!r} is no time; wanted one such as '2026-11-01T00:00:00Z'")
        self.times.append((node, time))
        return "time"


def _kind(arrow: pa.DataType) -> Kind | None:
    return next((kind for is_it, kind in _KINDS if is_it(arrow)), None)


def _named(kind: Kind) -> str:
    return {"truth": "true or false", "null": "NULL", "bytes": "bytes"}.get(kind, f"a {kind}")


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
    *_ARITHMETIC,
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
