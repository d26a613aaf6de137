"""Whole queries in which MATCH_RECOGNIZE stands among ordinary SQL: the engine answers the clause, DuckDB the rest.

    query("SELECT m.bottom FROM ticks MATCH_RECOGNIZE (...) AS m JOIN names USING (symbol)", {"ticks": table, ...})

The text is read once, from left to right. Where a clause ends, its input, its clause and
a fresh name are one step, and the name takes their place in the text: so an input may be
the result of a clause before it, and what is left at the end is plain DuckDB. An input is a query of its
own, with the common table expressions that are in scope where it stands.
"""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import islice, pairwise
from typing import Any

import duckdb
import pyarrow as pa
from sqlglot import exp

from patterns.errors import MatchError, QueryError, RuleError
from patterns.language.dialect import ClauseDialect
from patterns.language.lexemes import Kind, Lexeme, lexemes
from patterns.language.navigation import offset_of
from patterns.language.parser import parse_clause
from patterns.language.statements import (
    BEFORE_INPUT,
    Statement,
    first_of_input,
    input_of,
    name_of_input,
    statement,
    without_alias,
)
from patterns.language.syntax import Clause, Named
from patterns.language.text import Passage
from patterns.limits import Limits
from patterns.querying import duck
from patterns.querying.duck import first_line, sql_of
from patterns.querying.recognition import recognise

_CLAUSE = "MATCH_RECOGNIZE"
_ONE = '"__column"'
_AMBIGUOUS = re.compile(r"Ambiguous reference to column name .* \(use: (.*?)\)")
_NUMBERED = re.compile(r"(.+)_\d+")
_LISTED_MOST = 10_000
"""Values that the sub-query of IN in MEASURES may give."""
_STANDS_ALONE = (
    "the input of MATCH_RECOGNIZE is a query of its own: it does not see columns of the query around it, and "
    "LATERAL or correlated input is not supported"
)


@dataclass(frozen=True, slots=True)
class Step:
    """One clause.

    Attributes:
        name: The name by which the text after it knows the result.
        source: What it reads.
        one_column: The same of the column `_ONE` only.
        clause: What it says.
    """

    name: str
    source: Statement
    one_column: Statement
    clause: Clause


@dataclass(frozen=True, slots=True)
class Plan:
    """A query, taken apart.

    Attributes:
        passage: The user's text.
        steps: In the order in which they are answered.
        rest: What DuckDB answers in the end.
    """

    passage: Passage
    steps: tuple[Step, ...]
    rest: Statement


def query(sql: str, tables: Mapping[str, pa.Table], limits: Limits | None = None) -> pa.Table:
    """The answer to a DuckDB query with any number of MATCH_RECOGNIZE clauses over these tables.

    Nothing is downloaded. Names of tables are compared without regard to case, as DuckDB does.

    Raises:
        RuleError: The SQL is not right; with line, column and caret.
        MatchError: A clause cannot go on with the rows that it was given.
    """
    plan = take_apart(sql)
    with connection() as opened:
        for name, table in tables.items():
            register(opened, name, table)
        return answer(plan, opened, limits)


def connection() -> duckdb.DuckDBPyConnection:
    """A DuckDB in memory that downloads nothing, sees no Python variables and keeps time in UTC."""
    opened = duckdb.connect(config={"autoinstall_known_extensions": False, "python_enable_replacements": False})
    opened.execute("set timezone = 'UTC'")
    return opened


def register(opened: duckdb.DuckDBPyConnection, name: str, table: pa.Table) -> None:
    """Make the table known by this name; of `schema.table` also in that schema.

    Raises:
        MatchError: A column is of a type that DuckDB does not have, or there is none.
    """
    try:
        opened.register(name, _distinctly_named(table))
    except duckdb.Error as error:
        raise MatchError(f"the table {name!r} is none that DuckDB reads: {first_line(error)}") from error
    schema, dot, inner = name.partition(".")
    if dot:
        opened.execute(f"create schema if not exists {_quoted(schema)}")
        opened.execute(f"create view {_quoted(schema)}.{_quoted(inner)} as select * from {_quoted(name)}")


