import hashlib
import re
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import platformdirs
import pooch
import pytest

from vian.demo import clip as clips
from vian.demo.clip import ATTRIBUTION, NAME, Clip, Origin, choose, shown
from vian.errors import WorldFailed, WrongUsage

CONTENT = b"stands in for the clip" * 100


class Site:
    """A local HTTP server, and what it was asked for."""

    def __init__(self, folder: Path) -> None:
        self.asked: list[str] = []
        site = self

        class Handler(SimpleHTTPRequestHandler):
            def log_message(self, *_: Any) -> None:
                site.asked.append(self.path)

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/{NAME}"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / NAME).write_bytes(CONTENT)
    for proxy in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(proxy, raising=False)
    served = Site(folder)
    thread = threading.Thread(target=served.server.serve_forever)
    thread.start()
    yield served
    served.server.shutdown()
    thread.join()
    served.server.server_close()


@pytest.fixture
def pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in is what is pinned."""
    monkeypatch.setattr(clips, "SHA256", hashlib.sha256(CONTENT).hexdigest())


@pytest.fixture
def quick_street(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The street is not rendered, only noted."""
    rendered: list[Path] = []

    def write(_: Any, path: Path) -> None:
        path.write_bytes(b"street")
        rendered.append(path)

    monkeypatch.setattr(clips, "write", write)
    return rendered


NOWHERE = Path("/nowhere")


def test_a_file_that_is_named_comes_first(tmp_path: Path) -> None:
    video = tmp_path / "mine.mp4"
    video.touch()
    chosen = choose(video, NOWHERE, pytest.fail)
    assert (chosen.path, chosen.origin, chosen.attribution, chosen.is_known) == (video, Origin.GIVEN, None, False)


@pytest.mark.parametrize("name", ["missing.mp4", "."])
def test_a_name_without_a_file_is_refused(name: str) -> None:
    with pytest.raises(WrongUsage, match=r"--video must be a video file, got .*, which is not a file"):
        choose(Path(name), NOWHERE, pytest.fail)


def test_the_folder_of_samples_comes_second(tmp_path: Path) -> None:
    sample = tmp_path / "video" / "intel_one_by_one_person" / NAME
    sample.parent.mkdir(parents=True)
    sample.touch()
    chosen = choose(None, tmp_path, pytest.fail)
    assert (chosen.path, chosen.origin, chosen.attribution) == (sample, Origin.SAMPLES, ATTRIBUTION)


def test_the_sample_in_the_folder_is_the_pinned_clip(vian_data: Path) -> None:
    chosen = choose(None, vian_data, pytest.fail)
    assert chosen.origin is Origin.SAMPLES
    assert hashlib.sha256(chosen.path.read_bytes()).hexdigest() == clips.SHA256


def test_the_download_comes_third_and_is_kept(
    site: Site, pinned: None, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pooch.get_logger(), "handlers", [caplog.handler])
    notes: list[str] = []
    for _ in range(2):
        chosen = choose(None, NOWHERE, notes.append, url=site.url)
        assert (chosen.origin, chosen.attribution, chosen.is_known) == (Origin.DOWNLOAD, ATTRIBUTION, True)
        assert chosen.path.read_bytes() == CONTENT
    assert site.asked == [f"/{NAME}"]
    assert notes == [f"downloading the sample clip, 3 MB, from {site.url}"]
    assert "CC BY 4.0" in ATTRIBUTION
    assert caplog.records == [], "what is to be said, the demo says"


def test_a_download_with_the_wrong_checksum_is_not_shown(site: Site, quick_street: list[Path]) -> None:
    notes: list[str] = []
    chosen = choose(None, NOWHERE, notes.append, url=site.url)
    assert chosen.origin is Origin.RENDERED
    assert "(its SHA-256 hash is not the pinned one)" in notes[-1]
    assert "rendered street scene" in notes[-1]
    assert not list(platformdirs.user_cache_path("vian").glob(f"*{NAME}*"))


def test_a_kept_clip_that_was_damaged_is_fetched_again(site: Site, pinned: None) -> None:
    path = choose(None, NOWHERE, lambda _: None, url=site.url).path
    path.write_bytes(b"damaged")
    assert choose(None, NOWHERE, lambda _: None, url=site.url).path.read_bytes() == CONTENT
    assert len(site.asked) == 2


@pytest.mark.parametrize("url", ["http://127.0.0.1:9/clip.mp4", "http://nowhere.invalid/clip.mp4"])
def test_why_a_clip_cannot_be_downloaded_is_said_in_a_few_words(
    url: str, quick_street: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("no_proxy", "*")
    notes: list[str] = []
    choose(None, NOWHERE, notes.append, url=url)
    (reason,) = re.findall(r"cannot be downloaded \((.*)\);", notes[-1])
    assert reason == "Connection refused" or "name" in reason.lower()


@pytest.mark.parametrize("url", ["http://127.0.0.1:9/clip.mp4", "http://nowhere.invalid/clip.mp4"])
def test_offline_the_street_is_rendered_and_that_is_said(
    url: str, quick_street: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("no_proxy", "*")
    notes: list[str] = []
    chosen = choose(None, NOWHERE, notes.append, url=url)
    assert (chosen.origin, chosen.is_known) == (Origin.RENDERED, False)
    assert chosen.path.read_bytes() == b"street"
    assert "cannot be downloaded (" in notes[-1]
    assert notes[-1].endswith("; showing a rendered street scene instead")
    assert "\n" not in notes[-1]


def test_a_page_that_is_not_there_is_as_good_as_offline(site: Site, quick_street: list[Path]) -> None:
    notes: list[str] = []
    assert choose(None, NOWHERE, notes.append, url=f"{site.url}.gone").origin is Origin.RENDERED
    assert "(the server answered 404)" in notes[-1]


def test_the_street_is_rendered_once_and_never_left_half_done(quick_street: list[Path], monkeypatch: Any) -> None:
    def stopped(_: Any, path: Path) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(clips, "write", stopped)
        with pytest.raises(KeyboardInterrupt):
            choose(None, NOWHERE, lambda _: None, url="http://127.0.0.1:9/x")
    paths = {choose(None, NOWHERE, lambda _: None, url="http://127.0.0.1:9/x").path for _ in range(2)}
    assert [path.read_bytes() for path in paths] == [b"street"]
    assert len(quick_street) == 1


def test_beside_all_but_a_users_own_clip_the_square_is_shown(quick_street: list[Path]) -> None:
    clips = [Clip(Path("a.mp4"), origin, None) for origin in (Origin.GIVEN, Origin.SAMPLES, Origin.RENDERED)]
    assert [[each.origin for each in shown(clip)][1:] for clip in clips] == [[], [Origin.SQUARE], [Origin.SQUARE]]
    assert len(quick_street) == 1, "it is rendered once"


def test_without_a_place_for_it_the_next_step_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(WorldFailed, match=r"no clip can be kept in .*Next: give one with --video FILE"):
        choose(None, NOWHERE, lambda _: None, url="http://127.0.0.1:9/x")
