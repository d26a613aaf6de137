"""A folder of pictures as a video: which files, in which order, taken when.

Contract: pictures are taken in the order of their names, numbers in names by their value. Times come
from the names, else from EXIF, and only where every picture has one and they increase; else a frame rate must be
given. Nothing is decoded here but EXIF. A file that is no picture by its name is left out.
"""

import hashlib
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from extractors.errors import VideoUnreadable

ENDINGS = {
    ".bmp": "bmp_pipe",
    ".jpeg": "jpeg_pipe",
    ".jpg": "jpeg_pipe",
    ".pbm": "pbm_pipe",
    ".pgm": "pgm_pipe",
    ".png": "png_pipe",
    ".ppm": "ppm_pipe",
    ".tif": "tiff_pipe",
    ".tiff": "tiff_pipe",
    ".webp": "webp_pipe",
}
"""Names of pictures end so, in small or capital letters; and FFmpeg's name of the format. It is told, since FFmpeg
alone takes some for a pattern of names."""

_CALENDAR = re.compile(
    r"(?<!\d)((?:19|20|21)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[T_ -]?"
    r"(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)(?:[-_.,]?(\d{1,6}))?(?!\d)"
)
_EPOCH = re.compile(r"(?<!\d)(1\d{9}(?:\d{3}){0,3})(?!\d)")
"""Seconds, milli-, micro- or nanoseconds since 1970, from the year 2001 to 2033."""
_EXIF_TIMES, _EXIF_OFFSET, _EXIF_FRACTION, _EXIF_IFD = 0x9003, 0x9011, 0x9291, 0x8769


def pictures_in(folder: Path) -> list[Path]:
    """The folder's pictures, in order.

    Raises:
        VideoUnreadable: It cannot be read, or holds none.
    """
    try:
        found = [path for path in folder.iterdir() if path.suffix.lower() in ENDINGS and path.is_file()]
    except OSError as error:
        raise VideoUnreadable(f"{folder}: cannot be read: {error.strerror}") from error
    if not found:
        raise VideoUnreadable(
            f"{folder}: no pictures lie in this folder ({_what_is_in(folder)}), wanted files ending in "
            f"{', '.join(ENDINGS)}. Next: give the folder in which they lie; folders within it are not looked into"
        )
    return sorted(found, key=_by_number)


def _what_is_in(folder: Path) -> str:
    """What lies where pictures were wanted."""
    names = sorted(path.name for path in folder.iterdir())
    return f"it holds {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}" if names else "it is empty"


def digest(pictures: Sequence[Path]) -> str:
    """SHA-256 over names and bytes, hexadecimal: the same pictures under the same names, wherever they are."""
    whole = hashlib.sha256()
    for path in pictures:
        with path.open("rb") as file:
            inner = hashlib.file_digest(file, "sha256").hexdigest()
        whole.update(f"{inner}  {path.name}\n".encode(errors="surrogateescape"))
    return whole.hexdigest()


def times_us(pictures: Sequence[Path], fps: float | None) -> list[int]:
    """When each picture was taken, µs after the first.

    Raises:
        VideoUnreadable: No rate is given, and neither names nor EXIF say times that increase.
    """
    if fps is not None:
        return [round(at * 1e6 / fps) for at in range(len(pictures))]
    times = taken_at(pictures)
    if times is None:
        raise VideoUnreadable(
            f"{pictures[0].parent}: neither the pictures' names nor their EXIF say when each was taken, or two say "
            "the same. Next: --fps RATE, the rate at which they were taken"
        )
    return [(time - times[0]) // timedelta(microseconds=1) for time in times]


def taken_at(pictures: Sequence[Path]) -> list[datetime] | None:
    """When each picture was taken (UTC), by names or else by EXIF; None where that is not known of all."""
    for way in (time_of_name, _time_of_exif):
        times = []
        for path in pictures:
            time = way(path)
            if time is None:
                break
            times.append(time)
        if len(times) == len(pictures) and all(a < b for a, b in pairwise(times)):
            return times
    return None


def time_of_name(path: Path) -> datetime | None:
    """The time (UTC) that the name says: a date with a time of day, or a number since 1970.

    >>> time_of_name(Path("gate_2026-01-31T12-00-00.250.jpg"))
    datetime.datetime(2026, 1, 31, 12, 0, 0, 250000, tzinfo=datetime.timezone.utc)
    >>> time_of_name(Path("1403715273262142976.png"))
    datetime.datetime(2014, 6, 25, 16, 54, 33, 262142, tzinfo=datetime.timezone.utc)
    """
    if found := _CALENDAR.search(path.stem):
        *fields, fraction = found.groups()
        try:
            return datetime(*map(int, fields), int((fraction or "0").ljust(6, "0")), tzinfo=UTC)  # type: ignore[misc, arg-type]
        except ValueError:
            return None
    if found := _EPOCH.search(path.stem):
        digits = found[1].ljust(19, "0")
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=int(digits) // 1000)
    return None


def _time_of_exif(path: Path) -> datetime | None:
    try:
        with Image.open(path) as image:
            exif = image.getexif().get_ifd(_EXIF_IFD)
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None  # decoding it says what is the matter
    text, offset = str(exif.get(_EXIF_TIMES, "")), str(exif.get(_EXIF_OFFSET, "")) or "+00:00"
    fraction = str(exif.get(_EXIF_FRACTION, "")).strip().ljust(6, "0")[:6]
    try:
        time = datetime.strptime(text.strip() + offset.strip(), "%Y:%m:%d %H:%M:%S%z")
        return (time + timedelta(microseconds=int(fraction))).astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _by_number(path: Path) -> list[tuple[int, str]]:
    """A key by which `frame9` comes before `frame10`."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]
