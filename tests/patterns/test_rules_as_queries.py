"""A rule's SQL means what it means in a query: the situations are the query's rows, without empty matches."""

from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given

from patterns import Rule, bind, match, query
from tests.patterns.examples import examples
from tests.patterns.samples import SCHEMAS, letter_rows, letter_rule, partitions

RULES = {
    "next row": letter_rule(
        "A B*", "A AS letter <> NEXT(letter), B AS n <= NEXT(n, 2)", "NEXT(n) AS n, COUNT(*) AS many"
    ),
    "next of the first": letter_rule(
        "A B* C", "B AS B.n >= NEXT(A.n), C AS C.letter = 'c' OR NEXT(FIRST(A.n, 0), 2) IS NULL",
        "NEXT(FIRST(B.n, 1), 2) AS n, NEXT(LAST(n, 1)) AS last, COUNT(*) AS many", skip="TO NEXT ROW",
    ),
    "next label": letter_rule("A B", "", "NEXT(CLASSIFIER()) AS a, NEXT(LAST(CLASSIFIER(), 1)) AS b, COUNT(*) AS many"),
    "numbered": letter_rule(
        "A B?", "A AS letter = 'a', B AS letter <> 'c'",
        "MATCH_NUMBER() * 2 AS n, LAST(n * MATCH_NUMBER()) AS product, COUNT(*) AS many",
    ),
    "numbered, empty ones too": letter_rule(
        "A?", "A AS letter = 'a'", "MATCH_NUMBER() AS n, COUNT(*) AS many", skip="TO NEXT ROW"
    ),
    "numbered, empty ones where none may begin": letter_rule(
        "^ | A B", "A AS letter = 'a'", "MATCH_NUMBER() AS n, COUNT(*) AS many"
    ),
    "last in a window": letter_rule(
        "A B* $ | A B{1,2}?", "A AS letter = 'a', B AS letter <> 'c'", "COUNT(*) AS many, MATCH_NUMBER() AS n",
        within="INTERVAL '3' MICROSECOND", skip="TO NEXT ROW",
    ),
    "only the last in a window": letter_rule(
        "A+ $", "A AS n >= 0 OR NEXT(n) IS NULL", "COUNT(*) AS many", within="INTERVAL '2' MICROSECOND"
    ),
}  # fmt: skip


@examples(0.005)  # for each of the rules
@given(rows=partitions())
@pytest.mark.parametrize("name", RULES)
def test_a_rule_finds_what_its_sql_finds_as_a_query(name: str, rows: list[list[dict[str, Any]]]) -> None:
    table = letter_rows([record for partition in rows for record in partition])
    assert _situations(RULES[name], table) == _answers(RULES[name], table)


def test_the_rules_find_something() -> None:
    table = letter_rows([{"us": at, "letter": letter, "n": at % 3} for at, letter in enumerate("abacabbacaab")])
    assert all(_situations(rule, table) for rule in RULES.values())


def _situations(rule: Rule, table: pa.Table) -> list[dict[str, Any]]:
    found = [{**each.partition, **each.measures} for each in match(bind(rule, SCHEMAS), table)]
    return sorted(found, key=lambda each: int(each["key"]))


def _answers(rule: Rule, table: pa.Table) -> list[dict[str, Any]]:
    assert rule.match is not None
    answer = query(rule.match, {"letter": table.drop_columns(["blob"])}).to_pylist()
    return sorted((each for each in answer if each["many"]), key=lambda each: int(each["key"]))
