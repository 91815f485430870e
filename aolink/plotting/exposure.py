"""The figure that explains the method: one exposure's path, its histogram, and the blur that it left."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.estimation.estimate import Estimate
from aolink.estimation.registry import BASELINE_ESTIMATOR
from aolink.exporting.common import check_frame
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import exposure_density
from aolink.optics.sensor import BaseSensor, Sensor
from aolink.plotting.overview import limits_of, profile_density
from aolink.plotting.style import BAND, TimeUnit, colour, extremes, figure_or_new, hides_swings, is_narrow
from aolink.series import Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_SIZE_IN = (9.0, 3.4)
_BINS = 48
"""Bins of a path's histogram, over the drawn part of the field."""
_SEGMENTS = 120
"""Segments of a path that is drawn as an envelope."""


def exposure_with_estimates(
    series: Series, number: int, estimators: Sequence[str] | None = None
) -> tuple[Exposure, dict[str, Estimate]]:
    """An exposure by its number, counted from 0, and its estimates.

    Without names they are those of the baseline and of the estimator with the highest rank. Raises `RecordingError`
    where there are no estimates of such a name; `ExportError` where there is no such exposure, or its frame is not of
    the rig's sensor.
    """
    if not 0 <= number < len(series):
        there = f"has {len(series)}, counted from 0" if len(series) else "holds none"
        raise ExportError(f"there is no exposure {number}: {series.path} {there}")
    ranked = by_rank(list(series.named(None)))
    usual = [name for name in dict.fromkeys((BASELINE_ESTIMATOR, *ranked[-1:])) if name in ranked]
    names = series.named(usual if estimators is None else estimators)
    exposure, estimates = next(series[number : number + 1].walk(names), (None, {}))
    if exposure is None:
        raise ExportError(f"exposure {number} of {series.path} cannot be read; `aolink info --check` says why")
    check_frame(series, exposure)
    return exposure, estimates


def plot_exposure(
    series: Series, number: int, figure: Figure | SubFigure | None = None, *,
    estimators: Sequence[str] | None = None, spot: int = 0, unit: TimeUnit = "s",
) -> Figure | SubFigure:  # fmt: skip
    """Draw one exposure: the path over its blur, the path's histogram, and the intensity profile beside them.

    The three panels of a row share the axis of the spot's position. The path's histogram, blurred by the kernel, is
    the intensity that the path predicts; grey is the measured intensity. A spot on a plane has a row for x and one for
    y, and its picture.

    Parameters
    ----------
    number:
        Number of the exposure in the series, counted from 0.
    figure:
        The figure to draw on; by default a new one.
    estimators:
        Estimators whose paths are drawn; by default the baseline `o1` and the estimator with the highest rank.
    spot:
        Number of the spot, on a sensor with many.
    unit:
        Whether the time axis counts milliseconds of the exposure or its fast steps.

    Raises
    ------
    RecordingError
        There are no estimates of such a name.
    ExportError
        There is no such exposure or spot, its frame is not of the rig's sensor, or matplotlib is missing.
    """
    exposure, estimates = exposure_with_estimates(series, number, estimators)
    return draw_exposure(series, exposure, estimates, figure, spot=spot, unit=unit)


