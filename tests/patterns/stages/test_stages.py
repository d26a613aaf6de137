"""Stages: case files as data, and online equals batch in any split, with any restart and order of arrival."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import events_of
from patterns import RuleError, StateError
from patterns.stages import Stage, StageRun, derive, load_stages, parse_stage, run_stage_tests

FOLDER = Path(__file__).parent / "cases"
BEGINNING = datetime(2026, 1, 1, 10, tzinfo=UTC)
STAGES = load_stages(FOLDER)


@pytest.mark.parametrize(
    ("stage", "index"), [(stage, index) for stage in STAGES for index in range(len(stage.tests))],
    ids=lambda value: value.stage if isinstance(value, Stage) else str(value),
)  # fmt: skip
def test_case_files(stage: Stage, index: int) -> None:
    result = run_stage_tests(stage)[index]
    assert result.passed, f"{result.name}\n{result.difference}"


@pytest.mark.parametrize(
    "row,message",
    [
        ("{time: 2026-01-01T10:00:00Z, trak_id: 1}", "row 1: unknown column 'trak_id'; there are: .*mean 'track_id'"),
        ("{time: 2026-01-01T10:00:00Z, track_id: one}", "row 1, column track_id: wanted a whole number, got 'one'"),
        ("{track_id: 1}", "row 1: it has no `time`"),
    ],
)
def test_rows_of_a_test_that_are_not_right(row: str, message: str) -> None:
    text = f"stage: a\nversion: 1\npair_distance: {{radius_px: 3}}\ntests:\n  - given: [{row}]\n    expect: []\n"
    with pytest.raises(RuleError, match=message):
        run_stage_tests(parse_stage(text))


HEAD = "stage: a\nversion: 1\n"
MORE = "stage: sample\nversion: 1\ntime: {lateness: 4 us}\n"
SAMPLES = {
    "pairs": parse_stage(MORE + "pair_distance: {radius_px: 3}"),
    "pairs every": parse_stage(MORE + "pair_distance: {radius_px: 3, every: 3 us, pairs_most: 2}"),
    "zones": parse_stage(
        MORE + "occupancy:\n  gone_after: 5 us\n  zones:\n"
        "    left: {source: cam-01, units: pixels, polygon: [[0, 0], [3, 0], [3, 9], [0, 9]]}\n"
        "    right: {source: cam-02, units: pixels, polygon: [[3, 0], [6, 0], [6, 9], [3, 9]]}\n"
    ),
    "groups": parse_stage(MORE + "group_seen: {radius_px: 2, persists: 2 us, every: 3 us, gone_after: 4 us}"),
    "tally": parse_stage(MORE + "tally: {of: track_point, window: 4 us, by: track_id, empty_most: 2, keys_most: 3}"),
    "tally of all": parse_stage(MORE + "tally: {of: track_point, window: 3 us}"),
}


def point_rows(records: list[dict[str, Any]]) -> pa.Table:
    floats = {"x": 0.0, "y": 0.0, "vx": 1.0, "vy": 0.0, "confidence": 1.0}
    times = [BEGINNING + timedelta(microseconds=record["us"]) for record in records]
    return pa.table(
        {
            "time": pa.array(times, pa.timestamp("us", "UTC")),
            "sequence": pa.array([record["sequence"] for record in records], pa.int64()),
            "source": pa.array([record.get("source", "cam-01") for record in records], pa.string()),
            "station": pa.array(["here"] * len(records), pa.string()),
            "type": pa.array(["track_point"] * len(records), pa.string()),
            "track_id": pa.array([record["track_id"] for record in records], pa.int64()),
            **{
                name: pa.array([record.get(name, plain) for record in records], pa.float32())
                for name, plain in floats.items()
            },
        }
    )


@st.composite
def points(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Points of a few tracks of two sources in order of time, with ties and gaps."""
    drawn = draw(
        st.lists(
            st.tuples(
                st.sampled_from([0, 0, 1, 2, 9]), st.integers(1, 5), st.integers(0, 6), st.integers(0, 3),
                st.sampled_from(["cam-01", "cam-02"]), st.sampled_from([0.0, 1.0, 1.0]), st.integers(0, 4),
            ),
            max_size=20,
        )
    )  # fmt: skip
    us = 0
    records = []
    for index, (step, track, x, y, source, confidence, delay) in enumerate(drawn):
        us += step
        record = {"us": us, "sequence": index, "track_id": track, "x": x, "y": y, "source": source}
        records.append(record | {"confidence": confidence, "delay": delay})
    return records


