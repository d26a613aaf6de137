"""Bodies of requests, read while they come in.

Contract: a body is cut off at its limit, at the length that was declared where one must be, and when it stops
coming. What was signed of it is compared with what came, before anybody looks into it.
"""

import asyncio
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from fastapi import Request
from starlette.requests import ClientDisconnect

from sync.errors import Refusal
from sync.protocol.signing import digest_field

_HASHED_AT_ONCE = 64 * 1024
"""Bytes whose hash takes less than to have another thread make it."""


@dataclass(frozen=True, slots=True)
class BodyLimits:
    """What a body may cost."""

    bytes_max: int
    idle_s_max: float = 30.0
    """seconds between two pieces"""
    bytes_per_s_min: float = 100.0
    """least average speed, counted from `idle_s_max` on"""


async def read_body(request: Request, limits: BodyLimits, waited: Callable[[float], None] = lambda _: None) -> bytes:
    """The request's body, read piece by piece up to the limit.

    Args:
        request: The request.
        limits: What its body may cost.
        waited: Told the seconds that the body took to come.

    Raises:
        Refusal: It is too large, came too slowly, or broke off.
    """
    declared = request.headers.get("content-length", "0")
    if declared.isdecimal() and int(declared) > limits.bytes_max:
        raise _too_large(f"{declared} bytes", limits.bytes_max)
    parts: list[bytes] = []
    size = 0
    began = monotonic()
    pieces = request.stream()
    try:
        while (piece := await asyncio.wait_for(anext(pieces, None), limits.idle_s_max)) is not None:
            size += len(piece)
            if size > limits.bytes_max:
                raise _too_large(f"more than {limits.bytes_max} bytes", limits.bytes_max)
            if size < (monotonic() - began - limits.idle_s_max) * limits.bytes_per_s_min:
                raise _slow(size)
            parts.append(piece)
    except TimeoutError as error:
        raise _slow(size) from error
    except ClientDisconnect as error:
        raise Refusal(
            400,
            "broken_body",
            "the connection was lost in the body",
            f"{size} bytes",
            "the whole body",
            "send it again",
        ) from error
    waited(monotonic() - began)
    return b"".join(parts)


async def read_signed(
    request: Request, limits: BodyLimits, digest: str, waited: Callable[[float], None] = lambda _: None
) -> bytes:
    """The request's body, which has the digest that was signed.

    Raises:
        Refusal: It is another body, or as `read_body`.
    """
    body = await read_body(request, limits, waited)
    found = digest_field(_sha256(body) if len(body) <= _HASHED_AT_ONCE else await asyncio.to_thread(_sha256, body))
    if found != digest:
        raise Refusal(
            400,
            "other_body",
            "the body is not the one that was signed",
            found,
            digest[:100],
            "send it again; if it comes back, something changes bodies on the way",
        )
    return body


def check_declared(request: Request, limits: BodyLimits) -> int:
    """How long the request says that its body is, which is not too long.

    Raises:
        Refusal: It says nothing, or too much.
    """
    declared = request.headers.get("content-length")
    if declared is None or not declared.isdecimal():
        raise Refusal(
            411,
            "no_length",
            "the length of the body is not declared",
            "transfer-encoding" if "transfer-encoding" in request.headers else "no content-length",
            "content-length",
            "let a proxy before central pass the request on as it is",
        )
    if int(declared) > limits.bytes_max:
        raise _too_large(f"{declared} bytes", limits.bytes_max)
    return int(declared)


def _sha256(body: bytes) -> bytes:
    return hashlib.sha256(body).digest()


def _slow(size: int) -> Refusal:
    return Refusal(408, "slow_body", "the body stopped coming", f"{size} bytes", "the whole body", "send it again")


def _too_large(got: str, bytes_max: int) -> Refusal:
    return Refusal(
        413,
        "too_large",
        "the body is too large",
        got,
        f"at most {bytes_max} bytes",
        "send fewer segments at a time; hello says how many bytes are taken",
    )
