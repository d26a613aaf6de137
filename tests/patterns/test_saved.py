"""Saved state: small, of its own rule only, and never misread."""

import pyarrow as pa
import pytest

from patterns import RuleRun, StateError, bind
from tests.patterns.samples import SCHEMAS, define_letters, letter_rows, letter_rule, letters


def _run(version: str = "") -> RuleRun:
    return RuleRun(
        bind(letter_rule("A B+? C", define_letters("ABC"), more=version or "time: {lateness: 1 s}"), SCHEMAS)
    )


def test_state_does_not_grow_with_the_length_of_a_match() -> None:
    short, long = _run(), _run()
    short.push(letters("a" + "b" * 10))
    long.push(letters("a" + "b" * 10_000))
    assert len(long.state()) < len(short.state()) + 60


def test_state_of_many_partitions_is_small() -> None:
    run = _run()
    run.push(letter_rows([{"us": at, "letter": "a", "key": at} for at in range(2000)]))
    run.push(letter_rows([{"us": 9_000_000, "letter": "z", "key": 0}]))
    assert run.partitions_open == 2000
    assert len(run.state()) < 40_000


def test_state_of_another_rule_is_refused() -> None:
    state = _run().state()
    with pytest.raises(StateError, match="is of rule hash"):
        _run("time: {lateness: 2 s}").restore(state)


def test_state_over_other_columns_is_refused() -> None:
    state = _run().state()
    schema = SCHEMAS["letter"]
    at = schema.get_field_index("key")
    other = {"letter": schema.set(at, schema.field(at).with_type(pa.string()))}
    run = RuleRun(bind(letter_rule("A B+? C", define_letters("ABC"), more="time: {lateness: 1 s}"), other))
    with pytest.raises(StateError, match="other columns"):
        run.restore(state)


@pytest.mark.parametrize(
    "damage", [lambda s: b"", lambda s: b"VRS9" + s[4:], lambda s: s[:-9], lambda s: s[:4] + b"xx"]
)
def test_damaged_state_is_refused(damage: object) -> None:
    run = _run()
    run.push(letters("ab"))
    assert callable(damage)
    with pytest.raises(StateError):
        _run().restore(damage(run.state()))


def test_counts_frame_sizes_and_watermark_are_restored() -> None:
    run = _run()
    run.set_frame_size("cam-01", 640, 480)
    run.push(letters("abbc"))
    run.push(letters("z"))
    again = _run()
    again.restore(run.state())
    assert (again.counts, again.watermark, again.rows_waiting) == (run.counts, run.watermark, run.rows_waiting)
    assert again.counts.late == 1
    assert again.finish() == run.finish()
