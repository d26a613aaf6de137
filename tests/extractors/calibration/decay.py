"""How calibration from tracks decays as boxes get noisier: `python -m tests.extractors.calibration.decay FILE.svg`.

Synthetic scenes with exact truth; 3 cameras and 4 draws of people at each level of noise. The plot shows the largest
error of a position on the floor, of its distance from the camera; median of the draws.
"""

import sys
from pathlib import Path

import numpy as np

from extractors.calibration import CalibrationConfig, CalibrationFold, Camera
from extractors.horizon import HorizonConfig
from tests.extractors.plotting import small_svg
from tests.extractors.synthetic import homography_error, walks

NOISE = (0.0, 0.005, 0.01, 0.02, 0.03, 0.045, 0.06)
"""Standard deviation of each edge of a box, of the box's height."""
CAMERAS = (
    ("53° of view, 20° down", Camera(1280.0, 0.35, 0.05, 5.0, 1280, 720)),
    ("65° of view, 29° down, rolled by 11°", Camera(600.0, 0.5, 0.2, 4.0, 768, 576)),
    ("30° of view, 14° down", Camera(1430.0, 0.25, 0.0, 8.0, 768, 576)),
)
DRAWS = 4
CONFIG = CalibrationConfig.of_boxes().model_copy(update={"camera": HorizonConfig(update_s=1e6)})


def main(target: Path) -> None:
    """Draw the plot, and print its figures."""
    with small_svg(target, "calibration") as axes:
        for name, camera in CAMERAS:
            medians = [float(np.median(_errors(camera, noise))) for noise in NOISE]
            told = ", ".join(f"{noise:.1%} {error:.2%}" for noise, error in zip(NOISE, medians, strict=True))
            sys.stdout.write(f"{name}: {told}\n")
            axes.plot([100 * noise for noise in NOISE], [100 * error for error in medians], label=name)
        axes.axhline(1.0, color="grey", linewidth=0.8, linestyle=":")
        axes.set(xlabel="noise of a box's edges, % of its height", ylabel="largest error on the floor, % of distance")


def _errors(camera: Camera, noise: float) -> list[float]:
    errors = []
    for seed in range(DRAWS):
        seen = walks(camera, noise_share=noise, seed=seed)
        fold = CalibrationFold(CONFIG, (camera.width, camera.height))
        fold.add_points(seen.time_us, seen.track_id, seen.boxes_xyxy, seen.confidence)
        fold.finish()
        errors.append(float("nan") if fold.said is None else homography_error(camera, fold.said.camera))
    return errors


if __name__ == "__main__":
    main(Path(sys.argv[1]))
