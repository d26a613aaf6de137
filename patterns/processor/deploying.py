"""Rules into service and out of it, as events of the log: what runs is a function of the log.

`deploy` and `retire` append `rule_deployed` and `rule_retired`; `standing` reads them back. A version
never changes its content once it was deployed. A version that was retired, or set aside because it
failed, may be deployed again: it then begins anew, behind its retirement unless told otherwise.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from typing import Literal

import pyarrow as pa

from events import (
    Catalogue,
    Draft,
    EventType,
    Producer,
    RuleDeployed,
    RuleRetired,
    Segment,
    StreamName,
    batch_of,
    decode,
    encode,
    events_of,
    schema_of,
)
from patterns.binding.strata import rules_read, strata, with_situations
from patterns.errors import PatternError, RuleError
from patterns.files.expanding import expand
from patterns.files.loading import parse_rule
from patterns.files.rule import Rule
from patterns.processor.writing import SOURCE, producer_of
from store import Log

OpenMatches = Literal["dropped", "finished"]
Key = tuple[str, int]
"""A rule's name and version."""

FROM_HEAD = None
FROM_BEGINNING = 0
RULE_EVENTS: tuple[type[EventType], ...] = (RuleDeployed, RuleRetired)


@dataclass(frozen=True, slots=True)
class Retirement:
    """How a version left service."""

    position: int
    """position of the event that says it"""
    why: str
    open_matches: OpenMatches
    reason: str


@dataclass(frozen=True, slots=True)
class Service:
    """One version of a rule, as the log says it stands."""

    rule: str
    version: int
    rule_hash: str
    text: str
    """the rule file, whole"""
    deployed_at: datetime
    position: int
    """position of the newest event that deployed it"""
    after: int
    """it sees the log behind this position"""
    life: int = 0
    """0 for its first time in service, later the position of the event that brought it back"""
    is_shadow: bool = False
    retirement: Retirement | None = None

    @property
    def key(self) -> Key:
        """Its name and version."""
        return self.rule, self.version


def schemas(catalogue: Catalogue) -> dict[str, pa.Schema]:
    """What a rule may be written over: each event type's columns, the envelope's first."""
    names = ("station", "source", "type", "subject")
    envelope = [*(pa.field(name, pa.string()) for name in names), pa.field("sequence", pa.int64())]
    return {str(each.type_name): pa.schema([*envelope, *schema_of(each)]) for each in catalogue}


def readable_by(log: Log, rule: Rule, others: Sequence[Rule] | None = None) -> Mapping[str, pa.Schema]:
    """What the rule may be written over: the event types, and the situations of the other rules that it names.

    Args:
        log: The log.
        rule: The rule.
        others: The other rules there are; None: those that the log says are in service.

    Raises:
        RuleError: The rule's situations lead back to it.
    """
    known = schemas(log.catalogue)
    if not rules_read(rule):
        return known
    others = rules_in_service(log) if others is None else others
    return with_situations(known, list({each.rule: each for each in (*others, rule)}.values()))


def rules_in_service(log: Log) -> list[Rule]:
    """The rules that the log says are in service, at any station."""
    stations = {head.stream.station for head in log.streams() if head.stream.type == RuleDeployed.type_name}
    return [each for station in sorted(stations) for each in _in_service(standing(log, station))]


def _in_service(services: Mapping[Key, Service]) -> list[Rule]:
    """The rules that are in service and still rules for this program."""
    found = []
    for service in services.values():
        if service.retirement is None:
            with suppress(RuleError):
                found.append(rule_of(service))
    return found


