"""Central as the station sees it: two calls over HTTP, and what each failure means.

Contract: a call either returns central's answer or raises a `CentralError` that says what happened
and what to do next. It never retries; after an error it is unknown what central stored. Answers are
read up to a limit, and are untrusted text until they parse.
"""

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
    WireError,
)
from sync.grants import checked_token
from sync.wire import RECORD_TYPE, parse
from sync.wire_v1 import ANSWER_BYTES_MAX, PATH, PROTOCOL, Hello, HelloAnswer, Problem, SegmentsAnswer, parse_versioned


class Central:
    """Central at the address of an HTTP client.

    Args:
        client: Has central's address as `base_url`, and a timeout: 30 s, which outlasts central's wait for
            its database, is a good one.
        token: This station's token.

    Raises:
        GrantError: The token cannot be one.
    """

    def __init__(self, client: httpx.Client, token: str) -> None:
        self._client = client
        self._authorization = f"Bearer {checked_token(token)}"

    @property
    def address(self) -> str:
        """Central's address, without a password."""
        return str(self._client.base_url.copy_with(username=None, password=None)).rstrip("/")

    def hello(self, hello: Hello) -> HelloAnswer:
        """Central's answer to the hello.

        Raises:
            CentralError: There is none.
        """
        data = self._post("hello", hello.encoded(), "application/json")
        try:
            return parse_versioned(HelloAnswer, data)
        except ProtocolMismatch as error:
            raise ProtocolMismatch(f"central at {self.address}: {error}. {_UPGRADE}") from error
        except WireError as error:
            raise self._bad_answer(str(error)) from error

    def send(self, body: bytes) -> SegmentsAnswer:
        """Central's acknowledgement: the body's segments are durable there.

        Raises:
            CentralError: There is none; they may be durable or not.
        """
        data = self._post("segments", body, RECORD_TYPE)
        try:
            return parse(SegmentsAnswer, data)
        except WireError as error:
            raise self._bad_answer(str(error)) from error

    def _post(self, endpoint: str, body: bytes, content_type: str) -> bytes:
        headers = {"Authorization": self._authorization, "Content-Type": content_type, "Accept-Encoding": "identity"}
        try:
            with self._client.stream("POST", f"{PATH}/{endpoint}", content=body, headers=headers) as response:
                data = self._read(response)
        except httpx.TimeoutException as error:
            raise CentralUnreachable(f"central at {self.address} gave no answer in time ({_said(error)})") from error
        except httpx.HTTPError as error:
            raise CentralUnreachable(
                f"central at {self.address} cannot be reached: {_said(error)}. Next: check address and link; "
                "nothing is lost, it goes on by itself when central is back"
            ) from error
        if response.status_code == 200:
            return data
        raise self._error(response, data)

    def _read(self, response: httpx.Response) -> bytes:
        data = bytearray()
        for piece in response.iter_bytes():
            data += piece
            if len(data) > ANSWER_BYTES_MAX:
                raise self._bad_answer(f"more than {ANSWER_BYTES_MAX} bytes")
        return bytes(data)

    def _error(self, response: httpx.Response, data: bytes) -> CentralError:
        status = response.status_code
        try:
            problem = parse(Problem, data)
        except WireError:
            return self._foreign_error(response, data)
        said = f"central at {self.address} answered {status}: {_explained(problem)}"
        if status == 401 or problem.code == "foreign_station":
            return NotAuthorised(said)
        if problem.code == "protocol_version":
            return ProtocolMismatch(f"{said}. This station speaks version {PROTOCOL}")
        if status >= 500:
            return CentralFailed(said)
        stream = StreamName.parse(problem.stream) if problem.stream else None
        return Refused(
            said, code=problem.code, stream=stream, epoch=problem.epoch, first_sequence=problem.first_sequence
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
            return CentralFailed(f"central at {self.address} or a proxy before it failed: {_seen(response, data)}")
        return self._bad_answer(_seen(response, data))

    def _bad_answer(self, what: str) -> BadAnswer:
        return BadAnswer(
            f"what answers at {self.address} is not ViAn's central: {what}. "
            f"Next: check the address; curl -i -X POST {self.address}{PATH}/hello must answer 401 with JSON"
        )


_UPGRADE = "Next: bring station and central to the same ViAn: pip install --upgrade vian"


def _explained(problem: Problem) -> str:
    return _clean(
        f"{problem.error} ({problem.code}): got {problem.got}, wanted {problem.wanted}. Next: {problem.next}", 1500
    )


def _seen(response: httpx.Response, data: bytes) -> str:
    kind = _clean(response.headers.get("content-type", "no content type"), 80)
    location = response.headers.get("location")
    to = f" to {_clean(location, 200)}" if location else ""
    return f"status {response.status_code}{to}, {kind}, {_clean(data[:400].decode('utf-8', 'replace'), 160)!r}"


def _said(error: httpx.HTTPError) -> str:
    return _clean(str(error), 300) or type(error).__name__


def _clean(text: str, length_max: int) -> str:
    """The text in one line that is safe to print, cut to a length."""
    line = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in line)[:length_max]
