"""`vian query`: SQL over the log."""

from collections.abc import Sequence
from enum import StrEnum
from itertools import chain, count
from pathlib import Path
from typing import Annotated

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet
import typer

from store import Log
from vian import options
from vian.clock import utc_now
from vian.errors import WorldFailed, WrongUsage
from vian.options import check_known, opened, settings_for, time_of
from vian.output import Output, to_json
from vian.querying import Scope
from vian.querying import query as answer
from vian.settings import Settings

_EXAMPLE = 'Example: vian query "SELECT type, count(*) FROM events GROUP BY ALL"'


class Format(StrEnum):
    """How an answer is written."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"
    ARROW = "arrow"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog=_EXAMPLE)(query)


def query(
    sql: Annotated[
        str,
        typer.Argument(help="DuckDB SQL, MATCH_RECOGNIZE too; each event type is a table, `events` has all envelopes."),
    ],
    at_central: Annotated[
        bool,
        typer.Option("--central", help="Ask central, in PostgreSQL's SQL; this log, marked PARTIAL, where it is away."),
    ] = False,
    limit: Annotated[
        int | None,
        typer.Option("--limit", min=1, max=10_000, help="With --central: most rows.", show_default="1000"),
    ] = None,
    calibration: Annotated[
        int | None,
        typer.Option(
            "--calibration",
            help="For `track_ground`: position of the calibration to read all points of its view through.",
            min=1,
            show_default="the one valid at each point's time",
        ),
    ] = None,
    format_: Annotated[
        Format, typer.Option("--format", help="Form of the answer: table, csv, json, parquet or arrow.")
    ] = Format.TABLE,
    output_file: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the answer to this file.", dir_okay=False)
    ] = None,
    since: options.Since = None,
    until: options.Until = None,
    source: options.Sources = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Answer a query over the log with DuckDB, or over what central has."""
    chosen = Format.JSON if as_json else format_
    if chosen in (Format.PARQUET, Format.ARROW) and output_file is None:
        raise WrongUsage(f"--format {chosen} is binary and needs a file. Next: add --output FILE")
    settings, output = settings_for(data_dir, dsn), Output(is_json=chosen is Format.JSON)
    _check_central(at_central, limit, since or until or source or calibration)
    with opened(settings, data_dir=data_dir) as log:
        if at_central:
            table = _at_central(log, settings, sql, limit, output)
        else:
            check_known("source", source, {head.stream.source for head in log.streams()})
            table = answer(
                log, sql, Scope(time_of("--since", since), time_of("--until", until), source, calibration=calibration)
            )
    try:
        write(presentable(table), chosen, output_file, output)
    except BrokenPipeError:
        raise  # the reader of standard output has gone; it is no file of ours
    except OSError as error:
        folder = output_file.parent if output_file else Path()
        wanted = "" if folder.is_dir() else f". Next: mkdir -p {folder}"
        raise WorldFailed(f"the answer cannot be written to {output_file}: {error.strerror}{wanted}") from error


def _check_central(at_central: bool, limit: int | None, scope: object) -> None:
    """Nothing, if the options go together.

    Raises:
        WrongUsage: They do not.
    """
    if at_central and scope:
        raise WrongUsage(
            "--central takes no --since, --until, --source and --calibration. "
            "Next: say it in the SQL: WHERE time >= ..."
        )
    if limit is not None and not at_central:
        raise WrongUsage("--limit is for --central. Next: say it in the SQL: LIMIT 10")


def _at_central(log: Log, settings: Settings, sql: str, limit: int | None, output: Output) -> pa.Table:
    """Central's answer; what it leaves out is told."""
    # All of sync and HTTP, which queries of this log need not wait for.
    from sync.protocol.questions import SQL_LENGTH_MAX, QueryQuestion
    from vian.asking import person, query_at_central
    from vian.desk import central_desk, enrolment

    if len(sql) > SQL_LENGTH_MAX:
        raise WrongUsage(f"central takes at most {SQL_LENGTH_MAX} characters of SQL, got {len(sql)}")
    question = QueryQuestion(sql=sql, person=person(), **({} if limit is None else {"limit": limit}))
    membership = enrolment(settings)
    with central_desk(log, settings, membership) as desk:
        source, table = query_at_central(desk, log, membership.station, question)
    for remark in source.remarks(utc_now()):
        output.note(remark)
    return table


def presentable(table: pa.Table) -> pa.Table:
    """The table with column names that differ, and as text what Python or a file format has no form for."""
    table = table.rename_columns(_distinct(table.column_names))
    odd = [name for name in table.column_names if not _has_form(table.column(name))]
    if not odd:
        return table
    quoted = ['"' + name.replace('"', '""') + '"' for name in odd]
    texts = ", ".join(f"cast({name} as varchar) as {name}" for name in quoted)
    with duckdb.connect(config={"autoinstall_known_extensions": False}) as connection:
        connection.execute("set timezone = 'UTC'")
        return connection.from_arrow(table).project(f"* replace ({texts})").to_arrow_table()


def _distinct(names: Sequence[str]) -> list[str]:
    distinct: list[str] = []
    for name in names:
        numbered = (f"{name}_{number}" for number in count(1))
        distinct.append(next(each for each in chain([name], numbered) if each not in distinct))
    return distinct


def _has_form(column: pa.ChunkedArray) -> bool:
    """Whether its values are such that Python knows: no spans of months and days, no infinite times."""
    if pa.types.is_interval(column.type):
        return False
    if pa.types.is_timestamp(column.type):
        try:
            pc.min_max(column).as_py()
        except (OverflowError, ValueError):
            return False
    return True


def write(table: pa.Table, format_: Format, file: Path | None, output: Output) -> None:
    """Write an answer to a file, or print it."""
    if file is None:
        _print(table, format_, output)
    elif format_ is Format.PARQUET:
        pa.parquet.write_table(table, file)
    elif format_ is Format.ARROW:
        with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
            writer.write_table(table)
    elif format_ is Format.JSON:
        file.write_text("".join(to_json(row) + "\n" for row in table.to_pylist()), encoding="utf-8")
    else:
        pa.csv.write_csv(_flat(table), file)


def _print(table: pa.Table, format_: Format, output: Output) -> None:
    if format_ is Format.CSV:
        sink = pa.BufferOutputStream()
        pa.csv.write_csv(_flat(table), sink)
        output.stream.write(sink.getvalue().to_pybytes().decode())
    else:
        columns = (column.to_pylist() for column in table.columns)
        output.table("", table.column_names, zip(*columns, strict=True))


def _flat(table: pa.Table) -> pa.Table:
    """The table with nested columns as JSON text, for CSV."""
    for index, field in enumerate(table.schema):
        if pa.types.is_nested(field.type):
            texts = [None if value is None else to_json(value) for value in table.column(index).to_pylist()]
            table = table.set_column(index, field.name, pa.array(texts, pa.string()))
    return table
