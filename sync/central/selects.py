"""Which SQL a station may ask of central: one SELECT over the tables of events, and nothing that is not listed here.

Contract: the text is parsed as PostgreSQL's SQL, each part of it must be one that is listed, and what runs is
written anew from what was parsed; the text itself never runs. Nothing listed writes, waits, looks outside of the
tables, or makes a value larger than those that are stored: no concatenation, no arrays, no rows as values.

This is the first of two locks: what is asked runs as a role that could not do more either (`store.field`).
"""

import re
from collections.abc import Iterator, Mapping, Sequence

import sqlglot
from sqlglot import exp
from sqlglot.errors import OptimizeError, ParseError, SqlglotError
from sqlglot.optimizer.qualify import qualify

from store.field import VIEW_PREFIX
from sync.errors import SelectRefused

LENGTH_MAX = 10_000
"""Most characters of a question in SQL."""
COLUMNS_MAX = 100
"""Most columns of an answer."""
DEPTH_MAX = 60
"""Most parts that lie within one another."""

_SHOWN_MAX = 120
"""Most letters of the line in which something is wrong; an answer has room for a few lines only."""
_DIALECT = "postgres"
_RENAMED = "asked_"
"""Begins the names that a question gives by WITH, so that none can stand for a table of the database."""

_FORM: tuple[type[exp.Expr], ...] = (
    exp.Select,
    exp.Union,
    exp.Except,
    exp.Intersect,
    exp.Subquery,
    exp.With,
    exp.CTE,
    exp.From,
    exp.Join,
    exp.Lateral,
    exp.Table,
    exp.TableAlias,
    exp.Where,
    exp.Group,
    exp.GroupingSets,
    exp.Rollup,
    exp.Cube,
    exp.Having,
    exp.Order,
    exp.Ordered,
    exp.Limit,
    exp.Offset,
    exp.Distinct,
    exp.Window,
    exp.WindowSpec,
    exp.WithinGroup,
    exp.Filter,
    exp.Alias,
    exp.Column,
    exp.Identifier,
    exp.Star,
    exp.Paren,
    exp.Tuple,
    exp.Literal,
    exp.Boolean,
    exp.Null,
    exp.Interval,
    exp.Var,
    exp.DataType,
    exp.DataTypeParam,
)
_OPERATORS: tuple[type[exp.Expr], ...] = (
    exp.And,
    exp.Or,
    exp.Not,
    exp.EQ,
    exp.NEQ,
    exp.GT,
    exp.GTE,
    exp.LT,
    exp.LTE,
    exp.NullSafeEQ,
    exp.NullSafeNEQ,
    exp.Is,
    exp.In,
    exp.Between,
    exp.Like,
    exp.ILike,
    exp.Escape,
    exp.Exists,
    exp.Any,
    exp.All,
    exp.Add,
    exp.Sub,
    exp.Mul,
    exp.Div,
    exp.Mod,
    exp.Neg,
    exp.AtTimeZone,
    exp.Case,
    exp.If,
    exp.Cast,
    exp.JSONExtract,
    exp.JSONExtractScalar,
    exp.JSONBExtract,
    exp.JSONBExtractScalar,
    exp.JSONBContainsTopKey,
    exp.ArrayContainsAll,
    exp.JSONPath,
    exp.JSONPathKey,
    exp.JSONPathRoot,
    exp.JSONPathSubscript,
)
_FUNCTIONS: dict[type[exp.Expr], str] = {
    exp.Abs: "abs",
    exp.Avg: "avg",
    exp.Ceil: "ceil",
    exp.Coalesce: "coalesce",
    exp.Corr: "corr",
    exp.Count: "count",
    exp.CurrentDate: "current_date",
    exp.CurrentTimestamp: "now",
    exp.DateBin: "date_bin",
    exp.DenseRank: "dense_rank",
    exp.Exp: "exp",
    exp.Extract: "extract",
    exp.FirstValue: "first_value",
    exp.Floor: "floor",
    exp.Greatest: "greatest",
    exp.Lag: "lag",
    exp.LastValue: "last_value",
    exp.Lead: "lead",
    exp.Least: "least",
    exp.Left: "left",
    exp.Length: "length",
    exp.Ln: "ln",
    exp.LogicalAnd: "bool_and",
    exp.LogicalOr: "bool_or",
    exp.Lower: "lower",
    exp.Max: "max",
    exp.Min: "min",
    exp.Mode: "mode",
    exp.Nullif: "nullif",
    exp.Ntile: "ntile",
    exp.PercentileCont: "percentile_cont",
    exp.PercentileDisc: "percentile_disc",
    exp.PercentRank: "percent_rank",
    exp.Pow: "power",
    exp.Rank: "rank",
    exp.Right: "right",
    exp.Round: "round",
    exp.RowNumber: "row_number",
    exp.Sign: "sign",
    exp.Sqrt: "sqrt",
    exp.Stddev: "stddev",
    exp.StddevPop: "stddev_pop",
    exp.StddevSamp: "stddev_samp",
    exp.StrPosition: "position",
    exp.Substring: "substring",
    exp.Sum: "sum",
    exp.TimestampTrunc: "date_trunc",
    exp.Trim: "trim",
    exp.Trunc: "trunc",
    exp.Upper: "upper",
    exp.Variance: "variance",
}
_BY_NAME = ("jsonb_array_length", "jsonb_typeof", "plate_key")
"""Functions that the parser has no class for."""
FUNCTIONS = tuple(sorted({*_FUNCTIONS.values(), *_BY_NAME}))
"""The functions that a question may call."""
_TYPES = {
    exp.DType.BIGINT,
    exp.DType.BOOLEAN,
    exp.DType.DATE,
    exp.DType.DECIMAL,
    exp.DType.DOUBLE,
    exp.DType.FLOAT,
    exp.DType.INT,
    exp.DType.INTERVAL,
    exp.DType.JSONB,
    exp.DType.SMALLINT,
    exp.DType.TEXT,
    exp.DType.TIMESTAMP,
    exp.DType.TIMESTAMPTZ,
    exp.DType.VARCHAR,
}
TYPES = (
    "bigint",
    "boolean",
    "date",
    "double precision",
    "integer",
    "interval",
    "jsonb",
    "numeric",
    "real",
    "smallint",
    "text",
    "timestamp",
    "timestamptz",
    "varchar",
)
"""The types that a question may cast to."""
_ALLOWED = frozenset({*_FORM, *_OPERATORS, *_FUNCTIONS})