def take_apart(sql: str, name: str = "<query>") -> Plan:
    """The steps of a query.

    Args:
        sql: One statement.
        name: What errors call the text.

    Raises:
        RuleError: The text of a clause is not right, or words are not closed.
    """
    passage = Passage.alone(sql, name)
    read = _Reader(passage)
    read.whole()
    return Plan(passage, tuple(read.steps), statement(passage, read.words))


def answer(plan: Plan, opened: duckdb.DuckDBPyConnection, limits: Limits | None = None) -> pa.Table:
    """The answer, over the tables that the connection has.

    Raises:
        RuleError: The SQL is not right.
        MatchError: A clause cannot go on with the rows that it was given.
    """
    _check_single(plan, opened)
    for step in plan.steps:
        source = _run(plan.passage, step.source, opened, is_input=True)
        ambiguous = _ambiguous(source, step, opened)
        clause = _with_values(step.clause, opened)
        result = recognise(clause, _distinctly_named(source), limits=limits, ambiguous=ambiguous)
        duck.register(opened, step.name, result)
    return _run(plan.passage, plan.rest, opened)


class _Reader:
    """The words read so far, in which each clause and its input have become one name."""

    def __init__(self, passage: Passage) -> None:
        self.passage = passage
        self.words: list[Lexeme] = []
        self.steps: list[Step] = []

    def whole(self) -> None:
        at = 0
        while (at := self.up_to_a_clause(at)) < len(self.passage.text):
            at = self.clause(at)

    def up_to_a_clause(self, at: int) -> int:
        """Read words up to the next clause; its offset, or that of the end."""
        keyword: Lexeme | None = None
        for word in lexemes(self.passage, at):
            if keyword is not None and word.key == "(":
                self.words.pop()
                return keyword.start
            keyword = word if word.key == _CLAUSE and not self.follows_as() else None
            self.words.append(word)
        return len(self.passage.text)

    def follows_as(self) -> bool:
        return bool(self.words) and self.words[-1].key == "AS"

    def clause(self, at: int) -> int:
        """Make a step of the clause at this offset; the offset after it."""
        end = _closing(self.passage, at)
        clause, _ = parse_clause(_part(self.passage, at, end), 0)
        first = first_of_input(self.words)
        if first == len(self.words):
            raise self.passage.error(
                f"{_CLAUSE} wants its input before it: a table, a sub-query in parentheses or VALUES in parentheses", at
            )
        clause = replace(clause, source=name_of_input(self.words, first))
        name = f"__match_{len(self.steps) + 1}"
        while name in self.passage.text.lower():
            name += "_"
        whole = input_of(self.passage, self.words, first, at)
        one = input_of(self.passage, without_alias(self.words, first), first, at, _ONE)
        self.steps.append(Step(name, whole, one, clause))
        text = f'SELECT * FROM "{name}"' if self.is_alone_in_parentheses(first, end) else f'"{name}"'
        self.words[first:] = [Lexeme(Kind.QUOTED, text, self.words[first].start, end)]
        return end

    def is_alone_in_parentheses(self, first: int, end: int) -> bool:
        """Whether the input and the clause fill `FROM ( ... )`: DuckDB has no parentheses around a single table."""
        if first < 2 or self.words[first - 1].key != "(" or self.words[first - 2].key not in BEFORE_INPUT:
            return False
        after = [word for word in islice(lexemes(self.passage, end), 3) if word.key != "AS"]
        return any(word.key == ")" for word in after[:2]) and (after[0].key == ")" or after[0].is_name)


# The text around a clause.


