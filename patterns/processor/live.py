"""Which sources may still lead to situations, as the log says it.

Contract: the answer is of the log alone, up to a position, so it is the same whichever rules run beside, whenever it
is asked. A rule that reads situations sees nothing of the events below them; this is how it knows that
more may come.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from events import ProcessFailed, ProcessFinished
from patterns.binding.inputs import SITUATION
from patterns.files.rule import Rule
from patterns.language.parser import parse
from store import Log, StreamHead

_ENDS = (str(ProcessFinished.type_name), str(ProcessFailed.type_name))


@dataclass(frozen=True, slots=True)
class Below:
    """What lies below a rule that reads situations.

    Attributes:
        types: The event types that it and the rules below it read, situations aside.
        after: The position behind which it begins; what was said only before it does not count.
    """

    types: frozenset[str]
    after: int


def types_below(rule: Rule, others: Iterable[Rule]) -> frozenset[str]:
    """The event types that the rule and those below it read, situations aside.

    Args:
        rule: The rule.
        others: The other rules there are; one that is read and not among them says nothing.

    Raises:
        RuleError: The SQL of one of them cannot be parsed.
    """
    return _types_below(rule, {each.rule: each for each in others}, frozenset())


def _types_below(rule: Rule, others: Mapping[str, Rule], above: frozenset[str]) -> frozenset[str]:
    found: set[str] = set()
    above = above | {rule.rule}
    for arm in parse(rule.passage("match")).arms:
        if arm.situation_of is None and arm.source_type.name != SITUATION:
            found.add(arm.source_type.name)
            continue
        read = others if arm.situation_of is None else {arm.situation_of}
        for name in sorted(set(read) & set(others) - above):
            found |= _types_below(others[name], others, above)
    return frozenset(found)


def live_source(log: Log, below: Below, position: int, sources: Collection[str] | None = None) -> str | None:
    """A source that may still lead to situations of rules that have seen the log so far; None: all have ended.

    It has said something of the types, and no process of it has ended since, up to the position.

    Args:
        log: The log.
        below: What lies below the rule that asks.
        position: The rules have seen the log up to here.
        sources: Only these exist; None: all.
    """
    heads = [each for each in log.streams() if each.sequence and (sources is None or each.stream.source in sources)]
    ended: dict[str, int] = {}
    for head in heads:
        if head.stream.type in _ENDS:
            source = str(head.stream.source)
            ended[source] = max(_last_position(log, head), ended.get(source, 0))
    for head in heads:
        if head.stream.type in below.types:
            source, said = str(head.stream.source), _last_position(log, head)
            if said > below.after and not said < ended.get(source, 0) <= position:
                return source
    return None


def _last_position(log: Log, head: StreamHead) -> int:
    """Position of the stream's newest segment."""
    return int(next(iter(log.read(head.stream, head.sequence, epoch=head.epoch, with_hollow=True))).position)
