"""Plots for the documentation: small files, the same bytes for the same figures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@contextmanager
def small_svg(target: Path, salt: str) -> Iterator["Axes"]:
    """Axes to draw on, which become an SVG with text as text; `salt` names the plot."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": salt, "svg.fonttype": "none", "font.family": "sans-serif"}):
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.subplots()
        yield axes
        axes.set_ylim(bottom=0)
        axes.locator_params(nbins=6)
        axes.legend(frameon=False)
        axes.grid(axis="y", alpha=0.3)
        figure.savefig(target, format="svg", metadata={"Date": None})
