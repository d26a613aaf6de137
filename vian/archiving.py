"""The archive's work as commands do it: seal what is old, write its Parquet, move the whole to another place."""

import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from store import Log
from store.parquet import Projected, project, waiting
from store.places import Place
from store.sealing import Sealed, Sealer, archiver
from vian.errors import WorldFailed, WrongUsage
from vian.settings import at_home

_UNITS = {"d": 86_400.0, "h": 3_600.0, "m": 60.0, "s": 1.0}
_AGE = re.compile(r"(\d+(?:\.\d+)?)\s*([dhms])")


def days_of(option: str, text: str | None) -> float | None:
    """The option's span of time in days, from a text such as 30d, 12h, 90m or 10s.

    >>> days_of("--older-than", "12h")
    0.5

    Raises:
        WrongUsage: It is none.
    """
    if text is None:
        return None
    if (found := _AGE.fullmatch(text.strip())) is None:
        raise WrongUsage(f"{option} must be a span of time such as 30d, 12h, 90m or 10s, got {text!r}")
    return float(found[1]) * _UNITS[found[2]] / _UNITS["d"]


def time_before(days: float, now: datetime) -> datetime:
    """The time so many days ago.

    Raises:
        WrongUsage: It lies before the first year.
    """
    try:
        return now.astimezone(UTC) - timedelta(days=days)
    except OverflowError as error:
        raise WrongUsage(f"an age of {days:g} days lies before the year 1. Next: give a smaller one") from error


def location_for(log: Log, wanted: str | None) -> str:
    """Where sealed files go: what was wanted, else where the log's archive is.

    Raises:
        WrongUsage: It is in the home of somebody who has none.
    """
    if wanted is None:
        return log.archive.head().location
    if "://" in wanted:
        return wanted
    try:
        return str(at_home(Path(wanted)).resolve())
    except ValueError as error:
        raise WrongUsage(f"the archive cannot be at {wanted}: {error}. Next: check the name") from error


def place_of(log: Log, location: str) -> Place:
    """The place that a location names, for this log."""
    return Place(location, log.server.data_dir if log.server else None)


def archive(
    log: Log,
    location: str,
    before: datetime,
    file_bytes: int,
    on_step: Callable[[str], None] = lambda step: None,
) -> Iterator[Sealed | Projected]:
    """Seal what the log took before a time, and write the Parquet of each file; what was done, as it is done.

    What an earlier run left undone comes first.

    Args:
        log: The log.
        location: Where sealed files go.
        before: Segments recorded before this time are sealed.
        file_bytes: About how large a sealed file becomes.
        on_step: Told after each step.
    """
    sealer = Sealer(log, location, file_bytes=file_bytes, on_step=on_step)
    sealer.resume()
    yield from _projected(log, on_step)
    for sealed in sealer.seal(before):
        yield sealed
        yield from _projected(log, on_step)


def _projected(log: Log, on_step: Callable[[str], None]) -> Iterator[Projected]:
    for file in waiting(log):
        yield project(log, file)
        on_step("projected")


def relocate(log: Log, location: str, on_file: Callable[[int], None] = lambda count: None) -> int:
    """Read the log from sealed files at another place from now on, when all of them are there; how many these are.

    Args:
        log: The log.
        location: Where they lie now.
        on_file: Told how many were found to be right so far.

    Raises:
        WorldFailed: One is not there, or is not the one that was sealed.
    """
    place = place_of(log, location)
    place.require()
    files = log.archive.files()
    for count, file in enumerate(files, 1):
        try:
            sha256, _ = place.digest(file.path)
        except FileNotFoundError as error:
            raise WorldFailed(f"{place.full(file.path)} is not there. Next: copy all files first") from error
        if sha256 != file.sha256:
            raise WorldFailed(
                f"{place.full(file.path)} has SHA-256 {sha256.hex()}, sealed was {file.sha256.hex()}. "
                "Next: copy it again"
            )
        on_file(count)
    with archiver(log) as connection:
        connection.execute("select relocate_archive(%s)", (location,))
    return len(files)
