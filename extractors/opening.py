"""What FFmpeg is told to open, and what it may open: files, addresses, cameras, pictures.

Contract: nothing is opened but what the request names, in the formats and by the protocols that are listed for its
medium; no picture is decoded that is larger than the request allows.
"""

from dataclasses import dataclass
from pathlib import Path

import av
import av.error
from av.container import InputContainer
from av.video.codeccontext import VideoCodecContext

from extractors import folder
from extractors.errors import VideoUnreadable
from extractors.wire import Medium, Request

CONTAINERS = (
    "asf,avi,av1,dv,flv,gif,h264,hevc,ivf,m4v,matroska,webm,mjpeg,mov,mp4,mpeg,mpegts,mpegvideo,mxf,nut,obu,"
    "ogg,rm,vc1,yuv4mpegpipe"
)
"""Formats that are opened. Without a list FFmpeg takes any text file for a terminal recording, and
plays lists that name other files and addresses."""

LIVE = f"{CONTAINERS},mpjpeg,rtp,rtsp,sdp"
"""Formats of live streams. Play lists are none of them: they name other addresses."""

PROTOCOLS = {
    "rtsp": "rtsp,rtp,tcp,udp",
    "rtsps": "rtsps,rtsp,rtp,tcp,tls",
    "http": "http,tcp",
    "https": "https,tls,tcp",
}
"""Protocols that an address of each scheme may use; a redirection to any other is refused."""

ANALYSED_US = 1_000_000
"""Most of a live stream that is read to learn what it is, µs."""


class NoVideo(Exception):
    """It opens, and holds no video stream."""


@dataclass(frozen=True, slots=True)
class About:
    """What the source says of itself; the size where no frame tells it."""

    codec: str
    fps: float | None
    frames_expected: int | None
    duration_s: float | None = None
    creation_time: str | None = None
    size: tuple[int, int] = (0, 0)


def opened(request: Request) -> InputContainer:
    """The file, stream or camera that is requested.

    Raises:
        FFmpegError: It cannot be opened.
        NoVideo: It holds no video stream.
        VideoUnreadable: Its pictures are too large.
    """
    place, form, options = _way(request)
    container = av.open(
        place,
        format=form,
        container_options=options,
        stream_options=[],
        options={},
        metadata_errors="replace",
    )
    try:
        if not container.streams.video:
            raise NoVideo("it holds no video stream")
        context = container.streams.video[0].codec_context
        _limit_size(context, request)
    except (NoVideo, VideoUnreadable):
        container.close()
        raise
    context.thread_count = request.threads
    return container


def _limit_size(context: VideoCodecContext, request: Request) -> None:
    """Let it decode no picture that is too large.

    Raises:
        VideoUnreadable: It says itself that its pictures are.
    """
    if context.width * context.height > request.pixels_max:
        raise VideoUnreadable(
            f"{request.place}: pictures of {context.width}x{context.height} px are too large, at most "
            f"{request.pixels_max:,} px in all are decoded. Next: make it smaller with a tool you trust"
        )
    context.options = {"max_pixels": str(request.pixels_max)}


def _way(request: Request) -> tuple[str, str | None, dict[str, str]]:
    """What FFmpeg is told to open: the name, the format where it must be told, and options."""
    if request.medium is Medium.FILE:
        return f"file:{request.place}", None, {"protocol_whitelist": "file", "format_whitelist": CONTAINERS}
    if request.medium is Medium.CAMERA:
        return request.place, "v4l2", {"protocol_whitelist": "file"}
    scheme = request.place.partition("://")[0].lower()
    options = {
        "protocol_whitelist": PROTOCOLS[scheme],
        "format_whitelist": LIVE,
        "analyzeduration": str(ANALYSED_US),
        "fpsprobesize": "0",  # the rate is of no use here, and takes frames to learn
    }
    if scheme.startswith("rtsp"):
        # What is lost on the way is sent again, and no firewall is in it; UDP for cameras that know nothing else.
        options["rtsp_flags"] = "prefer_tcp"
    if request.ca_file is not None:
        options |= {"tls_verify": "1", "ca_file": request.ca_file}
    return request.place, None, options


def read_picture(path: Path, request: Request) -> av.VideoFrame:
    """The file's picture.

    Raises:
        FFmpegError: It does not decode.
        VideoUnreadable: It is too large.
        StopIteration: It holds none.
    """
    form = folder.ENDINGS[path.suffix.lower()]
    options = {"protocol_whitelist": "file"}
    with av.open(f"file:{path}", format=form, container_options=options) as file:
        _limit_size(file.streams.video[0].codec_context, request)
        return next(frame for frame in file.decode(video=0) if not frame.is_corrupt)


def about(container: InputContainer) -> About:
    """What the container says."""
    stream = container.streams.video[0]
    context = stream.codec_context
    rate = stream.average_rate or stream.guessed_rate
    duration_us = container.duration
    return About(
        codec=context.name,
        fps=float(rate) if rate else None,
        frames_expected=stream.frames or None,
        duration_s=duration_us / 1e6 if duration_us and duration_us > 0 else None,
        creation_time=container.metadata.get("creation_time") or stream.metadata.get("creation_time"),
        size=(context.width, context.height),
    )


def said(error: Exception) -> str:
    """What the error says, without the address that FFmpeg's may repeat."""
    return (isinstance(error, av.error.FFmpegError) and error.strerror) or str(error)
