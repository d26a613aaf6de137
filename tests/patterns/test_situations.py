"""What a match says: title, lineage, identity; and which matches become situations."""

import hashlib
from datetime import UTC, datetime, timedelta

import pyarrow as pa
import pytest

from patterns import EventRange, EventRef, MatchError, RuleRun, bind, match, situation_id
from tests.patterns.samples import BEGINNING, SCHEMAS, define_letters, letter_rows, letter_rule, letters

TITLE = "{letter} of {key} at {at} after {took}, {share:.1f}, {none}, {source}, {subject}, {n:>3}, {took:.2f}"


def test_the_title_is_filled_in() -> None:
    rule = letter_rule(
        "A B", define_letters("AB"),
        "B.time AS at, B.time - A.time AS took, B.n / 3.0 AS share, A.n + NULL AS none",
    )  # fmt: skip
    rule = rule.model_copy(update={"title": TITLE})
    (found,) = match(bind(rule, SCHEMAS), letters("ab", key=7))
    assert found.title == "b of 7 at 2026-01-01T10:00:01Z after 1 s, 0.3, ?, cam-01, ?,   1, 1.00 s"
    assert found.measures == {
        "at": BEGINNING + timedelta(seconds=1), "took": timedelta(seconds=1), "share": 1 / 3, "none": None,
    }  # fmt: skip
    assert (found.rule, found.version, found.rule_hash, found.severity) == ("sample", 1, rule.hash, "info")
    assert found.partition == {"key": 7}


def test_lineage_names_the_rows_of_each_variable_by_stream() -> None:
    rule = letter_rule("A+ B A", define_letters("AB"), partition="key")
    rows = letter_rows(
        [
            {"us": 0, "letter": "a", "sequence": 4, "source": "cam-01", "key": 1},
            {"us": 1, "letter": "z", "sequence": 5, "source": "cam-01", "key": 2},
            {"us": 2, "letter": "a", "sequence": 7, "source": "cam-01", "key": 1},
            {"us": 3, "letter": "a", "sequence": 6, "source": "cam-01", "key": 1},
            {"us": 4, "letter": "a", "sequence": 1, "source": "cam-02", "key": 1},
            {"us": 5, "letter": "b", "sequence": 2, "source": "cam-02", "key": 1},
            {"us": 6, "letter": "a", "sequence": 3, "source": "cam-02", "key": 1},
        ]
    )
    (found,) = match(bind(rule, SCHEMAS), rows)
    first, second = "here/cam-01/letter", "here/cam-02/letter"
    assert found.lineage == {
        "A": (
            EventRange(first, 4, 7, 2), EventRange(first, 6, 6, 1), EventRange(second, 1, 1, 1),
            EventRange(second, 3, 3, 1),
        ),
        "B": (EventRange(second, 2, 2, 1),),
    }  # fmt: skip
    assert (found.first.stream, found.first.sequence, found.last.stream, found.last.sequence) == (first, 4, second, 3)


def test_identity_is_the_hash_of_a_published_layout() -> None:
    first = EventRef("s/c/t", 1, datetime(1970, 1, 1, 0, 0, 1, tzinfo=UTC))
    last = EventRef("s/c/t", 9, datetime(1970, 1, 1, 0, 0, 2, tzinfo=UTC))
    text = '["situation/1","r",2,["cám",7,null],["s/c/t",1,1000000],["s/c/t",9,2000000]]'
    assert situation_id("r", 2, ["cám", 7, None], first, last) == hashlib.sha256(text.encode()).hexdigest()
    assert situation_id("r", 3, ["cám", 7, None], first, last) != situation_id("r", 2, ["cám", 7, None], first, last)


def test_identity_does_not_depend_on_what_else_there_is() -> None:
    rule = letter_rule("A B", define_letters("AB"))
    (alone,) = match(bind(rule, SCHEMAS), letters("ab"))
    crowd = match(bind(rule, SCHEMAS), letters("abab"))
    assert crowd[0] == alone
    assert crowd[1].situation_id != alone.situation_id


def test_partition_columns_of_every_type() -> None:
    rule = letter_rule("A", "A AS letter = 'a'", partition="time, key, gap, v, flag, letter")
    (found,) = match(
        bind(rule, SCHEMAS), letter_rows([{"us": 0, "letter": "a", "gap": timedelta(seconds=1), "v": 0.5}])
    )
    assert found.partition == {
        "time": BEGINNING, "key": 0, "gap": timedelta(seconds=1), "v": 0.5, "flag": None, "letter": "a",
    }  # fmt: skip
    again = match(bind(rule, SCHEMAS), letter_rows([{"us": 0, "letter": "a", "gap": timedelta(seconds=1), "v": 0.5}]))
    assert again == [found]


