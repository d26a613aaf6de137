"""Rules in, situations out: SQL:2016 row pattern recognition over events, in batch and online.

    rules = load_rules(Path("rules"))                   # YAML files
    bound = bind(rules[0], schemas, {"cam-01": (1920, 1080)})
    match(bound, rows)                                  # all rows at once: the definition

    run = RuleRun(bound)                                # the same online
    run.push(batch).matches

    query("SELECT ... FROM t MATCH_RECOGNIZE (...)", {"t": table})      # any table, among ordinary SQL

The road is parse, bind, compile, run: `language` reads the SQL, `binding` resolves
its names and compiles the pattern, and `engine` runs it over
rows as they become final. What is refused, is refused with its line and column.
"""

from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.engine.ruleset import RuleSetRun, RuleStatus
from patterns.engine.running import GivenUp, Outcome, RuleRun, match
from patterns.engine.situations import EventRange, EventRef, Match, situation_id
from patterns.errors import (
    FrameSizeUnknown,
    LimitError,
    MatchError,
    NotInRules,
    PatternError,
    QueryError,
    RuleError,
    SkipError,
    StateError,
)
from patterns.files.expanding import expand
from patterns.files.loading import load_rule, load_rules, parse_rule
from patterns.files.rule import Rule
from patterns.limits import Limits
from patterns.linting.findings import Finding
from patterns.linting.lint import check, lint
from patterns.querying.queries import query
from patterns.scene.geometry import FrameSize, Line, Zone
from patterns.tools.cases import TestResult, run_tests

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
    "NotInRules",
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
