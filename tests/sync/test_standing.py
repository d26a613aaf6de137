"""What a station believes that central holds, as answers come in."""

import pytest

from events import GENESIS, Run
from store import Log
from sync import Plan
from sync.plans.deriving import Deriver
from sync.plans.planning import set_plan
from sync.runs import BEGINNING, Point, StreamKey
from sync.station.outbox import Filled
from sync.station.standing import Standing
from tests.sync.conftest import BRNO, EVERYTHING, NOON, append_points, stream_of


def test_an_older_answer_that_is_taken_in_last_takes_nothing_back(station_log: Log) -> None:
    append_points(station_log, stream_of(), [3, 3])
    key = StreamKey(stream_of(), 1)
    first, second = (Point(s.header.last_sequence, s.chain_hash) for s in station_log.read(stream_of()))
    flights = [Filled(key, BEGINNING, first, 1, NOON), Filled(key, first, second, 1, NOON)]
    standing = Standing(station_log, BRNO)
    standing.follow(EVERYTHING)
    standing.look(*station_log.heads())
    standing.hear({})
    for each in flights:
        standing.launched([each])

    standing.landed({key: (Run(0, GENESIS, second.sequence, second.chain_hash),)}, flights[:1])
    standing.landed({key: (Run(0, GENESIS, first.sequence, first.chain_hash),)}, [])

    assert standing.acknowledged is not None
    assert [run.sequence for run in standing.acknowledged[key]] == [6]
    assert standing.works(may_jump=True) == []


@pytest.mark.parametrize("has_old_events", [True, False])
def test_what_is_derived_of_old_events_is_backlog_whenever_it_is_made_and_of_new_ones_live(
    station_log: Log, *, has_old_events: bool
) -> None:
    append_points(station_log, stream_of(), [3, 3])
    where = "true" if has_old_events else "frame >= 6"
    entry = {"stream": "*/gate/*", "where": where, "priority": "alerts"}
    planned = set_plan(station_log, BRNO, Plan.of({"entries": [entry]}), "", NOON)
    standing = Standing(station_log, BRNO)
    standing.follow(planned.plan)
    standing.look(*station_log.heads())
    standing.hear({})
    deriver = Deriver(station_log, BRNO)

    def waiting() -> list[tuple[int, int, bool]]:
        while deriver.step():
            pass
        standing.look(*station_log.heads())
        works = standing.works(may_jump=True)
        return [(work.gap.after.sequence, work.gap.until.sequence, work.is_live) for work in works]

    assert waiting() == ([(0, 6, False)] if has_old_events else [])
    append_points(station_log, stream_of(), [2])
    assert waiting() == ([(0, 6, False), (6, 8, True)] if has_old_events else [(0, 2, True)])
    append_points(station_log, stream_of(), [1])
    assert waiting()[-1] == ((6, 9, True) if has_old_events else (0, 3, True))
    assert all(work.gap.after.chain_hash for work in standing.works(may_jump=True))
