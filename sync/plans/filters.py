"""A condition of a plan over the fields of one event type, ready to run.

Contract: pure; nothing is run here. `bind` looks the fields up in a type and checks that what is compared can be
compared, so that what is bound does not fail for its types when it runs. What a condition means is what DuckDB means by
it, as in `vian query`: three-valued, a row counts where it is true.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import pyarrow as pa
from sqlglot import exp

from events import EventType, schema_of
from sync.plans.where import ARITHMETIC, DIALECT, Where

Kind = Literal["number", "text", "time", "truth", "bytes", "null"]

_KINDS: tuple[tuple[Callable[[pa.DataType], bool], Kind], ...] = (
    (pa.types.is_boolean, "truth"),
    (pa.types.is_integer, "number"),
    (pa.types.is_floating, "number"),
    (pa.types.is_string, "text"),
    (pa.types.is_timestamp, "time"),
    (pa.types.is_binary, "bytes"),
)
_ORDERED: tuple[Kind, ...] = ("number", "text", "time")


@dataclass(frozen=True, slots=True)
class Bound:
    """A condition over one type's columns, ready to run."""

    sql: str
    """in DuckDB's SQL, every column quoted"""
    columns: tuple[str, ...]
    """those that it reads"""


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
    return Bound(root.sql(DIALECT, comments=False), tuple(sorted(binder.columns)))


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
        if isinstance(node, ARITHMETIC):
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
