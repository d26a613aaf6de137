"""The fixed SELECTs behind `find`: plates and situations, newest first, a page at a time.

Contract: pure; what the station said goes into parameters and never into the text. The pages of one question have
each row that was there at the beginning once, whatever is stored meanwhile: rows are ordered by time and then by
place, and a page begins behind the last row of the one before.
"""

from collections.abc import Sequence
from typing import Any

from sync.protocol.questions import AnswerColumn, FindQuestion

KEY = ("time", "station", "source", "epoch", "sequence")
"""What orders rows, and tells two apart."""
_COLUMNS = {
    "plate": (
        ("time", "timestamptz"),
        ("station", "text"),
        ("source", "text"),
        ("plate", "text"),
        ("confidence", "float4"),
        ("country", "text"),
        ("region", "text"),
        ("id", "text"),
    ),
    "situation": (
        ("time", "timestamptz"),
        ("station", "text"),
        ("source", "text"),
        ("rule", "text"),
        ("severity", "text"),
        ("title", "text"),
        ("began_at", "timestamptz"),
        ("ended_at", "timestamptz"),
        ("situation", "text"),
        ("id", "text"),
    ),
}
_VIEWS = {"plate": "plate_read_events", "situation": "situation_detected_events"}
SEPARATORS = " \t-._/:·•"
"""What stands between the letters of a plate, as in the function plate_key of the database."""


def columns_of(kind: str) -> tuple[AnswerColumn, ...]:
    """The columns of an answer."""
    return tuple(AnswerColumn(name=name, type=type_) for name, type_ in _COLUMNS[kind])


def plate_key(plate: str) -> str:
    """The plate as it is looked for: capital letters (of ASCII), without what stands between them.

    >>> plate_key("1ab 23-45")
    '1AB2345'
    """
    return "".join(letter.upper() if letter.isascii() else letter for letter in plate if letter not in SEPARATORS)


def like(pattern: str) -> str:
    """The pattern of LIKE for one with * and ?.

    >>> like("1A?*")
    '1A_%'
    """
    escaped = pattern.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_")
    return escaped.replace("*", "%").replace("?", "_")


def select(
    question: FindQuestion, stations: Sequence[str] | None, after: Sequence[Any] | None, limit: int
) -> tuple[str, dict[str, Any]]:
    """The SELECT for a page and its parameters: the columns of the kind, then the row's key.

    Args:
        question: What is looked for.
        stations: The stations whose rows may be seen; None for all.
        after: Key of the last row of the page before.
        limit: Most rows.
    """
    given: dict[str, Any] = {
        "stations": None if stations is None else list(stations),
        "plate": None if question.plate is None else like(plate_key(question.plate)),
        "rule": None if question.rule is None else like(question.rule),
        "severity": question.severity,
        "station": question.station,
        "source": question.source,
        "since": question.since,
        "until": question.until,
    }
    conditions = [_CONDITIONS[name] for name, value in given.items() if value is not None]
    if after is not None:
        given |= {f"after_{name}": value for name, value in zip(KEY, after, strict=True)}
        # The time alone first: it tells PostgreSQL which days it need not read.
        conditions += ["time <= cast(%(after_time)s as timestamptz)", f"({', '.join(_ORDER)}) < ({_AFTER})"]
    names = ", ".join((*(name for name, _ in _COLUMNS[question.kind]), f"json_build_array({', '.join(KEY)}) as key"))
    where = f" where {' and '.join(conditions)}" if conditions else ""
    order = ", ".join(f"{each} desc" for each in _ORDER)
    text = f"select {names} from {_VIEWS[question.kind]}{where} order by {order} limit {limit}"
    return text, {name: value for name, value in given.items() if value is not None}


_ORDER = ("time", 'station collate "C"', 'source collate "C"', "epoch", "sequence")
"""The key, as every database orders it alike."""
_CONDITIONS = {
    "stations": "station = any(%(stations)s)",
    "plate": "plate_key(plate) like %(plate)s",
    "rule": "rule like %(rule)s",
    "severity": "severity = %(severity)s",
    "station": "station = %(station)s",
    "source": "source = %(source)s",
    "since": "time >= %(since)s",
    "until": "time < %(until)s",
}
_AFTER = (
    "cast(%(after_time)s as timestamptz), %(after_station)s, %(after_source)s, "
    "cast(%(after_epoch)s as integer), cast(%(after_sequence)s as bigint)"
)
