"""The wall clock of a live stream, with clocks that are set by hand."""

from fractions import Fraction

import av

from extractors.clocks import WallClock

S = 1_000_000


def frame(pts_ms: int | None) -> av.VideoFrame:
    made = av.VideoFrame(16, 16, "gray")
    made.pts, made.time_base = pts_ms, Fraction(1, 1000)
    return made


class Wall:
    def __init__(self) -> None:
        self.now_us = 1_000 * S

    def __call__(self) -> int:
        return self.now_us


def settled(wall: Wall, own_zero_us: int | None = None) -> WallClock:
    """A clock that has seen frames at 0 and 40 ms come at their pace; the second was the first to count."""
    clock = WallClock(lambda: own_zero_us, wall)
    assert clock.time_us(frame(0)) == (None, "")
    wall.now_us += 40_000
    return clock


def test_what_comes_at_once_has_no_time_and_what_comes_at_its_pace_has() -> None:
    wall = Wall()
    clock = WallClock(lambda: None, wall)
    assert [clock.time_us(frame(ms))[0] for ms in (None, 0, 40, 80, 120)] == [None] * 5
    wall.now_us += 40_000
    assert clock.time_us(frame(160)) == (1_000 * S + 40_000, "")
    wall.now_us += 90_000  # the network jitters, presentation times do not
    assert clock.time_us(frame(200)) == (1_000 * S + 80_000, "")


def test_a_stream_that_always_comes_at_once_is_taken_after_a_while() -> None:
    wall = Wall()
    clock = WallClock(lambda: None, wall)
    assert clock.time_us(frame(0))[0] is None
    wall.now_us += 6 * S
    assert clock.time_us(frame(40_000)) == (1_006 * S, "")


def test_the_streams_own_clock_counts_within_ten_seconds() -> None:
    wall = Wall()
    assert settled(wall, 995 * S).time_us(frame(40)) == (995 * S + 40_000, "")
    time_us, odd = settled(wall, 900 * S).time_us(frame(40))
    assert time_us == wall.now_us
    assert "own clock is -100 s off" in odd


def test_presentation_times_that_jump_back_are_told_and_time_goes_on() -> None:
    wall = Wall()
    clock = settled(wall)
    first, _ = clock.time_us(frame(40))
    assert first is not None
    wall.now_us += 40_000
    time_us, odd = clock.time_us(frame(-90_000))
    assert "ran apart by -90 s" in odd
    assert time_us == first + 40_000
    wall.now_us += 40_000
    assert clock.time_us(frame(-89_960)) == (first + 80_000, "")


def test_a_machines_clock_that_is_set_back_does_not_stop_the_time() -> None:
    wall = Wall()
    clock = settled(wall)
    first, _ = clock.time_us(frame(40))
    assert first is not None
    wall.now_us -= 3_600 * S
    told = []
    times = []
    for at in range(1, 6):
        wall.now_us += 40_000
        time_us, odd = clock.time_us(frame(40 + 40 * at))
        times.append(time_us)
        told.append(odd)
    assert [bool(odd) for odd in told] == [True, False, False, False, False]
    assert times == [first + 1 + 40_000 * at for at in range(5)]


def test_frames_without_a_time_have_that_of_their_arrival() -> None:
    wall = Wall()
    clock = settled(wall)
    clock.time_us(frame(40))
    wall.now_us += 33_000
    assert clock.time_us(frame(None)) == (wall.now_us, "")
    assert clock.time_us(frame(None)) == (wall.now_us + 1, "")
