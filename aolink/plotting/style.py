"""The common style of all figures: sizes, colours, and the axes and figures that are given or made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from aolink.colours import estimator_colour
from aolink.exporting.common import needed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

MM = 1 / 25.4
"""A millimetre in inches."""
_PAPER = {
    "font.size": 8, "axes.linewidth": 0.6, "lines.linewidth": 1.0, "legend.frameon": False, "legend.fontsize": 7,
    "axes.spines.top": False, "axes.spines.right": False, "pdf.fonttype": 42, "savefig.dpi": 300,
    "axes.titlesize": 8, "svg.hashsalt": "aolink",
}  # fmt: skip
_NARROW_IN = 4.8
"""Figures of less width are narrow, inches."""


@contextmanager
def paper(style: Mapping[str, Any] = _PAPER) -> Iterator[None]:
    """A context with small type and thin lines, or another style, for the figures made in it. Raises ExportError
    without matplotlib.

    Nothing of a ``matplotlibrc`` is in it: matplotlib reads one of the current folder, which may be a stranger's.
    """
    with needed("matplotlib.style", "plot", "a figure").context(["default", style]):
        yield


def new_figure(width_mm: float, height_mm: float) -> Figure:
    """An empty figure of a size on paper. Raises ExportError without matplotlib."""
    figure = needed("matplotlib.figure", "plot", "a figure")
    made: Figure = figure.Figure(figsize=(width_mm * MM, height_mm * MM), layout="constrained")
    return made


def axes_or_new(axes: Axes | None) -> Axes:
    """The axes given, or those of a new figure that a notebook shows. Raises ExportError without matplotlib."""
    if axes is None:
        axes = needed("matplotlib.pyplot", "plot", "a plot").subplots(layout="constrained")[1]
    return axes


def figure_or_new(figure: Figure | SubFigure | None, size_in: tuple[float, float]) -> Figure | SubFigure:
    """The figure given, or a new one that a notebook shows. Raises ExportError without matplotlib."""
    if figure is None:
        figure = needed("matplotlib.pyplot", "plot", "a plot").figure(figsize=size_in, layout="constrained")
    return figure


def colour(name: str) -> tuple[float, ...]:
    """The colour of a name as in the viewer, except for the truth, whose yellow is hard to see on white."""
    return (0.0, 0.0, 0.0) if name == "truth" else tuple(part / 255 for part in estimator_colour(name))


def is_narrow(figure: Figure | SubFigure) -> bool:
    """Whether a figure is as narrow as a column of a paper, so that panels stand one below the other."""
    return float(figure.bbox.width / figure.dpi) < _NARROW_IN


def legend_above(axes: Axes, columns: int = 5) -> None:
    """A legend over the axes, where it covers no curve; none where nothing has a label."""
    if axes.get_legend_handles_labels()[0]:
        columns = min(columns, 3) if is_narrow(axes.figure) else columns
        axes.legend(
            loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2, ncols=columns, columnspacing=1.0,
            handlelength=1.5,
        )  # fmt: skip


def colour_bar(mapped: Any, axes: Axes, label: str) -> None:
    """A colour bar beside the axes, with its quantity and unit."""
    axes.figure.colorbar(mapped, ax=axes, label=label, shrink=0.9)
