"""Where AFTER MATCH SKIP to a variable has no row to go to: for every match of the pattern, or for some."""

from typing import Literal

from patterns.binding.bound import BoundRule
from patterns.language.parser import parse
from patterns.language.syntax import SkipMode
from patterns.linting.findings import Finding

_Target = Literal["absent", "first", "later"]
"""The row to skip to: none, the match's first, one after that."""


def skip_findings(bound: BoundRule) -> list[Finding]:
    """A skip that sets the rule aside at every match is an error, one that does it at some is a warning."""
    if not bound.skip_variables:
        return []
    passage = bound.rule.passage("match")
    skip = parse(passage).clause.skip
    assert skip.variable is not None, "there are variables to skip to"
    name, targets = skip.variable.name, _targets(bound)
    said = []
    if "first" in targets:
        said.append(f"{name} is the first row of the match, and the search would find it for ever")
    if "absent" in targets:
        said.append(f"{name} is not in the match")
    if not said:
        return []
    is_always = "later" not in targets
    when = "at every match" if is_always else "at some matches of PATTERN"
    message = (
        f"AFTER MATCH SKIP {skip.mode.value} {name}: {when} {', or '.join(said)}: the rule is set aside there. "
        "Next: skip to a variable that comes later in every match, TO NEXT ROW or PAST LAST ROW"
    )
    return [Finding("error" if is_always else "warning", message, passage.place(skip.variable.at), "skip-nowhere")]


def _targets(bound: BoundRule) -> set[_Target]:
    """The rows that the skip may go to, over all ways through the pattern, whatever the conditions say."""
    tables, wanted = bound.tables, frozenset(bound.skip_variables)
    seen: set[tuple[int, _Target]] = {
        (at, "first" if tables.variables[at] in wanted else "absent") for at in tables.firsts()
    }
    waiting = list(seen)
    while waiting:
        position, target = waiting.pop()
        for after in tables.follow[position]:
            moves = tables.variables[after] in wanted and (target == "absent" or bound.skip is SkipMode.TO_LAST)
            reached: tuple[int, _Target] = (after, "later" if moves else target)
            if reached not in seen:
                seen.add(reached)
                waiting.append(reached)
    return {target for position, target in seen if tables.accepts[position] or tables.accepts_end[position]}
