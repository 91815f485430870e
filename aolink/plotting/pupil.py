"""Maps over the pupil of a sensor with many lenslets: light, slopes, blur, consistency."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.exporting.common import check_frame
from aolink.gathered import MAPS, has_pupil, maps_of
from aolink.numerics.arrays import FloatArray
from aolink.plotting.style import colour_bar, figure_or_new, is_narrow
from aolink.series import Series

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_EXPOSURES = 24
"""Most exposures that are read for the maps, spread evenly over the series."""
_MAP_IN = (2.6, 2.3)
_COLUMNS = 3
"""Maps in a row; on a narrow figure there is one less."""


def plot_pupil(
    series: Series, figure: Figure | SubFigure | None = None, *, estimator: str | None = None
) -> Figure | SubFigure:
    """Draw maps over the lenslets: light, mean slope in x and in y, blur, NIS; as means over a part of the exposures.

    Slopes and blur are those of the estimated paths; without estimates slopes are the spots' centroids. NIS is
    drawn where each spot has axes of its own. At most 24 exposures are read, spread evenly over the series.

    Parameters
    ----------
    figure:
        The figure to draw on; by default a new one.
    estimator:
        Estimator whose paths are drawn; by default the one with the highest rank.

    Raises
    ------
    RecordingError
        There are no estimates of such a name.
    ExportError
        The sensor has fewer than four lenslets, there is no exposure, or matplotlib is missing.
    """
    if not has_pupil(series.rig):
        raise ExportError(f"{series.path} has no map over the pupil: its sensor has fewer than 4 lenslets")
    names = by_rank(list(series.named(None if estimator is None else [estimator])))[-1:]
    seen: dict[str, list[FloatArray]] = {}
    spread = np.unique(np.linspace(0, len(series) - 1, min(_EXPOSURES, len(series))).astype(int))
    for exposure, estimates in series[spread].walk(names):
        check_frame(series, exposure)
        for what, values in maps_of(series.rig, exposure, next(iter(estimates.values()), None)).items():
            seen.setdefault(what, []).append(values)
    if not seen:
        raise ExportError(f"{series.path} holds no exposure to draw; `aolink info` says what it holds")
    figure = figure_or_new(figure, (_MAP_IN[0] * _COLUMNS, _MAP_IN[1] * -(-len(seen) // _COLUMNS)))
    columns = _COLUMNS - is_narrow(figure)
    for place, what in enumerate([what for what in MAPS if what in seen], 1):
        (title, label, cmap), values = MAPS[what], np.mean(seen[what], axis=0)
        axes = figure.add_subplot(-(-len(seen) // columns), columns, place)
        reach = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 1.0
        picture = axes.imshow(values, cmap=cmap, vmin=-reach if cmap == "RdBu_r" else 0.0, vmax=reach or 1.0)
        axes.set(title=title if what == "light" else f"{title} ({(*names, 'centroid')[0]})", xticks=[], yticks=[])
        colour_bar(picture, axes, label)
    return figure
