"""What looks wrong with a rule's pattern: it can never match, always does, or costs too much."""

from collections.abc import Iterator
from difflib import get_close_matches

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Call
from patterns.binding.guards import constant_value
from patterns.language.parser import parse
from patterns.language.pattern_variables import pattern_variables
from patterns.language.syntax import Alternation, Concatenation, Exclusion, Pattern, Permutation, Repetition, Variable
from patterns.language.tokens import canonical_name
from patterns.linting.contradictions import never_true
from patterns.linting.findings import Finding, warning


def pattern_findings(bound: BoundRule) -> list[Finding]:
    """What looks wrong with the pattern and its conditions."""
    return [
        *_undefined(bound),
        *_empty(bound),
        *_hopeless(bound),
        *_always(bound),
        *_unreachable(bound),
        *_unbounded(bound),
        *_waits(bound),
        *_leading_loop(bound),
        *_timed_out(bound),
    ]


def _undefined(bound: BoundRule) -> list[Finding]:
    """Variables without DEFINE that may be slips of the pen: their names are like that of one that has it.

    Others are left alone: a variable that any row fits is standard SQL, and usual.
    """
    passage = bound.rule.passage("match")
    query = parse(passage)
    defined = {define.name.key: define.name.name for define in query.clause.defines}
    findings: dict[str, Finding] = {}
    for variable in pattern_variables(query.clause.pattern):
        like = get_close_matches(variable.key, defined, n=1)
        if variable.key not in defined and like:
            message = (
                f"{variable.name} has no DEFINE: it is true for every row. Next: define it, "
                f"or write {defined[like[0]]} if that is meant"
            )
            findings.setdefault(variable.key, Finding("warning", message, passage.place(variable.at), "near-miss"))
    return list(findings.values())


def _empty(bound: BoundRule) -> list[Finding]:
    """A pattern that no row at all matches too."""
    if not bound.tables.accepts[bound.tables.start]:
        return []
    passage = bound.rule.passage("match")
    message = (
        "PATTERN can match no row at all, and such an empty match is no situation. "
        "Next: ask for one row or more, with + for * or without ?"
    )
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at), "empty-match")]


def _hopeless(bound: BoundRule) -> list[Finding]:
    """Variables that no row can ever be mapped to, and patterns that therefore never match."""
    tables, passage = bound.tables, bound.rule.passage("match")
    clause = parse(passage).clause
    reasons = {index: why for index in range(len(bound.variables)) if (why := never_true(bound, index))}
    if not reasons:
        return []
    reached = {at for at in tables.firsts() if tables.variables[at] not in reasons}
    queue = list(reached)
    for position in queue:
        after = {at for at in tables.follow[position] if tables.variables[at] not in reasons} - reached
        reached |= after
        queue += after
    named = "; ".join(f"{bound.variables[index]}: {why}" for index, why in reasons.items())
    if any(tables.accepts_end[at] for at in reached):
        message = f"a variable can never be true: {named}"
        return [Finding("warning", message, passage.place(clause.pattern_at), "never-true")]
    message = f"the rule can never match, because a variable can never be true: {named}"
    return [Finding("error", message, passage.place(clause.pattern_at), "never-matches")]


def _always(bound: BoundRule) -> list[Finding]:
    """A pattern for which one row of any kind is a match."""
    tables = bound.tables
    if any(each.where is not None for each in bound.inputs):
        return []
    free = [at for at in tables.firsts() if tables.accepts[at] and _is_free(bound, tables.variables[at])]
    if not free:
        return []
    passage = bound.rule.passage("match")
    name = bound.variables[tables.variables[free[0]]]
    message = f"every row is a match by itself, as {name} has no condition. Next: define {name}, or filter in FROM"
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at), "always-matches")]


def _is_free(bound: BoundRule, variable: int) -> bool:
    condition = bound.conditions[variable]
    return not condition.predicates and condition.guard is None and not condition.is_timed


def _unreachable(bound: BoundRule) -> list[Finding]:
    """Branches of an alternation that one further left always takes precedence of.

    Only branches of one variable are compared, and only where nothing depends on which of them took the row.
    """
    passage = bound.rule.passage("match")
    numbers = {canonical_name(name, is_quoted=False): index for index, name in enumerate(bound.variables)}
    findings = []
    for alternation in _alternations(parse(passage).clause.pattern):
        earlier: list[int] = []
        for choice in alternation.choices:
            index = numbers.get(choice.name.key) if isinstance(choice, Variable) else None
            if index is None:
                earlier = []
                continue
            hidden = next((each for each in earlier if _hides(bound, each, index)), None)
            if hidden is not None and isinstance(choice, Variable):
                message = (
                    f"{bound.variables[index]} is never taken: {bound.variables[hidden]} stands before it and is true "
                    "wherever it is. Next: put it first, or take it out"
                )
                findings.append(Finding("warning", message, passage.place(choice.name.at), "unreachable"))
            earlier.append(index)
    return findings


def _alternations(pattern: Pattern) -> Iterator[Alternation]:
    if isinstance(pattern, Alternation):
        yield pattern
    match pattern:
        case Concatenation(parts) | Permutation(parts) | Alternation(parts):
            for part in parts:
                yield from _alternations(part)
        case Repetition(body) | Exclusion(body):
            yield from _alternations(body)


