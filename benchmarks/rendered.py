"""How what is found in rendered pictures decays as they get worse: noise of the sensor, blur of the lens.

    python -m benchmarks.rendered [--plot docs/gallery/rendered-decay.svg]

The whole way: video, motion, horizon, calibration; truth is exact. Two cameras, one draw of people each: what one sees
is the trend, and where nothing is said any more.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

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


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--plot", type=Path, default=Path("docs/gallery/rendered-decay.svg"))
    target = parser.parse_args(arguments).plot
    found = {}
    for name, camera in CAMERAS.items():
        by_noise = [_found(camera, noise, 0.0) for noise in NOISE_LEVELS]
        by_blur = [_found(camera, NOISE_USUAL, blur) for blur in BLURS_PX]
        found[name] = by_noise, by_blur
        for what, values, rows in (("noise", NOISE_LEVELS, by_noise), ("blur", BLURS_PX, by_blur)):
            for value, row in zip(values, rows, strict=True):
                print(
                    f"{name:52} {what} {value:4.1f}: horizon off by {row.horizon_error:.4f} (deviation "
                    f"{_deviation(row):.4f}), height by {row.height_error:.1%}, speeds by {row.speed_error:.1%}"
                )
    _plot(found, target)


def _found(camera: Camera, noise_levels: float, blur_px: float) -> Rendered:
    scene = square(camera, people=16, apart_s=2.0, noise_levels=noise_levels, blur_px=blur_px)
    with tempfile.TemporaryDirectory() as folder:
        return rendered(scene, Path(folder) / "square.mp4")


def _deviation(row: Rendered) -> float:
    """Largest standard deviation within the picture that the horizon is said with, image heights."""
    ends = np.array([0.0, row.scene.width - 1.0])
    return float(row.horizon.sd_at(ends).max() / row.scene.height) if row.horizon else float("nan")


def _plot(found: dict[str, tuple[list[Rendered], list[Rendered]]], target: Path) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "vian", "svg.fonttype": "none"}):
        figure = Figure(figsize=(7.2, 3.2), layout="constrained")
        for number, (axes, values, label) in enumerate(
            zip(
                figure.subplots(1, 2, sharey=True),
                (NOISE_LEVELS, BLURS_PX),
                ("noise of the picture, grey levels", "blur of the lens, px"),
                strict=True,
            )
        ):
            for name, both in found.items():
                rows = both[number]
                errors = [100 * row.horizon_error if row.horizon else np.nan for row in rows]
                reach = [1.96 * 100 * _deviation(row) for row in rows]
                (line,) = axes.plot(values, errors, marker="o", label=name)
                axes.plot(values, reach, color=line.get_color(), linestyle=":", linewidth=1)
            axes.set(xlabel=f"{label} (standard deviation)", ylim=(0, None))
            axes.grid(alpha=0.3)
        figure.axes[0].set_ylabel("horizon's error, % of the picture's height")
        figure.axes[0].legend(
            fontsize="x-small", frameon=False, title="dotted: 95 % interval", title_fontsize="x-small"
        )
        figure.savefig(target, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
