"""Which conditions a plan may have, what they leave, and what is said of those that it may not have."""

import contextlib
import itertools
import struct
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import Catalogue, EventBatch, EventType, PlateRead, TrackPoint, batch_of, events_of
from sync import FilterFailed, Plan, PlanError
from sync.plans.checking import check_filters, covers, warnings_of
from sync.plans.filtering import Sieve, database, joined
from sync.plans.filters import bind
from sync.plans.where import WhereError, parse
from tests.sync.conftest import NOON, points

CATALOGUE = Catalogue.shipped()


RUNS = database()


def sieve(event_type: type[EventType] = TrackPoint, **said: Any) -> Sieve:
    return Sieve(Plan.of({"entries": [{"stream": "*/*/*", **said}]}).entries[0], event_type, RUNS)


def plates(*texts: str) -> EventBatch:
    return batch_of([PLATE.model_copy(update={"plate": text}) for text in texts])


def frames(batch: EventBatch | None) -> list[int]:
    return [] if batch is None else batch.data.column("frame").to_pylist()


BATCH = batch_of(points(0, 100))
PLATE = PlateRead(
    time=NOON, plate="", confidence=0.5, frame=0, x1=0, y1=0, x2=1, y2=1, country="CZ", region="B", candidates="[]"
)


@pytest.mark.parametrize(
    "where, kept",
    [
        ("frame < 3", [0, 1, 2]),
        ("FRAME < 3 AND Track_Id = 2", [1]),
        ("frame in (7, 3, 200)", [3, 7]),
        ("frame between 3 and 5 or frame = 99", [3, 4, 5, 99]),
        ("not frame > 0", [0]),
        ("vx is null and frame < 9", []),
        ("vx is not null and frame % 50 = 1", [1, 51]),
        ("abs(-frame) + 1 = 2", [1]),
        ("round(frame / 10.0) = 1 and frame > 13", [14]),
        ("coalesce(vx, 0) > 1 or frame = 5", [5]),
        ("frame not in (0, 1) and frame < 3", [2]),
        ("time < '2026-05-01T12:00:00.002Z'", [0, 1]),
        ("time = timestamp '2026-05-01 14:00:00.002+02:00'", [2]),
        ("time between '2026-05-01T12:00:00.010' and '2026-05-01T12:00:00.011'", [10, 11]),
        ("true and frame = 1 -- only one", [1]),
        ("false", []),
        ('"frame" = 1', [1]),
    ],
)
def test_a_condition_keeps_the_events_for_which_it_is_true(where: str, kept: list[int]) -> None:
    assert frames(sieve(where=where).passed(BATCH)) == kept


@pytest.mark.parametrize(
    "where, kept",
    [
        ("plate like '1AB%'", ["1AB23"]),
        ("upper(plate) = 'X''Y'", ["x'y"]),
        ("length(plate) = 0 or lower(plate) = '1ab23'", ["1AB23", ""]),
        ("plate > 'x'", ["x'y"]),
        ("candidates is null", []),
    ],
)
def test_texts_are_compared(where: str, kept: list[str]) -> None:
    passed = sieve(PlateRead, where=where).passed(plates("1AB23", "x'y", ""))
    assert ([] if passed is None else passed.data.column("plate").to_pylist()) == kept


def test_from_a_time_on_is_exact_to_the_event() -> None:
    since = (NOON + timedelta(milliseconds=97)).isoformat()
    assert frames(sieve(**{"from": since, "where": "true"}).passed(BATCH)) == [97, 98, 99]


def test_a_field_that_is_left_out_is_null_and_the_rest_is_as_it_was() -> None:
    passed = sieve(PlateRead, leave_out=["region", "candidates"]).passed(plates("a", "b"))
    assert passed is not None
    left_out = {"region": None, "candidates": None}
    assert events_of(passed) == [PLATE.model_copy(update={"plate": plate, **left_out}) for plate in "ab"]


def test_nothing_left_is_no_batch() -> None:
    assert sieve(where="frame > 1000").passed(BATCH) is None


def test_bits_are_kept() -> None:
    (nan,) = struct.unpack("<f", struct.pack("<I", 0x7FC01234))
    odd = [points(0, 1)[0].model_copy(update={"x": -0.0}), points(1, 1)[0].model_copy(update={"x": nan})]
    passed = sieve(where="frame >= 0").passed(batch_of(odd))
    assert passed is not None
    assert passed.data.column("x").buffers()[1].to_pybytes()[:8] == b"\0\0\0\x80" + struct.pack("<f", nan)


