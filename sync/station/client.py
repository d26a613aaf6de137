"""Central as the station sees it in protocol 2.

Contract: a call either returns central's answer or raises a `CentralError` that says what happened and what
to do next. It never retries; after an error it is unknown what central stored. `send` may be called from
several threads at once, the rest by one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

import httpx

from events import Segment, Station
from store import StreamHead
from sync.errors import BadAnswer, WireError
from sync.protocol.wire import (
    ANSWER_BYTES_MAX,
    BODY_BYTES_MAX,
    CHALLENGE_BYTES_MAX,
    FOLLOWS_HEADER,
    HELLO_ANSWER_BYTES_MAX,
    ORDER_HEADER,
    PATH,
    PROTOCOL,
    PROTOCOLS,
    RECORD_TYPE,
    Challenge,
    ChallengeRequest,
    Countersigned,
    CountersignRequest,
    Hello,
    HelloAnswer,
    M,
    Message,
    Range,
    Record,
    RepairAnswer,
    SegmentsAnswer,
    StreamState,
    cursors_hash,
    decode_records,
    encode_records,
    parse,
    program,
)
from sync.runs import Point, Runs, StreamKey, end_of
from sync.station.exchange import DEADLINE_S, Exchange
from sync.station.unreachable import GOES_ON

JSON = {"Content-Type": "application/json"}


@dataclass(frozen=True, slots=True)
class Greeting:
    """What a station says of itself in a hello."""

    station: Station
    epoch: int
    time: datetime
    heads: Sequence[StreamHead]
    """of the streams that it means to send"""
    believed: Mapping[StreamKey, Runs] | None
    """what it believes that central holds, of all its streams; None where it does not know"""
    checkpoint: int | None
    """sequence of its newest checkpoint that central countersigned"""
    wants_cursors: bool = True
    """Whether central is to say what it holds."""


class Link(Protocol):
    """Central in one version of the protocol."""

    protocol: int
    may_jump: bool
    """Whether a run may begin beyond what central holds."""
    knows_all: bool
    """Whether an answer to hello tells of all the station's streams, and not of those alone that were named."""

    @property
    def address(self) -> str:
        """Central's address, without a password."""

    def hello(self, greeting: Greeting) -> HelloAnswer:
        """Central's answer to a hello. Raises CentralError where there is none."""

    def send(self, records: Sequence[Record], order: str = "", follows: str = "") -> SegmentsAnswer:
        """Central's acknowledgement: the segments are durable there. Raises CentralError where there is none."""

    def countersign(self, request: CountersignRequest) -> Countersigned:
        """Central's signature under a checkpoint. Raises CentralError where there is none."""

    def repair(self, body: bytes) -> RepairAnswer:
        """What central put back of records that it wanted. Raises CentralError where there is no answer."""

    def read(self, wanted: Range) -> Sequence[Segment]:
        """What central holds of a range of this station's. Raises CentralError where there is no answer, or nothing."""


class Signer(Protocol):
    """What signs a station's requests, beside being an `httpx.Auth`."""

    def answer(self, challenge: str) -> None:
        """Sign the next hello over this challenge."""

    def use(self, token: str) -> None:
        """Begin a session: show this token from now on."""


