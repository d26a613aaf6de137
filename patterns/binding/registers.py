"""What a partial match remembers, and how a row changes it.

Registers are values in a tuple; a row that is taken makes a new tuple. Two
partial matches whose live registers are equal behave alike, so every value in
it can be compared and hashed.
"""

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

from patterns.binding.bound import Register
from patterns.binding.program import Tables
from patterns.errors import LimitError

Registers = tuple[Any, ...]

UNSET: tuple[()] = ()
"""A register that nothing was written to: reads as NULL, but differs from a NULL that was written."""

Change = Callable[[Any, Any], Any]
"""(what the register holds, the slot's value) -> what it holds then."""

Update = tuple[int, Change, int]
"""(register, how it changes, slot; -1: none)."""


@dataclass(frozen=True, slots=True, eq=False)
class Listed:
    """One value of a list and those before it: a list that many partial matches share. Equal to itself alone."""

    before: "Listed | None"
    value: Any
    length: int


def initial(register: Register) -> Any:
    """What the register holds before the match's first row."""
    if register.how in ("rows", "values"):
        return 0
    if register.offset or register.how == "first":
        return UNSET
    return None


def update_of(index: int, register: Register, variable: int, listed_most: int, *, wraps: bool = False) -> Update:
    """How a row of this variable changes the register of this index.

    Args:
        index: The register's index.
        register: The register.
        variable: The row's variable.
        listed_most: The limit `listed`.
        wraps: Whether sums of integers are of 64 bits, as all integers of rules are; else of any length.
    """
    slot = register.slot_for(variable)
    change = _lists(listed_most) if register.how == "list" else _change(register)
    if wraps and register.how == "sum":
        change = _sum_of_64_bits
    return index, change, -1 if slot is None else slot


def wrapped(value: int) -> int:
    """The integer as 64 bits hold it, so that all evaluators of rules overflow alike."""
    return (value + 2**63) % 2**64 - 2**63


def updated(registers: Registers, updates: tuple[Update, ...], values: Sequence[Any]) -> Registers:
    """The registers after a row with these values."""
    changed = list(registers)
    for register, change, slot in updates:
        changed[register] = change(changed[register], values[slot] if slot >= 0 else None)
    return tuple(changed)


def live_registers(
    tables: Tables, registers: Sequence[Register], reads: Sequence[AbstractSet[int]]
) -> tuple[tuple[int, ...], ...]:
    """For each position the registers whose value after it can still change which match is found.

    Backward data flow over the pattern's positions, to the fixed point.

    Args:
        tables: The pattern.
        registers: What a match remembers.
        reads: For each variable the registers that its guard reads.
    """
    overwritten = [
        {index for index, each in enumerate(registers) if each.takes(at) and each.how == "last" and not each.offset}
        for at in range(len(reads))
    ]
    before: list[list[int]] = [[] for _ in tables.variables]
    for position, following in enumerate(tables.follow[: tables.start]):
        for after in following:
            before[after].append(position)
    live: list[set[int]] = [set() for _ in tables.variables]
    changed = list(range(len(live)))
    while changed:
        after = changed.pop()
        variable = tables.variables[after]
        needed = (reads[variable] | live[after]) - overwritten[variable]
        for position in before[after]:
            if not needed <= live[position]:
                live[position] |= needed
                changed.append(position)
    return tuple(tuple(sorted(each)) for each in live)


def listed(register: Listed | None) -> list[Any]:
    """The values of a list register, in order."""
    values = []
    while register is not None:
        values.append(register.value)
        register = register.before
    return values[::-1]


def at_offset(how: str, offset: int) -> Callable[[tuple[Any, ...]], Any]:
    """How to read a `first` or `last` register that has an offset: NULL where there are not so many rows."""
    index = offset if how == "first" else 0
    return lambda window: window[index] if len(window) > offset else None


def _change(register: Register) -> Change:
    offset = register.offset
    if register.how == "last":
        return _last if not offset else lambda held, value: (*held[-offset:], value)
    if register.how == "first":
        return _first if not offset else lambda held, value: held if len(held) > offset else (*held, value)
    return _CHANGES[register.how]


def _lists(most: int) -> Change:
    def append(held: Listed | None, value: Any) -> Listed:
        length = 1 if held is None else held.length + 1
        if length > most:
            raise LimitError(
                f"a partial match lists {length} values for an aggregate in DEFINE; the limit `listed` is {most}. "
                "Use COUNT, SUM, MIN, MAX or AVG, which keep one value each"
            )
        return Listed(held, value, length)

    return append


def _last(held: Any, value: Any) -> Any:
    return value


def _first(held: Any, value: Any) -> Any:
    return value if held is UNSET else held


def _sum(held: Any, value: Any) -> Any:
    return held if value is None else value if held is None else held + value


def _sum_of_64_bits(held: Any, value: Any) -> Any:
    total = _sum(held, value)
    return wrapped(total) if isinstance(total, int) else total


def _min(held: Any, value: Any) -> Any:
    return held if value is None or (held is not None and held <= value) else value


def _max(held: Any, value: Any) -> Any:
    return held if value is None or (held is not None and held >= value) else value


_CHANGES: dict[str, Change] = {
    "rows": lambda held, value: held + 1,
    "values": lambda held, value: held + (value is not None),
    "sum": _sum,
    "min": _min,
    "max": _max,
}
