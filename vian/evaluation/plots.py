"""The distribution of errors as a plot; needs matplotlib, which the extra `vian[evaluate]` brings."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from vian.errors import WorldFailed, WrongUsage
from vian.evaluation.judging import Judged, summaries
from vian.evaluation.lines import AUC_MAX

FORMATS = (".png", ".svg")


def check_plot(file: Path) -> None:
    """Refuse, before anything is measured, a plot that could not be drawn.

    Raises:
        WrongUsage: The name ends with neither .png nor .svg.
        WorldFailed: matplotlib is not installed, or there is no such folder.
    """
    if file.suffix.lower() not in FORMATS:
        raise WrongUsage(f"--plot must end with {' or '.join(FORMATS)}, got {file.name!r}")
    if find_spec("matplotlib") is None:
        raise WorldFailed("--plot needs matplotlib. Next: pip install 'vian[evaluate]'")
    if not file.resolve().parent.is_dir():
        raise WorldFailed(f"{file}: cannot be written: no such folder. Next: give another place")


def plot_errors(found: Sequence[Judged], file: Path) -> None:
    """Draw the share of scenes over the largest error, a curve a method, up to where `auc` ends.

    Raises:
        WrongUsage: The name ends with neither .png nor .svg.
        WorldFailed: matplotlib is not installed, or the file cannot be written.
    """
    check_plot(file)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "vian", "font.family": "DejaVu Sans"}):
        figure = Figure(figsize=(5.2, 3.4), layout="constrained")
        axes = figure.add_subplot()
        for each in summaries(found):
            errors = np.sort([one.error for one in found if one.method == each.method])
            shares = np.arange(1, len(errors) + 1) / len(errors)
            x = np.concatenate([[0.0], errors[np.isfinite(errors)], [AUC_MAX * 2]])
            y = np.concatenate([[0.0], shares[np.isfinite(errors)], [np.isfinite(errors).mean()]])
            axes.step(x, y, where="post", label=f"{each.method}: AUC {each.auc:.2f}, median {each.median:.3f}")
        axes.set(xlim=(0, AUC_MAX), ylim=(0, 1.02), xlabel="error, image heights", ylabel="share of scenes")
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize="small")
        _save(figure, file)


def _save(figure: object, file: Path) -> None:
    dated = {"Date": None} if file.suffix.lower() == ".svg" else {}  # the same figures give the same bytes
    try:
        figure.savefig(file, dpi=110, metadata=dated)  # type: ignore[attr-defined]  # matplotlib has no types
    except OSError as error:
        raise WorldFailed(f"{file}: cannot be written: {error.strerror}. Next: give another place") from error
