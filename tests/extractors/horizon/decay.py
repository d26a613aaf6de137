"""How the horizon decays as boxes get noisier: `python -m tests.extractors.horizon.decay FILE.svg`.

Synthetic scenes with exact truth, random walks before random cameras, the same ones at each level of noise. The plot
shows the error (largest vertical distance within the frame over its height) in the median and in nine of ten scenes,
and the half-width of the 95 % interval; the figures say how many intervals hold the truth.
"""

import sys
from pathlib import Path

import numpy as np

from extractors.horizon import HorizonConfig, estimated
from tests.extractors.horizon.larger import error_of
from tests.extractors.horizon.scenes import random_camera, random_walks, scene
from tests.extractors.plotting import small_svg

NOISE = (0.0, 0.01, 0.02, 0.04, 0.06, 0.09, 0.12)
"""Standard deviation of each edge of a box, of the box's height."""
SCENES, FIRST_SEED = 24, 400_000


def main(target: Path) -> None:
    """Draw the plot, and print its figures."""
    rows = np.array([_level(noise) for noise in NOISE])
    for noise, (median, decile, reach, covered, silent) in zip(NOISE, rows, strict=True):
        sys.stdout.write(
            f"noise {noise:.0%}: median {median:.2%}, nine of ten within {decile:.2%}, interval +-{reach:.2%}, "
            f"holds the truth in {covered:.0%}, silent in {silent:.0%}\n"
        )
    with small_svg(target, "horizon") as axes:
        x = 100 * np.array(NOISE)
        for name, column, line in (
            ("error, median", 0, "-"),
            ("error, nine of ten scenes", 1, "--"),
            ("half-width of the 95 % interval, median", 2, ":"),
        ):
            axes.plot(x, 100 * rows[:, column], line, label=name)
        axes.set(xlabel="noise of a box's edges, % of its height", ylabel="% of the frame's height")


def _level(noise: float) -> tuple[float, float, float, float, float]:
    """Median and ninth decile of errors, median reach of intervals, their coverage, and the share without estimate."""
    errors, reaches, covered = [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + SCENES):
        random = np.random.default_rng(seed)
        camera, walks = random_camera(random), random_walks(random, count=30)
        made = scene(walks, camera, random, noise=noise, noise_px=0.0, false_tracks=0)
        found = estimated(made.points, camera.size, HorizonConfig())
        if found is None:
            continue
        middle = camera.size.width / 2
        reach = 1.96 * found.fit.deviation_at(middle)
        errors.append(error_of(found.fit.line, camera))
        reaches.append(reach / camera.size.height)
        covered.append(abs(found.fit.line.y(middle) - camera.horizon.y(middle)) < reach)
    silent = 1 - len(errors) / SCENES
    return (
        float(np.median(errors)),
        float(np.quantile(errors, 0.9)),
        float(np.median(reaches)),
        float(np.mean(covered)),
        silent,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
