"""Why a rule did not fire: how far the best attempt came, on which row, and what it fell short by."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pyarrow as pa
import pytest

from patterns import bind, parse_rule
from patterns.binding.bound import BoundRule
from patterns.engine.emitter import Emitter
from patterns.engine.running import RuleRun
from patterns.errors import FrameSizeUnknown
from patterns.files.rule import EmitSettings
from patterns.scene.site import Site
from patterns.tools.whynot import Answer, Decided, Past, Question, SubjectUnclear, Verdict, default_window, why_not
from tests.patterns.samples import BEGINNING, SCHEMAS

SIZES = {"gate": (100, 100)}
LOITERING = """
rule: loitering
version: 1
title: "track {track_id} stays"
severity: warning
zones: {yard: {source: gate, polygon: [[0.5, 0], [1, 0], [1, 1], [0.5, 1]]}}
params: {dwell: 10 s}
match: |
  SELECT * FROM (SELECT * FROM track_point WHERE confidence > 0) MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES entry.time AS entered_at
    ONE ROW PER MATCH AFTER MATCH SKIP PAST LAST ROW
    PATTERN (apart entry stay*? dwell) WITHIN INTERVAL '1' MINUTE
    DEFINE apart AS NOT in_zone(apart.x, apart.y, 'yard'),
           entry AS in_zone(entry.x, entry.y, 'yard'),
           stay AS in_zone(stay.x, stay.y, 'yard') AND stay.time < entry.time + :dwell,
           dwell AS in_zone(dwell.x, dwell.y, 'yard') AND dwell.time >= entry.time + :dwell)
