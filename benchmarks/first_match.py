"""What a fresh process does up to its first match: `benchmarks.patterns` measures it from outside.

python -m benchmarks.first_match
"""

from benchmarks.pattern_rows import RULES, rows
from patterns import RuleSetRun, bind, parse_rule


def main() -> None:
    """Import, bind, and run until something is found.

    Raises:
        RuntimeError: There is nothing to be found.
    """
    table = rows("line crossing", 100, 50_000)
    rule = bind(parse_rule(RULES["line crossing"]), {"track_point": table.schema})
    if not any(outcome.matches for outcome in RuleSetRun([rule]).push(table).values()):
        raise RuntimeError("no match")


if __name__ == "__main__":
    main()