def _closing(passage: Passage, at: int) -> int:
    """The offset after the parenthesis that closes the clause at this offset."""
    depth, opening = 0, at
    for word in lexemes(passage, at):
        if word.key == "(":
            depth += 1
            opening = word.start if depth == 1 else opening
        elif word.key == ")":
            depth -= 1
            if depth == 0:
                return word.end
    end = passage.place(len(passage.text.rstrip()) - 1)
    try:
        parse_clause(_part(passage, at, len(passage.text)), 0)
    except RuleError as error:
        if (error.line, error.column) < (end.line, end.column):  # a parenthesis inside, or what hid the closing one
            raise
    raise passage.error(f"the parenthesis of {_CLAUSE} is not closed", opening)


def _part(passage: Passage, start: int, end: int) -> Passage:
    """A stretch of the passage as one of its own, with its places in the document."""
    text = passage.text[start:end]
    first = passage.place(start)
    lines = range(first.line, first.line + text.count("\n"))
    return Passage(passage.document, text, ((first.line - 1, first.column - 1), *((line, 0) for line in lines)))


# DuckDB's word on it.


def _check_single(plan: Plan, opened: duckdb.DuckDBPyConnection) -> None:
    """Refuse what is not one statement, before any of it is run."""
    with _errors_told(plan.passage, plan.rest, opened):
        count = len(opened.extract_statements(plan.rest.sql))
    if count != 1:
        got = "nothing" if count == 0 else f"{count}, separated by semicolons"
        raise plan.passage.error(f"wanted one statement, got {got}", 0, QueryError)


def _run(passage: Passage, statement: Statement, opened: duckdb.DuckDBPyConnection, is_input: bool = False) -> pa.Table:
    with _errors_told(passage, statement, opened, is_input):
        return opened.execute(statement.sql).to_arrow_table()


def _with_values(clause: Clause, opened: duckdb.DuckDBPyConnection) -> Clause:
    """The clause with the values of sub-queries of MEASURES in their places; such a query sees tables only."""

    def settled(measure: Named) -> Named:
        node: Any = measure.value.node.transform(lambda part: _value_of(part, clause.passage, measure.value.at, opened))
        return replace(measure, value=replace(measure.value, node=node))

    return replace(clause, measures=tuple(settled(measure) for measure in clause.measures))


def _value_of(node: exp.Expression, passage: Passage, at: int, opened: duckdb.DuckDBPyConnection) -> exp.Expr:
    """The node; of a scalar sub-query or EXISTS its value, of IN with a sub-query IN with what that gives."""
    if isinstance(node, exp.In) and node.args.get("query") is not None:
        return _among_values(node, passage, at, opened)
    is_compared = isinstance(node.parent, exp.In | exp.Any | exp.All)
    if not isinstance(node, exp.Exists | exp.Subquery) or is_compared:
        return node
    at = offset_of(node, at)
    sql = f"SELECT CAST(value AS VARCHAR) AS text, typeof(value) AS kind FROM (SELECT {sql_of(node)} AS value)"
    (found,) = _run(passage, Statement(sql, (0,), ((at, at + 1),)), opened).to_pylist()
    return _typed_value(found)


def _among_values(node: exp.In, passage: Passage, at: int, opened: duckdb.DuckDBPyConnection) -> exp.Expr:
    """IN with the values of its sub-query written out; nothing is among none."""
    query = node.args["query"]
    at = offset_of(query, offset_of(node, at))
    place = ((at, at + 1),)
    columns = _run(passage, Statement(f"SELECT * FROM {sql_of(query)} LIMIT 0", (0,), place), opened).num_columns
    if columns != 1:
        raise passage.error(f"MEASURES: the sub-query of IN gives one column, got {columns}", at)
    sql = (
        "SELECT DISTINCT CAST(value AS VARCHAR) AS text, typeof(value) AS kind "
        f"FROM {sql_of(query)} AS listed(value) LIMIT {_LISTED_MOST + 1}"
    )
    found = _run(passage, Statement(sql, (0,), place), opened).to_pylist()
    if len(found) > _LISTED_MOST:
        message = f"MEASURES: the sub-query of IN gives at most {_LISTED_MOST:,} different values, got more"
        raise passage.error(f"{message}. Next: join it outside", at)
    if not found:
        return exp.false()
    values = [_typed_value(each) for each in found]
    operand = node.this.transform(lambda part: _value_of(part, passage, at, opened))
    return exp.In(this=operand, expressions=values)