"""

Point = tuple[float, float | None]
"""seconds after the beginning, x in pixels"""


def loitering(**changed: tuple[str, str]) -> BoundRule:
    text = LOITERING
    for old, new in changed.values():
        assert old in text
        text = text.replace(old, new)
    return bind(parse_rule(text), SCHEMAS, SIZES)


def rows(points: Sequence[Point], *, track: int = 7, source: str = "gate", confidence: float = 1.0) -> pa.Table:
    count = len(points)
    floats = {name: pa.array([50.0] * count, pa.float32()) for name in ("y", "x1", "y1", "x2", "y2", "vx", "vy")}
    return pa.table(
        {
            "time": pa.array(
                [BEGINNING + timedelta(seconds=second) for second, _ in points], pa.timestamp("us", "UTC")
            ),
            "sequence": pa.array(range(1, count + 1), pa.int64()),
            "source": [source] * count,
            "station": ["here"] * count,
            "subject": [str(track)] * count,
            "type": ["track_point"] * count,
            "track_id": pa.array([track] * count, pa.int64()),
            "frame": pa.array(range(count), pa.int64()),
            "x": pa.array([x for _, x in points], pa.float32()),
            "confidence": pa.array([confidence] * count, pa.float32()),
            **floats,
        }
    )


def asked(bound: BoundRule, table: pa.Table, second: float = 10.0, subject: str = "7", **past: Any) -> Answer:
    """The answer, for a log that holds these rows alone and is at its end."""
    whole = replace(bound, rule=bound.rule.model_copy(update={"emit": EmitSettings()}))
    run = RuleRun(whole)
    run.hold(table)
    decided: list[Decided] = []
    emitter = Emitter(bound.rule.emit)
    for match in run.finish().matches:
        at = match.decided_at or match.last.time
        is_let = emitter.lets_through(match, int(at.timestamp() * 1e6))
        decided.append(Decided(match, None if is_let else decided[0].match))
    question = Question(BEGINNING + timedelta(seconds=second), subject, past.pop("source", None), default_window(bound))
    return why_not(bound, question, Past(table, decided=decided, site=Site.of(SIZES), **past))


def test_a_stay_that_was_too_short_says_by_how_much_and_what_ended_it() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 60), (5, 70), (9.4, 80), (10, 37.7), (11, 20)]))

    assert answer.verdict is Verdict.FELL_SHORT
    assert [(each.variable, each.event.sequence) for each in answer.taken] == [("apart", 1), ("entry", 2), ("stay", 3)]
    assert answer.missing == 1
    assert answer.nearest is not None
    assert (answer.nearest.variable, answer.nearest.event.sequence) == ("dwell", 4)
    assert answer.nearest.shortfalls == (
        "dwell.time >= entry.time + 10 s: 8.4 s got, at least 10 s wanted: 1.6 s short",
    )
    assert {each.variable: each.shortfalls for each in answer.ended} == {
        "stay": ("in_zone(stay.x, stay.y, 'yard'): (37.7, 50.0) is 12.3 px outside",),
        "dwell": (
            "in_zone(dwell.x, dwell.y, 'yard'): (37.7, 50.0) is 12.3 px outside",
            "dwell.time >= entry.time + 10 s: 9 s got, at least 10 s wanted: 1 s short",
        ),
    }
    assert answer.partition == {"source": "gate", "track_id": 7}
    assert "needed 1 more" in answer.headline


def test_one_that_never_came_in_is_told_how_near_it_came() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 30), (2, 45), (3, 30)]))
    assert answer.nearest is not None
    assert (answer.nearest.variable, answer.nearest.event.sequence) == ("entry", 3)
    assert answer.nearest.shortfalls == ("in_zone(entry.x, entry.y, 'yard'): (45.0, 50.0) is 5.0 px outside",)
    assert answer.missing == 2


def test_one_that_was_inside_from_the_first_was_never_apart() -> None:
    answer = asked(loitering(), rows([(0, 60), (5, 60), (20, 60)]))
    assert answer.taken == ()
    assert answer.nearest is not None
    assert answer.nearest.variable == "apart"
    assert answer.nearest.shortfalls == ("NOT in_zone(apart.x, apart.y, 'yard'): (60.0, 50.0) is 10.0 px inside",)
    assert "took not one row and needed 3 more" in answer.headline


def test_one_that_vanished_is_said_to_have_no_further_row() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 60), (5, 70)]))
    assert answer.ended == ()
    assert answer.notes == ("no further row came after 2026-01-01T10:00:05Z",)
    assert answer.nearest is not None
    assert "4 s got, at least 10 s wanted: 6 s short" in answer.nearest.shortfalls[0]


def test_a_match_that_was_a_situation_is_said() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 60), (5, 70), (12, 70)]))
    assert answer.verdict is Verdict.MATCHED
    assert answer.match is not None
    assert answer.headline == (
        "it did match, from 2026-01-01T10:00:00Z to 2026-01-01T10:00:12Z, and was a situation at 2026-01-01T10:00:12Z"
    )


def test_a_match_in_its_cooldown_is_said_with_what_held_it_back() -> None:
    cooled = loitering(emit=("params:", "emit: {cooldown: 90 s}\nparams:"))
    twice = [(0, 20), (1, 60), (12, 70), (13, 20), (14, 60), (25, 60)]
    answer = asked(cooled, rows(twice), second=20)
    assert answer.verdict is Verdict.HELD_BACK
    assert "the situation of 2026-01-01T10:00:12Z holds others of its source, track_id back for 90 s" in answer.headline
    assert asked(cooled, rows(twice), second=5).verdict is Verdict.MATCHED


def test_another_match_of_the_window_is_noted() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 60), (12, 70), (13, 20), (14, 60), (20, 60), (21, 20)]), second=20)
    assert answer.verdict is Verdict.FELL_SHORT
    assert answer.notes == ("it did match from 2026-01-01T10:00:00Z to 2026-01-01T10:00:12Z",)
    assert [each.event.sequence for each in answer.taken] == [4, 5]


def test_rows_that_another_match_took_are_said_to_be_covered() -> None:
    bound = loitering(
        pattern=("apart entry stay*? dwell", "apart apart"),
        define=(LOITERING[LOITERING.index("entry AS in") :], "apart AS NOT in_zone(apart.x, apart.y, 'yard'))\n"),
        order=("apart AS NOT in_zone(apart.x, apart.y, 'yard'),\n           apart", "apart"),
        measures=("entry.time AS entered_at", "FIRST(apart.time) AS entered_at"),
        params=("params: {dwell: 10 s}\n", ""),
    )
    answer = asked(bound, rows([(0, 20), (1, 20), (2, 20), (3, 60)]), second=1.5)
    assert answer.verdict is Verdict.COVERED
    assert answer.headline.endswith(
        "would match, but the match from 2026-01-01T10:00:00Z to 2026-01-01T10:00:01Z took some of them: "
        "AFTER MATCH SKIP PAST LAST ROW"
    )


def test_a_match_that_the_watermark_has_not_passed_is_not_final() -> None:
    table = rows([(0, 20), (1, 60), (12, 70)])
    question = Question(BEGINNING + timedelta(seconds=10), "7", None, timedelta(minutes=1))
    answer = why_not(loitering(), question, Past(table, site=Site.of(SIZES), watermark=BEGINNING))
    assert answer.verdict is Verdict.NOT_FINAL
    assert "the watermark stands at 2026-01-01T10:00:00Z" in answer.headline
    assert [each.variable for each in answer.taken] == ["apart", "entry", "dwell"]


def test_within_that_ran_out_is_one_of_the_reasons() -> None:
    short = loitering(within=("INTERVAL '1' MINUTE", "INTERVAL '11' SECOND"))
    answer = asked(short, rows([(0, 20), (1, 60), (5, 70), (12.5, 70)]))
    assert answer.nearest is not None
    assert answer.nearest.shortfalls == (
        "WITHIN 11 s: 12.5 s after the first row, wanted less than 11 s: 1.5 s too late",
    )


def test_the_filter_of_from_is_named_where_no_row_passes_it() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 60)], confidence=0.0))
    assert answer.verdict is Verdict.FILTERED_OUT
    assert answer.nearest is not None
    assert answer.nearest.shortfalls == ("confidence > 0: 0 got, more than 0 wanted: exactly at the limit",)


def test_rows_that_came_late_are_said_to_be() -> None:
    table = rows([(0, 20), (1, 60)])
    late = frozenset(("here/gate/track_point", sequence) for sequence in (1, 2))
    question = Question(BEGINNING, "7", None, timedelta(minutes=1))
    answer = why_not(loitering(), question, Past(table, late=late, site=Site.of(SIZES)))
    assert answer.verdict is Verdict.LATE
    answer = why_not(loitering(), question, Past(table, late=frozenset([*late][:1]), site=Site.of(SIZES)))
    assert answer.notes[0] == "1 of its 2 rows came too late to take part"


def test_a_null_is_said_to_make_the_condition_unknown() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, None)]))
    assert answer.nearest is not None
    assert answer.nearest.shortfalls == ("in_zone(entry.x, entry.y, 'yard'): unknown, for entry.x is NULL",)


def test_a_zone_of_another_source_is_never_true() -> None:
    answer = asked(loitering(), rows([(0, 20), (1, 60)], source="roof"))
    assert answer.nearest is not None
    assert answer.nearest.shortfalls == (
        "in_zone(entry.x, entry.y, 'yard'): zone 'yard' is of source gate, and this row is of roof: never true",
    )


def test_metres_of_a_source_that_is_not_calibrated_are_unknown() -> None:
    metres = loitering(zone=("{source: gate, polygon", "{source: gate, units: metres, polygon"))
    answer = asked(metres, rows([(0, 20), (1, 60)]))
    assert answer.nearest is not None
    (shortfall,) = answer.nearest.shortfalls
    wanted = "'yard'): unknown, for source gate is not calibrated. Next: vian zones calibrate gate POINTS.yaml"
    assert shortfall.endswith(wanted)


def test_an_unknown_frame_size_is_an_error_that_names_zone_and_source() -> None:
    with pytest.raises(FrameSizeUnknown, match="'yard' is in normalised coordinates of source 'gate'"):
        asked_without_sizes()


def asked_without_sizes() -> Answer:
    question = Question(BEGINNING, "7", None, timedelta(minutes=1))
    return why_not(loitering(), question, Past(rows([(0, 20), (1, 60)])))


def test_an_unknown_subject_is_told_with_those_that_are_near() -> None:
    table = pa.concat_tables([rows([(0, 20)], track=8), rows([(5, 20)], track=9)])
    with pytest.raises(
        SubjectUnclear, match=r"no track_point of '7' between .*; there are, nearest in time first: 9, 8"
    ):
        asked(loitering(), table, second=5)
    with pytest.raises(SubjectUnclear, match="nor of anything else"):
        asked(loitering(), table.slice(0, 0))


def test_a_subject_of_two_sources_is_asked_back() -> None:
    table = pa.concat_tables([rows([(0, 20)]), rows([(5, 20)], source="roof")])
    with pytest.raises(
        SubjectUnclear, match="'7' is in 2 partitions: source gate, track_id 7; source roof, track_id 7"
    ):
        asked(loitering(), table)
    assert asked(loitering(), table, source="gate").partition == {"source": "gate", "track_id": 7}


ABSENCE = """
rule: alone
version: 1
title: "track {track_id} came and nothing followed"
severity: warning
zones: {yard: {source: gate, polygon: [[0.5, 0], [1, 0], [1, 1], [0.5, 1]]}}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES overdue.time AS at
    PATTERN (came overdue) WITHIN INTERVAL '1' MINUTE
    DEFINE came AS in_zone(came.x, came.y, 'yard'), overdue AS TIMER(came.time, INTERVAL '10' SECOND))