def draw_exposure(
    series: Series, exposure: Exposure, estimates: dict[str, Estimate], figure: Figure | SubFigure | None = None, *,
    spot: int = 0, unit: TimeUnit = "s",
) -> Figure | SubFigure:  # fmt: skip
    """Draw the figure of `plot_exposure` for an exposure that has been read."""
    sensor = series.rig.sensor
    on_plane = sensor.directions == 2
    if not 0 <= spot < sensor.spots:
        raise ExportError(f"there is no spot {spot}: the sensor has {sensor.spots}, counted from 0")
    outputs = [2 * spot, 2 * spot + 1] if on_plane else [spot]
    figure = figure_or_new(figure, (_SIZE_IN[0], _SIZE_IN[1] * (1.6 if on_plane else 1.0)))
    narrow, rows = is_narrow(figure), len(outputs)
    if narrow:  # the paths above, and below them what else there is
        grid = figure.add_gridspec(rows + 1, 2 * rows, height_ratios=[1.0] * rows + [1.6])
    else:
        widths = [3.0, 1.0, 1.2, 2.0] if on_plane else [3.0, 1.0, 1.2]
        grid = figure.add_gridspec(rows, len(widths), width_ratios=widths)
    first: Axes | None = None
    for row, output in enumerate(outputs):
        left = figure.add_subplot(grid[row, :] if narrow else grid[row, 0], sharex=first)
        beside = [grid[rows, k] if narrow else grid[row, 1 + k] for k in range(0 if narrow and on_plane else 2)]
        panels = [left, *(figure.add_subplot(place, sharey=left) for place in beside)]
        _draw_row(panels, series, exposure, estimates, output, unit)
        left.set_ylabel(("x", "y (slope units)")[row] if on_plane else "spot (slope units)")
        if row < len(outputs) - 1:
            for panel in panels:
                panel.set_xlabel("")
        first = first or left
    if on_plane:
        draw_spot(figure.add_subplot(grid[rows, :] if narrow else grid[:, 3]), sensor, exposure, estimates, spot)
    if first is not None and first.get_legend_handles_labels()[0]:
        figure.legend(*first.get_legend_handles_labels(), loc="outside upper left", ncols=2 if narrow else 4)
    return figure


def _draw_row(
    panels: Sequence[Axes], series: Series, exposure: Exposure, estimates: dict[str, Estimate], output: int,
    unit: TimeUnit,
) -> None:  # fmt: skip
    """Draw path, histogram and intensity profile of one output."""
    over_time, *others = panels
    line: Sensor = series.rig.sensor.profile
    seen = profile_density(series.rig.sensor, exposure, output)
    paths = paths_of(exposure, estimates, [output])
    low, high = limits_of(line, list(paths.values()))
    length = exposure.n_steps * _step(series, unit)
    top = float(np.nanmax(seen)) if np.isfinite(seen).any() else line.peak_density
    over_time.pcolormesh(
        [0, length], line.edges, seen[:, None], cmap="Greys", vmin=0, vmax=2.5 * max(top, 1e-12), rasterized=True
    )
    draw_paths(over_time, series, exposure, estimates, [output], unit)
    over_time.set(ylim=(low, high))
    if not others:
        return
    histogram, intensity = others
    bins = np.linspace(low, high, _BINS + 1)
    draw_intensity(intensity, series, exposure, estimates, output, orientation="horizontal")
    for name, (path,) in paths.items():
        share = np.histogram(np.clip(path, low, high), bins, density=True)[0]
        histogram.stairs(share, bins, orientation="horizontal", color=colour(name), linewidth=0.9)
    histogram.set_xlabel("time at a position\n(1 / slope unit)")
    intensity.set_xlabel("intensity\n(1 / slope unit)")
    for panel in (histogram, intensity):
        panel.tick_params(labelleft=False)
        panel.set_xlim(left=0)


def paths_of(exposure: Exposure, estimates: dict[str, Estimate], outputs: Sequence[int]) -> dict[str, FloatArray]:
    """Paths of some outputs by their names, (outputs, n_steps), with the truth before the estimates where it is
    known."""
    chosen = list(outputs)
    paths = {name: each.path[chosen] for name, each in estimates.items()}
    if exposure.truth is not None and exposure.truth.known[chosen].all():
        paths = {"truth": exposure.truth.path[chosen], **paths}
    return paths


def draw_intensity(
    axes: Axes, series: Series, exposure: Exposure, estimates: dict[str, Estimate], output: int, *,
    orientation: Literal["horizontal", "vertical"] = "vertical",
) -> None:  # fmt: skip
    """Draw the measured intensity profile of one output, and what each path predicts for it."""
    sensor = series.rig.sensor
    line: Sensor = sensor.profile
    seen = profile_density(sensor, exposure, output)
    drawn: Any = np.nan_to_num(seen)
    axes.stairs(drawn, line.edges, orientation=orientation, fill=True, color="0.8", label="measured")
    if not np.isfinite(seen).any():
        axes.text(0.5, 0.5, "no pixel\narrived", ha="center", va="center", transform=axes.transAxes)
    for name, (path,) in paths_of(exposure, estimates, [output]).items():
        plant = series.rig.plant
        if plant.delays:  # of the output's own interval
            late = plant.delays[output % plant.n_outputs]
            path = path[late : late + exposure.n_steps - plant.last_delay]
        predicted = sensor.light_of(output) * exposure_density(line.kernel, line.edges, path)
        width = 1.8 if name == "truth" else 1.3
        axes.stairs(predicted, line.edges, orientation=orientation, color=colour(name), linewidth=width, label=name)