def _hides(bound: BoundRule, first: int, later: int) -> bool:
    """Whether a row that the later variable takes, the first takes too, and nothing remembers which it was."""
    if first == later:
        return True
    one, other = bound.conditions[first], bound.conditions[later]
    remembered = any(register.takes(first) != register.takes(later) for register in bound.registers)
    is_plain = one.guard is None and not one.is_timed and not other.is_timed
    return is_plain and not remembered and set(one.predicates) <= set(other.predicates)


def _leading_loop(bound: BoundRule) -> list[Finding]:
    """A pattern that begins with any number of any rows: each row begins a partial match that takes all after it."""
    tables = bound.tables
    loops = [at for at in tables.firsts() if at in tables.follow[at] and _is_free(bound, tables.variables[at])]
    if not loops:
        return []
    passage = bound.rule.passage("match")
    name = bound.variables[tables.variables[loops[0]]]
    message = (
        f"{name} may take any number of rows of any kind from the match's beginning, so every row begins a partial "
        f"match that takes all rows after it: quadratic work. Next: define {name}, or leave it out"
    )
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at), "quadratic")]


def _is_timed_out(bound: BoundRule) -> bool:
    """Whether a timer ends every partial match of a partition that falls silent, so that it is not remembered."""
    tables, timed = bound.tables, bound.timed
    setters = {each for index in bound.timers for each in bound.registers[index].variables or ()}
    ends = all(not tables.follow[at] for at, variable in enumerate(tables.variables) if timed[variable])
    return bool(setters) and ends and {tables.variables[at] for at in tables.firsts()} <= setters


def _unbounded(bound: BoundRule) -> list[Finding]:
    """Rules that may remember a partition for ever."""
    findings = []
    emit = bound.rule.emit
    if emit.once_per is not None and emit.cooldown is None:
        message = "once_per without cooldown remembers every key for good. Next: give a cooldown"
        findings.append(warning(bound.rule, message, "unbounded", "emit", "once_per"))
    at = parse(bound.rule.passage("match")).clause.pattern_at
    place = bound.rule.passage("match").place(at)
    reasons = _remembered_for_good(bound)
    findings += [Finding("warning", reason, place, "unbounded") for reason in reasons]
    if reasons:
        return findings
    if bound.within_us is None and not _is_timed_out(bound):
        endless = _endless(bound)
        message = "without WITHIN, a partial match of a partition that falls silent is remembered for good"
        if endless:
            message += f", and {endless} may take rows for ever"
        findings.append(
            Finding("warning", f"{message}. Next: add WITHIN", place, "quadratic" if endless else "unbounded")
        )
    return findings


def _remembered_for_good(bound: BoundRule) -> list[str]:
    """Why something of every partition is remembered, whether a match is open there or not."""
    tables = bound.tables
    reasons = []
    if tables.has_start_anchor:
        reasons.append("^ asks whether a row is its partition's first, so every partition is remembered for good")
    elif bound.looks_back:
        reasons.append("PREV looks at rows before the match, so a row of every partition is remembered for good")
    if bound.is_numbered:
        reasons.append("MATCH_NUMBER counts the matches of every partition, so each is remembered for good")
    if bound.within_us is not None and tables.accepts_end != tables.accepts:
        reasons.append("$ waits for the partition's next row or the end of the input, whatever WITHIN says")
    if any(bound.ahead):
        reasons.append("NEXT waits for rows that a partition that falls silent never has")
    return reasons


def _waits(bound: BoundRule) -> list[Finding]:
    """Rows that are decided only when others have come."""
    names = [name for name, rows in zip(bound.variables, bound.ahead, strict=True) if rows]
    if not names:
        return []
    passage = bound.rule.passage("match")
    rows = max(bound.ahead)
    what = "the next row of its partition" if rows == 1 else f"up to {rows} further rows of its partition"
    message = (
        f"NEXT: a row that may be {', '.join(names)} waits for {what}, or the end of the input, and situations "
        "with it. Next: write the row that follows as a variable of its own, so that WITHIN bounds the wait"
    )
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at), "waits")]


def _endless(bound: BoundRule) -> str:
    """The variables that a match may take any number of rows for."""
    follow = bound.tables.follow
    endless = []
    for position in range(len(bound.tables.variables)):
        reached = set(follow[position])
        queue = list(reached)
        for each in queue:
            after = set(follow[each]) - reached
            reached |= after
            queue += after
        if position in reached:
            endless.append(bound.variables[bound.tables.variables[position]])
    return ", ".join(dict.fromkeys(endless))


def _timed_out(bound: BoundRule) -> list[Finding]:
    """Timers that are due only when WITHIN is over, so that no match ever sees them."""
    passage = bound.rule.passage("match")
    longest = max((_duration_of(bound, register) for register in bound.timers), default=0)
    if bound.within_us is None or longest < bound.within_us:
        return []
    message = "WITHIN is not longer than TIMER's duration, so the virtual row comes too late. Next: lengthen WITHIN"
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at), "within-timer")]


def _duration_of(bound: BoundRule, register: int) -> int:
    """How long after its variable's row the timer of this register is due, in microseconds."""
    slot = bound.registers[register].slot
    assert slot is not None, "it holds a time"
    due = bound.slots[slot]
    assert isinstance(due, Call), "it is the time and a duration"
    value = constant_value(due.operands[1])
    assert isinstance(value, int), "durations are whole microseconds"
    return value
