"""Shared zones through the log: from the first definition on, through changes and restarts, named by each situation."""

import json
from typing import Any

import pytest

from events import ZoneDefined, ZoneRemoved
from patterns import Rule, parse_rule
from patterns.processor import Processor, ProcessorLimits
from store import Log
from tests.patterns.walkers import STATION, T0, add_video, end, point, rule, say, situations

RIGHT = [[0.5, 0], [1, 0], [1, 1], [0.5, 1]]
NOWHERE = [[0, 0], [0.01, 0], [0.01, 0.01]]


def shared() -> Rule:
    """The rule of the walkers, with the zone of the log instead of its own."""
    own = rule()
    text = f"""
rule: enters
version: 1
title: sample
severity: info
shared: [yard]
time: {{lateness: 1 s}}
match: |
{"".join(f"  {line}" + chr(10) for line in own.match.splitlines())}
"""
    return parse_rule(text)


def draw(log: Log, points: Any, version: int, source: str = "gate") -> None:
    say(log, source, ZoneDefined(time=T0, zone="yard", kind="zone", zone_version=version, points=json.dumps(points),
                                 units="normalised", author=None, reason=None))  # fmt: skip


def step_in(log: Log, second: int, source: str = "gate") -> None:
    say(log, source, point(second + 1, second, 20), point(second + 1, second + 1, 80))


def found(log: Log) -> list[tuple[int, list[int]]]:
    """For each situation its track, and the versions of the zone that it was judged by."""
    return [
        (json.loads(each.partition)["track_id"], [r.first_sequence for r in each.lineage if r.variable == "zone:yard"])
        for each in situations(log)
    ]


def test_a_zone_that_was_drawn_after_the_footage_holds_for_all_of_it(log: Log) -> None:
    add_video(log, "gate")
    step_in(log, 0)
    draw(log, RIGHT, 1)
    step_in(log, 4)
    end(log, "gate")
    assert Processor(log, STATION, [shared()]).catch_up() == 2
    assert found(log) == [(1, [1]), (5, [1])]


@pytest.mark.parametrize("segments", [1, 100])
def test_a_change_holds_from_its_place_in_the_log_on_whatever_is_restarted(log: Log, segments: int) -> None:
    add_video(log, "gate")
    draw(log, RIGHT, 1)
    step_in(log, 0)
    step_in(log, 10)
    draw(log, NOWHERE, 2)
    step_in(log, 20)
    draw(log, RIGHT, 3)
    step_in(log, 30)
    step_in(log, 40)
    say(log, "gate", ZoneRemoved(time=T0, zone="yard", zone_version=3, author=None, reason=None))
    step_in(log, 50)
    end(log, "gate", 70)
    position, last = 0, log.head()
    while position < last:
        processor = Processor(log, STATION, [shared()], limits=ProcessorLimits(segments=segments, save_every_events=1))
        processor.step()
        position = processor.position
        processor.close()
    # The last points before each change are not final yet when it comes: the new zone judges them.
    assert found(log) == [(1, [1]), (21, [3]), (31, [3])]


def test_each_source_has_its_own(log: Log) -> None:
    for source in ("gate", "ramp"):
        add_video(log, source)
    draw(log, RIGHT, 1)
    draw(log, NOWHERE, 1, "ramp")
    for source in ("gate", "ramp"):
        step_in(log, 0, source)
        end(log, source)
    assert Processor(log, STATION, [shared()]).catch_up() == 1
    assert found(log) == [(1, [1])]
    (event,) = situations(log)
    assert [each.stream for each in event.lineage if each.variable == "zone:yard"] == ["brno/gate/zone_defined"]


def test_a_definition_that_is_none_sets_only_the_rules_aside_that_use_it(log: Log) -> None:
    add_video(log, "gate")
    draw(log, [[0, 0]], 1)
    step_in(log, 0)
    end(log, "gate")
    processor = Processor(log, STATION, [shared(), rule("other")])
    assert processor.catch_up() == 1
    assert set(processor.failures) == {"enters"}
    assert "defines no zone 'yard'" in str(processor.failures["enters"])
