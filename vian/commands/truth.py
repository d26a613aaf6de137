"""`vian truth`: what is true of a picture, from what somebody marked in it."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from vian import options
from vian.errors import WorldFailed
from vian.output import Output

app = typer.Typer(help="Work out what is true of a picture from what was marked in it.", no_args_is_help=True)


@app.command(epilog="Example: vian truth horizon marks.json --output truth.json")
def horizon(
    marks: Annotated[
        Path,
        typer.Argument(
            help="JSON: width and height of the frame, and groups of segments [x1, y1, x2, y2] on level lines that are "
            "parallel in the world.",
            callback=options.existing,
        ),
    ],
    output_file: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the horizon here, for --truth of vian evaluate.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Work out the horizon of a frame from groups of parallel lines that were marked in it."""
    from vian.evaluation.vanishing import horizon_of_marks, read_marks  # SciPy is slow to import

    read = read_marks(marks)
    found = horizon_of_marks(read)
    line = found.horizon
    assert line.covariance is not None, "marks have a covariance"
    values: dict[str, Any] = {
        "width": read.width,
        "height": read.height,
        "horizon": {"a": line.slope, "b": line.offset},
        "covariance": line.covariance.tolist(),
        "groups": [
            {
                "name": point.group,
                "vanishing_point": point.xy.tolist(),
                "rms_px": point.rms_px,
                "below_horizon_px": distance,
            }
            for point, distance in zip(found.points, found.distances_px, strict=True)
        ],
    }
    if output_file is not None:
        _write(output_file, values)
    output = Output(is_json=as_json)
    for doubt in found.doubts:
        output.note(doubt)
    if as_json:
        output.result(values)
        return
    columns = ("group", "vanishing point, px", "segments off, px rms", "below the horizon, px")
    rows = [
        (point.group, f"{point.xy[0]:.1f}, {point.xy[1]:.1f}", f"{point.rms_px:.2f}", f"{distance:.2f}")
        for point, distance in zip(found.points, found.distances_px, strict=True)
    ]
    output.table("", columns, rows)
    ends = [f"{line.at(x):.1f} +- {line.sd_at(x):.1f}" for x in (0.0, read.width - 1.0)]
    output.line(
        f"horizon: y = {line.slope:.6f} x + {line.offset:.3f} px; {ends[0]} px at the left, {ends[1]} at the right"
    )


def _write(file: Path, values: dict[str, Any]) -> None:
    try:
        file.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise WorldFailed(f"{file}: cannot be written: {error.strerror}. Next: give another place") from error
