"""How what is found in rendered pictures decays as they get worse: noise of the sensor, blur of the lens.

    python -m benchmarks.rendered [--plot docs/gallery/rendered-decay.svg]

The whole way: video, motion, horizon, calibration; truth is exact. Two cameras, one draw of people each: what one sees
is the trend, and where nothing is said any more.
"""

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.measuring import keep
from extractors.calibration import Camera
from extractors.scene import SQUARE_CAMERA, square
from vian.evaluation.rendered import Rendered, rendered

CAMERAS = {
    "landscape, rolled by 4°, horizon above the picture": SQUARE_CAMERA,
    "portrait, horizon in the picture": Camera(620.0, 0.35, 0.03, 4.5, 360, 640),
}
NOISE_LEVELS = (0.0, 4.0, 10.0, 20.0)
"""Standard deviations, grey levels; blur 0."""
BLURS_PX = (0.0, 1.5, 3.0, 5.0)
"""Standard deviations, px; noise of 3 grey levels."""
NOISE_USUAL = 3.0


@dataclass(frozen=True, slots=True)
class Row:
    """What was found of one film; None where nothing was."""

    camera: str
    worse: str
    """`noise` or `blur`"""
    value: float
    """its standard deviation: grey levels, or px"""
    horizon_error: float | None
    """image heights"""
    horizon_deviation: float | None
    """largest standard deviation within the picture that the horizon is said with, image heights"""
    height_error: float | None
    """of the camera's height, as a share"""
    speed_error: float | None
    """median over those who walk, as a share"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, keep and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--plot", type=Path, default=Path("docs/gallery/rendered-decay.svg"))
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/rendered.json"))
    options = parser.parse_args(arguments)
    rows = list(_measured())
    keep(options.results, is_quick=False, rows=[asdict(row) for row in rows])
    plot(rows, options.plot)


def _measured() -> Iterator[Row]:
    for name, camera in CAMERAS.items():
        films = [("noise", noise, noise, 0.0) for noise in NOISE_LEVELS]
        films += [("blur", blur, NOISE_USUAL, blur) for blur in BLURS_PX]
        for worse, value, noise, blur in films:
            row = _row(name, worse, value, _found(camera, noise, blur))
            print(row)
            yield row


def _found(camera: Camera, noise_levels: float, blur_px: float) -> Rendered:
    scene = square(camera, people=16, apart_s=2.0, noise_levels=noise_levels, blur_px=blur_px)
    with tempfile.TemporaryDirectory() as folder:
        return rendered(scene, Path(folder) / "square.mp4")


def _row(camera: str, worse: str, value: float, found: Rendered) -> Row:
    ends = np.array([0.0, found.scene.width - 1.0])
    deviation = float(found.horizon.sd_at(ends).max() / found.scene.height) if found.horizon else math.inf
    figures = (found.horizon_error, deviation, found.height_error, found.speed_error)
    return Row(camera, worse, value, *(round(each, 4) if math.isfinite(each) else None for each in figures))


def plot(rows: Sequence[Row], target: Path) -> None:
    """Draw the horizon's error and its interval over noise and over blur; a cross where no horizon was given."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "vian", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for axes, worse, label in zip(
            panels, ("noise", "blur"), ("noise of the picture, grey levels", "blur of the lens, px"), strict=True
        ):
            for number, name in enumerate(CAMERAS):
                own = [row for row in rows if (row.camera, row.worse) == (name, worse)]
                given = [row for row in own if row.horizon_error is not None]
                colour, values = f"C{number}", [row.value for row in given]
                axes.plot(values, [100 * (row.horizon_error or 0) for row in given], "o-", color=colour, label=name)
                reach = [1.96 * 100 * (row.horizon_deviation or 0) for row in given]
                axes.plot(values, reach, ":", color=colour, linewidth=1)
                nothing = [row.value for row in own if row.horizon_error is None]
                axes.plot(nothing, [0.1 + 0.2 * number] * len(nothing), "x", color=colour)
            axes.set_xlabel(f"{label} (standard deviation)", fontsize="small")
            axes.grid(alpha=0.3)
        panels[0].set_ylim(0, None)
        panels[0].set_ylabel("horizon's error, % of the height", fontsize="small")
        title = "dotted: reach of the 95 % interval; cross: no horizon given"
        figure.legend(
            *panels[0].get_legend_handles_labels(),
            title=title,
            fontsize="x-small",
            title_fontsize="x-small",
            frameon=False,
            loc="outside upper center",
            ncols=2,
        )
        figure.savefig(target, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
