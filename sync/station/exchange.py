"""One exchange with central over HTTP, and what each failure means.

Contract: `post` either returns the body of central's answer 200 or raises a `CentralError` that says what
happened and what to do next. It never retries; after an error it is unknown what central did. Answers are
read up to a limit, and are untrusted text until they parse. An exchange has a deadline for the whole of it.
"""

from collections.abc import Mapping

import httpx

from events import StreamName
from sync.errors import (
    BadAnswer,
    CentralError,
    CentralFailed,
    CentralUnreachable,
    NotAuthorised,
    ProtocolMismatch,
    Refused,
    SessionOver,
    WireError,
)
from sync.protocol.wire import Problem, parse
from sync.station.deadlines import deadline
from sync.station.unreachable import GOES_ON, why_unreachable
from sync.text import one_line

DEADLINE_S = 60.0
"""Longest time of an exchange, but for what its body takes."""
BYTES_PER_S_MIN = 1000
"""What a body is let take for: slower than this a link counts as hanging."""


class Exchange:
    """Requests to central under one path, by one HTTP client.

    Args:
        client: Has central's address as `base_url`, and a timeout: 30 s, which outlasts central's wait for
            its database, is a good one.
        path: Of the protocol's version.
        version: The protocol's version, for messages.
        auth: Signs each request.
        deadline_s: Longest time of an exchange, but for what its body takes.
        afterwards: What an error tells that becomes of what was to be done, once central is back.
    """

    def __init__(
        self,
        client: httpx.Client,
        path: str,
        version: int,
        auth: httpx.Auth | None = None,
        deadline_s: float = DEADLINE_S,
        afterwards: str = GOES_ON,
    ) -> None:
        self._client = client
        self._path = path
        self._version = version
        self._auth = auth
        self._deadline_s = deadline_s
        self._afterwards = afterwards

    @property
    def address(self) -> str:
        """Central's address, without a password."""
        return str(self._client.base_url.copy_with(username=None, password=None)).rstrip("/")

    def post(self, endpoint: str, body: bytes, headers: Mapping[str, str], answer_bytes_max: int) -> bytes:
        """The body of central's answer.

        Raises:
            CentralError: There is none, or it is a refusal.
        """
        given = {**headers, "Accept-Encoding": "identity"}
        auth = httpx.USE_CLIENT_DEFAULT if self._auth is None else self._auth
        try:
            with (
                deadline(self._deadline_s + len(body) / BYTES_PER_S_MIN),
                self._client.stream(
                    "POST", f"{self._path}/{endpoint}", content=body, headers=given, auth=auth
                ) as response,
            ):
                data = self._read(response, answer_bytes_max)
        except httpx.TimeoutException as error:
            raise CentralUnreachable(
                f"central at {self.address} gave no answer in time ({_said(error)}). Next: check the link, and vian "
                f"doctor on central; {self._afterwards}"
            ) from error
        except httpx.HTTPError as error:
            raise CentralUnreachable(f"central at {self.address} cannot be reached: {self._why(error)}") from error
        if response.status_code == 200:
            if response.headers.get("content-type", "").startswith("text/html"):
                raise self.bad_answer(f"a web page: {_seen(response, data)}")
            return data
        raise self._error(response, data)

    def _why(self, error: httpx.HTTPError) -> str:
        if isinstance(error, httpx.RemoteProtocolError) and self._client.base_url.scheme == "http":
            address = self._client.base_url.copy_with(scheme="https", username=None, password=None)
            return (
                f"what listens there speaks no http ({_said(error)}); perhaps it speaks TLS. "
                f"Next: --central {str(address).rstrip('/')}; {self._afterwards}"
            )
        return why_unreachable(error, self._afterwards)

    def _read(self, response: httpx.Response, bytes_max: int) -> bytes:
        data = bytearray()
        for piece in response.iter_bytes():
            data += piece
            if len(data) > bytes_max:
                raise self.bad_answer(f"more than {bytes_max} bytes")
        return bytes(data)

    def _error(self, response: httpx.Response, data: bytes) -> CentralError:
        status = response.status_code
        try:
            problem = parse(Problem, data)
        except WireError:
            return self._foreign_error(response, data)
        said = f"central at {self.address} answered {status}: {_explained(problem)}"
        if problem.code in SESSION_CODES:
            return SessionOver(said)
        if status == 401 or problem.code in GRANT_CODES:
            return NotAuthorised(said)
        if problem.code == "protocol_version":
            return ProtocolMismatch(f"{said}. This station speaks version {self._version}")
        if status >= 500:
            return CentralFailed(said)
        stream = StreamName.parse(problem.stream) if problem.stream else None
        return Refused(
            said,
            code=problem.code,
            stream=stream,
            epoch=problem.epoch,
            first_sequence=problem.first_sequence,
            got=problem.got,
        )

    def _foreign_error(self, response: httpx.Response, data: bytes) -> CentralError:
        """The error for an answer that has no problem body of ours."""
        status = response.status_code
        if status == 401:
            return NotAuthorised(
                f"something before central at {self.address} wants other credentials: {_seen(response, data)}. "
                "Next: let the proxy pass the Authorization header through"
            )
        if status == 413:
            return BadAnswer(
                f"a proxy before central at {self.address} finds the request too large: {_seen(response, data)}. "
                "Next: raise its limit (nginx: client_max_body_size), or lower the bytes of a request"
            )
        if status >= 500:
            return CentralFailed(
                f"central at {self.address} or a proxy before it failed: {_seen(response, data)}. "
                f"Next: vian doctor on central, and look at the proxy's log; {self._afterwards}"
            )
        return self.bad_answer(_seen(response, data))

    def bad_answer(self, what: str) -> BadAnswer:
        """The error for an answer that is not central's."""
        return BadAnswer(
            f"what answers at {self.address} is not ViAn's central: {what}. "
            f"Next: check the address; curl -i -X POST {self.address}{self._path}/hello must answer with JSON"
        )


SESSION_CODES = ("no_session", "stale_challenge", "replayed")
"""Codes that say that a new hello begins a new session, and nothing else is wrong."""
GRANT_CODES = ("foreign_station", "not_granted")
"""Codes, beside every 401, of what only an operator can change."""
UPGRADE = "Next: bring station and central to the same ViAn: pip install --upgrade vian"


def _explained(problem: Problem) -> str:
    return one_line(
        f"{problem.error} ({problem.code}): got {problem.got}, wanted {problem.wanted}. Next: {problem.next}", 1500
    )


def _seen(response: httpx.Response, data: bytes) -> str:
    kind = one_line(response.headers.get("content-type", "no content type"), 80)
    location = response.headers.get("location")
    to = f" to {one_line(location, 200)}" if location else ""
    return f"status {response.status_code}{to}, {kind}, {one_line(data[:400].decode('utf-8', 'replace'), 160)!r}"


def _said(error: httpx.HTTPError) -> str:
    return one_line(str(error), 300) or type(error).__name__