def permitted(sql: str, tables: Mapping[str, Sequence[str]]) -> str:
    """The SELECT to run for a question in SQL, over the views of `store.field`.

    Args:
        sql: The question.
        tables: The tables that it may name, with their columns.

    Raises:
        SelectRefused: It is not one SELECT of what is allowed; the message says what, and where.
    """
    try:
        asked = _parsed(sql)
        _check(asked, sql)
        renamed = _rename(asked, tables, sql)
        _check_columns(asked, tables, sql)
        text = renamed.sql(dialect=_DIALECT, comments=False)
        again = sqlglot.parse_one(text, dialect=_DIALECT)
    except RecursionError as error:
        raise _too_deep() from error
    except SqlglotError as error:
        raise SelectRefused(f"the question cannot be read: {str(error).splitlines()[0]}") from error
    if again != renamed:
        raise SelectRefused("the question can be read in two ways; write its literals and names more plainly")
    return text


def _parsed(sql: str) -> exp.Expr:
    if len(sql) > LENGTH_MAX:
        raise SelectRefused(f"a question has at most {LENGTH_MAX} characters, got {len(sql)}")
    if "\0" in sql or any(0xD800 <= ord(letter) <= 0xDFFF for letter in sql):
        raise SelectRefused("a question is Unicode text without U+0000")
    first = next((token.text for token in sqlglot.tokenize(sql, dialect=_DIALECT)), "nothing")
    if first.upper() not in ("SELECT", "WITH", "("):
        raise SelectRefused(f"a question is one SELECT, got {first[:40]}")
    try:
        statements = [each for each in sqlglot.parse(sql, dialect=_DIALECT) if each is not None]
    except ParseError as error:
        first_error = error.errors[0]
        place = _shown(sql, first_error["line"], first_error["col"])
        raise SelectRefused(f"{first_error['description']}{place}") from error
    if len(statements) != 1:
        raise SelectRefused(f"a question is one SELECT, got {len(statements)} statements")
    return statements[0]


