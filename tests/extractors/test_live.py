"""Live streams over every interruption, from cameras on this machine."""

import ssl
import time
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import islice, pairwise
from pathlib import Path

import pytest

from extractors.addresses import Address, parsed
from extractors.decoder import SLOT_TOLERANCE_US
from extractors.errors import DecoderStalled, StreamLost, VideoError, VideoUnreadable
from extractors.live import Live, LiveLimits
from extractors.media import Frame, Gap, GapReason, Shape
from tests.certificates import self_signed
from tests.extractors.streams import Camera, http, rtsp, unused_port

QUICK = LiveLimits(connect_s=20, stall_s=1, retry_s_min=0.1, retry_s_max=0.4)
"""The machine may be slow to start a process; nothing here waits for that long unless it is."""


def address(url: str) -> Address:
    found = parsed(url)
    assert isinstance(found, Address)
    return found


def seen(url: str, count: int) -> tuple[list[Frame], list[Gap]]:
    with Live(address(url), QUICK) as live:
        items = list(islice(live.frames(), count))
    return [i for i in items if isinstance(i, Frame)], [i for i in items if isinstance(i, Gap)]


def test_frames_come_with_the_wall_clocks_time() -> None:
    with rtsp(Camera()) as url, Live(address(url), QUICK) as live:
        assert (live.info.width, live.info.height, live.info.codec) == (160, 120, "h264")
        assert abs(datetime.now(UTC) - live.started_at) < timedelta(seconds=20)
        found = [item for item in islice(live.frames(), 20) if isinstance(item, Frame)]
    assert found[0].time_us == 0
    assert all(b.time_us - a.time_us == 40_000 * (b.index - a.index) for a, b in pairwise(found))


@pytest.mark.parametrize("kind", ["mjpeg", "ts"])
def test_streams_over_http_are_read(kind: str) -> None:
    with http(kind, frames=500) as url:
        found, _ = seen(url, 10)
    assert len(found) >= 9
    assert found[0].image.shape == (120, 160, 3)


def test_the_streams_own_clock_counts_where_it_can_be_right() -> None:
    said = datetime.now(UTC) - timedelta(seconds=3)
    with rtsp(Camera(says_ntp=said.timestamp())) as url, Live(address(url), QUICK) as live:
        # The first picture that is given is a whole number of frames after the time that was said.
        frames = (live.started_at - said) / timedelta(milliseconds=40)
    assert frames >= 0
    assert frames == pytest.approx(round(frames), abs=0.05)


def test_a_stream_whose_clock_is_wrong_has_this_machines_time_and_says_so() -> None:
    wrong = datetime.now(UTC) - timedelta(hours=1)
    with rtsp(Camera(says_ntp=wrong.timestamp())) as url, Live(address(url), QUICK) as live:
        assert abs(datetime.now(UTC) - live.started_at) < timedelta(seconds=20)
        gap = next(item for item in live.frames() if isinstance(item, Gap))
    assert gap.reason is GapReason.TIME_JUMPED
    assert "own clock is -36" in gap.detail


def test_time_goes_on_where_the_clock_is_behind_after_a_break() -> None:
    """The camera says the same time again at each connection, as one whose clock is set anew does."""
    ahead = datetime.now(UTC) + timedelta(seconds=8)
    with rtsp(Camera(frames=40, says_ntp=ahead.timestamp())) as url:
        frames, gaps = seen(url, 70)
    back, jumped = (
        next(gap for gap in gaps if gap.reason is reason) for reason in (GapReason.RESUMED, GapReason.TIME_JUMPED)
    )
    assert "s behind after the break: times go on from it" in jumped.detail
    after = [frame for frame in frames if frame.index >= back.before_index]
    assert len(after) > 5
    assert after[0].time_us > max(frame.time_us for frame in frames if frame.index < back.before_index)
    assert after[-1].time_us - after[0].time_us >= 35_000 * (after[-1].index - after[0].index)


@pytest.mark.parametrize(
    "camera, why",
    [(Camera(frames=40), "the other side ended it"), (Camera(mute_after=40), "said nothing for 1 s")],
)
def test_a_stream_that_ends_or_falls_silent_is_taken_up_again(camera: Camera, why: str) -> None:
    with rtsp(camera) as url:
        found, gaps = seen(url, 60)
    lost, back, *_ = [gap for gap in gaps if gap.reason in (GapReason.INTERRUPTED, GapReason.RESUMED)]
    assert (lost.reason, back.reason) == (GapReason.INTERRUPTED, GapReason.RESUMED)
    assert why in lost.detail
    assert lost.before_index == back.before_index
    before = [frame for frame in found if frame.index < lost.before_index]
    after = [frame for frame in found if frame.index >= lost.before_index]
    assert lost.time_us == before[-1].time_us
    assert after[0].time_us - before[-1].time_us > 100_000, "the time in between is missing"
    assert all(a.time_us < b.time_us and a.index < b.index for a, b in pairwise(found))


