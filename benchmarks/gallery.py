"""Pictures a person can judge: tracks with true and estimated horizons, as small files for docs/gallery.

    python -m benchmarks.gallery [--folder docs/gallery]

Reads the folder of VIAN_DATA. Only footage that may be passed on is shown (docs/gallery/README.md names it and whom to
credit); other scenes are drawn over nothing.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.accuracy import PETS, data_folder
from vian.evaluation.estimators import HorizonEstimator, estimators
from vian.evaluation.judging import judged
from vian.evaluation.lines import error_of
from vian.evaluation.overlays import Overlay, drawn, write_image
from vian.evaluation.plots import plot_errors
from vian.evaluation.running import watched
from vian.evaluation.scenes import read_scenes, read_truth

BYTES_MAX = 60_000
"""A picture is at most so large, bytes."""
FOOTAGE = {
    "car-park": "video/intel_car_detection/car-detection.mp4",
    "lobby": "video/intel_one_by_one_person/one-by-one-person-detection.mp4",
}
"""Clips under CC BY 4.0, credited on the gallery's page."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("docs/gallery"))
    folder = parser.parse_args(arguments).folder
    folder.mkdir(parents=True, exist_ok=True)
    data, chosen = data_folder(), estimators()
    scenes = read_scenes(data / "horizon/tracks_10")
    plot_errors(list(judged(scenes, chosen)), folder / "horizon-errors.svg")
    for scene in scenes:
        overlay = Overlay(scene.width, scene.height, scene.boxes, scene.truth, (), caption=f"tracks_10, {scene.name}")
        _write(overlay, chosen, folder / f"horizon-{scene.name}.png")
    for name, overlay in _videos(data):
        _write(overlay, chosen, folder / f"{name}.{'png' if overlay.picture is None else 'jpg'}")


def _videos(data: Path) -> Iterator[tuple[str, Overlay]]:
    video = watched(data / PETS / "vtest_480x360.avi")
    size = video.info.width, video.info.height
    truth = read_truth(data / PETS / "View_001.xml", *size)
    yield "pets", Overlay(*size, video.boxes, truth, (), caption="PETS 2009 S2.L1, View 001: tracks from the video")
    for name, path in FOOTAGE.items():
        video = watched(data / path)
        size = video.info.width, video.info.height
        yield name, Overlay(*size, video.boxes, None, (), video.picture, "footage: Intel Corporation, CC BY 4.0")


def _write(overlay: Overlay, chosen: Sequence[HorizonEstimator], file: Path) -> None:
    """Draw the scene with what each estimator says of it, and its error where the truth is known."""
    size = overlay.width, overlay.height
    estimates = []
    for each in chosen:
        line = each.estimate(overlay.boxes, *size)
        error = np.inf if overlay.truth is None else error_of(line, overlay.truth, *size)
        estimates.append((f"{each.name}: off by {error:.3f}" if np.isfinite(error) else each.name, line))
    whole = Overlay(*size, overlay.boxes, overlay.truth, estimates, overlay.picture, overlay.caption)
    write_image(drawn(whole), file)
    assert file.stat().st_size <= BYTES_MAX, f"{file} has {file.stat().st_size} bytes"


if __name__ == "__main__":
    main()
