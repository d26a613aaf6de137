"""One follower of chains: what it takes, in which order, and what it says of the rest."""

from dataclasses import replace
from itertools import accumulate, permutations

import pytest

from events import GENESIS, Base, Chains, Fault, Header, Position, Run, Segment, Sequence, StreamName, chain, encode
from tests.store.samples import GATE, NOON, PRODUCER, points


def segments(*counts: int, stream: StreamName = GATE) -> list[Segment]:
    """A stream's segments of so many events each."""
    made: list[Segment] = []
    for end, count in zip(accumulate(counts), counts, strict=True):
        drafted = encode(stream, points(end - count + 1, end), PRODUCER)
        times = drafted.time_min, drafted.time_max
        header = Header(stream, 1, Sequence(end - count + 1), count, drafted.schema_version, *times, PRODUCER)
        chain_hash = chain(made[-1].chain_hash if made else GENESIS, header, drafted.payload_hash)
        made.append(Segment(header, drafted.payload, drafted.payload_hash, chain_hash, Position(len(made) + 1), NOON))
    return made


FOUR = segments(2, 1, 3, 1)
BEFORE = [GENESIS, *(segment.chain_hash for segment in FOUR)]


def base_before(number: int, position: int) -> Base:
    return Base(GATE, 1, FOUR[number].header.first_sequence - 1, BEFORE[number], position)


def held(chains: Chains) -> list[tuple[int, int]]:
    return [(run.after, run.sequence) for run in chains.runs.get((GATE, 1), [])]


def test_segments_in_order_are_one_run() -> None:
    chains = Chains()
    assert [chains.follow(segment) for segment in FOUR] == [None] * 4
    assert chains.runs == {(GATE, 1): [Run(0, GENESIS, 7, FOUR[3].chain_hash)]}


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_every_order_ends_in_one_run(order: tuple[int, ...]) -> None:
    chains = Chains()
    for position, number in enumerate(order, 1):
        first = FOUR[number].header.first_sequence
        if not any(sequence == first - 1 for _, sequence in [(0, 0), *held(chains)]):
            chains.expect([base_before(number, position)])
        assert chains.follow(replace(FOUR[number], position=Position(position))) is None
    assert chains.runs == {(GATE, 1): [Run(0, GENESIS, 7, FOUR[3].chain_hash)]}
    assert chains.not_begun() == []


def test_a_run_needs_a_base_that_was_told_of() -> None:
    chains = Chains()
    assert chains.follow(FOUR[2]) == Fault("sequences 1 to 3 are missing", 1)
    chains.follow(FOUR[0])
    assert chains.follow(FOUR[2]) == Fault("sequences 3 to 3 are missing", 3)
    chains.expect([base_before(2, 9)])
    assert chains.follow(FOUR[2]) == Fault("the base at sequence 3 says that a run begins at position 9")
    chains.expect([base_before(2, 3)])
    assert chains.follow(FOUR[2]) is None
    assert held(chains) == [(0, 2), (3, 6)]


def test_a_segment_that_is_there_already_is_refused_wherever_it_lies() -> None:
    chains = Chains(bases=[base_before(2, 3)])
    for number in (2, 3, 0):
        assert chains.follow(FOUR[number]) is None
    for number in (2, 3, 0):
        assert chains.follow(FOUR[number]) is not None
    assert held(chains) == [(0, 2), (3, 7)]


def test_runs_meet_in_the_hash_behind_which_the_upper_one_was_begun() -> None:
    other = segments(3, 3)
    chains = Chains(bases=[base_before(2, 3)])
    chains.follow(FOUR[2])
    fault = chains.follow(other[0])
    assert fault is not None
    assert fault.reason.startswith("at sequence 3 the chain hash is")
    longer = segments(4)
    assert chains.follow(longer[0]) == Fault("it ends at sequence 4, but from 4 on the stream is here already")
    assert held(chains) == [(3, 6)]


def test_a_base_with_another_hash_is_found_by_the_segment_behind_it() -> None:
    chains = Chains(bases=[replace(base_before(2, 3), chain_hash=bytes(32))])
    fault = chains.follow(FOUR[2])
    assert fault is not None
    assert fault.reason.startswith("the chain hash is")
    assert held(chains) == []


def test_what_is_below_a_sequence_is_told() -> None:
    chains = Chains({(GATE, 1): [Run(6, bytes(32), 9, bytes(32)), Run(0, GENESIS, 3, bytes(32))]})
    assert [chains.below((GATE, 1), sequence).after for sequence in (1, 3, 4, 6, 7, 9, 10)] == [0, 0, 0, 0, 6, 6, 6]
    assert chains.below((GATE, 2), 5).sequence == 0
