"""Runs: which ranges of a stream central holds, and what is left to send.

Contract: pure. The runs of a stream ascend and do not touch; a run holds the events behind `after`, up to
`sequence`, and says the chain hash at both. A gap is a range that is to be sent and that no run holds.
"""

from dataclasses import dataclass
from typing import NamedTuple

from events import StreamName


class StreamKey(NamedTuple):
    """A stream in one epoch: what has a cursor of its own."""

    stream: StreamName
    epoch: int


@dataclass(frozen=True, slots=True)
class Run:
    """A contiguous range of a stream's events."""

    after: int
    after_hash: bytes
    sequence: int
    chain_hash: bytes
