"""`vian archive`: old segments out of PostgreSQL, into sealed files, with Parquet beside them."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from store import Log
from store.locks import ARCHIVE
from store.parquet import Projected, project, waiting
from store.sealing import Sealed, outlook
from vian import archiving, options
from vian.archiving import days_of, location_for, time_before
from vian.exclusive import exclusively
from vian.options import opened, settings_for
from vian.output import Output

To = Annotated[
    str | None,
    typer.Option(
        "--to",
        help="Folder or URL of the archive, such as /archive or s3://bucket/vian.",
        show_default="`archive` in the folder of the embedded log",
    ),
]
_MB = 1_000_000

app = typer.Typer()


@app.callback(invoke_without_command=True, epilog="Example: vian archive --older-than 30d")
def archive(
    ctx: typer.Context,
    older_than: Annotated[
        str | None,
        typer.Option("--older-than", help="Seal what this log took longer ago, such as 30d, 12h.", show_default="30d"),
    ] = None,
    to: To = None,
    file_mb: Annotated[
        int | None,
        typer.Option("--file-mb", help="About how large a sealed file becomes, MB.", show_default="64", min=1),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be sealed, and leave it.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Move old segments into sealed files, each read back and verified before it leaves PostgreSQL; reads span both."""
    if ctx.invoked_subcommand is not None:
        return
    given = {"archive": to, "archive_after_days": days_of("--older-than", older_than), "archive_file_mb": file_mb}
    settings = settings_for(data_dir, dsn, **given)
    before = time_before(settings.archive_after_days, datetime.now(UTC))
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        location = location_for(log, settings.archive)
        name = archiving.place_of(log, location).name
        if dry_run:
            _foresee(log, name, before, output)
            return
        with exclusively(log, ARCHIVE):
            done, files = _archive(log, location, before, settings.archive_file_mb * _MB, output)
        if not output.is_json:
            output.line(f"{done} segments sealed in {files} files at {name}" if files else _nothing(log, before))


@app.command(epilog="Example: vian archive status --json")
def status(data_dir: options.DataDir = None, dsn: options.Dsn = None, as_json: options.Json = False) -> None:
    """Say where the archive is, what it holds, and what PostgreSQL still holds."""
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        found = _status(log)
    Output(is_json=as_json).result(found, "\n".join(_lines(found)))


