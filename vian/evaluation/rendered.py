"""What the whole way from pictures to a camera comes to on a rendered scene, whose truth is exact."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from extractors.calibration import CalibrationConfig, CalibrationFold, Camera
from extractors.scene import Scene, truth, write
from vian.evaluation.boxes import Boxes
from vian.evaluation.estimators import TrackHorizon
from vian.evaluation.ground import GroundScores, ground_scores, mapped
from vian.evaluation.lines import Horizon, error_of
from vian.evaluation.running import Watched, watched
from vian.evaluation.scoring import pairs_of


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """A scene, what was found in its video, and how far that is off."""

    scene: Scene
    video: Watched
    horizon: Horizon | None
    camera: Camera | None
    ground: GroundScores | None
    """positions and speeds of found feet, by the camera that was found"""

    @property
    def truth(self) -> Horizon:
        """The true horizon."""
        return Horizon(*self.scene.camera.horizon)

    @property
    def horizon_error(self) -> float:
        """Of the horizon, image heights; infinite where there is none."""
        return error_of(self.horizon, self.truth, self.scene.width, self.scene.height)

    @property
    def height_error(self) -> float:
        """Of the camera's height, as a share of it; infinite where there is none."""
        return abs(self.camera.height_m / self.scene.camera.height_m - 1) if self.camera else math.inf

    @property
    def speed_error(self) -> float:
        """Of the speeds on the ground, as a share, median over those who walk; infinite where there are none."""
        return self.ground.speed_error if self.ground else math.inf


def rendered(scene: Scene, file: Path) -> Rendered:
    """Render the scene into the file, extract its motion, and find horizon and camera from that."""
    write(scene, file)
    video = watched(file)
    boxes = video.boxes
    horizon = TrackHorizon(is_of_blobs=True).estimate(boxes, scene.width, scene.height)
    fold = CalibrationFold(CalibrationConfig(), (scene.width, scene.height))
    fold.add_points(boxes.time_us, boxes.track_id, boxes.xyxy, boxes.confidence)
    fold.finish()
    camera = None if fold.said is None else fold.said.camera
    ground = None if camera is None else _ground(scene, boxes, camera)
    return Rendered(scene, video, horizon, camera, ground)


def true_boxes(scene: Scene) -> tuple[Boxes, npt.NDArray[np.float64]]:
    """The true tracks, and where each box's object stands, m, `(n, 2)`."""
    rows = truth(scene)
    boxes = Boxes(
        frame=np.array([row.frame for row in rows], np.int64),
        track_id=np.array([row.object_id for row in rows], np.int64),
        xyxy=np.array([(row.x1, row.y1, row.x2, row.y2) for row in rows]),
        confidence=np.ones(len(rows)),
        time_us=np.array([round(1e6 * row.frame / scene.fps) for row in rows], np.int64),
    )
    return boxes, np.array([(row.east_m, row.north_m) for row in rows])


def _ground(scene: Scene, found: Boxes, camera: Camera) -> GroundScores | None:
    true, places = true_boxes(scene)
    here, there = pairs_of(true, found)
    return ground_scores(true.where(here), mapped(camera.homography, found.feet_xy[there]), places[here])
