"""What a station believes that central holds, as answers come in."""

from events import GENESIS, Run
from store import Log
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
