"""What stands in the way of an installation: one finding a check, each with the next command.

Contract: looks, and changes nothing but a probe file that it removes.
"""

import base64
import hashlib
import importlib.util
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from events import CheckpointSigned
from store import BadProof, Log, StoreError, load_key
from store.embedded import MAJOR
from store.keys import FOLDER
from vian.findings import Finding, Verdict
from vian.log_checks import check_log
from vian.options import has_log
from vian.settings import Settings, config_file
from vian.signatures import has_key, key_path, own_station
from vian.version import VERSION

PACKAGES = ("events", "store", "patterns", "extractors", "sync", "migrations", "vian")
DISK_FREE_MIB_MIN = 500


def examine(settings: Settings, open_existing: Callable[[], Log], *, is_embedded: bool) -> Iterator[Finding]:
    """The findings, one after the other.

    Args:
        settings: The installation's settings.
        is_embedded: Whether the log is that of the data directory, not that of an address.
        open_existing: Opens the log; called only when there is one.
    """
    yield Finding("version", Verdict.OK, f"ViAn {VERSION}, Python {sys.version.split()[0]}")
    yield Finding(
        "settings", Verdict.OK, f"from {config_file()}" if config_file().exists() else "defaults and environment"
    )
    yield from _packages()
    if has_key(settings):
        yield _key(settings)
    if is_embedded:
        yield from _data_dir(settings.data_dir)
        if not has_log(settings.data_dir):
            if not has_key(settings):
                yield _no_key(settings)
            yield Finding(
                "log", Verdict.NOTE, f"no log in {settings.data_dir} yet; vian demo or vian extract makes one"
            )
            return
    yield from _log(settings, open_existing)


def _packages() -> Iterator[Finding]:
    """Each of our files must be ours: PyPI has another `events`, for one, that installs over it."""
    strangers = [*_elsewhere(), *_overwritten()]
    if strangers:
        yield Finding(
            "packages",
            Verdict.BAD,
            f"another distribution took the place of: {', '.join(strangers[:5])}. "
            "Next: pip uninstall it, then pip install --force-reinstall vian",
        )
    else:
        yield Finding("packages", Verdict.OK, f"{', '.join(PACKAGES)} belong to this distribution")


def _elsewhere() -> Iterator[str]:
    """Packages that are imported from another folder than this one."""
    here = Path(__file__).resolve().parent.parent
    for name in PACKAGES:
        found = importlib.util.find_spec(name)
        origin = Path(found.origin).resolve() if found and found.origin else None
        if origin is None or origin.parent.parent != here:
            yield f"{name} ({origin or 'missing'})"


def _overwritten() -> Iterator[str]:
    """Files that differ from what the installed distribution recorded; none in a checkout."""
    try:
        recorded = distribution("vian").files or []
    except PackageNotFoundError:
        recorded = []
    for file in recorded:
        if file.hash is None or file.parts[0] not in PACKAGES:
            continue
        path = Path(str(file.locate()))
        digest = hashlib.new(file.hash.mode, path.read_bytes()).digest() if path.exists() else b""
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != file.hash.value:
            yield str(file)


def _key(settings: Settings) -> Finding:
    path = key_path(settings)
    try:
        return Finding("key", Verdict.OK, f"{load_key(path).id} in {path}")
    except BadProof as error:
        return Finding("key", Verdict.BAD, str(error))


def _no_key(settings: Settings, signed_before: str | None = None) -> Finding:
    """What to do about a key that is not here, where a key of that station signed before, or none did."""
    if signed_before is None:
        return Finding("key", Verdict.NOTE, "there is no key: nothing is signed. Next, if it shall be: vian init")
    path = key_path(settings)
    return Finding(
        "key",
        Verdict.NOTE,
        f"there is no key, but one of station {signed_before} signed this log before: nothing is signed any more. "
        f"Next: bring {path} back from where the log was, or from a copy; if it is lost, bring its public key back "
        f"into {path.parent / FOLDER}, then vian init",
    )


def _signed_before(log: Log, settings: Settings) -> str | None:
    """The station whose log this is, if it signed."""
    heads = log.streams()
    own = own_station(log, settings)
    stations = {str(head.stream.station) for head in heads}
    is_signed = any(head.stream.type == CheckpointSigned.type_name for head in heads)
    return stations.pop() if own is None and is_signed and len(stations) == 1 else own


def _data_dir(data_dir: Path) -> Iterator[Finding]:
    try:
        existing = next(folder for folder in (data_dir, *data_dir.parents) if folder.exists())
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        yield Finding(
            "data directory",
            Verdict.BAD,
            f"{data_dir} cannot be written: {error.strerror}. Next: give another with --data-dir",
        )
        return
    yield Finding("data directory", Verdict.OK, f"{data_dir} (embedded PostgreSQL {MAJOR})")
    free = shutil.disk_usage(existing).free // 2**20
    verdict = Verdict.OK if free >= DISK_FREE_MIB_MIN else Verdict.BAD
    next_step = "" if verdict is Verdict.OK else ". Next: free some, or move the log with --data-dir"
    yield Finding("disk", verdict, f"{free} MiB free{next_step}")


def _log(settings: Settings, open_existing: Callable[[], Log]) -> Iterator[Finding]:
    try:
        yield from _log_found(settings, open_existing)
    except StoreError as error:
        yield Finding("log", Verdict.BAD, str(error))


def _log_found(settings: Settings, open_existing: Callable[[], Log]) -> Iterator[Finding]:
    with open_existing() as log:
        if not has_key(settings):
            yield _no_key(settings, _signed_before(log, settings))
        yield Finding("log", Verdict.OK, f"{len(log.streams())} streams, {log.head()} segments, epoch {log.epoch}")
        data_dir = log.server.data_dir if log.server is not None else None
        yield from check_log(log, shutil.disk_usage(data_dir).free if data_dir is not None else None)
        yield from _archive(log)
        yield Finding("psql", Verdict.NOTE, _psql(log))


def _archive(log: Log) -> Iterator[Finding]:
    """Whether every sealed file is in its place with its size; nothing where nothing is sealed."""
    files = log.archive.files()
    if not files:
        return
    try:
        place = log.archive.place()
        place.require()
        strange = [place.full(file.path) for file in files if place.size(file.path) != file.bytes]
    except StoreError as error:
        yield Finding("archive", Verdict.BAD, str(error))
        return
    if strange:
        text = f"{len(strange)} of {len(files)} sealed files are missing or cut off, first {strange[0]}"
        yield Finding("archive", Verdict.BAD, f"{text}. Next: bring them back from a copy, then vian verify")
    else:
        yield Finding("archive", Verdict.OK, f"{len(files)} sealed files at {place.name}")


def _psql(log: Log) -> str:
    if log.server is None:
        return "connect with the address that you gave in --dsn"
    return f"{log.server.bin_path / 'psql'} '{log.dsn}' (while a vian command runs, such as vian serve)"
