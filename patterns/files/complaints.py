"""What pydantic says of a file's values, in the words of those who write the file.

Contract: pure. Of a value that may be of several types, one complaint is made, and it says what is wanted.
"""

from collections.abc import Mapping
from typing import Any

PARAM_WANTED = (
    "wanted a number, true or false, a text, a duration such as 10 s, a length or speed such as 2.5 m or 50 km/h, "
    "or a list of these"
)
_NAME_WANTED = "a name is 1 to 64 of A-Z a-z 0-9 . _ - and begins and ends with a letter or digit"
_COLUMN_WANTED = "a name here is a letter or _, then up to 62 letters, digits or _"


def in_words(complaint: Mapping[str, Any]) -> tuple[tuple[str, ...], str]:
    """Where in the file a complaint belongs, and what it says.

    Args:
        complaint: One of pydantic's, as `ValidationError.errors` gives them.
    """
    location = tuple(str(part) for part in complaint["loc"])
    given = complaint["input"]
    got = f", got {given!r}" if given is None or isinstance(given, str | int | float) else ""
    if location[0:1] == ("params",) and len(location) > 2 and location[2] != "[key]":
        return location[:2], PARAM_WANTED + got
    return location, _words(complaint, got)


def _words(complaint: Mapping[str, Any], got: str) -> str:
    context = complaint.get("ctx", {})
    match complaint["type"]:
        case "value_error":
            return str(complaint["msg"]).removeprefix("Value error, ")
        case "string_pattern_mismatch":
            return (_NAME_WANTED if "._-" in context["pattern"] else _COLUMN_WANTED) + got
        case "time_delta_type":
            return f"wanted a duration with its unit, such as 10 s{got}"
        case "too_long":
            return f"wanted {context['max_length']} values, got {context['actual_length']}"
        case "too_short":
            return f"wanted {context['min_length']} values or more, got {context['actual_length']}"
        case "finite_number":
            return f"wanted a finite number{got}"
        case "string_type":
            return f"wanted a text{got}"
        case _:
            return f"{complaint['msg']}{got}"
