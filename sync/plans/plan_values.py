"""How a plan writes rates, durations, times and truths, and what they mean.

Contract: pure. YAML gives texts, TOML and JSON typed values; both mean the same here. What is refused is a
ValueError that says what was wanted, which pydantic passes on with its place.
"""

import re
from datetime import UTC, datetime, timedelta

RATE_BPS_MIN, RATE_BPS_MAX = 1_000, 10**12
DURATION_MAX = timedelta(days=36_500)

_RATE = re.compile(r"(\d{1,12}(?:\.\d{1,6})?) ?(|k|M|G)bit/s")
_PREFIXES = {"": 1, "k": 1_000, "M": 10**6, "G": 10**9}
_DURATION = re.compile(r"(\d{1,9}(?:\.\d{1,6})?) ?(s|min|h|d)")
_UNITS_S = {"s": 1, "min": 60, "h": 3_600, "d": 86_400}


def rate(value: object) -> int | None:
    """The rate in bits a second that a text such as `800 kbit/s` says; None for None.

    >>> rate("1.5 Mbit/s")
    1500000

    Raises:
        ValueError: It says none, or one out of range.
    """
    if value is None:
        return None
    found = _RATE.fullmatch(value) if isinstance(value, str) else None
    bps = round(float(found[1]) * _PREFIXES[found[2]]) if found else 0
    if not RATE_BPS_MIN <= bps <= RATE_BPS_MAX:
        raise ValueError("must be a rate such as 800 kbit/s or 1.5 Mbit/s, from 1 kbit/s to 1000 Gbit/s")
    return bps


def duration(value: object) -> timedelta:
    """The duration that a text such as `7 d` says.

    >>> duration("36 h").days
    1

    Raises:
        ValueError: It says none.
    """
    if isinstance(value, timedelta):
        return value
    found = _DURATION.fullmatch(value) if isinstance(value, str) else None
    if not found or float(found[1]) * _UNITS_S[found[2]] > DURATION_MAX.total_seconds():
        raise ValueError("must be a duration such as 7 d, 36 h, 30 min or 10 s")
    return timedelta(seconds=round(float(found[1]) * _UNITS_S[found[2]]))


def whole_seconds(length: timedelta) -> str:
    """The duration as a plan writes it."""
    return f"{round(length.total_seconds())} s"


def time_text(time: datetime | None) -> str | None:
    """The time in UTC as a plan writes it; None for None."""
    return None if time is None else time.astimezone(UTC).isoformat().replace("+00:00", "Z")


def truth(value: object) -> object:
    """True or False where a text says so; anything else as it is."""
    return {"true": True, "false": False}.get(value, value) if isinstance(value, str) else value


def no_text(value: object) -> str:
    """A value as messages show it: short."""
    return repr(str(value)[:60])