def deploy(
    log: Log,
    station: str,
    rules: Sequence[Rule],
    texts: Mapping[str, str],
    at: datetime,
    *,
    after: int | Literal["default", "head"] = "default",
    open_matches: OpenMatches = "finished",
    is_shadow: bool | None = None,
) -> list[Rule]:
    """Record the rules as deployed where that changes anything; those for which it did.

    Args:
        log: The log.
        station: This station.
        rules: The rules.
        texts: The rule files' texts by rule name.
        at: The time of the deployment.
        after: A rule sees the log behind this position. `head`: behind its deployment. `default`: the
            first version of a rule sees the whole log, a further version what lies behind its
            deployment, one that comes back what lies behind its retirement.
        open_matches: What becomes of the matches that the version before has begun.
        is_shadow: Whether they run in shadow; None: as their files say.

    Raises:
        PatternError: A version that was deployed before now has another content, or is in service
            already and was to begin elsewhere; or a rule's situations would lead back to it.
    """
    heads = _heads(log, station)
    known = standing(log, station)
    strata({each.rule: each for each in (*_in_service(known), *rules)}.values())
    drafts: list[Draft] = []
    deployed = []
    for rule in rules:
        shadow = rule.shadow if is_shadow is None else is_shadow
        service = known.get((rule.rule, rule.version))
        if service is not None and not _changes(service, rule, shadow, after):
            continue
        deployed.append(rule)
        drafts += _replaced(station, rule, known, at, open_matches)
        event = RuleDeployed(
            time=at,
            rule=rule.rule,
            rule_version=rule.version,
            rule_hash=rule.hash,
            text=text_of(rule, texts.get(rule.rule)),
            after_position=_after(rule, known, after),
            is_shadow=shadow,
        )
        drafts.append(_draft(station, event, producer_of(rule)))
    _append(log, drafts, heads)
    return deployed


def retire(
    log: Log, station: str, name: str, at: datetime, *, open_matches: OpenMatches = "finished", reason: str = "told to"
) -> list[Key]:
    """Record every version of the rule that is in service as retired; which they were.

    Raises:
        PatternError: No version of it is in service.
    """
    heads = _heads(log, station)
    known = standing(log, station)
    inside = [each for each in known.values() if each.rule == name and each.retirement is None]
    if not inside:
        others = ", ".join(sorted({each.rule for each in known.values() if each.retirement is None})) or "none"
        raise PatternError(f"no version of rule {name!r} is in service; in service: {others}. Next: vian rules status")
    _append(log, [retirement_draft(station, each, at, "told", open_matches, reason) for each in inside], heads)
    return [each.key for each in inside]


def standing(log: Log, station: str, to_position: int | None = None) -> dict[Key, Service]:
    """Every version that was ever deployed, as it stands, in the order in which they first were.

    Args:
        log: The log.
        station: This station.
        to_position: As it stood at this position; now by default.
    """
    found: dict[Key, Service] = {}
    names = [each.type_name for each in RULE_EVENTS]
    for segment in log.read_all(types=names, sources=[SOURCE], stations=[station], to_position=to_position):
        note(found, segment, log.catalogue)
    return found


def note(services: dict[Key, Service], segment: Segment, catalogue: Catalogue) -> list[Service]:
    """Brings the services up to what a segment of rule events says; those that it changed."""
    changed = []
    for event in events_of(decode(segment, catalogue)):
        if isinstance(event, RuleDeployed):
            service = _deployed(services.get((event.rule, event.rule_version)), event, segment.position)
        else:
            assert isinstance(event, RuleRetired), "only rule events are asked for"
            before = services.get((event.rule, event.rule_version))
            if before is None or before.retirement is not None:
                continue
            gone = Retirement(segment.position, event.why, event.open_matches, event.reason)
            service = replace(before, retirement=gone)
        services[service.key] = service
        changed.append(service)
    return changed


def rule_of(service: Service) -> Rule:
    """The rule that was deployed.

    Raises:
        RuleError: Its text is no rule for this program.
    """
    return _read(service.text, f"<{service.rule} version {service.version}, deployed at {service.position}>")


@lru_cache(maxsize=512)
def _read(text: str, name: str) -> Rule:
    """The rule of a text that the log keeps, read once: each deployment looks at all that are in service."""
    return parse_rule(text, name)


