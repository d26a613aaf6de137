"""How right tracks, horizons and positions are, on real data beside references in the same run.

    python -m benchmarks.accuracy [--quick] [--results FILE]

Reads the folder of VIAN_DATA. SORT and ByteTrack are those of the package `trackers`, in an environment of its own
that the script makes from PyPI in the cache folder: it brings the `opencv-python` wheel, which must never come
into ours. Horizons stand beside methods A and B of `vian.evaluation.references`. `--quick` leaves out what needs
a whole video or that environment.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs

from benchmarks.measuring import keep
from vian.evaluation.boxes import Boxes
from vian.evaluation.calibrations import TrackCalibration
from vian.evaluation.estimators import estimators
from vian.evaluation.files import read_boxes
from vian.evaluation.ground import ground_scores, mapped
from vian.evaluation.judging import Summary, judged, summaries
from vian.evaluation.running import Watched, tracked, watched
from vian.evaluation.scenes import Scene, read_scenes, read_truth
from vian.evaluation.scoring import Scores, scores
from vian.evaluation.tsai import read_camera

PEER = "trackers>=2.6,<3"
PEER_FOLDER = Path(platformdirs.user_cache_dir("vian")) / "benchmarks" / "trackers-2.6"
PEERS = ("SORT", "ByteTrack")
PETS, TUD = Path("video/pets2009_s2l1_view001"), Path("tracking/mot15_tud")
PETS_FPS, TUD_FPS = 7.0, 25.0
PETS_SIZE, TUD_SIZE = (768, 576), (640, 480)
"""Frames of the annotations and detections, px."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure of ours beside those of references."""

    what: str
    measure: str
    ours: float | None
    references: Mapping[str, float | None]
    target: float | None = None
    at_least: bool = True
    is_ahead_wanted: bool = False
    """whether every reference must be reached, too"""
    target_max: float | None = None
    """upper end where the target is a range"""

    @property
    def is_reached(self) -> bool | None:
        """Whether what is wanted is reached; None where nothing is, or nothing of ours was measured."""
        if self.target is None and not self.is_ahead_wanted:
            return None
        if self.ours is None:
            return False
        is_met = self.target is None or (self.ours >= self.target if self.at_least else self.ours <= self.target)
        is_met = is_met and (self.target_max is None or self.ours <= self.target_max)
        beaten = all(each is None or self.ours >= each for each in self.references.values())
        return is_met and (beaten or not self.is_ahead_wanted)

    def plain(self) -> dict[str, Any]:
        """For a file of results."""
        return {
            "what": self.what,
            "measure": self.measure,
            "ours": self.ours,
            "references": dict(self.references),
            "wanted": self._wanted(),
            "is_reached": self.is_reached,
        }

    def _wanted(self) -> str:
        said = []
        if self.target is not None:
            bound = f"{'at least' if self.at_least else 'at most'} {self.target:g}"
            said.append(bound if self.target_max is None else f"{self.target:g} to {self.target_max:g}")
        return " and ".join([*said, *(["not behind any"] if self.is_ahead_wanted else [])])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="horizons of the folder of scenes only")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/accuracy.json"))
    options = parser.parse_args(arguments)
    data = data_folder()
    found = list(_horizons(data))
    if not options.quick:
        video = watched(data / PETS / "vtest_480x360.avi")
        found += [*_pets_horizon(data, video), *_pets_tracks(data, video), *_pets_ground(data, video), *_alone(data)]
    for row in found:
        said = row.plain()
        beside = ", ".join(f"{name} {_shown(value)}" for name, value in row.references.items())
        print(
            f"{row.what:44} {row.measure:22} {_shown(row.ours):>8}  {beside:32} {said['wanted']} {said['is_reached']}"
        )
    if not options.quick:
        keep(options.results, is_quick=False, rows=[row.plain() for row in found])


def data_folder() -> Path:
    """The folder of real data."""
    folder = Path(os.environ.get("VIAN_DATA", "../shared/data"))
    if not (folder / "horizon/tracks_10").is_dir():
        sys.exit(f"no horizon/tracks_10 in {folder}. Next: set VIAN_DATA to the folder of test data")
    return folder


def _horizons(data: Path) -> Iterator[Row]:
    """Over ten scenes."""
    said = {each.method: each for each in _summed(read_scenes(data / "horizon/tracks_10"))}
    what = "horizon of 10 scenes (tracks_10)"
    yield _row(what, "median error", said, "median", target=0.02, at_least=False)
    yield _row(what, "AUC to 0.25", said, "auc", target=0.85)
    yield _row(what, "coverage of 95 %", said, "coverage", target=0.9, target_max=0.99)


