"""`vian backup`, `vian restore`: a copy of the log elsewhere, and the way back."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from events import load_catalogue
from store import Log, Restore, back_up, note_restored, restore, verify_restored
from store.embedded import EmbeddedServer
from store.restoring import usable_manifest
from store.schema import migrate
from vian import options
from vian.errors import WorldFailed
from vian.options import opened, settings_for
from vian.output import Output
from vian.settings import Settings


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(name="backup", epilog="Example: vian backup /mnt/usb/vian-backup")(backup_log)
    app.command(name="restore", epilog="Example: vian restore /mnt/usb/vian-backup --verify --data-dir restored")(
        restore_log
    )


def backup_log(
    destination: Annotated[
        Path, typer.Argument(help="Folder of the backup; a new one, or one that vian backup wrote.", show_default=False)
    ],
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Back the log up into a folder, beside whatever uses it; given again, it adds what is new."""
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log, output.progress("positions", log.head()) as bar:
        done = back_up(log, destination, on_segment=lambda segment: bar.at(segment.position))
    manifest = done.manifest
    output.result(
        {
            "backup": str(destination),
            "position": manifest.position,
            "events": manifest.events,
            "bytes": manifest.bytes,
            "segments_new": done.segments_new,
            "bytes_new": done.bytes_new,
        },
        f"backup in {destination}: {manifest.events} events up to position {manifest.position}, "
        f"{_size(manifest.bytes)}; {done.segments_new} segments were new",
    )


def restore_log(
    source: Annotated[Path, typer.Argument(help="Folder that vian backup wrote.", show_default=False)],
    is_verified: Annotated[
        bool, typer.Option("--verify", help="Read the restored log back and recompute every hash.")
    ] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Restore a backup into an empty log, which goes on in a new epoch."""
    settings = settings_for(data_dir, dsn)
    output = Output(is_json=as_json)
    total = usable_manifest(source).position
    with _database(settings, data_dir) as (address, server):
        with output.progress("positions restored", total) as bar:
            restored = restore(address, source, on_segment=lambda segment: bar.at(segment.position))
        with output.progress("positions verified", total) as bar, Log(address, load_catalogue(), server) as log:
            found = verify_restored(log, source, lambda segment: bar.at(segment.position)) if is_verified else None
    if found is not None and not found.is_sound:
        raise WorldFailed(f"the restored log does not verify: {found.broken[0]}. Next: restore from another copy")
    _note(output, source, restored, is_verified)
    output.result(
        {
            "restored": str(source),
            "made_at": restored.made_at,
            "position": restored.position,
            "events": restored.events,
            "epoch": restored.epoch,
            "verified": is_verified,
        },
        f"restored {restored.events} events up to position {restored.position}, backed up at "
        f"{restored.made_at:%Y-%m-%d %H:%M:%S} UTC; {'read back and verified' if is_verified else 'not read back'}. "
        f"The log goes on in epoch {restored.epoch}. Next: vian project",
    )


@contextmanager
def _database(settings: Settings, data_dir: Path | None) -> Iterator[tuple[str, EmbeddedServer | None]]:
    """The migrated database, with nobody connected to it."""
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


def _note(output: Output, source: Path, restored: Restore, is_verified: bool) -> None:
    try:
        note_restored(source, restored, is_verified=is_verified)
    except OSError as error:
        output.note(
            f"{source} cannot be written ({error.strerror}), so the log it came from will not know that it was "
            f"restored; restore it only once, or two logs will claim epoch {restored.epoch}"
        )


def _size(size: int) -> str:
    return f"{size / 2**20:.1f} MiB" if size >= 2**20 else f"{size / 2**10:.1f} KiB"