"""


def alone() -> BoundRule:
    return bind(parse_rule(ABSENCE), SCHEMAS, SIZES)


def test_a_row_that_came_before_the_timer_was_due_is_told_with_how_much_before() -> None:
    answer = asked(alone(), rows([(0, 60), (8.5, 20), (30, 20)]), second=5)
    assert answer.verdict is Verdict.FELL_SHORT
    assert [each.variable for each in answer.taken] == ["came"]
    assert answer.nearest is not None
    assert answer.nearest.shortfalls == (
        "TIMER(came.time, 10 s): due at 2026-01-01T10:00:10Z; this row came 1.5 s before",
    )


def test_a_timer_that_time_has_not_come_to_is_told() -> None:
    answer = asked(alone(), rows([(0, 20), (5, 60)]), second=5, watermark=BEGINNING + timedelta(seconds=6))
    assert answer.verdict is Verdict.STILL_OPEN
    assert answer.notes[0] == "TIMER is due at 2026-01-01T10:00:15Z; time has come to 2026-01-01T10:00:06Z"


def test_a_virtual_row_is_told_at_the_time_when_it_was_due() -> None:
    table = rows([(0, 60), (30, 20)])
    question = Question(BEGINNING + timedelta(seconds=5), "7", None, timedelta(minutes=1))
    answer = why_not(alone(), question, Past(table, site=Site.of(SIZES), watermark=BEGINNING + timedelta(seconds=20)))
    assert answer.verdict is Verdict.NOT_FINAL
    assert [(each.variable, each.event.sequence, each.event.time) for each in answer.taken] == [
        ("came", 1, BEGINNING),
        ("overdue", 1, BEGINNING + timedelta(seconds=10)),
    ]
    assert asked(alone(), table, second=5).verdict is Verdict.MATCHED


def test_a_rule_that_is_partitioned_by_source_alone_is_asked_for_the_source() -> None:
    text = LOITERING.replace("BY source, track_id", "BY source").replace("track {track_id}", "one")
    bound = bind(parse_rule(text), SCHEMAS, SIZES)
    assert asked(bound, rows([(0, 20), (1, 30), (2, 45)]), subject="gate").partition == {"source": "gate"}
    with pytest.raises(SubjectUnclear, match=r"of 'gaet' between .*; there are, nearest in time first: gate$"):
        asked(bound, rows([(0, 20)]), subject="gaet")
    with pytest.raises(SubjectUnclear, match=r"no track_point of 'gate' between .*nearest in time first: 7$"):
        asked(loitering(), rows([(0, 20)]), subject="gate")