@pytest.mark.parametrize(
    "emit,wanted",
    [
        ("", [0, 1, 2, 3, 4, 5]),
        ("emit: {cooldown: 2 s}", [0, 1, 4, 5]),
        ("emit: {cooldown: 2 s, once_per: []}", [0, 3, 5]),
        ("emit: {once_per: [key]}", [0, 1]),
        ("emit: {once_per: [n]}", [0, 5]),
        ("emit: {once_per: [key, n], cooldown: 3999999 us}", [0, 1, 4, 5]),
        ("emit: {once_per: [key, n], cooldown: 4 s}", [0, 1, 5]),
    ],
)
def test_once_per_and_cooldown(emit: str, wanted: list[int]) -> None:
    rule = letter_rule("A", "A AS letter = 'a'", "A.n AS n", more=emit)
    seconds_keys_numbers = [(0, 1, 1), (1, 2, 1), (1.9, 1, 1), (2.5, 2, 1), (3.999999, 1, 1), (4.5, 2, 2)]
    rows = letter_rows(
        [{"us": round(s * 1e6), "letter": "a", "key": key, "n": n} for s, key, n in seconds_keys_numbers]
    )
    run = RuleRun(bind(rule, SCHEMAS))
    found = list(run.push(rows).matches) + list(run.finish().matches)
    assert [each.first.sequence for each in found] == wanted
    assert run.held_back == 6 - len(wanted)
    assert run.counts.matches == len(wanted)
    assert found == match(bind(rule, SCHEMAS), rows)


@pytest.mark.parametrize(
    "change,message",
    [
        (lambda rows: rows.drop_columns(["station"]), "station is missing"),
        (lambda rows: rows.drop_columns(["letter"]), "the rule reads the column letter, which the rows do not have"),
        (lambda rows: rows.set_column(0, "time", [[None, None]]), "time of a row must not be NULL"),
        (lambda rows: rows.set_column(7, "letter", [[[1], [2]]]), "letter is not a column of type string"),
        (lambda rows: rows.set_column(1, "sequence", [["a", "b"]]), "sequence is not a column of type integer"),
    ],
)
def test_rows_of_another_shape_than_the_rule_was_bound_to(change: object, message: str) -> None:
    bound = bind(letter_rule("A B", define_letters("AB")), SCHEMAS)
    assert callable(change)
    with pytest.raises(MatchError, match=message):
        match(bound, change(letters("ab")))


def test_dictionaries_and_other_units_of_time_are_read() -> None:
    rows = letters("ab")
    rows = rows.set_column(rows.column_names.index("letter"), "letter", rows.column("letter").dictionary_encode())
    rows = rows.set_column(0, "time", rows.column("time").cast(pa.timestamp("ns", "UTC")))
    (found,) = match(bind(letter_rule("A B", define_letters("AB")), SCHEMAS), rows)
    assert found.last.time == BEGINNING + timedelta(seconds=1)


def test_times_at_the_ends_of_the_calendar() -> None:
    rule = letter_rule("A+", within="INTERVAL '1' DAY")
    rows = letters("ab")
    end = datetime(9999, 12, 31, 23, 59, 59, 999_999, UTC)
    last = rows.set_column(0, "time", [pa.array([end] * 2, pa.timestamp("us", "UTC"))])
    (found,) = match(bind(rule, SCHEMAS), last)
    assert found.decided_at == found.last.time == end
    beyond = rows.set_column(0, "time", [pa.array([2**60, 2**62]).cast(pa.timestamp("us", "UTC"))])
    with pytest.raises(MatchError, match="years 1 to 9999"):
        match(bind(rule, SCHEMAS), beyond)


def test_a_lateness_longer_than_history_holds_everything() -> None:
    run = RuleRun(bind(letter_rule("A", more="time: {lateness: 53375995 d}"), SCHEMAS))
    assert run.push(letters("abc")).matches == ()
    assert run.watermark == datetime(1, 1, 1, tzinfo=UTC)
    assert len(run.finish().matches) == 3


def test_no_rows_give_no_situations() -> None:
    assert match(bind(letter_rule("A"), SCHEMAS), letters("")) == []
