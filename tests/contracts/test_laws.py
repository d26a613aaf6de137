"""Laws that hold for any interleaving of appends."""

from collections.abc import Callable

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events import StreamName, decode
from store import Appended, Log, Projector, SequenceConflict, verify
from tests.store.samples import draft, query

STREAMS = [StreamName.of("brno", source, "track_point") for source in ("a", "b", "c")]

appends = st.tuples(
    st.integers(0, len(STREAMS) - 1),
    st.integers(1, 5),
    st.sampled_from(["expected", "anywhere", "again", "wrong"]),
)
calls = st.lists(st.lists(appends, min_size=1, max_size=5), max_size=12)


class Model:
    """What a log does, in memory."""

    def __init__(self) -> None:
        self.stored: dict[int, list[tuple[int, int]]] = {number: [] for number in range(len(STREAMS))}
        """First sequence and count of each segment."""

    def head(self, stream: int) -> int:
        return sum(count for _, count in self.stored[stream])

    @property
    def segments(self) -> int:
        return sum(len(ranges) for ranges in self.stored.values())


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(calls=calls)
def test_any_interleaving_of_appends_is_gapless_chained_and_projected(
    make_log: Callable[[], Log], calls: list[list[tuple[int, int, str]]]
) -> None:
    log, model = make_log(), Model()
    for call in calls:
        heads = {stream: model.head(stream) for stream in range(len(STREAMS))}
        drafts, expected, fresh, is_wrong = [], [], [], False
        for stream, count, kind in call:
            first = heads[stream] + 1
            if kind == "again" and model.stored[stream]:
                first, count = model.stored[stream][0]
            else:
                heads[stream] += count
                fresh.append((stream, first, count))
            is_wrong |= kind == "wrong"
            drafts.append(draft(STREAMS[stream], first, first + count - 1))
            expected.append({"anywhere": None, "wrong": first + 100}.get(kind, first - 1))
        if is_wrong:
            try:
                log.append(drafts, expected)
            except SequenceConflict:
                continue
            raise AssertionError("a wrong expectation must be refused")
        appended: list[Appended] = log.append(drafts, expected)
        for stream, first, count in fresh:
            model.stored[stream].append((first, count))
        assert [a.first_sequence for a in appended if not a.was_there] == [first for _, first, _ in fresh]

    segments = list(log.read_all())
    assert [segment.position for segment in segments] == list(range(1, model.segments + 1))
    for number, stream in enumerate(STREAMS):
        own = [segment for segment in segments if segment.stream == stream]
        assert own == list(log.read(stream))
        ranges = [(segment.header.first_sequence, segment.header.event_count) for segment in own]
        assert ranges == model.stored[number]
        frames = [n for segment in own for n in decode(segment, log.catalogue).data.column("frame").to_pylist()]
        assert frames == list(range(1, model.head(number) + 1))
    assert verify(log).broken == []
    projector = Projector(log)
    assert projector.catch_up() == model.segments
    projector.close()
    counted = dict(query(log, "select source, count(*) from events group by 1"))
    assert counted == {s.source: model.head(n) for n, s in enumerate(STREAMS) if model.head(n)}
