"""`vian upgrade`: what this version would change in a log, and doing it."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from events import load_catalogue
from store import LogUnavailable, WrongMajor, health
from store.embedded import MAJOR, EmbeddedServer
from store.health import Schema
from store.schema import MAJOR_MIN, migrate
from vian import options
from vian.errors import WorldFailed
from vian.findings import Finding, Verdict
from vian.options import has_log, settings_for
from vian.output import Output
from vian.settings import Settings
from vian.version import VERSION

ROOM_BYTES = 256 * 2**20
"""Room that migrations need at most: none of them writes the segments anew."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian upgrade --check --data-dir /var/lib/vian")(upgrade)


def upgrade(
    is_check: Annotated[bool, typer.Option("--check", help="Say what would be done, and do nothing.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Bring a log to this version's schema, as opening it does; exit code 1 if it cannot be."""
    settings = settings_for(data_dir, dsn)
    output = Output(is_json=as_json)
    bad = 0
    for finding in _upgrade(settings, data_dir, is_check=is_check):
        bad += finding.verdict is Verdict.BAD
        output.result(
            {"check": finding.check, "verdict": finding.verdict, "text": finding.text},
            f"{finding.verdict.value:4}  {finding.check}: {finding.text}",
        )
    if bad:
        raise WorldFailed("this log cannot be upgraded as it stands; what is bad says what to do next")


def _upgrade(settings: Settings, data_dir: Path | None, *, is_check: bool) -> Iterator[Finding]:
    yield Finding("version", Verdict.OK, f"this is ViAn {VERSION}")
    is_embedded = settings.dsn is None or data_dir is not None
    if is_embedded and not has_log(settings.data_dir):
        yield Finding("log", Verdict.NOTE, f"no log in {settings.data_dir}: there is nothing to upgrade")
        return
    try:
        with _address(settings, is_embedded=is_embedded) as address:
            catalogue = load_catalogue()
            found = health.schema(address, catalogue)
            yield from _findings(found, settings.data_dir if is_embedded else None)
            if not is_check and found.is_known and found.is_to_migrate:
                migrate(address, catalogue)
                yield Finding("upgraded", Verdict.OK, f"the log is at revision {found.newest} now")
    except WrongMajor as error:
        yield Finding("PostgreSQL", Verdict.BAD, str(error))
    except LogUnavailable as error:
        yield Finding("log", Verdict.BAD, str(error))


@contextmanager
def _address(settings: Settings, *, is_embedded: bool) -> Iterator[str]:
    """The database's address, with an embedded one running; nothing is migrated."""
    if not is_embedded:
        assert settings.dsn is not None, "a log is embedded or has an address"
        yield settings.dsn.get_secret_value()
        return
    server = EmbeddedServer(settings.data_dir.expanduser().resolve())
    try:
        yield server.dsn
    finally:
        server.close()


def _findings(found: Schema, data_dir: Path | None) -> Iterator[Finding]:
    wanted = f"major {MAJOR} embedded" if data_dir is not None else f"{MAJOR_MIN} or newer"
    is_old = int(found.server.split(".")[0]) < MAJOR_MIN
    next_step = ". Next: upgrade that server" if is_old else ""
    yield Finding("PostgreSQL", Verdict.BAD if is_old else Verdict.OK, f"{found.server}, wanted {wanted}{next_step}")
    yield _revision(found)
    for revision, what in found.pending:
        yield Finding("would run" if found.revision else "would make", Verdict.NOTE, f"revision {revision}: {what}")
    if found.row_tables and found.revision:
        yield Finding("would add", Verdict.NOTE, f"row tables {', '.join(found.row_tables)}")
    if found.outdated:
        yield Finding("would rebuild", Verdict.NOTE, f"rows of {', '.join(found.outdated)}, of a newer version now")
    yield _room(found, data_dir)


def _revision(found: Schema) -> Finding:
    if not found.is_known:
        return Finding(
            "schema",
            Verdict.BAD,
            f"revision {found.revision} is newer than this ViAn, which knows up to {found.newest}. "
            "Next: pip install --upgrade vian",
        )
    if found.revision is None:
        return Finding("schema", Verdict.NOTE, f"there is no log in the database yet; it would get {found.newest}")
    if found.is_to_migrate:
        return Finding(
            "schema",
            Verdict.NOTE,
            f"revision {found.revision}, this ViAn's is {found.newest}. It goes up when a command opens the log, and "
            "an older ViAn refuses it then. Next: vian backup FOLDER with the version that wrote it, then vian upgrade",
        )
    return Finding("schema", Verdict.OK, f"revision {found.revision}, this ViAn's own: there is nothing to upgrade")


def _room(found: Schema, data_dir: Path | None) -> Finding:
    need = ROOM_BYTES if found.pending else 0
    said = (
        f"the database has {found.bytes // 2**20} MiB; an upgrade needs {need // 2**20} MiB, "
        f"a backup of it about {found.bytes_log // 2**20} MiB"
    )
    if data_dir is None:
        return Finding("disk", Verdict.NOTE, f"{said}; room on the database's server cannot be seen from here")
    free = shutil.disk_usage(data_dir).free
    if free < need:
        return Finding("disk", Verdict.BAD, f"{free // 2**20} MiB free; {said}. Next: free some")
    return Finding("disk", Verdict.OK, f"{free // 2**20} MiB free; {said}")
