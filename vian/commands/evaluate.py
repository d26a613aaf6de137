"""`vian evaluate`: horizons, tracks and positions on the ground beside the truth."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vian import options
from vian.errors import WorldFailed, WrongUsage
from vian.output import Output

if TYPE_CHECKING:
    from vian.evaluation.boxes import Boxes
    from vian.evaluation.calibrations import Calibration
    from vian.evaluation.ground import GroundScores
    from vian.evaluation.judging import Judged
    from vian.evaluation.scenes import Scene

app = typer.Typer(help="Measure what is extracted beside the truth.", no_args_is_help=True)

OUTSIDE_MAX = 0.1
"""Larger shares of true boxes outside the frame mean that it is another frame's truth."""
Fps = Annotated[
    float, typer.Option("--fps", help="Frames per second of files without times.", min=0.01, max=1000, metavar="N")
]
TruthSize = Annotated[
    str | None,
    typer.Option(
        "--truth-size", help="Frame size of truth and detections, as 768x576.", show_default="that of the video"
    ),
]


@app.command(epilog="Example: vian evaluate horizon scenes/ --plot errors.svg --overlays pictures/")
def horizon(
    path: Annotated[
        Path,
        typer.Argument(
            help="A folder with tracks.csv and truth.json of many scenes, or a video.", callback=options.existing
        ),
    ],
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth",
            help="A video's true horizon: from vian truth horizon, or a Tsai calibration (.xml).",
            callback=options.existing,
        ),
    ] = None,
    methods: Annotated[list[str] | None, typer.Option("--method", help="Only this estimator; may be repeated.")] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the errors' distribution (.svg, .png).")] = None,
    overlays: Annotated[
        Path | None, typer.Option("--overlays", help="A folder for a picture of each scene with tracks and horizons.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Estimate horizons and measure them: largest vertical distance within the image, over the image's height."""
    from vian.evaluation.estimators import estimators
    from vian.evaluation.judging import judged, summaries
    from vian.evaluation.plots import check_plot, plot_errors

    if plot is not None:
        check_plot(plot)
    if overlays is not None:
        _make(overlays)
    chosen = estimators(methods, is_of_blobs=not path.is_dir())
    scenes = _scenes(path, truth)
    found = list(judged(scenes, chosen))
    output = Output(is_json=as_json)
    columns = ("scene", "method", "error", "slope", "offset", "in the 95 % interval")
    output.table("", columns, [_row(each) for each in found])
    summed = ("method", "scenes", "abstained", "median", "p75", "p90", "AUC", "coverage", "coverage of the region")
    output.table("", summed, [_rounded(tuple(asdict(each).values())) for each in summaries(found)])
    if plot is not None:
        plot_errors(found, plot)
    if overlays is not None:
        _draw(found, overlays)


@app.command(epilog="Example: vian evaluate tracks gt.txt sort.txt bytetrack.txt gate.mp4 --fps 25")
def tracks(
    truth: Annotated[
        Path,
        typer.Argument(
            help="True tracks: MOTChallenge gt.txt, or a PETS annotation (.xml).", callback=options.existing
        ),
    ],
    found: Annotated[
        list[Path],
        typer.Argument(
            help="A tracker's output, detections (ids -1) that are tracked first, or a video; may be many.",
            callback=options.existing,
        ),
    ],
    fps: Fps = 25.0,
    truth_size: TruthSize = None,
    as_json: options.Json = False,
) -> None:
    """Score tracks: HOTA, MOTA and IDF1, of files as MOTChallenge has them or of what is found in a video."""
    from vian.evaluation.files import read_boxes
    from vian.evaluation.scoring import scores

    true = read_boxes(truth, fps=fps, is_truth=True)
    size = _size_of(truth_size)
    columns = (
        "found", "HOTA", "DetA", "AssA", "MOTA", "IDF1", "misses", "false positives", "switches", "true boxes",
        "found boxes", "true tracks", "found tracks",
    )  # fmt: skip
    rows = []
    for path in found:
        boxes, own = _found(path, fps, size)
        here = true if own is None else _fitted(truth, true, size or own, own)
        rows.append((str(path), *_rounded(tuple(asdict(scores(here, boxes)).values()))))
    Output(is_json=as_json).table("", columns, rows)


@app.command(epilog="Example: vian evaluate ground View_001.xml annotation.xml gate.mp4 --fps 7")
def ground(
    camera: Annotated[
        Path,
        typer.Argument(
            help="The published calibration: Tsai's model, as PETS has it (.xml).", callback=options.existing
        ),
    ],
    truth: Annotated[
        Path,
        typer.Argument(
            help="True tracks in that camera's frames: MOTChallenge or PETS (.xml).", callback=options.existing
        ),
    ],
    found: Annotated[
        Path | None,
        typer.Argument(
            help="What the camera is calibrated from: its video, or tracks like the truth's.",
            show_default="none",
            callback=options.existing,
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            help="Instead: JSON with homography, width and height, as camera_calibrated has them.",
            callback=options.existing,
        ),
    ] = None,
    fps: Fps = 25.0,
    as_json: options.Json = False,
) -> None:
    """Measure positions on the ground and walkers' speeds by a calibration, against a published one."""
    from vian.evaluation.files import read_boxes
    from vian.evaluation.ground import ground_scores, mapped
    from vian.evaluation.scenes import check_proportions
    from vian.evaluation.scoring import pairs_of
    from vian.evaluation.tsai import read_camera

    if (found is None) == (calibration is None):
        raise WrongUsage(f"give either FOUND or --calibration, got {'neither' if found is None else 'both'}")
    published = read_camera(camera)
    size = (published.width, published.height)
    true = read_boxes(truth, fps=fps, is_truth=True)
    _check_within(truth, true, size)
    boxes, own = (None, None) if found is None else _found(found, fps, size)
    tested = _calibration(calibration, found, boxes, own or size, is_of_blobs=own is not None)
    named = calibration or found
    assert named is not None, "one of them was given"
    check_proportions(named, (tested.width, tested.height), size)
    scale = tested.width / size[0], tested.height / size[1]
    places = published.ground_of(true.feet_xy)
    output = Output(is_json=as_json)
    _tell(output, "annotated", ground_scores(true, mapped(tested.matrix, true.feet_xy * scale), places), named)
    if boxes is not None:
        here, there = pairs_of(true.scaled(*scale), boxes)
        moved = mapped(tested.matrix, boxes.feet_xy[there])
        _tell(output, "found", ground_scores(true.where(here), moved, places[here]), named)


def _tell(output: Output, feet: str, measured: "GroundScores | None", named: Path) -> None:
    """Print how far positions of these feet are off."""
    if measured is None:
        raise WrongUsage(
            f"{named}: fewer than two {feet} positions can be compared on the ground. "
            "Next: see that it is of this camera, and its homography of pixels to metres, with W > 0 below the horizon"
        )
    centiles = ", ".join(f"{p} %: {value:.2f}" for p, value in measured.percentiles_m.items())
    output.result(
        {"feet": feet} | asdict(measured),
        f"{feet} feet: positions of {measured.tracks} tracks off by {measured.median_m:.3f} m (median; m within "
        f"{centiles}), {measured.unplaced} of {measured.positions + measured.unplaced} not on the ground\n"
        f"{feet} feet: speeds of {measured.walkers} walkers off by {measured.speed_error:.1%} (median), "
        f"{measured.speed_within:.0%} of them by at most 15 %; estimated over true: {measured.speed_ratio:.3f}",
    )


def _calibration(
    file: Path | None, found: Path | None, boxes: "Boxes | None", size: tuple[int, int], *, is_of_blobs: bool
) -> "Calibration":
    """The calibration of the file, or the one that tracks give."""
    from vian.evaluation.calibrations import TrackCalibration, read_calibration

    if file is not None:
        return read_calibration(file)
    assert boxes is not None, "there are tracks where there is no file"
    calibrated = TrackCalibration(is_of_blobs=is_of_blobs).calibrate(boxes, *size)
    if calibrated is None:
        raise WorldFailed(
            f"{found}: its {len(boxes)} boxes do not decide the camera: too few upright tracks, or too little between "
            "near and far. Next: give a longer recording"
        )
    return calibrated


def _scenes(path: Path, truth: Path | None) -> "list[Scene]":
    from vian.evaluation.running import watched
    from vian.evaluation.scenes import Scene, read_scenes, read_truth

    if path.is_dir():
        if truth is not None:
            raise WrongUsage(f"--truth goes with a video, got the folder {path}, which has its own truth.json")
        return read_scenes(path)
    if truth is None:
        if not path.exists():
            raise WorldFailed(f"{path}: no such file or directory. Next: check the name")
        raise WrongUsage(f"{path}: a video needs its true horizon. Next: --truth FILE, from vian truth horizon")
    video = watched(path)
    info = video.info
    line = read_truth(truth, info.width, info.height)
    return [Scene(path.name, info.width, info.height, video.boxes, line, video.picture)]


def _row(each: "Judged") -> tuple[object, ...]:
    line = each.estimate
    if line is None:
        return (each.scene.name, each.method, None, None, None, None)
    is_covered = None if each.is_covered is None else ("yes" if each.is_covered else "no")
    return (each.scene.name, each.method, *_rounded((each.error, line.slope, line.offset)), is_covered)


def _rounded(values: tuple[object, ...]) -> tuple[object, ...]:
    return tuple(round(each, 4) if isinstance(each, float) else each for each in values)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorldFailed(f"{folder}: cannot be made: {error.strerror}. Next: give another folder") from error


def _draw(found: "list[Judged]", folder: Path) -> None:
    from vian.evaluation.overlays import Overlay, drawn, write_image

    for scene in {id(each.scene): each.scene for each in found}.values():
        estimates = [(each.method, each.estimate) for each in found if each.scene is scene]
        overlay = Overlay(
            scene.width, scene.height, scene.boxes, scene.truth, estimates, scene.picture, f"scene {scene.name}"
        )
        name = re.sub(r"[^\w.-]", "_", scene.name)
        write_image(drawn(overlay), folder / f"{name}.png")


def _found(path: Path, fps: float, size: tuple[int, int] | None) -> "tuple[Boxes, tuple[int, int] | None]":
    """The boxes of a tracker's output, of detections that are tracked, or of a video with its frame size."""
    from vian.evaluation.files import read_boxes
    from vian.evaluation.running import tracked, watched

    if path.suffix.lower() not in (".txt", ".csv", ".xml"):
        video = watched(path)
        return video.boxes, (video.info.width, video.info.height)
    boxes = read_boxes(path, fps=fps)
    is_free = boxes.track_id < 0
    if not is_free.any():
        return boxes, None
    if not is_free.all():
        raise WrongUsage(f"{path}: boxes with and without a track (id -1), wanted one kind. Next: give two files")
    if size is None:
        raise WrongUsage(f"{path}: detections are tracked in a frame of known size. Next: --truth-size WIDTHxHEIGHT")
    return tracked(boxes, *size), None


def _size_of(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", text)
    if found is None:
        raise WrongUsage(f"--truth-size must be like 768x576, got {text!r}")
    return int(found[1]), int(found[2])


def _fitted(path: Path, true: "Boxes", size: tuple[int, int], wanted: tuple[int, int]) -> "Boxes":
    """The true boxes in pixels of a frame of the wanted size."""
    from vian.evaluation.scenes import check_proportions

    check_proportions(path, size, wanted)
    _check_within(path, true, size)
    return true.scaled(wanted[0] / size[0], wanted[1] / size[1])


def _check_within(path: Path, true: "Boxes", size: tuple[int, int]) -> None:
    """Refuse truth of which a part lies where its frame is not."""
    middles = (true.xyxy[:, :2] + true.xyxy[:, 2:]) / 2
    outside = ((middles < 0) | (middles > size)).any(axis=1).mean()
    if outside > OUTSIDE_MAX:
        reach = middles.max(axis=0)
        raise WrongUsage(
            f"{path}: {outside:.0%} of the boxes lie outside a frame of {size[0]}x{size[1]} px; they reach "
            f"{reach[0]:.0f}, {reach[1]:.0f}. Next: give the truth of this camera, and its frame size with --truth-size"
        )