def _pets_horizon(data: Path, video: Watched) -> Iterator[Row]:
    info = video.info
    truth = read_truth(data / PETS / "View_001.xml", info.width, info.height)
    scene = Scene("pets", info.width, info.height, video.boxes, truth)
    said = {each.method: each for each in _summed([scene], is_of_blobs=True)}
    yield _row("horizon of the PETS clip, from its video", "error", said, "median", target=0.03, at_least=False)


def _summed(scenes: Sequence[Scene], *, is_of_blobs: bool = False) -> list[Summary]:
    return summaries(list(judged(scenes, estimators(is_of_blobs=is_of_blobs))))


def _row(what: str, measure: str, said: dict[str, Summary], name: str, **wanted: Any) -> Row:
    figures = {method: getattr(summary, name) for method, summary in said.items()}
    return Row(what, measure, figures.pop("vian", None), figures, **wanted)


def _pets_tracks(data: Path, video: Watched) -> Iterator[Row]:
    """The clip from its video, beside the public detections through the peers."""
    truth = read_boxes(data / PETS / "PETS2009-S2L1.xml", fps=PETS_FPS)
    scale = video.info.width / PETS_SIZE[0]
    ours = scores(truth.scaled(scale, scale), video.boxes)
    peers = _peers(data / PETS / "det_mot15.txt", PETS_FPS, truth)
    what = "tracking on the PETS clip, from its video"
    for measure, target in (("MOTA", 0.7), ("IDF1", 0.75), ("HOTA", None)):
        yield _scored(what, measure, ours, peers, target)


def _pets_ground(data: Path, video: Watched) -> Iterator[Row]:
    """Annotated feet by the calibration that the video's own tracks give, beside the published one."""
    truth = read_boxes(data / PETS / "PETS2009-S2L1.xml", fps=PETS_FPS)
    size = video.info.width, video.info.height
    calibrated = TrackCalibration(is_of_blobs=True).calibrate(video.boxes, *size)
    found = None
    if calibrated is not None:
        feet = truth.feet_xy * [size[0] / PETS_SIZE[0], size[1] / PETS_SIZE[1]]
        published = read_camera(data / PETS / "View_001.xml")
        found = ground_scores(truth, mapped(calibrated.matrix, feet), published.ground_of(truth.feet_xy))
    what = "positions on the PETS clip, from its video"
    for measure, name, target in (
        ("median error, m", "median_m", 0.3),
        ("speed of walkers off by", "speed_error", 0.15),
    ):
        yield Row(what, measure, None if found is None else getattr(found, name), {}, target, at_least=False)


def _alone(data: Path) -> Iterator[Row]:
    """The tracker on given detections, beside the peers on the same."""
    clips = [
        (name, data / TUD / name / "gt.txt", data / TUD / name / "det.txt", TUD_FPS, TUD_SIZE)
        for name in ("TUD-Campus", "TUD-Stadtmitte")
    ]
    clips.append(("PETS", data / PETS / "PETS2009-S2L1.xml", data / PETS / "det_mot15.txt", PETS_FPS, PETS_SIZE))
    for name, annotation, detections, fps, size in clips:
        truth = read_boxes(annotation, fps=fps, is_truth=True)
        peers = _peers(detections, fps, truth)
        ours = scores(truth, tracked(read_boxes(detections, fps=fps), *size))
        for measure in ("IDF1", "HOTA", "MOTA"):
            yield _scored(
                f"tracker alone, detections of {name}", measure, ours, peers, None, is_ahead=measure != "MOTA"
            )


def _scored(
    what: str, measure: str, ours: Scores, peers: dict[str, Scores], target: float | None, *, is_ahead: bool = True
) -> Row:
    name = measure.lower()
    references = {peer: float(getattr(each, name)) for peer, each in peers.items()}
    return Row(what, measure, float(getattr(ours, name)), references, target, is_ahead_wanted=is_ahead)


def _peers(detections: Path, fps: float, truth: Boxes) -> dict[str, Scores]:
    python = _peer_python()
    found = {}
    for name in PEERS:
        result = PEER_FOLDER / f"{name}.txt"
        command = [
            str(python),
            str(Path(__file__).with_name("trackers_peer.py")),
            name,
            str(fps),
            str(detections),
            str(result),
        ]
        subprocess.run(command, check=True)
        found[name] = scores(truth, read_boxes(result, fps=fps))
    return found


def _peer_python() -> Path:
    """The interpreter of the peers' environment, which is made if it is not there."""
    python = PEER_FOLDER / "bin/python"
    done = PEER_FOLDER / "installed"
    if not done.exists():
        subprocess.run([sys.executable, "-m", "venv", str(PEER_FOLDER)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", "--quiet", PEER], check=True)
        done.touch()
    return python


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