def _typed_value(found: dict[str, Any]) -> exp.Expr:
    """A value that DuckDB gave as text and type, as an expression."""
    value = exp.null() if found["text"] is None else exp.Literal.string(found["text"])
    return value if found["kind"] == '"NULL"' else exp.cast(value, found["kind"], dialect=ClauseDialect)


@contextmanager
def _errors_told(
    passage: Passage, statement: Statement, opened: duckdb.DuckDBPyConnection, is_input: bool = False
) -> Iterator[None]:
    """DuckDB's errors in the block become ours."""
    opened.execute("set errors_as_json = true")
    try:
        yield
    except duckdb.Error as error:
        raise _explained(passage, statement, error, is_input) from error
    finally:
        opened.execute("set errors_as_json = false")


def _explained(passage: Passage, statement: Statement, error: duckdb.Error, is_input: bool) -> RuleError:
    """DuckDB's error, at its place in the user's text."""
    kind, _, body = str(error).partition(": ")
    try:
        told = json.loads(body)
    except ValueError:
        told = {"exception_message": body}
    message = f"{kind}: {told['exception_message']}"
    if is_input and isinstance(error, duckdb.BinderException) and "not found" in message:
        message += f"\n({_STANDS_ALONE})"
    if isinstance(error, duckdb.ParserException):
        message += _meant(passage)
    octets = int(told.get("position", 0))
    offset = len(statement.sql.encode()[:octets].decode(errors="ignore"))
    return passage.error(message, statement.origin(offset), QueryError)


def _meant(passage: Passage) -> str:
    """Where a word is like MATCH_RECOGNIZE, or has no parenthesis behind it, that this may be what is wrong."""
    for word, after in pairwise(lexemes(passage)):
        if word.key == _CLAUSE and after.key not in ("(", ")", ",", "."):
            return f"\n({_CLAUSE} wants a parenthesis behind it, got {after.text})"
        is_like = word.key != _CLAUSE and get_close_matches(word.key, (_CLAUSE,), n=1, cutoff=0.8)
        if is_like and after.key == "(":
            return f"\n({word.text}: did you mean {_CLAUSE}?)"
    return ""


def _ambiguous(table: pa.Table, step: Step, opened: duckdb.DuckDBPyConnection) -> dict[str, str]:
    """The names, in lower case, that several tables of the clause's input have, and which columns these are.

    DuckDB says so of each; of two columns of a sub-query the later has got a number from it, and none is meant by both.
    """
    names = [name.lower() for name in table.column_names]
    numbered = (_NUMBERED.fullmatch(name) for name in names)
    perhaps = {name for name in names if names.count(name) > 1} | {found[1] for found in numbered if found} & set(names)
    told = {name: _told_twice(name, step, opened) for name in sorted(perhaps)}
    return {name: where for name, where in told.items() if where is not None}


def _told_twice(name: str, step: Step, opened: duckdb.DuckDBPyConnection) -> str | None:
    """The columns of the input that the name may mean, as DuckDB tells; None: it means one."""
    try:
        opened.execute(step.one_column.sql.replace(_ONE, _quoted(name), 1))
    except duckdb.BinderException as error:
        told = _AMBIGUOUS.search(str(error))
        return None if told is None else told[1].replace('"', "").replace(" or ", " and ")
    return None


def _distinctly_named(table: pa.Table) -> pa.Table:
    """The table with column names that differ without regard to case, as a join of two tables may not have them."""
    names: list[str] = []
    folded: set[str] = set()
    for name in table.column_names:
        number, distinct = 0, name
        while distinct.lower() in folded:
            number += 1
            distinct = f"{name}_{number}"
        names.append(distinct)
        folded.add(distinct.lower())
    return table.rename_columns(names)


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
