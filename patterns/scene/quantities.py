"""Speeds and lengths as rule files write them: `50 km/h`, `1.5 m`, `20 px`, `8 px/s`.

In SQL such a parameter is a number in its base unit: metres, metres a second, pixels or pixels a second.
"""

import re
from fractions import Fraction

FACTORS: dict[str, tuple[str, Fraction]] = {
    "mm": ("m", Fraction(1, 1000)), "cm": ("m", Fraction(1, 100)), "m": ("m", Fraction(1)), "km": ("m", Fraction(1000)),
    "m/s": ("m/s", Fraction(1)), "km/h": ("m/s", Fraction(5, 18)), "px": ("px", Fraction(1)),
    "px/s": ("px/s", Fraction(1)),
}  # fmt: skip
"""For each unit its base unit, and how many of that it is."""
_WRITTEN = re.compile(r"\s*([+-]?[0-9]+(?:\.[0-9]+)?)\s*([a-zA-Z]+(?:/[a-zA-Z]+)?)\s*")


class Quantity:
    """A number with a unit; equal to another that means the same."""

    __slots__ = ("number", "unit")

    def __init__(self, number: str, unit: str) -> None:
        self.number = number
        self.unit = unit

    @property
    def base_unit(self) -> str:
        """The unit that `value` is in: m, m/s, px or px/s."""
        return FACTORS[self.unit][0]

    @property
    def value(self) -> float:
        """The number in the base unit."""
        return float(Fraction(self.number) * FACTORS[self.unit][1])

    def __str__(self) -> str:
        return f"{self.number} {self.unit}"

    def __repr__(self) -> str:
        return f"Quantity({self.number!r}, {self.unit!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Quantity) and (self.base_unit, self.value) == (other.base_unit, other.value)

    def __hash__(self) -> int:
        return hash((self.base_unit, self.value))


def parse_quantity(text: str) -> Quantity:
    """The quantity that the text writes.

    >>> parse_quantity("36 km/h").value
    10.0

    Raises:
        ValueError: Not a number and one of the units.
    """
    written = _WRITTEN.fullmatch(text)
    if written is None or written[2] not in FACTORS:
        raise ValueError(
            f"a speed or length is a number and one of {', '.join(FACTORS)}, as in '50 km/h'; got {text!r}"
        )
    return Quantity(written[1], written[2])


def is_quantity(text: str) -> bool:
    """Whether the text writes a speed or a length."""
    written = _WRITTEN.fullmatch(text)
    return written is not None and written[2] in FACTORS
