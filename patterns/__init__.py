"""Rules in, situations out: SQL:2016 row pattern recognition over events, in batch and online.

    rules = load_rules(Path("rules"))                   # YAML files
    bound = bind(rules[0], schemas, {"cam-01": (1920, 1080)})
    match(bound, rows)                                  # all rows at once: the definition

    run = RuleRun(bound)                                # the same online
    run.push(batch).matches

    query("SELECT ... FROM t MATCH_RECOGNIZE (...)", {"t": table})      # any table, among ordinary SQL

The road is parse, bind, compile, run: `parser` reads the SQL, `binder` resolves
its names, `program` compiles the pattern, and `running` feeds the `engine` with
rows as they become final. What is refused, is refused with its line and column.
"""

from patterns.binder import bind
from patterns.bound import BoundRule
from patterns.cases import TestResult, run_tests
from patterns.errors import (
    FrameSizeUnknown,
    LimitError,
    MatchError,
    NotSupportedYet,
    PatternError,
    QueryError,
    RuleError,
    SkipError,
    StateError,
)
from patterns.expanding import expand
from patterns.findings import Finding
from patterns.geometry import FrameSize, Line, Zone
from patterns.limits import Limits
from patterns.lint import check, lint
from patterns.loading import load_rule, load_rules, parse_rule
from patterns.queries import query
from patterns.rule import Rule
from patterns.ruleset import RuleSetRun, RuleStatus
from patterns.running import GivenUp, Outcome, RuleRun, match
from patterns.situations import EventRange, EventRef, Match, situation_id

__all__ = [
    "BoundRule",
    "EventRange",
    "EventRef",
    "Finding",
    "FrameSize",
    "FrameSizeUnknown",
    "GivenUp",
    "LimitError",
    "Limits",
    "Line",
    "Match",
    "MatchError",
    "NotSupportedYet",
    "Outcome",
    "PatternError",
    "QueryError",
    "Rule",
    "RuleError",
    "RuleRun",
    "RuleSetRun",
    "RuleStatus",
    "SkipError",
    "StateError",
    "TestResult",
    "Zone",
    "bind",
    "check",
    "expand",
    "lint",
    "load_rule",
    "load_rules",
    "match",
    "parse_rule",
    "query",
    "run_tests",
    "situation_id",
]
