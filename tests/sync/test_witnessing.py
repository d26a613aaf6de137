"""What the countersignatures in a log are worth: by a known key, over all that they say, fitting the log."""

from typing import Any

import pytest

from events import CheckpointCountersigned
from store import Log, StreamHead
from sync.keeping.countersigned import Held, countersigned_bytes, held_text
from sync.keeping.witnessing import witnessed
from tests.store.samples import GATE, NOON, append, draft_of
from tests.sync.conftest import CENTRAL_KEY, key_of

KEYS = {CENTRAL_KEY.id: CENTRAL_KEY.public}


def held(log: Log, sequence: int, after: int = 0, **changed: Any) -> Held:
    hashes = {each.header.last_sequence: each.chain_hash for each in log.read(GATE)} | {0: bytes(32)}
    head = StreamHead(GATE, 1, sequence, changed.get("chain_hash", hashes[sequence]))
    return Held(head, after, changed.get("after_hash", hashes[after]))


def countersign(log: Log, *said: Held, **changed: Any) -> None:
    key = changed.pop("key", CENTRAL_KEY)
    signed = countersigned_bytes("brno", 1, bytes(32), said, NOON, key.public)
    event = CheckpointCountersigned(
        time=NOON,
        of_station="brno",
        checkpoint_sequence=1,
        statement_hash="00" * 32,
        held=held_text(said),
        key_id=key.id,
        algorithm="ed25519",
        signature=key.sign(signed),
    )
    log.append([draft_of(event.model_copy(update=changed), "sync")])


def test_signatures_with_bases_and_without_hold_and_those_of_other_keys_are_counted(log: Log) -> None:
    append(log, GATE, 3, 3)
    countersign(log, held(log, 6))
    countersign(log, held(log, 6, 3))
    countersign(log, held(log, 6), key=key_of("another central"))
    found = witnessed(log, KEYS)
    assert (found.signatures, found.unknown, found.broken) == (2, 1, ())
    assert witnessed(log, KEYS, after=log.head() - 2).signatures == 1


@pytest.mark.parametrize("with_base", [False, True])
def test_what_was_changed_since_it_was_signed_is_named(log: Log, *, with_base: bool) -> None:
    append(log, GATE, 3, 3)
    said = held(log, 6, 3 if with_base else 0)
    countersign(log, said, held=held_text([held(log, 3)]))
    (broken,) = witnessed(log, KEYS).broken
    assert broken.position == 3
    assert "whose signature it does not bear" in broken.reason


@pytest.mark.parametrize("changed", [{"chain_hash": b"x" * 32}, {"after_hash": b"x" * 32}])
def test_a_signature_over_another_history_is_named(log: Log, changed: dict[str, bytes]) -> None:
    append(log, GATE, 3, 3)
    countersign(log, held(log, 6, 3, **changed))
    (broken,) = witnessed(log, KEYS).broken
    sequence = 6 if "chain_hash" in changed else 3
    assert f"central signed the chain hash {'78' * 32} at sequence {sequence} of {GATE}, epoch 1" in broken.reason