def said(derived: Any) -> list[tuple[str, dict[str, Any]]]:
    return [(each.source, dict(event)) for each in derived for event in events_of(each.batch)]


@settings(max_examples=40)
@given(
    records=points(), cuts=st.lists(st.integers(0, 100), max_size=5), restarts=st.sets(st.integers(0, 5)),
    is_shuffled=st.booleans(),
)  # fmt: skip
@pytest.mark.parametrize("name", SAMPLES)
def test_any_split_restart_and_order_of_arrival_derives_what_batch_derives(
    name: str, records: list[dict[str, Any]], cuts: list[int], restarts: set[int], is_shuffled: bool
) -> None:
    stage = SAMPLES[name]
    arriving = sorted(records, key=lambda each: each["us"] + each["delay"]) if is_shuffled else records
    bounds = [0, *sorted(cut % (len(records) + 1) for cut in cuts), len(records)]
    run = StageRun(stage)
    found = []
    for index, (begin, end) in enumerate(pairwise(bounds)):
        outcome = run.push(point_rows(arriving[begin:end]))
        assert outcome.late == 0
        found += said(outcome.derived)
        if index in restarts:
            state = run.state()
            run = StageRun(stage)
            run.restore(state)
            assert run.state() == state
    found += said(run.finish().derived)
    assert found == said(derive(stage, point_rows(records)))
    times = [event["time"] for _, event in found]
    assert times == sorted(times)


def test_late_points_are_counted_and_take_no_part() -> None:
    run = StageRun(SAMPLES["pairs"])
    run.push(point_rows([{"us": 100, "sequence": 1, "track_id": 1}]))
    outcome = run.push(point_rows([{"us": 95, "sequence": 2, "track_id": 2}, {"us": 96, "sequence": 3, "track_id": 3}]))
    assert (outcome.late, run.late) == (1, 1)


def test_pairs_beyond_the_limit_are_counted() -> None:
    stage = parse_stage(MORE + "pair_distance: {radius_px: 9, pairs_most: 2}")
    run = StageRun(stage)
    run.push(point_rows([{"us": 0, "sequence": at, "track_id": at, "x": at * at} for at in range(1, 4)]))
    pairs = [event["pair"] for _, event in said(run.finish().derived)]
    assert pairs == ["1+2", "2+3"], "the nearest"
    assert run.given_up == 1


def test_the_state_of_another_stage_is_refused() -> None:
    with pytest.raises(StateError, match="is of stage hash"):
        StageRun(SAMPLES["pairs"]).restore(StageRun(SAMPLES["groups"]).state())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "<stage>:1:1: a stage file is a mapping with `stage:`, `version:`, ...; got an empty file"),
        (HEAD, "<stage>:1:1: stage: a stage has one of the keys pair_distance, occupancy, "),
        (HEAD + "pair_distance: {radius: 3}\n", "<stage>:3:17: pair_distance.radius: unknown key; there are:"),
        (HEAD + "pair_distance: {radius_px: -3}\n", "<stage>:3:28: pair_distance.radius_px: Input should be"),
        (HEAD + "tally: {of: x, window: 0 s}\n", "<stage>:3:24: tally.window: Input should be greater than"),
        (HEAD + "tally: {of: x, window: 1 week}\n", "<stage>:3:24: tally.window: a duration is a number"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_stage_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(RuleError) as caught:
        parse_stage(text)
    assert str(caught.value).startswith(message)
