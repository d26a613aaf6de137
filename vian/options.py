"""Options that many commands share, and how a command opens the log they name."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from events import load_catalogue
from store import Log, open_log
from store.embedded import EmbeddedServer
from store.schema import migrate
from vian.errors import WorldFailed, WrongUsage
from vian.settings import Settings, load_settings


def existing(given: Path | list[Path] | None) -> Path | list[Path] | None:
    """What a command is told to read, if it is there: the callback of each argument and option that names such a path.

    Raises:
        WrongUsage: It is not there. That nobody may read it is told by who reads it.
    """
    for path in [given] if isinstance(given, Path) else given or []:
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError) as error:
            raise WrongUsage(f"{path}: no such file or folder. Next: check the name") from error
        except OSError:
            continue
    return given


DataDir = Annotated[
    Path | None, typer.Option("--data-dir", help="Folder of the embedded log.", show_default="the user's data folder")
]
Dsn = Annotated[str | None, typer.Option("--dsn", help="External PostgreSQL instead: postgresql://user@host/database.")]
Station = Annotated[str | None, typer.Option("--station", help="Name of this station.", show_default="the host's name")]
KeyFile = Annotated[
    Path | None,
    typer.Option("--key-file", help="This station's key for signatures.", show_default="station.key in --data-dir"),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object a line, for machines.")]
Since = Annotated[str | None, typer.Option("--since", help="Only events at or after this time (ISO 8601, UTC).")]
Until = Annotated[str | None, typer.Option("--until", help="Only events before this time (ISO 8601, UTC).")]
Sources = Annotated[list[str] | None, typer.Option("--source", help="Only this source; may be repeated.")]
Types = Annotated[list[str] | None, typer.Option("--type", help="Only this event type; may be repeated.")]


def settings_for(data_dir: Path | None = None, dsn: str | None = None, **given: object) -> Settings:
    """The settings with what the command line gave on top.

    Raises:
        WrongUsage: Both a data directory and an address were given, or a setting is wrong.
    """
    if data_dir is not None and dsn is not None:
        raise WrongUsage("give either --data-dir or --dsn, got both")
    return load_settings(data_dir=data_dir, dsn=dsn, **given)


def open_from(settings: Settings, *, data_dir: Path | None = None) -> Log:
    """The log that the settings name; a data directory on the command line beats an address in a file."""
    if settings.dsn is not None and data_dir is None:
        log = open_log(dsn=settings.dsn.get_secret_value())
    else:
        log = open_log(data_dir=settings.data_dir)
    log.room.bytes_min = settings.disk_free_mb_min * 2**20
    return log


def has_log(data_dir: Path) -> bool:
    """Whether there is an embedded log in the folder, or something that keeps one from looking."""
    try:
        return (data_dir / "pg" / "PG_VERSION").exists()
    except PermissionError:
        return True  # opening it says what is the matter


def _what_is_there(data_dir: Path) -> str:
    """What stands where a log was wanted."""
    if not data_dir.exists():
        return "there is no such folder"
    if not data_dir.is_dir():
        return "it is a file"
    if (data_dir / "PG_VERSION").exists():
        return f"it is the inside of one; give {data_dir.parent}"
    names = sorted(path.name for path in data_dir.iterdir())
    return f"it holds {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}" if names else "it is empty"


@contextmanager
def opened(settings: Settings, *, data_dir: Path | None = None, is_made: bool = False) -> Iterator[Log]:
    """The log of `open_from`, for the length of the block.

    Args:
        settings: The settings.
        data_dir: What the command line gave, if anything.
        is_made: Whether an embedded log is made where there is none yet; a command that only reads
            had better say that the folder is the wrong one.

    Raises:
        WorldFailed: There is no log in the folder.
    """
    is_embedded = settings.dsn is None or data_dir is not None
    if is_embedded and not is_made and not has_log(settings.data_dir):
        raise WorldFailed(
            f"there is no log in {settings.data_dir} ({_what_is_there(settings.data_dir)}). "
            "Next: vian demo or vian extract makes one; for one that is elsewhere give --data-dir DIR or --dsn URL"
        )
    with open_from(settings, data_dir=data_dir) as log:
        yield log


@contextmanager
def bare_database(settings: Settings, *, data_dir: Path | None = None) -> Iterator[tuple[str, EmbeddedServer | None]]:
    """Address of the migrated database of `open_from`, with nobody connected; its server, if it is an embedded one."""
    if settings.dsn is not None and data_dir is None:
        address = settings.dsn.get_secret_value()
        migrate(address, load_catalogue())
        yield address, None
        return
    server = EmbeddedServer(settings.data_dir.expanduser().resolve())
    try:
        migrate(server.dsn, load_catalogue())
        yield server.dsn, server
    finally:
        server.close()


def time_of(option: str, text: str | None) -> datetime | None:
    """The option's text as a time; UTC where it names no zone.

    Raises:
        WrongUsage: It is not a time.
    """
    if text is None:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise WrongUsage(f"{option} must be a time such as 2026-01-31T12:00:00Z, got {text!r}") from error
    try:
        return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    except OverflowError as error:
        raise WrongUsage(f"{option} must lie in the years 1 to 9999 of UTC, got {text!r}") from error


def has_zone(text: str) -> bool:
    """Whether the text of a time says its time zone."""
    return datetime.fromisoformat(text).tzinfo is not None


def check_known(what: str, wanted: Sequence[str] | None, known: Collection[str]) -> None:
    """Refuse a name that nothing in the log bears: an empty answer would hide the slip.

    Raises:
        WrongUsage: One of the wanted names is not known.
    """
    unknown = sorted(set(wanted or ()) - set(known))
    if unknown:
        raise WrongUsage(f"no {what} {unknown[0]!r} in this log; known: {', '.join(sorted(known)) or 'none yet'}")
