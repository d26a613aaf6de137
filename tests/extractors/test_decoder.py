"""The decoding process's work, done within this process so that it can be seen at work."""

import io
import json
from pathlib import Path

import pytest

from extractors.decoder import send
from extractors.wire import HEADER, Header, Kind, Medium, Request, pack, unpack
from tests.extractors.films import film, film_of_two_sizes, first_half, with_noise

PIXELS_MAX = 4096 * 4096


def sent(path: Path, pixels_max: int = PIXELS_MAX) -> list[tuple[Header, bytes]]:
    out = io.BytesIO()
    send(Request(Medium.FILE, str(path), pixels_max=pixels_max), out)
    out.seek(0)
    messages = []
    while head := out.read(HEADER.size):
        header = unpack(head)
        messages.append((header, out.read(header.body_bytes)))
    return messages


def kinds(messages: list[tuple[Header, bytes]]) -> list[Kind]:
    return [header.kind for header, _ in messages]


def test_info_frames_and_end_are_sent_in_order(tmp_path: Path) -> None:
    messages = sent(film(tmp_path / "film.mp4", frames=4))
    assert kinds(messages) == [Kind.INFO, Kind.FRAME, Kind.FRAME, Kind.FRAME, Kind.FRAME, Kind.END]
    assert all(len(body) == 160 * 120 * 3 for header, body in messages if header.kind is Kind.FRAME)
    assert json.loads(messages[0][1])["frames_expected"] == 4


def test_a_refusal_says_why(tmp_path: Path) -> None:
    path = tmp_path / "text.mp4"
    path.write_text("text\n" * 100)
    ((header, body),) = sent(path)
    assert header.kind is Kind.REFUSED
    assert json.loads(body)["error"]


def test_gaps_are_sent_where_they_are(tmp_path: Path) -> None:
    at = kinds(sent(film_of_two_sizes(tmp_path, frames=6))).index(Kind.GAP)
    assert at == 7  # info, six frames
    whole = film(tmp_path / "whole.avi", frames=60, codec="mjpeg")
    header, body = sent(first_half(tmp_path / "half.avi", whole))[-2]
    assert (header.kind, json.loads(body)["reason"]) == (Kind.GAP, "broken_off")
    corrupt = sent(with_noise(tmp_path / "corrupt.avi", whole, start=0.4, stop=0.6))
    reasons = [json.loads(body)["reason"] for header, body in corrupt if header.kind is Kind.GAP]
    assert "corrupt" in reasons


def test_frames_above_the_limit_are_not_sent(tmp_path: Path) -> None:
    messages = sent(film(tmp_path / "film.mp4", frames=4), pixels_max=1000)
    assert Kind.FRAME not in kinds(messages)


def test_a_header_survives_the_wire() -> None:
    header = Header(Kind.FRAME, 7, -3, 640, 480, 1.5, 640 * 480 * 3)
    assert unpack(pack(header)) == header


def test_bytes_that_are_no_header_are_refused() -> None:
    with pytest.raises(ValueError, match="a message begins with"):
        unpack(bytes(HEADER.size))


def test_a_request_survives_the_wire() -> None:
    request = Request(Medium.ADDRESS, "rtsp://user:geheim@host/ä?a=1", pixels_max=7, fps=2.5, queue_frames=3)
    assert Request.from_line(request.to_line()) == request
