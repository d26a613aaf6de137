"""Central restored from an older backup after its station pruned: it is loud at both sides, with exact ranges."""

import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest

from store import Log, verify
from store.payloads import put_back, weights
from sync import Daemon, Damaged, Plan
from sync.keeping.gone import Gone, accept, gone_in, told_at_central, told_at_station
from sync.keeping.pruning import Proven, take_off_held
from tests.sync.conftest import BRNO, CENTRAL, NOON, MakeDaemon, Serve, append_points, central_app, stream_of
from tests.sync.test_deriving import damage_records, give_up

GATE = stream_of()
NOW = datetime.now(UTC) + timedelta(days=1)


def prune(log: Log, *positions: int) -> None:
    found = [each for each in weights(log, 0, NOW, 1000) if each.position in positions]
    take_off_held(log, BRNO, found, Proven("", {}), NOW)


def catch_up(daemon: Daemon) -> list[str]:
    """Send all that waits; what was said to be gone."""
    told: list[str] = []
    while (step := daemon.step()).did != "nothing":
        assert step.error is None
        told += step.gone
    return told


def test_both_logs_say_what_is_gone_at_both_sides(
    station_log: Log, make_daemon: MakeDaemon, make_log: Callable[[], Log], serve: Serve
) -> None:
    append_points(station_log, GATE, [3, 2, 4, 1])
    catch_up(make_daemon())
    prune(station_log, 1, 2, 4)
    assert gone_in(station_log, BRNO) == []
    restored = make_log()

    told = catch_up(make_daemon(address=serve(central_app(restored))))

    gone = [Gone(GATE, 1, 1, 5), Gone(GATE, 1, 10, 10)]
    assert told == list(map(str, gone))
    assert gone_in(station_log, BRNO) == gone_in(restored, CENTRAL) == gone
    assert gone_in(restored, CENTRAL, BRNO) == gone
    assert told_at_station(gone[0]).startswith(f"payload gone here and at central: {GATE}, epoch 1, sequences 1 to 5; ")
    assert re.search(rf"vian sync repair --stream {GATE} --epoch 1 --from 1 --to 5 asks", told_at_central(gone[0]))
    assert verify(station_log, station=BRNO).is_sound
    assert verify(restored, station=CENTRAL).is_sound

    assert catch_up(make_daemon(address=serve(central_app(make_log())))) == [], "said once"
    accept(restored, CENTRAL, gone[:1], NOON)
    assert gone_in(restored, CENTRAL) == gone[1:]


def test_what_is_back_is_gone_no_more(
    station_log: Log, make_daemon: MakeDaemon, make_log: Callable[[], Log], serve: Serve
) -> None:
    append_points(station_log, GATE, [3, 2])
    first = next(station_log.read(GATE))
    prune(station_log, 1, 2)
    restored = make_log()
    catch_up(make_daemon(address=serve(central_app(restored))))
    position = next(restored.read(GATE, with_hollow=True)).position
    with restored.transaction() as transaction:
        put_back(transaction, position, first.payload)
    assert gone_in(restored, CENTRAL) == [Gone(GATE, 1, 4, 5)]


def test_where_what_is_recorded_cannot_be_read_the_stream_stops_and_the_others_go_on(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, GATE, [3, 2])
    append_points(station_log, stream_of("yard"), [4])
    give_up(station_log, 1)
    damage_records(station_log)
    daemon = make_daemon(plan=Plan.of({"entries": [{"stream": "*/*/track_point"}]}))

    with pytest.raises(Damaged, match=f"stream {GATE} .* what is recorded of that cannot be read") as raised:
        daemon.catch_up()
    assert (raised.value.stream, raised.value.first_sequence) == (GATE, 1)
    assert [(each.stream, each.sequence) for each in central_log.heads(BRNO)[1]] == [(stream_of("yard"), 4)]


def test_what_was_given_up_is_no_surprise(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, GATE, [3, 2])
    give_up(station_log, 1)
    assert catch_up(make_daemon()) == []
    assert gone_in(station_log, BRNO) == gone_in(central_log, CENTRAL) == []
    found = verify(central_log, station=CENTRAL)
    assert (found.is_sound, found.hollow, found.unrecorded) == (True, 1, 0)


def test_what_is_noted_of_one_life_of_a_stream_hides_nothing_of_another(
    station_log: Log, make_daemon: MakeDaemon, make_log: Callable[[], Log], serve: Serve
) -> None:
    append_points(station_log, GATE, [3])
    prune(station_log, 1)
    restored = make_log()
    catch_up(make_daemon(address=serve(central_app(restored))))
    accept(restored, CENTRAL, [Gone(GATE, 2, 1, 3)], NOON)
    assert gone_in(restored, CENTRAL) == [Gone(GATE, 1, 1, 3)]
    accept(restored, CENTRAL, [Gone(GATE, 1, 1, 3)], NOON)
    assert gone_in(restored, CENTRAL) == []
