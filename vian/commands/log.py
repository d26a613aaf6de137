"""`vian streams`, `vian tail`, `vian project`, `vian psql`: look at the log."""

import subprocess
from typing import Annotated

import typer
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from events import Segment, UnknownType, decode, events_of
from store import Log, Standing, StreamHead, Subscription
from store.verification import gaps_in
from vian import options
from vian.errors import WorldFailed
from vian.options import check_known, opened, settings_for
from vian.output import Output, to_json

_MAY_READ = """
select coalesce(bool_or(pg_has_role(session_user, oid,
  case when current_setting('server_version_num')::integer >= 160000 then 'set' else 'member' end)), false)
from pg_roles where rolname = 'vian_reader'
"""
"""Whether who connects may act as `vian_reader`; from PostgreSQL 16 on, a member may lack that right."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(epilog="Example: vian streams --json")(streams)
    app.command(epilog="Example: vian tail --follow --type situation_detected")(tail)
    app.command(
        epilog='Example: vian psql -- -c "select type, count(*) from events group by type"',
        # `vian psql -c ...` is what people type: what is no option of ours is psql's.
        context_settings={"ignore_unknown_options": True},
    )(psql)


def streams(data_dir: options.DataDir = None, dsn: options.Dsn = None, as_json: options.Json = False) -> None:
    """List the streams: how many events each has, its newest chain hash, and which sequences are not here."""
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        standing = log.standing()
    rows = [
        (str(head.stream), head.epoch, head.sequence, head.chain_hash.hex(), _gaps(standing, head))
        for head in standing.heads
    ]
    Output(is_json=as_json).table("", ("stream", "epoch", "sequence", "chain_hash", "not_here"), rows)


def _gaps(standing: Standing, head: StreamHead) -> str:
    """The sequences of a stream that are not here, for people."""
    place = (head.stream, head.epoch)
    return ", ".join(f"{gap.first} to {gap.last}" for gap in gaps_in({place: standing.runs.get(place, [])}))


def tail(
    count: Annotated[int, typer.Option("--count", "-n", help="How many of the newest events.", min=0)] = 10,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what comes, until Ctrl-C.")] = False,
    types: options.Types = None,
    source: options.Sources = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Show the newest events, oldest first, as JSON after their place."""
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        head, heads = log.heads()
        check_known("type", types, {*(str(each.type_name) for each in log.catalogue), *(h.stream.type for h in heads)})
        if not follow:
            check_known("source", source, {head.stream.source for head in heads})
        for line in _newest(log, head, count, types, source, as_json):
            output.line(line)
        if follow:
            _follow(log, head, types, source, output)


def _newest(
    log: Log, head: int, count: int, types: list[str] | None, sources: list[str] | None, as_json: bool
) -> list[str]:
    """Lines for the newest `count` events up to a position, looking back over ever longer stretches of the log."""
    stretch = 64
    while True:
        first = max(1, head - stretch + 1)
        segments = list(log.read_all(first, types=types, sources=sources, to_position=head))
        lines = [line for segment in segments for line in _lines(log, segment, as_json)]
        if len(lines) >= count or first == 1:
            return lines[len(lines) - min(count, len(lines)) :]
        stretch *= 8


def _follow(log: Log, position: int, types: list[str] | None, sources: list[str] | None, output: Output) -> None:
    # A reader that is not a registered subscriber: it begins where the newest events ended.
    with Subscription(log, "tail", types=types, sources=sources) as subscription:
        subscription.position = position
        while True:
            for segment in subscription.poll(timeout_s=1.0).segments:
                for line in _lines(log, segment, output.is_json):
                    output.line(line)


def _lines(log: Log, segment: Segment, as_json: bool) -> list[str]:
    place = {"station": segment.stream.station, "source": segment.stream.source, "type": segment.stream.type}
    first = segment.header.first_sequence
    try:
        events = [event.model_dump(mode="json") for event in events_of(decode(segment, log.catalogue))]
    except UnknownType as error:
        return [to_json({**place, "sequence": first, "events": segment.header.event_count, "unknown": str(error)})]
    if as_json:
        return [to_json({**place, "sequence": first + i, **event}) for i, event in enumerate(events)]
    return [f"{event.pop('time')}  {segment.stream}/{first + i}  {to_json(event)}" for i, event in enumerate(events)]


def psql(
    arguments: Annotated[list[str] | None, typer.Argument(help="What psql is given, best after --.")] = None,
    owner: Annotated[
        bool, typer.Option("--owner", help="As the log's owner, who can change the row tables, not as a reader.")
    ] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
) -> None:
    """Run psql on the row tables, to read them; an embedded PostgreSQL runs as long as psql does."""
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        program = str(log.server.bin_path / "psql") if log.server is not None else "psql"
        try:
            code = subprocess.call([program, log.dsn if owner else _as_reader(log), *(arguments or [])])
        except FileNotFoundError as error:
            raise WorldFailed("psql is not installed here. Next: install PostgreSQL's client programs") from error
    if code:
        raise WorldFailed(f"psql ended with exit code {code}")


def _as_reader(log: Log) -> str:
    """The log's address, to be used with the rights of `vian_reader`; a user who may not take them has fewer anyway."""
    with log.connection() as connection:
        may = connection.execute(_MAY_READ).fetchone()
    if may != (True,):
        return log.dsn
    given = conninfo_to_dict(log.dsn).get("options") or ""
    return make_conninfo(log.dsn, options=f"{given} -c role=vian_reader".strip())
