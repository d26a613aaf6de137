"""Pictures a person can judge, as small files for docs/gallery: tracks with true and estimated horizons, a plan, bars.

    python -m benchmarks.gallery [--folder docs/gallery]

Reads the folder of VIAN_DATA, and renders scenes. Only footage that may be passed on is shown (docs/gallery/README.md
names it and whom to credit); other scenes are drawn over nothing. The bars are of benchmarks/results/accuracy.json,
as `python -m benchmarks.accuracy` left it.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.accuracy import PETS, PETS_FPS, PETS_SIZE, data_folder
from benchmarks.rendered import CAMERAS
from extractors.scene import square, write
from vian.evaluation.calibrations import TrackCalibration
from vian.evaluation.estimators import HorizonEstimator, estimators
from vian.evaluation.files import read_boxes
from vian.evaluation.ground import mapped, rigid
from vian.evaluation.judging import judged
from vian.evaluation.lines import Horizon, error_of
from vian.evaluation.overlays import Overlay, drawn, write_image
from vian.evaluation.plots import plot_errors
from vian.evaluation.running import Watched, watched
from vian.evaluation.scenes import read_scenes, read_truth
from vian.evaluation.tsai import read_camera

Floats = npt.NDArray[np.float64]

BYTES_MAX = 60_000
"""A picture is at most so large, bytes."""
CREDITED = "footage: Intel Corporation, CC BY 4.0"
FOOTAGE = {
    "car-park": ("video/intel_car_detection/car-detection.mp4", CREDITED),
    "lobby": ("video/intel_one_by_one_person/one-by-one-person-detection.mp4", CREDITED),
    "road": ("video/o4n_traffic/traffic.mp4", ""),
    "motorway": ("video/bgs_video02_osd/video02.avi", ""),
}
"""Clips without truth, and whom to credit; a clip with nobody to credit may not be shown, and is drawn over nothing."""
RESULTS = Path("benchmarks/results/accuracy.json")


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("docs/gallery"))
    parser.add_argument("--only", choices=("scenes", "videos", "rendered", "bars"), help="only these")
    options = parser.parse_args(arguments)
    folder: Path = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [options.only] if options.only else ["scenes", "videos", "rendered", "bars"]
    if "scenes" in wanted:
        _scenes(data_folder(), folder)
    if "videos" in wanted:
        _videos(data_folder(), folder)
    if "rendered" in wanted:
        _rendered(folder)
    if "bars" in wanted:
        _plot_bars(json.loads(RESULTS.read_text())["rows"], folder / "accuracy.svg")


def _scenes(data: Path, folder: Path) -> None:
    """The ten scenes of annotated ways, and their errors."""
    scenes = read_scenes(data / "horizon/tracks_10")
    plot_errors(list(judged(scenes, estimators())), folder / "horizon-errors.svg")
    for scene in scenes:
        overlay = Overlay(scene.width, scene.height, scene.boxes, scene.truth, (), caption=f"tracks_10, {scene.name}")
        _write(overlay, estimators(), folder / f"horizon-{scene.name}.png")


def _videos(data: Path, folder: Path) -> None:
    """The PETS clip with its truth, and clips without."""
    video = watched(data / PETS / "vtest_480x360.avi")
    truth = read_truth(data / PETS / "View_001.xml", video.info.width, video.info.height)
    caption = "PETS 2009 S2.L1, View 001: tracks from the video"
    _write(replace(_overlay(video, caption), truth=truth, picture=None), _of_blobs(), folder / "pets.png")
    _plot_plan(*_places(data, video), folder / "pets-plan.svg")
    for name, (path, credit) in FOOTAGE.items():
        overlay = _overlay(watched(data / path), credit or f"{name}: tracks from the video")
        shown = overlay if credit else replace(overlay, picture=None)
        _write(shown, _of_blobs(), folder / f"{name}.{'jpg' if credit else 'png'}")


def _rendered(folder: Path) -> None:
    """Scenes whose truth is exact."""
    for name, camera in zip(("square", "portrait"), CAMERAS.values(), strict=True):
        with tempfile.TemporaryDirectory() as place:
            file = Path(place) / f"{name}.mp4"
            write(square(camera), file)
            overlay = replace(_overlay(watched(file), "rendered"), truth=Horizon(*camera.horizon))
        _write(overlay, _of_blobs(), folder / f"{name}.jpg")


def _overlay(video: Watched, caption: str) -> Overlay:
    return Overlay(video.info.width, video.info.height, video.boxes, None, (), video.picture, caption)


def _of_blobs() -> list[HorizonEstimator]:
    return estimators(is_of_blobs=True)


def _write(overlay: Overlay, chosen: Sequence[HorizonEstimator], file: Path) -> None:
    """Draw the scene with what each estimator says of it, and its error where the truth is known."""
    size = overlay.width, overlay.height
    estimates = []
    for each in chosen:
        line = each.estimate(overlay.boxes, *size)
        error = np.inf if overlay.truth is None else error_of(line, overlay.truth, *size)
        estimates.append((f"{each.name}: off by {error:.3f}" if np.isfinite(error) else each.name, line))
    write_image(drawn(replace(overlay, estimates=estimates)), file)
    assert file.stat().st_size <= BYTES_MAX, f"{file} has {file.stat().st_size} bytes"


def _places(data: Path, video: Watched) -> tuple[list[Floats], list[Floats]]:
    """Ways of the annotated feet on the ground, m: by the published calibration, and by that of the tracks."""
    true = read_boxes(data / PETS / "PETS2009-S2L1.xml", fps=PETS_FPS)
    found = TrackCalibration(is_of_blobs=True).calibrate(video.boxes, video.info.width, video.info.height)
    assert found is not None, "the clip decides its camera"
    feet = true.feet_xy * [video.info.width / PETS_SIZE[0], video.info.height / PETS_SIZE[1]]
    published = read_camera(data / PETS / "View_001.xml").ground_of(true.feet_xy)
    estimated = mapped(found.matrix, feet)
    known = np.isfinite(estimated).all(axis=1)
    rotation, shift = rigid(estimated[known], published[known])
    both = published, estimated @ rotation.T + shift
    rows = [np.flatnonzero(true.track_id == number) for number in np.unique(true.track_id)]
    return [both[0][own] for own in rows], [both[1][own] for own in rows]


def _plot_plan(true: list[Floats], found: list[Floats], file: Path) -> None:
    """The ways seen from above."""

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for ways, colour, name in ((true, "#2a9d4a", "published calibration"), (found, "#e0662f", "from the tracks")):
            for number, way in enumerate(ways):
                # Every fifth place: the plan stays small.
                axes.plot(*way[::5].T, color=colour, linewidth=0.8, label=name if not number else None)
        axes.set(xlabel="m", ylabel="m", aspect="equal")
        axes.legend(fontsize="x-small", frameon=False, loc="upper left", bbox_to_anchor=(0, 1.12), ncols=2)

    _figure(file, (4.6, 4.2), draw)


def _plot_bars(rows: list[dict[str, Any]], file: Path) -> None:
    """A panel for each measured thing, a group of bars for each measure, a stroke where the wanted figure is."""
    panels: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        panels.setdefault(row["what"], []).append(row)

    def draw(figure: Any) -> None:
        across = 2
        down = -(-len(panels) // across)
        for at, (what, own) in enumerate(panels.items(), 1):
            axes = figure.add_subplot(down, across, at)
            for place, row in enumerate(own):
                _bars(axes, place, {"vian": row["ours"]} | row["references"])
                for value in _numbers(row["wanted"]):
                    axes.plot([place - 0.4, place + 0.4], [value, value], color="black", linewidth=1.2)
            axes.set_title(what, fontsize="small")
            axes.set_xticks(range(len(own)), [row["measure"] for row in own], fontsize="x-small")
            axes.tick_params(axis="y", labelsize="x-small")
            axes.set_ylim(0, 1.25 * axes.get_ylim()[1])  # room for the names above the bars

    _figure(file, (8.0, 9.0), draw)


def _bars(axes: Any, place: int, values: dict[str, float | None]) -> None:
    """One group: ours first, then the references, each with its name and value."""
    wide = 0.8 / len(values)
    for number, (name, value) in enumerate(values.items()):
        if value is None:
            continue
        x = place - 0.4 + (number + 0.5) * wide
        axes.bar(x, value, wide * 0.92, color="#e0662f" if name == "vian" else "#9db4c8")
        axes.text(x, value, f"{name}\n{value:.3g}", ha="center", va="bottom", fontsize=5.5)


def _numbers(wanted: str) -> list[float]:
    """The figures in what is wanted."""
    return [float(word) for word in wanted.split() if word.replace(".", "", 1).isdigit()]


def _figure(file: Path, size: tuple[float, float], draw: Any) -> None:
    """Draw a figure and keep it, the same bytes for the same figures."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "vian", "svg.fonttype": "none"}):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        figure.savefig(file, format="svg", metadata={"Date": None})
    assert file.stat().st_size <= 2 * BYTES_MAX, f"{file} has {file.stat().st_size} bytes"


if __name__ == "__main__":
    main()
