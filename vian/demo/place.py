"""Where the demo goes: into the folder asked for, or the first beside it that this release's demo may use.

Contract: looking appends nothing, but brings a log to this release's schema, as opening it does. A log in which another
release's demo is keeps its events and gets no others: beside them this one's would be counted twice. One that this
release cannot open is not touched.
"""

from collections.abc import Callable, Iterable, Mapping
from itertools import count
from pathlib import Path

from events import ProcessStarted
from patterns.files.rule import Rule
from patterns.processor import standing
from store import Log, SchemaMismatch, WrongMajor, open_log
from vian.errors import WorldFailed
from vian.options import has_log
from vian.said import Said

FOLDERS_MAX = 100
"""So many folders are looked into: one for each release that somebody may have tried."""


def folder_for(wanted: Path, obstacle: Callable[[Log], str | None], note: Callable[[str], None]) -> Path:
    """The folder, or the first of `FOLDER-2`, `FOLDER-3`, ... in whose log nothing stands in the way, or that has none.

    Args:
        wanted: The folder asked for.
        obstacle: What stands in the way of the demo in a log, in words; None: nothing.
        note: Told of each folder that is left alone.

    Raises:
        WorldFailed: All have logs that the demo must leave alone.
    """
    folder = wanted
    for number in count(2):
        if not has_log(folder):
            return folder
        found = _found(folder, obstacle)
        if found is None:
            return folder
        if number > FOLDERS_MAX:
            break
        left, folder = folder, wanted.with_name(f"{wanted.name}-{number}")
        note(f"the log in {left} {found}. Nothing is added to it, and the demo goes on in {folder}")
    raise WorldFailed(
        f"{FOLDERS_MAX} folders from {wanted} to {folder} hold logs that the demo leaves alone. "
        "Next: remove those that nobody needs, or vian demo --data-dir NEW-FOLDER"
    )


def _found(folder: Path, obstacle: Callable[[Log], str | None]) -> str | None:
    try:
        with open_log(data_dir=folder) as log:
            return obstacle(log)
    except SchemaMismatch:
        return "is of a newer release, or not of ViAn alone"
    except WrongMajor:
        return "is of a release with another PostgreSQL"


def obstacle_in(log: Log, station: str, processes: Mapping[str, str], rules: Iterable[Rule]) -> str | None:
    """What stands in the way of a station's demo in the log, in words that go on "the log ..."; None: nothing.

    Args:
        log: The log.
        station: The demo's station.
        processes: What the demo's extractions are called, by source.
        rules: The rules that it deploys.
    """
    stations = {head.stream.station for head in log.streams()}
    if stations and station not in stations:
        return f"holds streams of {', '.join(sorted(stations)[:3])}, beside which the demo's would stay for ever"
    deployed = {each.key: each.rule_hash for each in standing(log, station).values()}
    if any(deployed.get((rule.rule, rule.version), rule.hash) != rule.hash for rule in rules):
        return "was begun by another release's demo, whose rules were others"
    newest = {source: Said(log, station, source).newest(ProcessStarted) for source in processes}
    if any(begun is not None and begun[0].process != processes[source] for source, begun in newest.items()):
        return "was begun by another release's demo, whose tracks were others"
    return None