def _check(asked: exp.Expr, sql: str) -> None:
    """Nothing, if each part of it is allowed.

    Raises:
        SelectRefused: One is not.
    """
    names = {_name(alias.this) for alias in asked.find_all(exp.TableAlias) if alias.this}
    names |= {_name(table.this) for table in asked.find_all(exp.Table) if isinstance(table.this, exp.Identifier)}
    for part in asked.walk():
        if type(part) is exp.Anonymous:
            if part.name.lower() not in _BY_NAME:
                raise _refused_function(part.name, part, sql)
        elif type(part) not in _ALLOWED:
            raise _refused(part, sql)
        _check_rules(part, names, sql)
        if part.depth > DEPTH_MAX:
            raise _too_deep()


def _check_rules(part: exp.Expr, names: set[str], sql: str) -> None:
    """What a part that is allowed may not be all the same."""
    if isinstance(part, exp.With) and part.recursive:
        raise SelectRefused("WITH RECURSIVE is not for questions; a question ends by itself")
    if isinstance(part, exp.DataType) and (part.this not in _TYPES or part.args.get("nested")):
        raise SelectRefused(
            f"a question casts to {', '.join(TYPES[:-1])} or {TYPES[-1]}, got {part.sql(dialect=_DIALECT)}"
        )
    if isinstance(part, exp.Tuple) and not isinstance(
        part.parent, exp.In | exp.Distinct | exp.GroupingSets | exp.Tuple
    ):
        raise SelectRefused(f"a row is no value of a question{_at(part, sql)}")
    if isinstance(part, exp.Star) and not _is_list_of_columns(part):
        raise SelectRefused(f"* stands for columns in the list of SELECT, and in count(*){_at(part, sql)}")
    if isinstance(part, exp.Column) and not part.table and _name(part.this) in names:
        raise SelectRefused(
            f"{part.name} is a table's name, and a row is no value of a question; where a column is meant, give the "
            f"table another name{_at(part, sql)}"
        )
    if isinstance(part, exp.Lateral) and not isinstance(part.this, exp.Subquery):
        raise SelectRefused(f"LATERAL stands before a sub-query{_at(part, sql)}")


def _is_list_of_columns(star: exp.Star) -> bool:
    place = star.parent if isinstance(star.parent, exp.Column) else star
    holder = place.parent
    is_counted = isinstance(holder, exp.Count) and place is star
    return isinstance(holder, exp.Select) or is_counted


def _check_columns(asked: exp.Expr, tables: Mapping[str, Sequence[str]], sql: str) -> None:
    """Nothing, if each column is one of its table, which `table.name` need not be: PostgreSQL also calls functions so.

    Raises:
        SelectRefused: One is not.
    """
    schema: dict[str, object] = {name: dict.fromkeys(columns, "text") for name, columns in tables.items()}
    try:
        qualify(asked.copy(), schema=schema, dialect=_DIALECT)
    except OptimizeError as error:
        named = re.match(r"(?:Column|Unknown column:) '?([^'. ]+)", str(error))
        if named is None:
            raise
        wanted = named[1].strip('"')
        places = (part for part in asked.find_all(exp.Column) if part.name.lower() == wanted.lower())
        place = next((_at(part, sql) for part in places), "")
        named_tables = sorted({_name(table.this) for table in asked.find_all(exp.Table)} & tables.keys())
        known = "; ".join(f"{name}: {', '.join(tables[name])}" for name in named_tables[:3])
        raise SelectRefused(
            f"no table there has a column {wanted}, or more than one has{place}\nColumns of {known}"
        ) from error


