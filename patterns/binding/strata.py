"""Rules over situations of other rules: which reads which, and what columns those situations have.

A rule that reads no situation is of stratum 0; one that does is one above the highest that it reads. A rule
whose situations led back to itself would feed on its own, so such a set is refused, with the cycle named. A rule
that reads the situations of all rules reads those that rest on no situation themselves, so it needs no stratum.
"""

from collections.abc import Iterable, Mapping, Sequence

import pyarrow as pa

from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.binding.columns import arrow_type
from patterns.binding.expressions import Kind
from patterns.binding.inputs import SITUATION_FIELDS, situation_key
from patterns.errors import RuleError
from patterns.files.rule import Rule
from patterns.language.parser import parse

_COLUMN_TYPES = {Kind.TIME: pa.timestamp("us", "UTC"), Kind.DURATION: pa.duration("us"), Kind.NULL: pa.string()}


def rules_read(rule: Rule) -> frozenset[str]:
    """The rules whose situations the rule reads by name.

    Raises:
        RuleError: Its SQL cannot be parsed.
    """
    arms = parse(rule.passage("match")).arms
    return frozenset(arm.situation_of for arm in arms if arm.situation_of is not None)


def strata(rules: Iterable[Rule]) -> dict[str, int]:
    """The stratum of each rule; a rule that is read and not among them counts as one that reads no situation.

    Raises:
        RuleError: A rule's situations lead back to the rule; it points at the FROM that closes the cycle.
    """
    by_name = {rule.rule: rule for rule in rules}
    found: dict[str, int] = {}
    return {name: _stratum(name, by_name, found, ()) for name in by_name}


def in_strata(rules: Sequence[Rule]) -> list[Rule]:
    """The rules, those that are read before those that read them, otherwise in their order.

    Raises:
        RuleError: A rule's situations lead back to the rule.
    """
    levels = strata(rules)
    return sorted(rules, key=lambda rule: levels[rule.rule])


def with_situations(schemas: Mapping[str, pa.Schema], rules: Sequence[Rule]) -> dict[str, pa.Schema]:
    """The event types, and the situations of these rules, as rules may read them.

    A rule that cannot be bound has none here: who reads them is told, and who binds it is told why.

    Raises:
        RuleError: A rule's situations lead back to the rule.
    """
    known = dict(schemas)
    for rule in in_strata(rules):
        try:
            known[situation_key(rule.rule)] = situation_schema(bind(rule, known))
        except RuleError:
            continue
    return known


def situation_schema(bound: BoundRule) -> pa.Schema:
    """The columns of a rule's situations: those of all situations, its partition columns and its measures."""
    kinds = dict(SITUATION_FIELDS)
    kinds |= {name: bound.columns[name] for name in bound.keys}
    kinds |= {measure.name: measure.value.kind for measure in bound.measures}
    return pa.schema([(name, _COLUMN_TYPES.get(kind) or arrow_type(kind)) for name, kind in kinds.items()])


def _stratum(name: str, rules: Mapping[str, Rule], found: dict[str, int], above: tuple[str, ...]) -> int:
    if name in above:
        reader = rules[above[-1]]
        path = " reads ".join([*above[above.index(name) :], name])
        raise _at_from(reader, f"FROM: a rule cannot feed on its own situations: {path}", name)
    if name not in found:
        read = sorted(rules_read(rules[name])) if name in rules else []
        found[name] = max((1 + _stratum(each, rules, found, (*above, name)) for each in read), default=0)
    return found[name]


def _at_from(rule: Rule, message: str, read: str) -> RuleError:
    """The error that points at the FROM that reads this rule's situations."""
    query = parse(rule.passage("match"))
    (at, *_) = (arm.source_type.at for arm in query.arms if arm.situation_of == read)
    return query.passage.error(message, at)
