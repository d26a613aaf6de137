"""Central as the station sees it in protocol 1, which release N-1 speaks: a token in place of signatures.

Contract: as `sync.station.client`. Central tells cursors of the streams that are named only, and a stream is sent in
order, from its beginning: there are no runs. What lacks its payload cannot be sent.
"""

from collections.abc import Sequence

import httpx

from events import GENESIS, Run, Segment, StreamName
from sync.errors import BadAnswer, CentralFailed, ProtocolMismatch, Refused, WireError
from sync.protocol.grants import checked_token
from sync.protocol.wire import (
    RECORD_TYPE,
    Countersigned,
    CountersignRequest,
    Cursor,
    Range,
    Record,
    RepairAnswer,
    parse,
    program,
)
from sync.protocol.wire import HelloAnswer as HelloAnswer2
from sync.protocol.wire import SegmentsAnswer as SegmentsAnswer2
from sync.protocol.wire_v1 import (
    ANSWER_BYTES_MAX,
    PATH,
    PROTOCOL,
    Hello,
    HelloAnswer,
    SegmentsAnswer,
    StreamState,
    encode_records,
    parse_versioned,
)
from sync.runs import StreamKey
from sync.station.client import JSON, Greeting
from sync.station.exchange import DEADLINE_S, UPGRADE, Exchange
from sync.station.unreachable import GOES_ON

_HOLLOW = "its payload left the disk, which protocol 1 cannot say. Next: vian station enrol CODE --central URL"


class CentralV1:
    """Central at the address of an HTTP client.

    Args:
        client: As for `sync.station.client.Central`.
        token: This station's token.
        deadline_s: Longest time of an exchange, but for what its body takes.

    Raises:
        GrantError: The token cannot be one.
    """

    protocol = PROTOCOL
    may_jump = False
    knows_all = False

    def __init__(
        self, client: httpx.Client, token: str, deadline_s: float = DEADLINE_S, afterwards: str = GOES_ON
    ) -> None:
        self._exchange = Exchange(client, PATH, PROTOCOL, deadline_s=deadline_s, afterwards=afterwards)
        self._authorization = {"Authorization": f"Bearer {checked_token(token)}"}

    @property
    def address(self) -> str:
        """Central's address, without a password."""
        return self._exchange.address

    def hello(self, greeting: Greeting) -> HelloAnswer2:
        """Central's answer to the hello.

        Raises:
            CentralError: There is none.
        """
        hello = Hello(
            protocol=PROTOCOL,
            program=program(),
            station=greeting.station,
            epoch=greeting.epoch,
            time=greeting.time,
            streams=tuple(map(StreamState.of, greeting.heads)),
        )
        data = self._post("hello", hello.encoded(), JSON)
        try:
            answer = parse_versioned(HelloAnswer, data)
        except ProtocolMismatch as error:
            raise ProtocolMismatch(f"central at {self.address}: {error}. {UPGRADE}") from error
        except WireError as error:
            raise self._exchange.bad_answer(str(error)) from error
        told = {(cursor.stream, cursor.epoch) for cursor in answer.cursors}
        unanswered = [str(head.stream) for head in greeting.heads if (str(head.stream), head.epoch) not in told]
        if unanswered:
            raise BadAnswer(f"central at {self.address} gave no cursor for {', '.join(unanswered[:5])}")
        return HelloAnswer2(
            protocol=PROTOCOL,
            program=answer.program,
            station=answer.station,
            time=answer.time,
            cursors=_cursors(answer.cursors),
            body_bytes_max=answer.body_bytes_max,
            segments_max=answer.segments_max,
        )

    def send(self, records: Sequence[Record], order: str = "", follows: str = "") -> SegmentsAnswer2:
        """Central's acknowledgement: the segments are durable there.

        Raises:
            CentralError: There is none; they may be durable or not.
            Refused: The payload of one left the disk; central of this version would take its header for a false one.
        """
        for segment in (record.segment for record in records if not record.segment.has_payload):
            raise Refused(
                _HOLLOW,
                code="false_header",
                stream=segment.stream,
                epoch=segment.header.epoch,
                first_sequence=segment.header.first_sequence,
            )
        body = encode_records([record.segment for record in records])
        data = self._post("segments", body, {"Content-Type": RECORD_TYPE})
        try:
            answer = parse(SegmentsAnswer, data)
        except WireError as error:
            raise self._exchange.bad_answer(str(error)) from error
        return SegmentsAnswer2(cursors=_cursors(answer.cursors), stored=answer.stored, duplicates=answer.duplicates)

    def countersign(self, request: CountersignRequest) -> Countersigned:
        """Not in this version.

        Raises:
            CentralFailed: Always.
        """
        raise CentralFailed(f"central at {self.address} countersigns nothing in protocol {PROTOCOL}. {UPGRADE}")

    def repair(self, body: bytes) -> RepairAnswer:
        """Not in this version.

        Raises:
            CentralFailed: Always.
        """
        raise CentralFailed(f"central at {self.address} wants nothing back in protocol {PROTOCOL}. {UPGRADE}")

    def read(self, wanted: Range) -> Sequence[Segment]:
        """None: not in this version."""
        del wanted
        return ()

    def _post(self, endpoint: str, body: bytes, headers: dict[str, str]) -> bytes:
        return self._exchange.post(endpoint, body, self._authorization | headers, ANSWER_BYTES_MAX)


def _cursors(states: Sequence[StreamState]) -> tuple[Cursor, ...]:
    return tuple(
        Cursor.of(
            StreamKey(StreamName.parse(state.stream), state.epoch),
            [Run(0, GENESIS, state.sequence, bytes.fromhex(state.chain_hash))] if state.sequence else [],
        )
        for state in states
    )
