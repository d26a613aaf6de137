"""What Flink SQL 2.3 can say of a rule: one table, and where a rule leaves it.

`profile: portable` asks for it when the file is checked; the compiler to Flink SQL refuses by the
same table. A construct that is allowed says how it lowers; one that is not says why, and what to
write in its stead.

Source: Apache Flink's documentation of MATCH_RECOGNIZE ("Pattern Recognition", its sections on
quantifiers, output mode and known limitations), and the errors of its planner for a greedy last
quantifier, for ALL ROWS PER MATCH and for patterns that allow an empty match.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from sqlglot import exp

from patterns.errors import Place
from patterns.files.rule import Rule
from patterns.language.syntax import (
    Alternation,
    Anchor,
    Clause,
    Concatenation,
    Exclusion,
    Identifier,
    Pattern,
    Permutation,
    Query,
    Repetition,
    RowsPerMatch,
    Scalar,
    Variable,
)


@dataclass(frozen=True, slots=True)
class Construct:
    """One construct of the language: whether Flink SQL has it, and how it lowers or why it does not."""

    is_allowed: bool
    why: str


PORTABLE: dict[str, Construct] = {
    # Pattern.
    "concatenation": Construct(True, "as it is; parentheses without a quantifier are taken away"),
    "quantifier": Construct(True, "as it is, on a variable: *, +, ?, {n}, {n,}, {n,m}, greedy or reluctant"),
    "range from no row": Construct(False, "Flink's {n,m} begins with one row; write {1,m}, or a rule for no row"),
    "variable twice": Construct(False, "Flink takes each variable once in a pattern; give the second another name"),
    "greedy variable with an open end": Construct(
        False,
        "where a row fits a greedy variable and the next one, Flink never goes back as the standard does; "
        "add AND NOT (...) of the one to the other, or make it reluctant",
    ),
    "two variables with open ends": Construct(
        False,
        "where a row fits a variable and the next one, and a later one varies in length, Flink takes the match that "
        "completes first; add AND NOT (...) of the one to the other",
    ),
    "undefined variable": Construct(True, "gets no DEFINE: it is true for every row there too"),
    "quantified group": Construct(False, "Flink has no quantifier on a group of the pattern; repeat a single variable"),
    "alternation": Construct(
        False, "Flink has no | in a pattern; write a rule for each branch, or one variable whose condition has OR"
    ),
    "PERMUTE": Construct(False, "Flink has no PERMUTE; write a rule for each order"),
    "exclusion": Construct(False, "Flink has no {- -}, which only ALL ROWS PER MATCH would show; leave the braces out"),
    "anchor": Construct(False, "Flink has no ^ and $: a stream has no first and last row"),
    "empty pattern": Construct(False, "Flink refuses a pattern that no row at all matches; ask for one row or more"),
    "greedy last variable": Construct(
        False,
        "Flink refuses a greedy quantifier at the pattern's end, because it never "
        "knows that no further row comes; make it reluctant, or end the pattern "
        "with a variable that says what ends the run",
    ),
    "reluctant optional": Construct(False, "Flink has no reluctant ?? or {0,1}?; write ?, or two rules"),
    "SUBSET": Construct(False, "Flink has no SUBSET; name the variables one by one"),
    # Clauses.
    "PARTITION BY": Construct(True, "as it is"),
    "ORDER BY": Construct(True, "the event-time column first, then stream and sequence, so that the order is total"),
    "MEASURES": Construct(True, "as they are"),
    "ONE ROW PER MATCH": Construct(True, "as it is"),
    "ALL ROWS PER MATCH": Construct(False, "Flink has ONE ROW PER MATCH only"),
    "AFTER MATCH SKIP": Construct(True, "as it is; a skip without a row to go to stops Flink's whole job"),
    "WITHIN": Construct(True, "as it is, exclusive; conditions say what Flink's milliseconds leave open"),
    "no DEFINE": Construct(True, "Flink's grammar wants one; a variable is defined as TRUE"),
    "measure of a column's name": Construct(
        False, "in Flink the partition columns and the first and last event stand beside it; rename the measure"
    ),
    "TIMER": Construct(True, "a second source: the setting rows shifted by the duration, in a UNION ALL"),
    "several timers": Construct(False, "in Flink a pattern can wait for one TIMER only; write a rule for each"),
    "TIMER from or in a loop": Construct(False, "Flink needs to know the one row that TIMER counts from and ends at"),
    "counted loop beside a TIMER": Construct(
        False, "Flink would count virtual rows among a loop's; beside TIMER write single variables, and * behind one"
    ),
    "optional first variable beside a TIMER": Construct(
        False, "in Flink a match would begin at a virtual row there; write a rule with the variable, and one without"
    ),
    "rows beside a TIMER": Construct(
        False, "Flink would take virtual rows for rows of the match here; name a variable that takes one row"
    ),
    "TIMER over a given table": Construct(False, "a Flink script makes the table of virtual rows beside its own"),
    "FROM with a filter": Construct(True, "a view"),
    "UNION ALL BY NAME": Construct(True, "UNION ALL of views with their columns spelled out"),
    "situations as input": Construct(
        False, "Flink does not know other rules' situations as events; feed it a table of them under a type of its own"
    ),
    # Expressions.
    "operators": Construct(True, "arithmetic, comparison, AND, OR, NOT, IN, BETWEEN, IS NULL, CASE, as they are"),
    "functions": Construct(True, "ABS, LEAST, GREATEST, SQRT, COALESCE; the root of a negative number by CASE"),
    "parameters": Construct(True, "their values are written into the SQL, durations as INTERVAL, lists after IN"),
    "FIRST and LAST": Construct(True, "as they are, with offsets"),
    "aggregates": Construct(True, "COUNT, SUM, MIN, MAX, AVG over one variable or all rows, as they are"),
    "aggregate of an expression over all rows": Construct(
        False, "Flink takes an expression over one variable, or a column over all rows"
    ),
    "DISTINCT aggregate": Construct(False, "Flink has no DISTINCT inside MATCH_RECOGNIZE"),
    "other aggregate": Construct(False, "inside MATCH_RECOGNIZE portable rules have COUNT, SUM, MIN, MAX and AVG only"),
    "PREV": Construct(True, "the match's own earlier row, LAST(column, n), where the pattern says which that is"),
    "PREV out of reach": Construct(
        False,
        "Flink sees only rows that the match took; give the row before a variable of its own in the pattern",
    ),
    "NEXT": Construct(False, "Flink sees only rows that the match took, up to the row at hand"),
    "value in place of NULL": Construct(
        False, "COALESCE, CASE, OR and IS NULL over a variable that may have no row would see no NULL in Flink"
    ),
    "other function": Construct(False, "Flink has no function that gives the same value to the last bit"),
    "CLASSIFIER": Construct(False, "Flink has no CLASSIFIER(); write a rule for each variable that may be last"),
    "MATCH_NUMBER": Construct(False, "Flink has no MATCH_NUMBER(); number the rows behind the clause"),
    "RUNNING": Construct(False, "Flink's MEASURES are final; leave the word out"),
    # Places.
    "in_zone": Construct(True, "arithmetic over the polygon's edges; normalised ones with a frame size that is given"),
    "crosses": Construct(True, "arithmetic over the line's points; normalised ones with a frame size that is given"),
    "shared zone": Construct(True, "as the log says it when the script is written; after a change, write it anew"),
    "metres": Construct(True, "arithmetic with the calibration that the log says when the script is written"),
    # Around the query.
    "time": Construct(True, "lateness is the watermark's, less a millisecond for ties; idle is its idle-timeout"),
    "once_per": Construct(True, "the first row of each key: ROW_NUMBER() OVER (PARTITION BY key ORDER BY time) = 1"),
    "cooldown": Construct(
        True, "one more MATCH_RECOGNIZE over the matches: the next one after the cooldown of the last"
    ),
    "emit of matches that overlap": Construct(
        False,
        "what `emit` lets through depends on which match was decided first, and Flink may end overlapping ones in "
        "another order; give all matches one length, let the first variable exclude all others, or let the last one "
        "ask only how long ago the first was",
    ),
    "column of a name of the script's": Construct(
        False, "the Flink script has columns rowtime, stream, arm and timer of its own; rename it in FROM"
    ),
    "one station": Construct(False, "a Flink script for one station has no column `station`; leave the option out"),
}
"""Every construct that a rule may use."""

_ALLOWED: tuple[type, ...] = (exp.Count, exp.Sum, exp.Min, exp.Max, exp.Avg, exp.First, exp.Last)
_NAMED = ("NEXT", "CLASSIFIER", "MATCH_NUMBER", "RUNNING")


@dataclass(frozen=True, slots=True)
class Refusal:
    """A construct that Flink SQL does not have, and where the rule uses it."""

    construct: str
    place: Place

    @property
    def message(self) -> str:
        """What is wrong, and what to write in its stead."""
        return f"portable: {self.construct}: {PORTABLE[self.construct].why}"


def refusals(rule: Rule, query: Query) -> list[Refusal]:
    """Where the rule uses what Flink SQL does not have, in the order of the places; empty: it is portable."""
    passage = rule.passage("match")
    found = {(construct, at): passage.place(at) for construct, at in _in_clause(query)}
    return [Refusal(construct, place) for (construct, _), place in sorted(found.items(), key=lambda each: each[0][1])]


def _in_clause(query: Query) -> Iterator[tuple[str, int]]:
    clause = query.clause
    yield from _in_pattern(clause.pattern, clause)
    if clause.rows is not RowsPerMatch.ONE:
        yield "ALL ROWS PER MATCH", clause.rows_at
    if clause.subsets:
        yield "SUBSET", clause.subsets[0].name.at
    scalars = [each.value for each in (*clause.measures, *clause.defines)]
    for scalar in scalars:
        yield from _in_scalar(scalar)


def _in_pattern(pattern: Pattern, clause: Clause) -> Iterator[tuple[str, int]]:
    yield from _parts(pattern, clause.pattern_at)
    seen: set[str] = set()
    for variable in _variables(pattern):
        if variable.key in seen:
            yield "variable twice", variable.at
        seen.add(variable.key)
    last = _last(pattern)
    if isinstance(last, Repetition) and last.greedy and last.least != last.most:
        yield "greedy last variable", last.at
    if _can_be_empty(pattern):
        yield "empty pattern", clause.pattern_at


def _parts(pattern: Pattern, at: int) -> Iterator[tuple[str, int]]:
    """The refused constructs of the tree; `at` is where to point at a part that knows no place."""
    match pattern:
        case Alternation(choices):
            yield "alternation", _first_place(pattern, at)
            for choice in choices:
                yield from _parts(choice, at)
        case Permutation(parts, place):
            yield "PERMUTE", place
            for part in parts:
                yield from _parts(part, at)
        case Exclusion(body, place):
            yield "exclusion", place
            yield from _parts(body, at)
        case Anchor(_, place):
            yield "anchor", place
        case Repetition(body):
            if not isinstance(body, Variable):
                yield "quantified group", pattern.at
            if not pattern.greedy and (pattern.least, pattern.most) == (0, 1):
                yield "reluctant optional", pattern.at
            if pattern.least == 0 and pattern.most not in (1, None):
                yield "range from no row", pattern.at
            yield from _parts(body, at)
        case Concatenation(parts):
            for part in parts:
                yield from _parts(part, at)


def _variables(pattern: Pattern) -> Iterator[Identifier]:
    if isinstance(pattern, Variable):
        yield pattern.name
    elif isinstance(pattern, Repetition | Exclusion):
        yield from _variables(pattern.body)
    elif not isinstance(pattern, Anchor):
        for part in pattern.choices if isinstance(pattern, Alternation) else pattern.parts:
            yield from _variables(part)


def _first_place(pattern: Pattern, at: int) -> int:
    match pattern:
        case Variable(name):
            return name.at
        case Concatenation(parts) | Alternation(parts):
            return _first_place(parts[0], at) if parts else at
        case Repetition(body):
            return _first_place(body, at)
        case _:
            return pattern.at


def _last(pattern: Pattern) -> Pattern:
    while isinstance(pattern, Concatenation) and pattern.parts:
        pattern = pattern.parts[-1]
    return pattern


def _can_be_empty(pattern: Pattern) -> bool:
    match pattern:
        case Variable():
            return False
        case Concatenation(parts) | Permutation(parts):
            return all(_can_be_empty(part) for part in parts)
        case Alternation(choices):
            return any(_can_be_empty(choice) for choice in choices)
        case Repetition(body, least):
            return least == 0 or _can_be_empty(body)
        case Exclusion(body):
            return _can_be_empty(body)
        case Anchor():
            return True


def _in_scalar(scalar: Scalar) -> Iterator[tuple[str, int]]:
    for node in scalar.node.walk():
        construct = _refused(node)
        if construct is not None:
            yield construct, _offset(node, scalar.at)


def _refused(node: exp.Expr) -> str | None:
    name = str(node.this).upper() if isinstance(node, exp.Anonymous) else type(node).__name__.upper()
    if name in _NAMED:
        return name
    if isinstance(node, exp.Distinct):
        return "DISTINCT aggregate"
    kind = type(node)
    if issubclass(kind, exp.AggFunc) and kind not in _ALLOWED:
        return "other aggregate"
    return None


def _offset(node: exp.Expr, at: int) -> int:
    return min((part.meta["start"] for part in node.walk() if "start" in part.meta), default=at)
