"""What a whole MATCH_RECOGNIZE clause answers, worked out from the definition: rows, measures, columns.

The matches are the reference's; this module evaluates measures over them and lays out the rows.
An expression is a pair: how SQL writes it, and a Python function of what can be seen.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tests.patterns.reference import Condition, Found, Mapping_, Reference, Row, Seen, Tree, rendered

Value = Callable[[Seen], Any]


@dataclass(frozen=True)
class Expression:
    """A scalar expression."""

    sql: str
    value: Value


@dataclass(frozen=True)
class Clause:
    """A clause over columns `key`, `us`, `n`, `letter`, partitioned by key and ordered by us."""

    tree: Tree
    defines: Mapping[str, Expression]
    measures: Mapping[str, Expression]
    rows_per_match: str
    skip: tuple[str, str | None]
    within: int | None
    subsets: Mapping[str, str]

    @property
    def sql(self) -> str:
        """The clause as SQL writes it."""
        mode, variable = self.skip
        subsets = ", ".join(f"{name} = ({', '.join(members)})" for name, members in self.subsets.items())
        parts = [
            "PARTITION BY key ORDER BY us",
            _listed("MEASURES", [f"{each.sql} AS {name}" for name, each in self.measures.items()]),
            self.rows_per_match,
            f"AFTER MATCH SKIP {mode} {variable or ''}".rstrip(),
            f"PATTERN ({rendered(self.tree)})",
            f"WITHIN INTERVAL '{self.within}' MICROSECOND" if self.within else "",
            f"SUBSET {subsets}" if subsets else "",
            _listed("DEFINE", [f"{name} AS {each.sql}" for name, each in self.defines.items()]),
        ]
        return "MATCH_RECOGNIZE (\n  " + "\n  ".join(part for part in parts if part) + ")"

    @property
    def columns(self) -> list[str]:
        """The answer's columns, in their order."""
        if self.rows_per_match.startswith("ALL"):
            return ["key", "us", *self.measures, "n", "letter"]
        return ["key", *self.measures]

    def answer(self, partition: list[Row]) -> list[tuple[Any, ...]]:
        """The answer's rows of one partition."""
        conditions: dict[str, Condition] = {name: each.value for name, each in self.defines.items()}
        reference = Reference(self.tree, conditions, self.skip, self.within, self.subsets)
        rows = []
        for found in reference.found(partition):
            rows += self._rows(found, partition)
        return rows

    def _rows(self, found: Found, partition: list[Row]) -> list[tuple[Any, ...]]:
        if found.number is None:
            is_shown = self.rows_per_match.endswith("WITH UNMATCHED ROWS")
            return [self._row(partition[found.start], None)] if is_shown else []
        if not found.mapped:
            is_shown = not self.rows_per_match.endswith("OMIT EMPTY MATCHES")
            return [self._row(partition[found.start], self._seen(found, (), partition))] if is_shown else []
        if not self.rows_per_match.startswith("ALL"):
            return [self._row(partition[found.start], self._seen(found, found.mapped, partition))]
        return [
            self._row(partition[each.at], self._seen(found, found.mapped[: index + 1], partition))
            for index, each in enumerate(found.mapped)
            if each.is_shown
        ]

    def _seen(self, found: Found, mapped: Mapping_, partition: list[Row]) -> Seen:
        at = mapped[-1].at if mapped else found.start
        return Seen(partition, at, mapped, found.number or 0, self.subsets, found.mapped)

    def _row(self, row: Row, seen: Seen | None) -> tuple[Any, ...]:
        """The row of an answer; without a match, all measures are NULL."""
        values = row | {name: seen and each.value(seen) for name, each in self.measures.items()}
        if seen is None:
            values |= dict.fromkeys(self.measures)
        return tuple(values[name] for name in self.columns)


def _listed(word: str, items: list[str]) -> str:
    return f"{word} {', '.join(items)}" if items else ""


# Expressions, one function for each kind.


def column(name: str, variable: str | None) -> Expression:
    """The column in the last row of the variable."""
    return Expression(_of(variable, name), lambda seen: seen.value(name, seen.place(variable)))


def logical(name: str, variable: str | None, is_first: bool, offset: int, is_final: bool | None) -> Expression:
    """FIRST and LAST."""
    return _in_view(
        f"{'FIRST' if is_first else 'LAST'}({_of(variable, name)}{f', {offset}' if offset else ''})",
        is_final,
        lambda seen: seen.value(name, seen.place(variable, is_first, offset)),
    )


def physical(name: str, variable: str | None, shift: int | None, is_back: bool) -> Expression:
    """PREV and NEXT; without a shift, by one."""
    places = (1 if shift is None else shift) * (-1 if is_back else 1)
    return Expression(
        f"{'PREV' if is_back else 'NEXT'}({_of(variable, name)}{'' if shift is None else f', {shift}'})",
        lambda seen: seen.value(name, seen.place(variable), places),
    )


