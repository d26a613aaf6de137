"""Which video the demo shows.

In this order: a file that the user names; the sample folder (`VIAN_DATA`); a pinned download that
is checked against its SHA-256; and, offline, a street scene that the demo renders itself. Beside all but a
user's own comes a rendered square: many people cross it, so its camera can be calibrated, and its truth is known.
"""

import logging
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import platformdirs
import pooch

from extractors.scene import PICTURES, Scene, square, street, write
from vian.errors import WorldFailed, WrongUsage

NAME = "one-by-one-person-detection.mp4"
SHA256 = "a5964aa259099a482a8b360ffc2c57b5a30f84d5919236a4dad01f8e929ac07c"
URL = f"https://raw.githubusercontent.com/intel-iot-devkit/sample-videos/579788908228/{NAME}"
ATTRIBUTION = (
    "Clip: one-by-one-person-detection.mp4 of intel-iot-devkit/sample-videos (commit 579788908228), "
    "Intel Corporation, CC BY 4.0"
)
SQUARE = square(people=16, apart_s=2.5)
"""What the demo shows of metres: who runs comes when enough have walked for the camera to be calibrated."""
_IN_SAMPLES = Path("video/intel_one_by_one_person") / NAME
_DOWNLOAD_SECONDS_MAX = 60


class Origin(StrEnum):
    """Where the demo's clip came from."""

    GIVEN = "given"
    SAMPLES = "samples"
    DOWNLOAD = "download"
    RENDERED = "rendered"
    SQUARE = "square"


@dataclass(frozen=True, slots=True)
class Clip:
    """The demo's video."""

    path: Path
    origin: Origin
    attribution: str | None
    """who made it and under which licence, where the demo knows"""

    @property
    def is_known(self) -> bool:
        """Whether it is the clip that the demo's zones were drawn for."""
        return self.origin in (Origin.SAMPLES, Origin.DOWNLOAD)


def choose(
    given: Path | None, samples: Path, note: Callable[[str], None], *, url: str = URL, is_rendered: bool = False
) -> Clip:
    """The clip to show.

    Args:
        given: What the user named, if anything.
        samples: Folder of sample videos; may not exist.
        note: Told what the user should know.
        url: Where the pinned clip is.
        is_rendered: The rendered street is wanted, whatever else there is.

    Raises:
        WrongUsage: The named file does not exist, or the rendered street is wanted beside it.
        WorldFailed: There is no place for the others.
    """
    if given is not None:
        if is_rendered:
            raise WrongUsage("give either --video or --rendered, got both")
        if not given.is_file():
            raise WrongUsage(f"--video must be a video file, got {given}, which is not a file")
        return Clip(given, Origin.GIVEN, None)
    if is_rendered:
        return _street()
    if (samples / _IN_SAMPLES).is_file():
        return Clip(samples / _IN_SAMPLES, Origin.SAMPLES, ATTRIBUTION)
    try:
        if not (_cache() / NAME).exists():
            note(f"downloading the sample clip, 3 MB, from {url}")
        return Clip(_downloaded(url), Origin.DOWNLOAD, ATTRIBUTION)
    except (OSError, ValueError) as error:
        note(f"the sample clip cannot be downloaded ({_reason(error)}); showing a rendered street scene instead")
    return _street()


def square_clip() -> Clip:
    """The rendered square.

    Raises:
        WorldFailed: There is no place for it.
    """
    return _scene("square", SQUARE, Origin.SQUARE)


def _street() -> Clip:
    return _scene("street", street(), Origin.RENDERED)


def _scene(name: str, scene: Scene, origin: Origin) -> Clip:
    try:
        return Clip(_rendered(name, scene), origin, f"Clip: a {name} rendered by ViAn itself")
    except OSError as error:
        raise WorldFailed(f"no clip can be kept in {_cache()}: {error}. Next: give one with --video FILE") from error


def _cache() -> Path:
    return platformdirs.user_cache_path("vian")


def _downloaded(url: str) -> Path:
    """The pinned clip, from the cache if it is there; checked against its SHA-256 each time."""
    pooch.get_logger().setLevel(logging.WARNING)  # that it is fetched, `choose` has said
    return Path(
        pooch.retrieve(
            url,
            known_hash=f"sha256:{SHA256}",
            fname=NAME,
            path=_cache(),
            downloader=pooch.HTTPDownloader(timeout=_DOWNLOAD_SECONDS_MAX),
        )
    )


def _rendered(name: str, scene: Scene) -> Path:
    """The scene, from the cache if it is there whole."""
    path = _cache() / f"{name}-{PICTURES}.mp4"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            unfinished = Path(folder) / path.name
            write(scene, unfinished)
            unfinished.replace(path)
    return path


def _reason(error: OSError | ValueError) -> str:
    """Why it failed, in a few words: what libraries say of a lost connection is a chain of their own classes."""
    if isinstance(error, ValueError):
        return "its SHA-256 hash is not the pinned one"
    if (response := getattr(error, "response", None)) is not None:
        return f"the server answered {response.status_code}"
    found = re.findall(r"\[Errno -?\d+\] ([^\"'()]+)", str(error))
    return found[-1].strip() if found else type(error).__name__
