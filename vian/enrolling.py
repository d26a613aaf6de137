"""Joining a central server: the one request by which a station is taken in.

Contract: the code's secret goes only to a server whose certificate holds, or on this machine. Nothing is kept of a
request that failed; the code may be used again then, unless central says otherwise.
"""

from dataclasses import dataclass

import httpx

from events import Station
from store import StationKey
from sync.errors import WireError
from sync.protocol.enrolment import Enrol, Enrolled
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import PATH, M, Problem, parse
from sync.station.unreachable import why_unreachable
from vian.errors import WorldFailed
from vian.membership import Membership
from vian.tls import AGAIN, station_context

_SECONDS_MAX = 30.0
_ANSWER_BYTES_MAX = 64 * 1024


@dataclass(frozen=True, slots=True)
class Joined:
    """What came of an enrolment."""

    membership: Membership
    epoch: int
    """behind all epochs of which central holds events of the station; 0: it holds none, or is of the release before"""


def enrol_at(url: httpx.URL, certificate: str | None, secret: bytes, station: Station, key: StationKey) -> Joined:
    """What the station knows of its central once it was taken in.

    Args:
        url: Central's address.
        certificate: Central's pinned certificate as PEM; None where its authority is known.
        secret: The code's.
        station: The station's name.
        key: The station's key.

    Raises:
        WorldFailed: Central cannot be reached, or refuses.
    """
    body = Enrol(secret=secret.hex(), public_key=key.public.hex()).encoded()
    context = station_context(certificate)
    with httpx.Client(base_url=url, timeout=_SECONDS_MAX, verify=context) as client:
        client.auth = RequestSigner(key, station, "", PATH)
        answer = _answer(client, url, body)
    membership = Membership(
        address=str(url).rstrip("/"),
        station=answer.station,
        central=answer.central,
        public_key=answer.public_key,
        certificate=certificate,
        operations=answer.operations,
        reads=answer.reads,
        key_id=key.id,
    )
    return Joined(membership, answer.epoch)


def _answer(client: httpx.Client, url: httpx.URL, body: bytes) -> Enrolled:
    try:
        with client.stream("POST", f"{PATH}/enrol", content=body) as response:
            data = bytearray()
            for piece in response.iter_bytes():
                data += piece
                if len(data) > _ANSWER_BYTES_MAX:
                    raise WorldFailed(_not_central(url, f"an answer of more than {_ANSWER_BYTES_MAX} bytes"))
    except httpx.HTTPError as error:
        raise WorldFailed(f"central at {url} cannot be reached: {why_unreachable(error, AGAIN)}") from error
    if response.status_code == 200:
        return _parsed(Enrolled, bytes(data), url, response)
    problem = _parsed(Problem, bytes(data), url, response)
    raise WorldFailed(
        _clean(
            f"central at {url} says: {problem.error}: got {problem.got}, wanted {problem.wanted}. Next: {problem.next}"
        )
    )


def _parsed(kind: type[M], data: bytes, url: httpx.URL, response: httpx.Response) -> M:
    try:
        return parse(kind, data)
    except WireError as error:
        raise WorldFailed(
            _not_central(url, f"status {response.status_code}, {data[:80].decode('utf-8', 'replace')!r}")
        ) from error


def _not_central(url: httpx.URL, got: str) -> str:
    return _clean(
        f"what answers at {url} is not a central server of this ViAn: {got}. Next: check the address; "
        f"curl {url} must name the paths that it serves, {PATH}/enrol among them"
    )


def _clean(text: str) -> str:
    line = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in line)[:1500]