def draw_paths(
    axes: Axes, series: Series, exposure: Exposure, estimates: dict[str, Estimate], outputs: Sequence[int],
    unit: TimeUnit = "s",
) -> None:  # fmt: skip
    """Draw paths of some outputs inside an exposure with the bands of their estimates."""
    step = _step(series, unit)
    times: FloatArray = np.asarray(np.arange(exposure.n_steps) * step, dtype=np.float64)
    for name, paths in paths_of(exposure, estimates, outputs).items():
        for output, path in zip(outputs, paths, strict=True):
            sd = None if name == "truth" else estimates[name].path_sd[output]
            _draw_path(axes, times, path, sd, name)
    axes.set_xlim(0, exposure.n_steps * step)
    axes.set_xlabel("time in the exposure (ms)" if unit == "s" else "fast step in the exposure")


def _step(series: Series, unit: TimeUnit) -> float:
    """The length of a fast step on the time axis of an exposure."""
    return series.rig.timing.fast_step_s * 1e3 if unit == "s" else 1.0


def _draw_path(axes: Axes, times: FloatArray, path: FloatArray, sd: FloatArray | None, name: str) -> None:
    """Draw a path with the band of its estimate; one that swings too fast for a line is drawn as its range."""
    low, high = extremes(path, _SEGMENTS)
    if hides_swings(path, _SEGMENTS):
        edges = np.linspace(times[0], times[-1], len(low))
        axes.fill_between(edges, low, high, color=colour(name), alpha=0.4, linewidth=0, label=f"{name} (range)")
        return
    label = name if sd is None else f"{name}, ±{BAND:g} sd"
    axes.plot(times, path, color=colour(name), linewidth=1.8 if sd is None else 1.2, label=label)
    if sd is not None:
        axes.fill_between(times, path - BAND * sd, path + BAND * sd, color=colour(name), alpha=0.2, linewidth=0)


def _on_line(value: float, slope: float, at: float, place: FloatArray) -> FloatArray:
    """A straight line that has this value at a place."""
    return np.asarray(value + slope * (np.asarray(place) - at))


def draw_spot(axes: Axes, sensor: BaseSensor, exposure: Exposure, estimates: dict[str, Estimate], spot: int) -> None:
    """Draw the picture of one spot with the paths over it."""
    window = sensor.window_of(spot)
    counts = np.where(exposure.mask[window], exposure.pixels[window].astype(float), np.nan)
    low, high = sensor.field
    picture = axes.imshow(counts, cmap="Greys", extent=(low, high, high, low), interpolation="nearest")
    axes.figure.colorbar(picture, ax=axes, label="counts", orientation="horizontal", shrink=0.9)
    outputs = [2 * spot, 2 * spot + 1]
    paths = paths_of(exposure, estimates, outputs)
    for name, path in paths.items():
        axes.plot(*path, color=colour(name), linewidth=1.6 if name == "truth" else 1.0)
    axes.set(xlabel="x (slope units)", ylabel="y (slope units)", xlim=(low, high), ylim=(high, low))
    if sensor.row_time_s:  # beside the rows, when the exposure of each starts
        first, per_unit = 1e3 * sensor.row_starts_s[window[0]][0], 1e3 * sensor.row_time_s / sensor.pixel_width
        row = low + sensor.pixel_width / 2
        start, back = partial(_on_line, first, per_unit, row), partial(_on_line, row, 1 / per_unit, first)
        axes.secondary_yaxis("right", functions=(start, back)).set_ylabel("start of a row's exposure (ms)")
    if paths:  # the part of the window that they are in, as a square
        ends = np.array([limits_of(sensor.profile, [path[k] for path in paths.values()]) for k in (0, 1)])
        half, (middle_x, middle_y) = float(np.ptp(ends, axis=1).max()) / 2, ends.mean(axis=1)
        axes.set(xlim=(middle_x - half, middle_x + half), ylim=(middle_y + half, middle_y - half))
