"""Conversations that were recorded from earlier releases."""

from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Exchange:
    """One request and its response, to the byte."""

    name: str
    request: bytes
    response: bytes

    @property
    def request_body(self) -> bytes:
        return self.request.partition(b"\r\n\r\n")[2]

    @property
    def response_body(self) -> bytes:
        return self.response.partition(b"\r\n\r\n")[2]

    @property
    def status(self) -> int:
        return int(self.response.split(b" ", 2)[1])


def conversation(release: str) -> list[Exchange]:
    """The exchanges of a release's conversation, in order."""
    return [
        Exchange(path.stem, path.read_bytes(), path.with_suffix(".response").read_bytes())
        for path in sorted((FOLDER / release).glob("*.request"))
    ]
