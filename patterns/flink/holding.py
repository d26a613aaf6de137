"""What `emit` holds back, as one more step over the matches."""

from collections.abc import Sequence
from dataclasses import dataclass

from patterns.flink.names import later_sql, quoted

_CHAIN = """\
SELECT {columns}
FROM {matches} MATCH_RECOGNIZE (
    {partition}ORDER BY {order}
    MEASURES {measures}
    ONE ROW PER MATCH
    AFTER MATCH SKIP TO LAST `next`
    PATTERN (`kept` `held`*? `next`)
    DEFINE `held` AS `held`.`last_time` < {over},
           `next` AS `next`.`last_time` >= {over}
)"""


@dataclass(frozen=True, slots=True)
class Held:
    """What is held back of a view of matches.

    Attributes:
        matches: The view.
        columns: All its columns, in order.
        keys: Of them, those that make a key.
        order: Of them, the order in which matches were decided, the time attribute first.
        cooldown_us: For how long a key's matches are held back; None: for good.
    """

    matches: str
    columns: Sequence[str]
    keys: Sequence[str]
    order: Sequence[str]
    cooldown_us: int | None


def held_sql(held: Held) -> str:
    """The query for what is let through: the first of each key, and each that comes after its cooldown."""
    first = _first(held)
    return first if held.cooldown_us is None else f"{first}\nUNION ALL\n{_later(held, held.cooldown_us)}"


def _first(held: Held) -> str:
    partition = f"PARTITION BY {_listed(held.keys)} " if held.keys else ""
    numbered = f"ROW_NUMBER() OVER ({partition}ORDER BY {quoted(held.order[0])} ASC) AS `nth`"
    return (
        f"SELECT {_listed(held.columns)}\n"
        f"FROM (SELECT *, {numbered} FROM {quoted(held.matches)})\n"
        "WHERE `nth` = 1"
    )  # fmt: skip


def _later(held: Held, cooldown_us: int) -> str:
    """Each match that comes when the cooldown of the one let through before it is over."""
    measures = [f"`next`.{quoted(name)} AS {quoted(name)}" for name in held.columns if name not in held.keys]
    return _CHAIN.format(
        columns=_listed(held.columns),
        matches=quoted(held.matches),
        partition=f"PARTITION BY {_listed(held.keys)}\n    " if held.keys else "",
        order=_listed(held.order),
        measures=",\n             ".join(measures),
        over=later_sql("`kept`.`last_time`", cooldown_us),
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(quoted(name) for name in names)