@settings(max_examples=60)
@given(
    st.lists(st.integers(0, 40), max_size=4), st.integers(-1, 40), st.sampled_from(["<", "<=", "=", "<>", ">", ">="])
)
def test_any_split_leaves_the_same(cuts: list[int], limit: int, operator: str) -> None:
    batch = batch_of(points(0, 40))
    each = SIEVES.setdefault((limit, operator), sieve(where=f"frame {operator} {limit} or track_id = 3"))
    places = [0, *sorted(cuts), 40]
    parts = [each.passed(batch.slice(a, b)) for a, b in itertools.pairwise(places) if a < b]
    python = {"<>": "!=", "=": "=="}.get(operator, operator)
    wanted = [f for f in range(40) if eval(f"f {python} limit or 1 + f % 7 == 3", {"f": f, "limit": limit})]
    assert [f for part in parts for f in frames(part)] == frames(each.passed(batch)) == wanted
    kept = [part for part in parts if part is not None]
    assert not kept or frames(joined(kept)) == wanted


SIEVES: dict[tuple[int, str], Sieve] = {}


def test_a_number_that_overflows_is_told() -> None:
    with pytest.raises(FilterFailed, match=r"the condition fails: Out of Range"):
        sieve(where="frame * 9223372036854775807 > 1").passed(BATCH)


@pytest.mark.parametrize(
    "where, said",
    [
        ("confidence > ", "line 1, column 12: something is missing here"),
        ("x > 1 and (y > 2", "line 1, column 16: Expecting )\n    x > 1 and (y > 2\n" + " " * 19 + "^"),
        ("x = 'abc", "a quote or a bracket is not closed"),
        ("x in (select 1)", "line 1, column 7: a subquery cannot stand here; functions are abs, coalesce, length"),
        ("exists(select 1)", "a subquery cannot stand here"),
        ("x > 1 union select 1", "a subquery cannot stand here"),
        ("x > 1\nor random() > 1", "line 2, column 4: the function random cannot stand here"),
        ("now() > time", "line 1, column 1: the function now cannot stand here"),
        ("current_timestamp > time", "CURRENTTIMESTAMP cannot stand here"),
        ("read_text('/etc/passwd') = 'x'", "the function read_text cannot stand here"),
        ("x = $1", "a parameter cannot stand here"),
        ("x = :limit", "a parameter cannot stand here"),
        ("x = ?", "a parameter cannot stand here"),
        ("x > 1; drop table events", "a second statement cannot stand here"),
        ("x::int = 1", "a cast cannot stand here"),
        ("cast(x as int) = 1", "cannot stand here"),
        ("case when x > 1 then true end", "CASE cannot stand here"),
        ("sum(x) over () > 1", "the function sum cannot stand here"),
        ("t.x > 1", "a field stands alone here"),
        ("x is true", "after IS stands NULL or NOT NULL"),
        ("x ** 2 > 1", "POW cannot stand here"),
        ("*", "STAR cannot stand here"),
        ("-- nothing", "there is no condition here"),
        ("(" * 2000, "nested too deep"),
        (" or ".join(["x > 1"] * 400), "nested deeper than 150"),
    ],
)
def test_what_no_plan_may_ask_is_refused_with_its_place(where: str, said: str) -> None:
    with pytest.raises(WhereError) as raised:
        parse(where)
    assert said in str(raised.value)
    assert len(str(raised.value)) < 400
    with pytest.raises(PlanError, match=r"entries\[0\]\.where: "):
        Plan.of({"entries": [{"stream": "*/*/track_point", "where": where}]})


@pytest.mark.parametrize(
    "where, said",
    [
        ("speed > 1", "column 1: track_point has no field 'speed'; it has time, track_id, frame, x, y"),
        ('"X" > 1', "track_point has no field 'X'"),
        ("x > 1 and\n y > 'a'", "line 2, column 6: a number cannot be compared with a text\n     y > 'a'\n         ^"),
        ("x", "column 1: a condition must be true or false, this is a number"),
        ("x + 1", "a condition must be true or false, this is a number"),
        ("x = null", "nothing equals NULL; write IS NULL"),
        ("x in (1, 'a')", "a number cannot be compared with a text"),
        ("not x", "wanted true or false here, this is a number"),
        ("x and y", "wanted true or false here, this is a number"),
        ("x like 'a'", "wanted a text here, this is a number"),
        ("length(x) = 1", "column 8: wanted a text here, this is a number"),
        ("'a' + 1 > 1", "wanted a number here, this is a text"),
        ("time > 'noon'", "'noon' is no time; wanted one such as '2026-11-01T00:00:00Z'"),
        ("time > 5", "a time cannot be compared with a number"),
        ("true > false", "true or false cannot be compared like this"),
        ("coalesce(vx, 'a') = 1", "a number cannot be compared with a text"),
    ],
)
def test_what_does_not_fit_the_type_is_refused_with_its_place(where: str, said: str) -> None:
    with pytest.raises(WhereError) as raised:
        bind(parse(where), TrackPoint)
    assert said in str(raised.value)