def test_a_stream_that_comes_back_in_another_size_goes_on() -> None:
    with rtsp(Camera(frames=40, sizes=((160, 120), (192, 144)))) as url:
        found, gaps = seen(url, 60)
    assert [gap.reason for gap in gaps if gap.reason is not GapReason.DROPPED][:3] == [
        GapReason.INTERRUPTED,
        GapReason.RESUMED,
        GapReason.SIZE_CHANGED,
    ]
    assert found[0].image.shape == (120, 160, 3)
    assert found[-1].image.shape == (144, 192, 3)


def test_a_stream_that_changes_its_size_says_so_in_its_own_pixels() -> None:
    """Reckoned back from the smaller picture it would be 250x141."""
    sizes = ((160, 120), (250, 142))
    with (
        http("mjpeg", frames=40, sizes=sizes) as url,
        Live(address(url), QUICK, Shape(width_max=64)) as live,
    ):
        before = live.info
        gap = next(item for item in live.frames() if isinstance(item, Gap) and item.reason is GapReason.SIZE_CHANGED)
        next(item for item in live.frames() if isinstance(item, Frame))
        after = live.info
    assert [(info.width, info.height) for info in (before, after)] == list(sizes)
    assert gap.size == sizes[1]


def test_pictures_that_nobody_has_time_for_are_left_out_and_counted() -> None:
    with rtsp(Camera(rate=200)) as url, Live(address(url), replace(QUICK, queue_frames=2)) as live:
        items = []
        for item in live.frames():
            items.append(item)
            if isinstance(item, Gap):
                break
            time.sleep(0.05)  # somebody who takes longer over a picture than the camera does
    assert isinstance(items[-1], Gap)
    assert items[-1].reason is GapReason.DROPPED
    assert "were left out" in items[-1].detail


def test_a_camera_that_never_answers_is_named() -> None:
    said = r"rtsp://127.*said nothing for 1 s after no frame at all\. Next: is the camera"
    with (
        rtsp(Camera(is_mute=True)) as url,
        pytest.raises(DecoderStalled, match=said),
        Live(address(url), replace(QUICK, connect_s=1)),
    ):
        pass


def test_an_address_at_which_nobody_listens_is_named() -> None:
    url = f"rtsp://user:geheim@127.0.0.1:{unused_port()}/1"
    with (
        pytest.raises(VideoUnreadable, match=r"127\..*Connection refused.*Next: try the address") as caught,
        Live(address(url), QUICK),
    ):
        pass
    assert "geheim" not in str(caught.value)


def test_a_camera_that_wants_a_login_gets_it() -> None:
    with rtsp(Camera(login="user:ge/heim")) as url:
        with pytest.raises(VideoUnreadable, match="401 Unauthorized"), Live(address(url), QUICK):
            pass
        with Live(address(url).with_login("user:ge/heim"), QUICK) as live:
            assert live.info.width == 160


def test_a_redirection_to_a_file_is_refused() -> None:
    with http("redirect") as url, pytest.raises(VideoUnreadable, match="not a live stream"), Live(address(url), QUICK):
        pass


def test_a_lower_rate_leaves_pictures_of_a_live_stream_out() -> None:
    with rtsp(Camera()) as url, Live(address(url), QUICK, Shape(fps=5)) as live:
        found = [item for item in islice(live.frames(), 6) if isinstance(item, Frame)]
    slots = [(round(1e6 * live.started_at.timestamp()) + SLOT_TOLERANCE_US + each.time_us) // 200_000 for each in found]
    assert len(found) >= 5
    assert len(set(slots)) == len(slots)


def test_a_camera_that_sends_by_udp_only_is_read() -> None:
    with rtsp(Camera(is_udp=True)) as url:
        found, _ = seen(url, 10)
    assert len(found) >= 9


def test_a_certificate_is_checked_where_one_is_given(tmp_path: Path) -> None:
    own = self_signed(tmp_path / "camera.pem", "127.0.0.1")
    another = self_signed(tmp_path / "another.pem", "127.0.0.1")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(own)
    with rtsp(Camera(tls=context)) as url:
        for ca_file in (None, own):
            with Live(address(url), QUICK, ca_file=ca_file) as live:
                assert live.info.width == 160
        said = r"does .*another\.pem hold its certificate"
        with pytest.raises(VideoUnreadable, match=said), Live(address(url), QUICK, ca_file=another):
            pass


def test_a_camera_that_is_not_there_is_named() -> None:
    with pytest.raises(VideoError, match=r"/dev/video97: .*Next: ls -l /dev/video"), Live(address("97"), QUICK):
        pass


def test_a_stream_that_stays_away_is_given_up_after_the_limit() -> None:
    with ExitStack() as camera:
        url = camera.enter_context(rtsp(Camera(frames=40)))
        with Live(address(url), replace(QUICK, give_up_s=0.5)) as live:
            frames = live.frames()
            next(frames)
            camera.close()
            with pytest.raises(StreamLost, match=r"interrupted for 0\.5 s and given up after [1-9]"):
                list(frames)


def test_who_wants_no_more_is_heard_while_nothing_comes() -> None:
    wants: list[bool] = []
    limits = replace(QUICK, stall_s=60)
    with rtsp(Camera(mute_after=40)) as url, Live(address(url), limits, is_stopped=lambda: bool(wants)) as live:
        for item in live.frames():
            if isinstance(item, Frame) and item.index == 5:
                wants.append(True)