def nested(name: str, variable: str | None, is_first: bool, offset: int, shift: int, is_back: bool) -> Expression:
    """PREV(FIRST(...)) and its like."""
    inner = logical(name, variable, is_first, offset, None)
    return Expression(
        f"{'PREV' if is_back else 'NEXT'}({inner.sql}, {shift})",
        lambda seen: seen.value(name, seen.place(variable, is_first, offset), -shift if is_back else shift),
    )


def within_navigation(variable: str | None, is_first: bool) -> Expression:
    """An expression inside FIRST or LAST."""
    n = _of(variable, "n")
    return Expression(
        f"{'FIRST' if is_first else 'LAST'}({n} * 2 + 1)",
        lambda seen: _doubled(seen.value("n", seen.place(variable, is_first))),
    )


def _doubled(value: int | None) -> int | None:
    return None if value is None else value * 2 + 1


def aggregate(function: str, variable: str | None, is_final: bool | None) -> Expression:
    """An aggregate over n of the variable's rows, or `count_rows`."""
    if function == "count_rows":
        return _in_view(f"COUNT({f'{variable}.*' if variable else '*'})", is_final, lambda seen: len(seen.of(variable)))
    return _in_view(
        f"{function}({_of(variable, 'n')})",
        is_final,
        lambda seen: _AGGREGATES[function]([seen.value("n", each.at) for each in seen.of(variable)]),
    )


def classifiers(variable: str | None, is_final: bool | None) -> Expression:
    """The list of the variables of all rows."""
    return _in_view(
        f"array_agg(CLASSIFIER({variable or ''}))",
        is_final,
        lambda seen: [each.variable for each in seen.of(variable)] or None,
    )


def classifier(variable: str | None) -> Expression:
    """CLASSIFIER()."""
    return Expression(f"CLASSIFIER({variable or ''})", lambda seen: seen.classifier(variable))


def match_number() -> Expression:
    """MATCH_NUMBER()."""
    return Expression("MATCH_NUMBER()", lambda seen: seen.number)


def compared(left: Expression, sign: str, right: Expression) -> Expression:
    """A comparison."""
    return Expression(
        f"{left.sql} {sign} {right.sql}", lambda seen: _COMPARE[sign](left.value(seen), right.value(seen))
    )


def constant(value: int | str) -> Expression:
    """A literal."""
    return Expression(f"'{value}'" if isinstance(value, str) else str(value), lambda _: value)


def negated(inner: Expression) -> Expression:
    """NOT."""
    return Expression(f"NOT ({inner.sql})", lambda seen: _not(inner.value(seen)))


def is_null(inner: Expression) -> Expression:
    """IS NULL."""
    return Expression(f"{inner.sql} IS NULL", lambda seen: inner.value(seen) is None)


def joined(left: Expression, word: str, right: Expression) -> Expression:
    """AND and OR, of three values."""
    decisive = word == "OR"

    def value(seen: Seen) -> bool | None:
        values = (left.value(seen), right.value(seen))
        if decisive in values:
            return decisive
        return None if None in values else not decisive

    return Expression(f"({left.sql}) {word} ({right.sql})", value)


def _in_view(sql: str, is_final: bool | None, value: Value) -> Expression:
    """The expression in FINAL or RUNNING form; None writes neither, which is running."""
    if is_final:
        return Expression(f"FINAL {sql}", lambda seen: value(seen.final))
    return Expression(sql if is_final is None else f"RUNNING {sql}", value)


def _of(variable: str | None, name: str) -> str:
    return f"{variable}.{name}" if variable else name


def _known(values: list[int | None]) -> list[int]:
    return [value for value in values if value is not None]


def _mean(values: list[int | None]) -> float | None:
    known = _known(values)
    return sum(known) / len(known) if known else None


def _not(value: bool | None) -> bool | None:
    return None if value is None else not value


def _comparing(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool | None]:
    return lambda left, right: None if left is None or right is None else compare(left, right)


_COMPARE = {
    "<": _comparing(lambda left, right: left < right),
    "<=": _comparing(lambda left, right: left <= right),
    "=": _comparing(lambda left, right: left == right),
    "<>": _comparing(lambda left, right: left != right),
}
_AGGREGATES: dict[str, Callable[[list[int | None]], Any]] = {
    "sum": lambda values: sum(_known(values)) if _known(values) else None,
    "min": lambda values: min(_known(values), default=None),
    "max": lambda values: max(_known(values), default=None),
    "avg": _mean,
    "count": lambda values: len(_known(values)),
    "array_agg": lambda values: values or None,
}