def _rename(asked: exp.Expr, tables: Mapping[str, Sequence[str]], sql: str) -> exp.Expr:
    """The question over the views that answer for its tables.

    Raises:
        SelectRefused: It names another table.
    """
    own = {_name(cte.args["alias"].this) for cte in asked.find_all(exp.CTE)}
    if taken := sorted(own & tables.keys()):
        raise SelectRefused(f"{taken[0]} is a table; give what WITH names another name")
    renamed = asked.copy()
    for table in list(renamed.find_all(exp.Table)):
        name = _name(table.this) if isinstance(table.this, exp.Identifier) else ""
        if table.args.get("db") or table.args.get("catalog") or name not in tables.keys() | own:
            raise _refused_table(table, tables, sql)
        if not table.alias:
            table.set("alias", exp.TableAlias(this=exp.to_identifier(name, quoted=True)))
        prefix = VIEW_PREFIX if name in tables else _RENAMED
        table.set("this", exp.to_identifier(prefix + name, quoted=True))
    for cte in renamed.find_all(exp.CTE):
        alias = cte.args["alias"]
        alias.set("this", exp.to_identifier(_RENAMED + _name(alias.this), quoted=True))
    return renamed


def _name(identifier: exp.Expr) -> str:
    """The name as PostgreSQL understands it: in small letters unless it is quoted."""
    return identifier.name if identifier.args.get("quoted") else identifier.name.lower()


def _refused_table(table: exp.Table, tables: Mapping[str, Sequence[str]], sql: str) -> SelectRefused:
    known = ", ".join(sorted(tables))
    got = table.sql(dialect=_DIALECT)
    return SelectRefused(f"there is no table {got} for questions{_at(table, sql)}\nTables: {known}")


def _refused(part: exp.Expr, sql: str) -> SelectRefused:
    if isinstance(part, exp.Func):
        return _refused_function(part.sql_name(), part, sql)
    text = part.sql(dialect=_DIALECT, comments=False)
    return SelectRefused(f"that is not for questions: {text[:80]}{_at(part, sql)}")


def _refused_function(name: str, part: exp.Expr, sql: str) -> SelectRefused:
    known = ", ".join(FUNCTIONS)
    return SelectRefused(f"the function {name.lower()} is not for questions{_at(part, sql)}\nFunctions: {known}")


def _too_deep() -> SelectRefused:
    return SelectRefused(f"the question nests too deeply: at most {DEPTH_MAX} parts within one another")


def _at(part: exp.Expr, sql: str) -> str:
    """Where the part stands, if the parser has noted it for the part or one within."""
    for each in _with_parts(part):
        if "line" in each.meta and "col" in each.meta:
            return _shown(sql, each.meta["line"], each.meta["col"] - (each.meta["end"] - each.meta["start"]))
    return ""


def _with_parts(part: exp.Expr) -> Iterator[exp.Expr]:
    yield part
    yield from part.find_all(exp.Identifier, exp.Literal)


def _shown(sql: str, line: int, column: int) -> str:
    """The place, and the line with a caret below it."""
    lines = sql.splitlines() or [""]
    text, at = lines[min(line, len(lines)) - 1], max(column, 1) - 1
    begin = max(0, at - _SHOWN_MAX // 2)
    shown = text[begin : begin + _SHOWN_MAX]
    return f" (line {line}, column {at + 1})\n  {shown}\n  {' ' * (at - begin)}^"