def retirement_draft(
    station: str,
    service: Service,
    at: datetime,
    why: Literal["told", "replaced", "failed", "too_slow"],
    open_matches: OpenMatches,
    reason: str,
) -> Draft:
    """The event that takes a version out of service."""
    event = RuleRetired(
        time=at, rule=service.rule, rule_version=service.version, why=why, open_matches=open_matches, reason=reason
    )
    producer = Producer(f"rule/{service.rule}", str(service.version), bytes.fromhex(service.rule_hash))
    return _draft(station, event, producer)


def text_of(rule: Rule, text: str | None) -> str:
    """A rule file that says this rule by itself: the text given if it does, else one written anew.

    Raises:
        PatternError: No text says it.
    """
    for said in (text, expand(rule)):
        if said is not None and _says(said, rule):
            return said
    raise PatternError(
        f"rule {rule.rule} version {rule.version} cannot be written down as one text, which is what the log keeps of "
        "it. Next: write into the rule file what it takes from elsewhere"
    )


def _says(text: str, rule: Rule) -> bool:
    try:
        return parse_rule(text, f"<{rule.rule}>").hash == rule.hash
    except RuleError:
        return False


def _changes(service: Service, rule: Rule, is_shadow: bool, after: int | str) -> bool:
    """Whether deploying the rule changes how the version stands."""
    if service.rule_hash != rule.hash:
        raise PatternError(
            f"rule {rule.rule} version {rule.version} is deployed with another content: deployed hash "
            f"{service.rule_hash[:12]}, this file's {rule.hash[:12]}. Next: give the changed rule a new version"
        )
    if service.retirement is not None:
        return True
    if after != "default":
        raise PatternError(
            f"rule {rule.rule} version {rule.version} is in service already, and cannot begin elsewhere. "
            f"Next: vian rules retire {rule.rule}, then deploy it again"
        )
    return service.is_shadow != is_shadow


def _after(rule: Rule, known: Mapping[Key, Service], after: int | str) -> int | None:
    if isinstance(after, int):
        return after
    if after == "head":
        return FROM_HEAD
    service = known.get((rule.rule, rule.version))
    if service is not None:
        return service.after if service.retirement is None else service.retirement.position
    is_first = all(each.rule != rule.rule for each in known.values())
    return FROM_BEGINNING if is_first else FROM_HEAD


def _replaced(
    station: str, rule: Rule, known: Mapping[Key, Service], at: datetime, open_matches: OpenMatches
) -> list[Draft]:
    """The events that take the other versions of the rule out of service."""
    others = [
        each
        for each in known.values()
        if each.rule == rule.rule and each.version != rule.version and each.retirement is None
    ]
    reason = f"version {rule.version} takes over"
    return [retirement_draft(station, each, at, "replaced", open_matches, reason) for each in others]


def _deployed(before: Service | None, event: RuleDeployed, position: int) -> Service:
    after = position if event.after_position is None else event.after_position
    if before is not None and before.retirement is None:
        return replace(before, is_shadow=event.is_shadow, position=position)
    return Service(
        rule=event.rule,
        version=event.rule_version,
        rule_hash=event.rule_hash,
        text=event.text,
        deployed_at=event.time,
        position=position,
        after=after,
        life=0 if before is None else position,
        is_shadow=event.is_shadow,
    )


def _draft(station: str, event: EventType, producer: Producer) -> Draft:
    return encode(StreamName.of(station, SOURCE, event.type_name), batch_of([event]), producer)


def _heads(log: Log, station: str) -> dict[StreamName, int]:
    """Where the streams of rule events stand."""
    streams = [StreamName.of(station, SOURCE, each.type_name) for each in RULE_EVENTS]
    return {stream: log.stream_head(stream).sequence for stream in streams}


def _append(log: Log, drafts: Sequence[Draft], heads: dict[StreamName, int]) -> None:
    """Appends all or nothing, and nothing if somebody else deployed or retired since the streams stood like this."""
    expected = []
    for draft in drafts:
        expected.append(heads[draft.stream])
        heads[draft.stream] += draft.event_count
    if drafts:
        log.append(drafts, expected)
