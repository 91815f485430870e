"""The figure of `Series.plot`: blur and paths over the NIS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from aolink.exporting.common import needed
from aolink.plotting.overview import need_exposures, overview
from aolink.plotting.session import plot_blur, plot_nis
from aolink.series import Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_IN = (10.0, 6.0)


def plot_series(
    series: Series, estimators: Sequence[str] | None, output: int, axes: tuple[Axes, Axes] | None
) -> tuple[Axes, Axes]:
    """Draw one output's blur with all paths over it, and its axis's NIS."""
    view = overview(series, estimators, output=output)
    need_exposures(view)
    if axes is None:
        pyplot = needed("matplotlib.pyplot", "plot", "a plot")
        figure = pyplot.figure(figsize=_SIZE_IN, layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    else:
        above, below = axes
    plot_blur(view, above, names=["truth", *view.names])
    if view.nis:
        plot_nis(view, below, one_axis=True)
    above.set_xlabel("")
    return above, below
