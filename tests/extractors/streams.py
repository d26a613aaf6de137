"""Live streams on this machine, made for the tests: RTSP with H.264, and HTTP with MJPEG or MPEG-TS.

Only the network is a stand-in. The RTSP server knows what a client needs to play one stream that is
interleaved with its control connection or comes by UDP (RFC 2326, RFC 6184), and each way in which a camera may
fail.
"""

import base64
import io
import socket
import socketserver
import ssl
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import av

from tests.extractors.films import picture

RATE = 25
SIZE = (160, 120)
_NTP_SECONDS = 2_208_988_800
"""From the epoch of NTP, 1900, to that of Unix."""


@dataclass(frozen=True, slots=True)
class Camera:
    """How the camera behaves."""

    frames: int = 1_000
    """frames of each connection, after which it closes"""
    is_mute: bool = False
    """takes connections and never answers"""
    mute_after: int | None = None
    """frame after which a connection stays open and says nothing more"""
    login: str | None = None
    """`user:password` that it wants"""
    rate: float = RATE
    """frames per second that it sends"""
    says_ntp: float | None = None
    """its wall clock, s since 1970 at its first frame; None: it says nothing of it"""
    is_udp: bool = False
    """sends by UDP, and in no other way"""
    tls: ssl.SSLContext | None = None
    """its certificate, where it speaks TLS"""
    sizes: tuple[tuple[int, int], ...] = (SIZE,)
    """frame size of each connection; the last one goes on"""


def h264(frames: int, size: tuple[int, int]) -> list[list[bytes]]:
    """NAL units of each frame; the first frame brings its parameter sets."""
    context: Any = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = *size, "yuv420p"
    context.framerate, context.options = (
        RATE,
        {"tune": "zerolatency", "preset": "ultrafast", "x264-params": "keyint=10"},
    )
    packets: list[list[bytes]] = []
    for at in range(frames):
        frame = av.VideoFrame.from_ndarray(picture(*size, at), format="bgr24").reformat(format="yuv420p")
        frame.pts = at
        packets += [_nal_units(bytes(packet)) for packet in context.encode(frame)]
    return packets


