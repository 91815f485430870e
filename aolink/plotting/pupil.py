"""Maps over the pupil of a sensor with many lenslets: light, slopes, blur, consistency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.estimation.estimate import Estimate
from aolink.estimation.frames.measure import profiles_of
from aolink.exporting.common import check_frame
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import to_density
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import BaseSensor
from aolink.plotting.style import colour_bar, figure_or_new
from aolink.rig import Rig
from aolink.series import Series

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_EXPOSURES = 24
"""Most exposures that are read for the maps, spread evenly over the series."""
_MAP_IN = (2.6, 2.3)
_LEAST_SPOTS = 4
_COLUMNS = 3
"""Maps in a row."""


def has_pupil(series: Series) -> bool:
    """Whether the sensor has lenslets enough for a map."""
    return series.rig.sensor.spots >= _LEAST_SPOTS


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
    sensor = series.rig.sensor
    if not has_pupil(series):
        raise ExportError(f"{series.path} has no map over the pupil: its sensor has fewer than {_LEAST_SPOTS} lenslets")
    names = by_rank(list(series.named(None if estimator is None else [estimator])))
    maps = _maps(series, names[-1:])
    rows = -(-len(maps) // _COLUMNS)
    figure = figure_or_new(figure, (_MAP_IN[0] * _COLUMNS, _MAP_IN[1] * rows))
    for place, (title, (label, values, cmap)) in enumerate(maps.items(), 1):
        axes = figure.add_subplot(rows, _COLUMNS, place)
        shown = np.full(sensor.grid[0] * sensor.grid[1], np.nan)
        shown[sensor.lit] = values
        reach = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 1.0
        low = -reach if cmap == "RdBu_r" else 0.0
        picture = axes.imshow(shown.reshape(sensor.grid), cmap=cmap, vmin=low, vmax=reach or 1.0)
        axes.set_title(title)
        axes.set_xticks([])
        axes.set_yticks([])
        colour_bar(picture, axes, label)
    return figure


MAPS = {
    "light": ("light", "1 = a lenslet wholly lit", "viridis"),
    "slope_x": ("mean slope x", "slope units", "RdBu_r"),
    "slope_y": ("mean slope y", "slope units", "RdBu_r"),
    "blur": ("blur", "RMS of the path, slope units", "magma"),
    "nis": ("NIS", "no unit", "magma"),
}
"""Maps by the name of their values: title, meaning of the colours, colour map."""


def spot_values(rig: Rig, exposure: Exposure, estimate: Estimate | None) -> dict[str, FloatArray]:
    """A number for each lit lenslet, (spots,), by the names of `MAPS`, as far as an exposure and its estimate have
    them.

    Without an estimate slopes are the spots' centroids. NIS is there where each spot has axes of its own, and NaN
    where nothing was measured.
    """
    sensor = rig.sensor
    found: dict[str, FloatArray] = {}
    if exposure.mask.any():
        density = np.where(exposure.mask, to_density(sensor, exposure.pixels), 0.0)
        found["light"] = spot_windows(sensor, density).sum(axis=(-2, -1)) * sensor.pixel_size
    if estimate is None:
        slopes = exposure.slopes if exposure.slopes is not None else _centroids(sensor, exposure)
    else:
        slopes = estimate.path.mean(axis=1)
        blur = np.mean((estimate.path - slopes[:, None]) ** 2, axis=1)
        found["blur"] = np.sqrt(blur.reshape(-1, 2).sum(axis=1))
        if rig.plant.n_outputs <= 2 and estimate.innovation.shape[1]:
            measured = np.where(estimate.nis > 0, estimate.nis, np.nan)
            found["nis"] = measured.reshape(-1, 2 // rig.plant.n_outputs).mean(axis=1)
    found["slope_x"], found["slope_y"] = np.reshape(slopes, (-1, 2)).T
    return found


def _maps(series: Series, names: Sequence[str]) -> dict[str, tuple[str, FloatArray, str]]:
    """Each map by its title: the meaning of its colours, a value for each spot, a colour map."""
    seen: dict[str, list[FloatArray]] = {}
    spread = np.unique(np.linspace(0, len(series) - 1, min(_EXPOSURES, len(series))).astype(int))
    for exposure, estimates in series[spread].walk(names):
        check_frame(series, exposure)
        for name, values in spot_values(series.rig, exposure, estimates.get(names[0]) if names else None).items():
            seen.setdefault(name, []).append(values)
    if not seen:
        raise ExportError(f"{series.path} holds no exposure to draw; `aolink info` says what it holds")
    by = names[0] if names else "centroid"
    return {
        title if name == "light" else f"{title} ({by})": (label, np.mean(seen[name], axis=0), cmap)
        for name, (title, label, cmap) in MAPS.items()
        if name in seen
    }


def _centroids(sensor: BaseSensor, exposure: Exposure) -> FloatArray:
    """Centre of each output's profile, slope units, (n_outputs,); NaN where no light came."""
    line, found = sensor.profile, profiles_of(sensor, exposure.pixels, exposure.mask)
    density = np.where(found.mask, to_density(line, np.asarray(found.counts, dtype=np.float64)), 0.0)
    light = density.sum(axis=1)
    return np.asarray(np.divide(density @ line.centres, light, out=np.full(len(light), np.nan), where=light > 0))
