"""Units in conditions: a speed is not compared with a length, nor metres with pixels.

A column's unit is the one that its event type's description names (`..., px/s`), a parameter's the one
that it is written with. A number without a unit goes with any, and what nothing is known of is let
through: what is named is wrong, what is not named may be wrong all the same.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa
from sqlglot import exp

from patterns.scene.quantities import Quantity

Units = Mapping[str, str]

_NAMED = re.compile(r", (px/s|px|m/s|m)(?=$|[;,(])")
_COMPARED = (exp.LT, exp.LTE, exp.GT, exp.GTE, exp.EQ, exp.NEQ, exp.Add, exp.Sub)
_KEPT = frozenset(("PREV", "NEXT", "FIRST", "LAST", "MIN", "MAX", "AVG", "SUM", "ABS", "LEAST", "GREATEST", "COALESCE"))
_GROUND = {"GROUND_X": "m", "GROUND_Y": "m", "GROUND_SPEED": "m/s", "DISTANCE_M": "m"}
_SHORT = {"speed_kmh": "km/h"}


def units_of(schema: pa.Schema) -> dict[str, str]:
    """The units of the columns whose descriptions name one that parameters have, too."""
    found = {}
    for field in schema:
        description = (field.metadata or {}).get(b"description", b"").decode()
        named = _NAMED.search(description)
        if named is not None:
            found[field.name] = named[1]
    return found


def mismatches(node: exp.Expr, units: Units, params: Mapping[str, Any]) -> Iterator[tuple[exp.Expr, str, str]]:
    """The comparisons, sums and differences below the node whose two sides have different units, with both."""
    for part in node.walk():
        if isinstance(part, exp.Between):
            pairs = [(part.this, part.args["low"]), (part.this, part.args["high"])]
        elif isinstance(part, _COMPARED):
            pairs = [(part.this, part.expression)]
        else:
            continue
        for left, right in pairs:
            one, other = unit_of(left, units, params), unit_of(right, units, params)
            if one and other and one != other:
                yield part, one, other


def unit_of(node: Any, units: Units, params: Mapping[str, Any]) -> str:
    """The expression's unit; empty if it has none, or none that is known."""
    if isinstance(node, exp.Column):
        return units.get(node.name.lower(), _SHORT.get(node.name.lower(), ""))
    if isinstance(node, exp.Placeholder):
        value = params.get(str(node.this or ""))
        return value.base_unit if isinstance(value, Quantity) else ""
    if isinstance(node, exp.Anonymous):
        return _of_call(str(node.this).upper(), [unit_of(each, units, params) for each in node.expressions])
    if isinstance(node, exp.Paren | exp.Neg):
        return unit_of(node.this, units, params)
    if isinstance(node, exp.Add | exp.Sub):
        return unit_of(node.this, units, params) or unit_of(node.expression, units, params)
    if isinstance(node, exp.Mul):
        return _product(unit_of(node.this, units, params), unit_of(node.expression, units, params))
    return ""


def _of_call(name: str, given: list[str]) -> str:
    """The unit of what a function gives, from those of its arguments."""
    if name == "SQRT":
        return given[0].removesuffix("²") if given and given[0].endswith("²") else ""
    if name in _KEPT:
        return next(filter(None, given), "")
    return _GROUND.get(name, "")


def _product(one: str, other: str) -> str:
    """The unit of a product: known for a square only. A plain factor may convert, as in `speed * 3.6`."""
    return f"{one}²" if one and one == other and not one.endswith("²") else ""