class Central:
    """Central at the address of an HTTP client.

    Args:
        client: Has central's address as `base_url`, and a timeout: 30 s, which outlasts central's wait for
            its database, is a good one.
        signer: An `httpx.Auth` that signs each request, such as `sync.protocol.signing.RequestSigner`; None sends them
            unsigned, which no central takes but one in tests.
        deadline_s: Longest time of an exchange, but for what its body takes.
        afterwards: What an error tells that becomes of what was to be done, once central is back.
    """

    protocol = PROTOCOL
    may_jump = True
    knows_all = True

    def __init__(
        self,
        client: httpx.Client,
        signer: Signer | None,
        deadline_s: float = DEADLINE_S,
        afterwards: str = GOES_ON,
    ) -> None:
        assert signer is None or isinstance(signer, httpx.Auth), "a signer is handed to httpx"
        self._exchange = Exchange(client, PATH, PROTOCOL, signer, deadline_s, afterwards)
        self._signer = signer

    @property
    def address(self) -> str:
        """Central's address, without a password."""
        return self._exchange.address

    def hello(self, greeting: Greeting) -> HelloAnswer:
        """Central's answer to the hello, which is signed over a challenge of central's and begins a session.

        Raises:
            CentralError: There is none.
        """
        challenge = self._challenge(greeting.station)
        if self._signer is not None:
            self._signer.answer(challenge.challenge)
        said = Hello(
            protocols=PROTOCOLS,
            program=program(),
            station=greeting.station,
            epoch=greeting.epoch,
            time=greeting.time,
            streams=_named(greeting),
            cursors_hash=None if greeting.believed is None else cursors_hash(greeting.believed.items()),
            checkpoint=greeting.checkpoint,
            wants_cursors=greeting.wants_cursors,
        )
        answer = self._parsed(HelloAnswer, "hello", said.encoded(), JSON, HELLO_ANSWER_BYTES_MAX)
        if answer.protocol not in PROTOCOLS:
            raise BadAnswer(f"central at {self.address} answers in protocol {answer.protocol}, which was not offered")
        if self._signer is not None:
            self._signer.use(answer.token)
        return answer

    def send(self, records: Sequence[Record], order: str = "", follows: str = "") -> SegmentsAnswer:
        """Central's acknowledgement: the segments are durable there.

        Args:
            records: One or more.
            order: A name for the request.
            follows: Name of the request in flight on which this one goes on; empty: none.

        Raises:
            CentralError: There is none; they may be durable or not.
        """
        headers = {"Content-Type": RECORD_TYPE, ORDER_HEADER: order, FOLLOWS_HEADER: follows}
        given = {name: value for name, value in headers.items() if value}
        return self._parsed(SegmentsAnswer, "segments", encode_records(records), given, ANSWER_BYTES_MAX)

    def countersign(self, request: CountersignRequest) -> Countersigned:
        """Central's signature under a checkpoint of this station.

        Raises:
            CentralError: There is none.
        """
        return self._parsed(Countersigned, "countersign", request.encoded(), JSON, ANSWER_BYTES_MAX)

    def ask(self, endpoint: str, question: Message, answer_type: type[M]) -> M:
        """Central's answer to a question, within the session that a hello began.

        Raises:
            CentralError: There is none.
        """
        return self._parsed(answer_type, endpoint, question.encoded(), JSON, ANSWER_BYTES_MAX)

    def repair(self, body: bytes) -> RepairAnswer:
        """What central put back of a body of records that it wanted.

        Raises:
            CentralError: There is no answer; they may have been put back or not.
        """
        return self._parsed(RepairAnswer, "segments/repair", body, {"Content-Type": RECORD_TYPE}, ANSWER_BYTES_MAX)

    def read(self, wanted: Range) -> list[Segment]:
        """The segments of this station that hold the range at central; the first of them where they are many.

        Raises:
            CentralError: There is no answer, or central holds nothing of it.
        """
        data = self._exchange.post("segments/read", wanted.encoded(), JSON, BODY_BYTES_MAX)
        try:
            return [record.segment for record in decode_records(data)]
        except WireError as error:
            raise self._exchange.bad_answer(str(error)) from error

    def _challenge(self, station: Station) -> Challenge:
        said = ChallengeRequest(station=station).encoded()
        return self._parsed(Challenge, "challenge", said, JSON, CHALLENGE_BYTES_MAX)

    def _parsed(
        self, message_type: type[M], endpoint: str, body: bytes, headers: Mapping[str, str], answer_bytes_max: int
    ) -> M:
        data = self._exchange.post(endpoint, body, headers, answer_bytes_max)
        try:
            return parse(message_type, data)
        except WireError as error:
            raise self._exchange.bad_answer(str(error)) from error


def _named(greeting: Greeting) -> tuple[StreamState, ...]:
    """The streams of which central may lack something, as the station believes."""
    believed = greeting.believed or {}
    return tuple(
        state_of(head)
        for head in greeting.heads
        if end_of(believed.get(StreamKey(head.stream, head.epoch), ())) != Point(head.sequence, head.chain_hash)
    )


def state_of(head: StreamHead) -> StreamState:
    """The message that says where a stream stands here."""
    return StreamState(
        stream=str(head.stream), epoch=head.epoch, sequence=head.sequence, chain_hash=head.chain_hash.hex()
    )
