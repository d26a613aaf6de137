"""Whether a plan can do what it says, beyond its own text: filters that fit the types, entries that can ever apply.

Contract: pure; a filter that does not fit is a PlanError, an entry that never applies a warning.
"""

from collections.abc import Collection, Iterator
from fnmatch import fnmatchcase

import duckdb

from events import Catalogue, EventType, StreamName
from sync.errors import PlanError
from sync.plans.entries import Entry
from sync.plans.filtering import Sieve, database
from sync.plans.plan import Plan


def check_filters(plan: Plan, catalogue: Catalogue) -> None:
    """Nothing, if every filter fits all types of this program that come to its entry.

    Raises:
        PlanError: One does not; it says which, and of which type.
    """
    with database() as runs:
        for number, entry in enumerate(plan.entries):
            if entry.is_derived:
                _check_filter(plan, number, entry, catalogue, runs)


def _check_filter(plan: Plan, number: int, entry: Entry, catalogue: Catalogue, runs: duckdb.DuckDBPyConnection) -> None:
    types = list(_types(plan, number, catalogue))
    if not types:
        known = ", ".join(sorted(each.type_name for each in catalogue))
        raise PlanError(
            f"entries[{number}] ({entry.stream}): no type that this program knows comes to it, so nothing can be "
            f"filtered; known: {known}"
        )
    for event_type in types:
        try:
            Sieve(entry, event_type, runs)
        except PlanError as error:
            narrower = "; name a single type in the pattern" if len(types) > 1 else ""
            end = "\n" if "\n" in str(error) else ". "
            raise PlanError(f"entries[{number}] {error}{end}Next: correct the entry{narrower}") from error


def warnings_of(plan: Plan) -> list[str]:
    """What the plan says in vain: entries that an earlier one covers."""
    found = []
    for number, entry in enumerate(plan.entries):
        earlier = next((n for n, each in enumerate(plan.entries[:number]) if covers(each.stream, entry.stream)), None)
        if earlier is not None:
            found.append(
                f"entries[{number}] ({entry.stream}) never applies: entries[{earlier}] stands before it, and its "
                f"pattern {plan.entries[earlier].stream} takes all of its streams. Next: put it first, or take it out"
            )
    return found


def unmatched(plan: Plan, streams: Collection[StreamName], catalogue: Catalogue) -> list[str]:
    """The entries that fit no stream of those: right before anything is recorded, else perhaps a slip."""
    found = []
    for number, entry in enumerate(plan.entries):
        if any(map(entry.fits, streams)):
            continue
        kind = entry.stream.split("/")[2]
        is_known = any(fnmatchcase(str(each.type_name), kind) for each in catalogue)
        slip = "" if is_known else f", and no event type that is installed here fits {kind}"
        found.append(
            f"entries[{number}] ({entry.stream}) fits no stream of this station yet{slip}. "
            f"Next, if it is a slip: {'vian streams' if is_known else 'vian events'}"
        )
    return found


def covers(wide: str, narrow: str) -> bool:
    """Whether the first pattern certainly fits every stream that the second fits; False where it is not certain."""
    return all(map(_covers, wide.split("/"), narrow.split("/")))


def _covers(wide: str, narrow: str) -> bool:
    if wide == narrow or not set(wide) - {"*"}:
        return True
    return not set(narrow) & set("*?[") and fnmatchcase(narrow, wide)


def _types(plan: Plan, number: int, catalogue: Catalogue) -> Iterator[type[EventType]]:
    """The types that come to an entry: those that its pattern fits and no earlier entry takes for certain."""
    station, source, type_part = plan.entries[number].stream.split("/")
    for event_type in catalogue:
        name = str(event_type.type_name)
        is_taken = any(covers(each.stream, f"{station}/{source}/{name}") for each in plan.entries[:number])
        if fnmatchcase(name, type_part) and not is_taken:
            yield event_type
