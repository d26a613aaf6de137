"""`vian backup`, `vian restore`: a copy of the log elsewhere, and the way back."""

from pathlib import Path
from typing import Annotated

import typer

from events import CheckpointSigned, load_catalogue
from store import BadProof, Log, Restore, back_up, note_restored, restore, verify_restored
from store.keys import copy_public
from store.restoring import usable_manifest
from vian import options
from vian.errors import WorldFailed
from vian.options import bare_database, opened, settings_for
from vian.output import Output
from vian.signatures import KEY_NAME, key_path


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
    key_file: options.KeyFile = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Back the log up into a folder, beside whatever uses it; given again, it adds what is new.

    The station's public keys come along, its private key and its settings do not.
    """
    settings = settings_for(data_dir, dsn, key_file=key_file)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log, output.progress("positions", log.head()) as bar:
        done = back_up(log, destination, on_segment=lambda segment: bar.at(segment.position))
    _copy_keys(output, key_path(settings), destination / KEY_NAME)
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
    source: Annotated[
        Path, typer.Argument(help="Folder that vian backup wrote.", show_default=False, callback=options.existing)
    ],
    is_verified: Annotated[
        bool, typer.Option("--verify", help="Read the restored log back and recompute every hash.")
    ] = False,
    key_file: options.KeyFile = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Restore a backup into an empty log, which goes on in a new epoch."""
    settings = settings_for(data_dir, dsn, key_file=key_file)
    output = Output(is_json=as_json)
    manifest = usable_manifest(source)
    total = manifest.position
    with bare_database(settings, data_dir=data_dir) as (address, server):
        with output.progress("positions restored", total) as bar:
            restored = restore(address, source, on_segment=lambda segment: bar.at(segment.position))
        with output.progress("positions verified", total) as bar, Log(address, load_catalogue(), server) as log:
            found = verify_restored(log, source, lambda segment: bar.at(segment.position)) if is_verified else None
    if found is not None and not found.is_sound:
        raise WorldFailed(f"the restored log does not verify: {found.broken[0]}. Next: restore from another copy")
    _note(output, source, restored, is_verified)
    brought = _copy_keys(output, source / KEY_NAME, key_path(settings))
    is_signed = any(head.key[0].type == CheckpointSigned.type_name for head in manifest.streams)
    output.result(
        {
            "restored": str(source),
            "made_at": restored.made_at,
            "position": restored.position,
            "events": restored.events,
            "epoch": restored.epoch,
            "verified": is_verified,
            "public_keys": brought,
        },
        f"restored {restored.events} events up to position {restored.position}, backed up at "
        f"{restored.made_at:%Y-%m-%d %H:%M:%S} UTC; {'read back and verified' if is_verified else 'not read back'}. "
        f"The log goes on in epoch {restored.epoch}. "
        f"{_words_on_keys(brought, key_path(settings)) if is_signed else ''}Next: vian project",
    )


def _copy_keys(output: Output, source: Path, target: Path) -> list[str]:
    """Take the public keys along; ids of the station's own that were not there."""
    try:
        return copy_public(source, target)
    except BadProof as error:
        output.note(f"not every public key was copied: {error}")
        return []


def _words_on_keys(brought: list[str], path: Path) -> str:
    """What is to be done about the keys of a log that was signed."""
    came = f"Public keys that came with it, to be compared with those you noted: {', '.join(brought)}. "
    old = f"The key that signs is in no backup: copy the old station.key to {path}, and public-keys/ beside it. "
    return (came if brought else "") + ("" if path.exists() else old)


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