@app.command(name="project", epilog="Example: vian archive project --all")
def write_parquet(
    everything: Annotated[bool, typer.Option("--all", help="Of all sealed files, not only of those without.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Write the decoded Parquet of sealed files that have none, or could not be decoded whole; with --all anew."""
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log, exclusively(log, ARCHIVE):
        incomplete = {row[0] for row in _rows(log, "select file from archive_projections where segments_skipped > 0")}
        missing = {file.first_position for file in waiting(log)}
        files = [file for file in log.archive.files() if everything or file.first_position in missing | incomplete]
        with output.progress("sealed files", len(files)) as bar:
            for count, file in enumerate(files, 1):
                _tell(project(log, file), output)
                bar.at(count)
    if not files:
        output.note("every sealed file has its Parquet")


@app.command(epilog="Example: vian archive relocate --to s3://bucket/vian")
def relocate(
    to: Annotated[str, typer.Option("--to", help="Folder or URL where all the archive's files lie now.")],
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Read sealed files from another place from now on, once each of them was found there unchanged."""
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log, exclusively(log, ARCHIVE):
        location = location_for(log, to)
        with output.progress("sealed files", len(log.archive.files())) as bar:
            count = archiving.relocate(log, location, bar.at)
    name = archiving.place_of(log, location).name
    output.result(
        {"location": name, "files": count},
        f"the archive is at {name}: {count} sealed files, each with the SHA-256 that it was sealed with",
    )


def _archive(log: Log, location: str, before: datetime, file_bytes: int, output: Output) -> tuple[int, int]:
    """Seal, and say how many segments in how many files."""
    wanted = outlook(log, before)
    done = files = 0
    with output.progress("segments", wanted.segments) as bar:
        for each in archiving.archive(log, location, before, file_bytes):
            _tell(each, output)
            if isinstance(each, Sealed):
                files += 1
                done += each.last_position - each.first_position + 1
                bar.at(done)
    return done, files


def _nothing(log: Log, before: datetime) -> str:
    return (
        f"nothing to seal: no segment in PostgreSQL was taken before {before:%Y-%m-%d %H:%M} UTC "
        f"(sealed up to position {log.archive.sealed_position()} of {log.head()})"
    )


def _tell(done: Sealed | Projected, output: Output) -> None:
    if isinstance(done, Sealed):
        output.result(
            {
                "sealed": done.path,
                "first_position": done.first_position,
                "last_position": done.last_position,
                "bytes": done.bytes,
            },
            f"sealed positions {done.first_position} to {done.last_position}: {done.path}, {done.bytes} bytes",
        )
        return
    output.result(
        {
            "projected": done.path,
            "files": len(done.paths),
            "events": done.events,
            "skipped": done.segments_skipped,
            "note": done.note,
        },
        f"Parquet of {done.path}: {done.events} events in {len(done.paths)} files",
    )
    if done.segments_skipped:
        output.note(
            f"{done.segments_skipped} segments of {done.path} have no Parquet, they stay sealed as they are; "
            f"{done.note}. Next: when that is mended, vian archive project"
        )


def _foresee(log: Log, name: str, before: datetime, output: Output) -> None:
    found = outlook(log, before)
    values = {
        "to": name,
        "first_position": found.first_position,
        "last_position": found.last_position,
        "segments": found.segments,
        "events": found.events,
        "payload_bytes": found.payload_bytes,
    }
    text = (
        f"would seal positions {found.first_position} to {found.last_position}: {found.events} events in "
        f"{found.segments} segments, {found.payload_bytes} bytes, at {name}"
    )
    output.result(values, text if found.segments else _nothing(log, before))


def _status(log: Log) -> dict[str, Any]:
    head = log.archive.head()
    files = log.archive.files()
    ((hot,),) = _rows(log, "select count(*) from segments")
    ((skipped,),) = _rows(log, "select coalesce(sum(segments_skipped), 0)::bigint from archive_projections")
    return {
        "location": _name(log, head.location),
        "sealed_position": head.sealed_position,
        "position": log.head(),
        "files": len(files),
        "bytes": sum(file.bytes for file in files),
        "events": sum(file.events for file in files),
        "time_min": min((file.time_min for file in files), default=None),
        "time_max": max((file.time_max for file in files), default=None),
        "sealed_at": max((file.sealed_at for file in files), default=None),
        "segments_in_postgresql": hot,
        "files_without_parquet": len(waiting(log)),
        "segments_without_parquet": skipped,
        "interrupted": head.pending_path,
    }


def _name(log: Log, location: str) -> str:
    """The archive's place as people would say it; the default as it is where there is no folder to start from."""
    is_whole = log.server is not None or "://" in location or Path(location).is_absolute()
    return archiving.place_of(log, location).name if is_whole else location


def _lines(found: dict[str, Any]) -> list[str]:
    lines = [
        f"archive at {found['location']}: positions 1 to {found['sealed_position']} of {found['position']} in "
        f"{found['files']} sealed files, {found['bytes']} bytes, {found['events']} events"
        if found["files"]
        else f"nothing is sealed; the archive would be at {found['location']}. Next: vian archive --older-than 30d",
        f"PostgreSQL holds {found['segments_in_postgresql']} segments",
    ]
    if found["files"]:
        lines.insert(1, f"events from {found['time_min']} to {found['time_max']}, last sealed {found['sealed_at']}")
    if found["files_without_parquet"] or found["segments_without_parquet"]:
        lines.append(
            f"without Parquet: {found['files_without_parquet']} files, {found['segments_without_parquet']} segments of "
            "others. Next: vian archive project"
        )
    if found["interrupted"]:
        lines.append(f"at work on {found['interrupted']}, or interrupted there. Next: vian archive goes on")
    return lines


def _rows(log: Log, query: str) -> list[tuple[Any, ...]]:
    with log.connection() as connection:
        return connection.execute(query.encode()).fetchall()
