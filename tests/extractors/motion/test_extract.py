"""The whole method on the synthetic street, whose truth is exact."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from events import ActivityInterval, Appearance, TrackEnded, TrackPoint
from extractors import scene
from extractors.errors import DecoderDied, DetectorFailed
from extractors.media import Frame, Gap, GapReason, Image
from extractors.motion import Detections, Extraction, MotionConfig, Seen, extract
from extractors.video import frames
from tests.extractors.films import film_of_two_sizes
from tests.extractors.motion.runs import START, Run, run, scored
from vian.evaluation.scoring import iou_of

STREET = scene.street()


@pytest.fixture(scope="module")
def street_frames() -> list[Frame]:
    return [Frame(i, 100_000 * i, image) for i, image in enumerate(scene.render(STREET))]


@pytest.fixture(scope="module")
def street_run(street_frames: list[Frame]) -> Run:
    return run(street_frames)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return np.array([(b.frame, b.object_id, b.x1, b.y1, b.x2, b.y2) for b in scene.truth(STREET)], float)


def short(street_frames: list[Frame], count: int = 90) -> list[Frame]:
    return street_frames[:count]


def test_each_object_is_one_track(street_run: Run, truth: np.ndarray) -> None:
    found = scored(truth, street_run.rows)
    assert found.switches == 0
    # Missing are the pictures in which an object is only just entering or leaving.
    assert found.mota > 0.9
    assert found.idf1 > 0.95
    assert len(street_run.ends) == len(STREET.actors)


def test_positions_are_true_to_a_few_pixels(street_run: Run) -> None:
    errors = []
    rows = street_run.rows
    for box in scene.truth(STREET):
        if not box.is_whole or box.kind != "person":
            continue
        here = rows[rows[:, 0] == box.frame]
        wanted = np.array([[box.x1, box.y1, box.x2, box.y2]])
        iou = iou_of(here[:, 2:], wanted)[:, 0]
        if iou.max(initial=0) > 0.3:
            x1, _, x2, y2 = here[iou.argmax(), 2:]
            errors.append(((x1 + x2 - box.x1 - box.x2) / 2, y2 - box.y2))
    # The mask's speckle filter takes two pixels off, the closing adds as much, coding and noise the rest.
    assert len(errors) > 300
    assert np.median(np.abs(errors), axis=0).max() < 2.5
    assert np.percentile(np.abs(errors), 95, axis=0).max() < 6


def test_velocities_are_true(street_run: Run) -> None:
    # Actor 1 walks 1.1 picture widths in 14 s.
    wanted = 1.1 * STREET.width / 14
    frame, x = street_run.column("frame"), street_run.column("y")
    walker = (frame > 60) & (frame < 130) & (x < 0.6 * STREET.height)
    found = street_run.column("vx")[walker]
    assert np.median(found) == pytest.approx(wanted, rel=0.05)


def test_who_stands_still_keeps_the_track(street_run: Run) -> None:
    x, y = 0.30 * STREET.width, 0.76 * STREET.height
    frame = street_run.column("frame")
    near = np.hypot(street_run.column("x") - x, street_run.column("y") - y) < 12
    standing = near & (frame >= 70) & (frame <= 210)
    assert len(np.unique(street_run.column("track_id")[standing])) == 1
    assert standing.sum() >= 138  # of 141 pictures
    assert np.abs(street_run.column("vx")[standing & (frame > 90)]).max() < 5


def test_points_come_in_order_of_time_and_agree_with_their_track_ended(street_run: Run) -> None:
    frame = street_run.column("frame")
    assert (np.diff(frame) >= 0).all()
    for end in street_run.ends:
        own = street_run.column("track_id") == end.track_id
        assert own.sum() == end.points
        assert (frame[own][0], frame[own][-1]) == (end.first_frame, end.last_frame)
        xs, ys = street_run.column("x")[own], street_run.column("y")[own]
        assert end.duration_s == (end.time - end.began_at).total_seconds()
        means = [np.mean(street_run.column(name)[own]) for name in ("x1", "y1", "x2", "y2")]
        assert [end.x1_mean, end.y1_mean, end.x2_mean, end.y2_mean] == pytest.approx(means, rel=1e-5)
        assert (xs[0], ys[0], xs[-1], ys[-1]) == (end.x_entry, end.y_entry, end.x_exit, end.y_exit)
        assert end.path_px == pytest.approx(np.hypot(np.diff(xs), np.diff(ys)).sum(), rel=1e-4)
        assert (end.began_at - START).total_seconds() == pytest.approx(end.first_frame / 10)
        assert (end.time - START).total_seconds() == pytest.approx(end.last_frame / 10)


def test_reasons_say_how_a_track_ended(street_run: Run) -> None:
    reasons = {end.reason for end in street_run.ends}
    assert reasons == {"left_frame", "end_of_video"}


def test_an_activity_interval_spans_what_moves(street_run: Run, truth: np.ndarray) -> None:
    (interval,) = street_run.intervals
    # Nothing is certain of an object before it is in view by more than its edge.
    assert interval.first_frame == pytest.approx(truth[0, 0], abs=30)
    assert interval.tracks_max == 3
    assert 0 < interval.area_share_max < 0.3
    assert (interval.ended_at - interval.time).total_seconds() > 20


def test_an_empty_scene_brings_no_events(street_frames: list[Frame]) -> None:
    empty = run(street_frames[:9])
    assert not empty.batches
    assert empty.extractions[-1].frames == 9


def test_the_same_input_gives_the_same_bytes_on_any_number_of_threads(street_frames: list[Frame]) -> None:
    threads = cv2.getNumThreads()
    found = []
    try:
        for count in (1, 2, 1):
            cv2.setNumThreads(count)
            found.append(run(short(street_frames)).bytes)
    finally:
        cv2.setNumThreads(threads)
    assert found[0]
    assert found[0] == found[1] == found[2]


def test_batches_are_cut_by_media_time(street_frames: list[Frame]) -> None:
    extractions = run(short(street_frames)).extractions
    assert [e.frames for e in extractions] == [10, 20, 30, 40, 50, 60, 70, 80, 90]
    assert [e.time_us for e in extractions] == [1_000_000 * i - 100_000 for i in range(1, 10)]
    order = [TrackPoint, TrackEnded, Appearance, ActivityInterval]
    for extraction in extractions:
        types = [batch.type for batch in extraction.batches]
        assert types == [t for t in order if t in types]
    longer = run(short(street_frames), MotionConfig(batch_s=5.0)).extractions
    assert [e.frames for e in longer] == [50, 90]


def test_track_numbers_begin_where_wanted(street_frames: list[Frame]) -> None:
    found = run(short(street_frames), first_track_id=500)
    assert sorted({end.track_id for end in found.ends}) == [500, 501, 502]


def test_an_onlooker_sees_each_frame(street_frames: list[Frame]) -> None:
    seen: list[tuple[int, Seen]] = []
    run(short(street_frames, 50), on_frame=lambda frame, what: seen.append((frame.index, what)))
    assert [index for index, _ in seen] == list(range(50))
    assert any(len(what.blobs_xyxy) for _, what in seen)


def test_a_video_that_fails_in_the_middle_gives_a_prefix_of_the_whole(street_frames: list[Frame]) -> None:
    def failing() -> Iterator[Frame]:
        yield from street_frames[:75]
        raise DecoderDied("gone")

    whole = run(short(street_frames, 120))
    part: list[Extraction] = []
    with pytest.raises(DecoderDied, match="gone"):
        part.extend(extract(failing(), MotionConfig(), start_time=START))
    broken = Run(part)
    count = len(broken.rows)
    assert count > 50
    np.testing.assert_array_equal(broken.rows, whole.rows[:count])
    assert part[-1].frames == 75
    ended = [(e.track_id, e.points) for e in whole.ends]
    assert [(e.track_id, e.points) for e in broken.ends] == ended[: len(broken.ends)]


def test_a_change_of_size_ends_tracks_and_work_goes_on(street_frames: list[Frame]) -> None:
    def resized(first: int, count: int) -> Iterator[Frame | Gap]:
        yield from street_frames[:count]
        yield Gap(count, GapReason.SIZE_CHANGED, "the frame size changed")
        for frame in street_frames[first : first + 60]:
            small = np.asarray(cv2.resize(frame.image, (480, 270)), np.uint8)
            yield Frame(frame.index - first + count, frame.time_us - 100_000 * (first - count), small)

    found = run(resized(first=33, count=63))
    gaps = [gap for extraction in found.extractions for gap in extraction.gaps]
    assert [gap.reason for gap in gaps] == [GapReason.SIZE_CHANGED]
    # An interval ends there: what is said of the new size comes before its points.
    assert 63 in [extraction.frames for extraction in found.extractions]
    before = [end for end in found.ends if end.reason == "input_changed"]
    assert before
    assert all(end.last_frame < 63 for end in before)
    after = [end for end in found.ends if end.first_frame >= 63]
    assert after
    assert not {e.track_id for e in before} & {e.track_id for e in after}


def test_a_real_file_of_two_sizes_is_read_to_its_end(tmp_path: Path) -> None:
    found = run(frames(film_of_two_sizes(tmp_path, frames=15)))
    assert found.extractions[-1].frames == 30


def test_a_larger_picture_gives_the_same_tracks_in_its_own_pixels(street_frames: list[Frame]) -> None:
    doubled = (
        Frame(f.index, f.time_us, np.repeat(np.repeat(f.image, 2, axis=0), 2, axis=1))
        for f in islice(street_frames, 60)
    )
    small, large = run(short(street_frames, 60)), run(doubled)
    np.testing.assert_allclose(large.rows[:, 2:], 2 * small.rows[:, 2:], atol=1e-3)


def test_the_configuration_has_a_hash_of_its_values() -> None:
    assert MotionConfig().config_hash == MotionConfig().config_hash
    assert len(MotionConfig().config_hash) == 32
    assert MotionConfig(lost_s=3).config_hash != MotionConfig().config_hash


def test_what_was_certain_before_a_detector_failed_comes_out() -> None:
    class FailsAtLast:
        calls = 0

        def detect(self, image: Image) -> Detections:
            self.calls += 1
            if self.calls > 25:
                raise DetectorFailed("the model stopped")
            return Detections.clear(np.array([[10.0 + self.calls, 10, 30 + self.calls, 60]]), np.ones(1))

    pictures = [Frame(i, 100_000 * i, np.full((120, 160, 3), 90, np.uint8)) for i in range(40)]
    steps: list[Extraction] = []
    with pytest.raises(DetectorFailed, match="the model stopped"):
        steps.extend(extract(pictures, MotionConfig(), start_time=START, detector=FailsAtLast()))
    # Points come 0.8 s late, and the interval before ended with frame 19.
    assert Run(steps).column("frame").max() == 16