def _nal_units(data: bytes) -> list[bytes]:
    return [unit.rstrip(b"\0") for unit in data.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1") if unit]


@contextmanager
def rtsp(camera: Camera) -> Iterator[str]:
    """The address of an RTSP camera that lives as long as the block."""
    server = _Rtsp(camera)
    with _served(server):
        yield f"rtsp{'s' if camera.tls else ''}://127.0.0.1:{server.server_address[1]}/stream"


@contextmanager
def _served(server: socketserver.BaseServer) -> Iterator[None]:
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Rtsp(socketserver.ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.connections = 0
        self.units = {size: h264(40, size) for size in set(camera.sizes)} if not camera.is_mute else {}
        super().__init__(("127.0.0.1", 0), _Session)
        if camera.tls is not None:
            self.socket = camera.tls.wrap_socket(self.socket, server_side=True, do_handshake_on_connect=False)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away is no news."""


class _Session(socketserver.StreamRequestHandler):
    server: _Rtsp

    def handle(self) -> None:
        camera = self.server.camera
        while request := self._request():
            method, headers = request
            if camera.is_mute:
                threading.Event().wait(60)
                return
            if camera.login and headers.get("authorization", "") != _basic(camera.login):
                self._answer(headers, "401 Unauthorized", 'WWW-Authenticate: Basic realm="camera"')
            elif method == "OPTIONS":
                self._answer(headers, "200 OK", "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN")
            elif method == "DESCRIBE":
                self._answer(headers, "200 OK", "Content-Type: application/sdp", body=_SDP)
            elif method == "SETUP" and camera.is_udp and "/TCP" in headers["transport"]:
                self._answer(headers, "461 Unsupported transport")
            elif method == "SETUP" and camera.is_udp:
                self._ports = [int(each) for each in headers["transport"].partition("client_port=")[2].split("-")]
                udp = f"Transport: RTP/AVP/UDP;unicast;client_port={self._ports[0]}-{self._ports[1]}"
                self._answer(headers, "200 OK", udp, "Session: 1")
            elif method == "SETUP":
                self._answer(headers, "200 OK", "Transport: RTP/AVP/TCP;unicast;interleaved=0-1", "Session: 1")
            elif method == "PLAY":
                self._answer(headers, "200 OK", "Session: 1")
                self._play(camera)
                return
            else:
                return

    def _request(self) -> tuple[str, dict[str, str]] | None:
        line = self.rfile.readline().decode()
        if not line.strip():
            return None
        headers = {}
        while text := self.rfile.readline().decode().strip():
            name, _, value = text.partition(":")
            headers[name.lower()] = value.strip()
        return line.split()[0], headers

    def _answer(self, asked: dict[str, str], status: str, *headers: str, body: str = "") -> None:
        lines = [f"RTSP/1.0 {status}", f"CSeq: {asked['cseq']}", *headers, f"Content-Length: {len(body)}", "", body]
        self.wfile.write("\r\n".join(lines).encode())

    def _play(self, camera: Camera) -> None:
        size = camera.sizes[min(self.server.connections, len(camera.sizes) - 1)]
        self.server.connections += 1
        units = self.server.units[size]
        sequence, began = 0, time.monotonic()
        if camera.says_ntp is not None:
            self._packet(1, _sender_report(camera.says_ntp))
        for at in range(camera.frames):
            if at == camera.mute_after:
                threading.Event().wait(60)
                return
            payloads = [part for unit in units[at % len(units)] for part in _fragments(unit)]
            for i, payload in enumerate(payloads):
                is_last = i == len(payloads) - 1
                stamp = round(at * 90_000 / camera.rate)
                head = struct.pack(">BBHII", 0x80, 96 | (0x80 if is_last else 0), sequence & 0xFFFF, stamp, 7)
                self._packet(0, head + payload)
                sequence += 1
            time.sleep(max(0.0, began + (at + 1) / camera.rate - time.monotonic()))

    def _packet(self, channel: int, packet: bytes) -> None:
        """Send a packet of the pictures (channel 0) or of the times (1)."""
        if not self.server.camera.is_udp:
            self.wfile.write(struct.pack(">cBH", b"$", channel, len(packet)) + packet)
            return
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(packet, ("127.0.0.1", self._ports[channel]))


_SDP = """v=0
o=- 0 0 IN IP4 127.0.0.1
s=test
c=IN IP4 0.0.0.0
t=0 0
m=video 0 RTP/AVP 96
a=rtpmap:96 H264/90000
a=fmtp:96 packetization-mode=1
a=control:video
""".replace("\n", "\r\n")


def _fragments(unit: bytes, most: int = 1200) -> list[bytes]:
    """The unit as payloads of RTP: whole where it is small, else in fragments (RFC 6184, FU-A)."""
    if len(unit) <= most:
        return [unit]
    kind, body = unit[0] & 0x1F, unit[1:]
    parts = [body[i : i + most] for i in range(0, len(body), most)]
    flags = [(0x80 if i == 0 else 0) | (0x40 if i == len(parts) - 1 else 0) for i in range(len(parts))]
    return [bytes([(unit[0] & 0xE0) | 28, flag | kind]) + part for flag, part in zip(flags, parts, strict=True)]


def _sender_report(seconds: float) -> bytes:
    whole = int(seconds)
    ntp = ((whole + _NTP_SECONDS) << 32) | int((seconds - whole) * 2**32)
    return struct.pack(">BBHIQIII", 0x80, 200, 6, 7, ntp, 0, 0, 0)


def _basic(login: str) -> str:
    return f"Basic {base64.b64encode(login.encode()).decode()}"


@contextmanager
def http(
    kind: str, *, frames: int = 50, rate: float = RATE, sizes: Sequence[tuple[int, int]] = (SIZE,)
) -> Iterator[str]:
    """The address of an HTTP camera that sends `mjpeg` or `ts`, or points to a `redirect` of another protocol.

    With `mjpeg` so many frames come in each of the sizes.
    """
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(kind, frames, rate, sizes))
    server.daemon_threads, server.block_on_close = True, False
    with _served(server):
        yield f"http://127.0.0.1:{server.server_port}/camera?user=admin&pwd=geheim"


def _handler(kind: str, frames: int, rate: float, sizes: Sequence[tuple[int, int]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if kind == "redirect":
                self.send_response(302)
                self.send_header("Location", "file:///etc/passwd")
                self.end_headers()
                return
            self.send_response(200)
            self.send_header(
                "Content-Type", "video/mp2t" if kind == "ts" else "multipart/x-mixed-replace; boundary=frame"
            )
            self.end_headers()
            for part in _transport_stream(frames) if kind == "ts" else _jpegs(frames, sizes):
                try:
                    self.wfile.write(part)
                except (BrokenPipeError, ConnectionResetError):
                    return
                time.sleep(1 / rate)

        def log_message(self, *args: Any) -> None:
            """Say nothing."""

    return Handler


def _jpegs(frames: int, sizes: Sequence[tuple[int, int]]) -> Iterator[bytes]:
    for size in sizes:
        context: Any = av.CodecContext.create("mjpeg", "w")
        context.width, context.height, context.pix_fmt, context.framerate = *size, "yuvj420p", RATE
        for at in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(*size, at), format="bgr24").reformat(format="yuvj420p")
            frame.pts = at
            for packet in context.encode(frame):
                data = bytes(packet)
                yield b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(data), data)


def _transport_stream(frames: int) -> Iterator[bytes]:
    out = io.BytesIO()
    with av.open(out, "w", format="mpegts") as container:
        stream = container.add_stream("mpeg2video", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for at in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(*SIZE, at), format="bgr24")))
            yield out.getvalue()
            out.seek(0)
            out.truncate()
        container.mux(stream.encode(None))
    yield out.getvalue()


def unused_port() -> int:
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