def test_an_empty_text_is_no_condition() -> None:
    with pytest.raises(WhereError, match="there is no condition here"):
        parse("")


@given(st.text(alphabet="xy()<>='1., andornulik%\"-", max_size=30))
def test_any_text_is_a_condition_or_is_refused(text: str) -> None:
    with contextlib.suppress(WhereError):
        assert bind(parse(text), TrackPoint).sql


@pytest.mark.parametrize(
    "said, words",
    [
        ({"leave_out": ["x"]}, "go without 'x', which must always be there; no field of it can be left out"),
        (
            {"stream": "*/*/plate_read", "leave_out": ["plate"]},
            "plate_read cannot go without 'plate', which must always be there; can be left out: country, region, cand",
        ),
        ({"leave_out": ["time"]}, "cannot go without 'time', which must always be there"),
        ({"leave_out": ["nope"]}, "cannot go without 'nope', which is no field of it"),
        ({"where": "nope = 1"}, "*/*/track_point: where, for track_point: line 1, column 1: track_point has no field"),
        ({"stream": "*/*/*", "where": "x > 1"}, "Next: correct the entry; name a single type in the pattern"),
        ({"stream": "*/*/no_such_type", "where": "x > 1"}, "no type that this program knows comes to it"),
    ],
)
def test_a_filter_that_does_not_fit_is_refused_before_it_is_set(said: dict[str, Any], words: str) -> None:
    plan = Plan.of({"entries": [{"stream": "*/*/track_ended"}, {"stream": "*/*/track_point", **said}]})
    with pytest.raises(PlanError) as raised:
        check_filters(plan, CATALOGUE)
    assert "entries[1] " in str(raised.value)
    assert words in str(raised.value)


def test_a_filter_need_not_fit_types_that_an_earlier_entry_takes() -> None:
    others = [{"stream": f"*/*/{each.type_name}"} for each in CATALOGUE if each is not TrackPoint]
    check_filters(Plan.of({"entries": [*others, {"stream": "*/*/*", "where": "confidence > 0.5"}]}), CATALOGUE)


@pytest.mark.parametrize(
    "wide, narrow, is_covered",
    [
        ("*/*/*", "a/b/c", True),
        ("*/*/*", "?*/[ab]/c*", True),
        ("a*/*/*", "ab/*/*", True),
        ("a*/*/*", "a*/x/*", True),
        ("a*/*/*", "a?/x/*", False),
        ("a/b/c", "*/b/c", False),
        ("a/b/track_*", "a/b/track_point", True),
    ],
)
def test_one_pattern_covers_another(wide: str, narrow: str, is_covered: bool) -> None:
    assert covers(wide, narrow) is is_covered


def test_an_entry_that_never_applies_is_told() -> None:
    plan = Plan.of(
        {"entries": [{"stream": "*/gate/*"}, {"stream": "*/*/track_point"}, {"stream": "*/gate/track_point"}]}
    )
    (said,) = warnings_of(plan)
    assert said.startswith("entries[2] (*/gate/track_point) never applies: entries[0] stands before it")


def test_a_hash_names_the_filter_and_not_the_pattern() -> None:
    one, same, other = (
        Plan.of({"entries": [{"stream": stream, "where": "x > 1", "leave_out": left_out, "from": since}]}).entries[0]
        for stream, left_out, since in [
            ("*/*/track_point", ["vx", "vy"], "2026-01-01T00:00:00Z"),
            ("*/gate/*", ["vy", "vx"], "2026-01-01T01:00:00+01:00"),
            ("*/gate/*", ["vx"], "2026-01-01T00:00:00Z"),
        ]
    )
    assert one.filter_hash == same.filter_hash != other.filter_hash
    assert one.since == datetime(2026, 1, 1, tzinfo=UTC)
