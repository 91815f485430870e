"""The figure that explains the method: one exposure's path, its histogram, and the blur that it left."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.estimation.registry import BASELINE_ESTIMATOR
from aolink.exporting.common import check_frame
from aolink.gathered import BAND, PER_SLOPE, SLOPES, Blur, extremes, hides_swings, limits_of, paths_of
from aolink.numerics.arrays import FloatArray
from aolink.plotting.style import colour, figure_or_new, is_narrow
from aolink.rig import Rig
from aolink.series import Series, Step

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_SIZE_IN = (9.0, 3.4)
_BINS = 48
"""Bins of a path's histogram over the drawn part of the field."""
_SEGMENTS = 120
"""Segments of a path that is drawn as an envelope."""


def step_of(series: Series, number: int, estimators: Sequence[str] | None = None) -> Step:
    """An exposure by its number, counted from 0, with its estimates.

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
    step = next(series[number : number + 1].steps(names), None)
    if step is None:
        raise ExportError(f"exposure {number} of {series.path} cannot be read; `aolink info --check` says why")
    check_frame(series, step.exposure)
    return step


def plot_exposure(
    series: Series, number: int, figure: Figure | SubFigure | None = None, *,
    estimators: Sequence[str] | None = None, spot: int = 0,
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

    Raises
    ------
    RecordingError
        There are no estimates of such a name.
    ExportError
        There is no such exposure or spot, its frame is not of the rig's sensor, or matplotlib is missing.
    """
    return draw_exposure(series.rig, step_of(series, number, estimators), figure, spot=spot)


def draw_exposure(
    rig: Rig, step: Step, figure: Figure | SubFigure | None = None, *, spot: int = 0
) -> Figure | SubFigure:
    """Draw the figure of `plot_exposure` for an exposure that has been read."""
    sensor = rig.sensor
    on_plane = sensor.directions == 2
    if not 0 <= spot < sensor.spots:
        raise ExportError(f"there is no spot {spot}: the sensor has {sensor.spots}, counted from 0")
    blurs = [Blur.of(rig, step, output) for output in ((2 * spot, 2 * spot + 1) if on_plane else (spot,))]
    figure = figure_or_new(figure, (_SIZE_IN[0], _SIZE_IN[1] * (1.6 if on_plane else 1.0)))
    narrow, rows = is_narrow(figure), len(blurs)
    if narrow:  # the paths above, and below them what else there is
        grid = figure.add_gridspec(rows + 1, 2 * rows, height_ratios=[1.2] * rows + [1.6])
    else:
        widths = [3.0, 1.0, 1.2, 2.0] if on_plane else [3.0, 1.0, 1.2]
        grid = figure.add_gridspec(rows, len(widths), width_ratios=widths)
    first: Axes | None = None
    for row, blur in enumerate(blurs):
        left = figure.add_subplot(grid[row, :] if narrow else grid[row, 0], sharex=first)
        beside = [grid[rows, k] if narrow else grid[row, 1 + k] for k in range(0 if narrow and on_plane else 2)]
        panels = [left, *(figure.add_subplot(place, sharey=left) for place in beside)]
        _draw_row(panels, rig, step, blur)
        left.set_ylabel(("x", f"y ({SLOPES})")[row] if on_plane else f"spot ({SLOPES})")
        if row < rows - 1:
            for panel in panels:
                panel.set_xlabel("")
        first = first or left
    if on_plane:
        draw_spot(figure.add_subplot(grid[rows, :] if narrow else grid[:, 3]), rig, step, spot)
    if first is not None and first.get_legend_handles_labels()[0]:
        figure.legend(*first.get_legend_handles_labels(), loc="outside upper left", ncols=2 if narrow else 4)
    return figure


def _draw_row(panels: Sequence[Axes], rig: Rig, step: Step, blur: Blur) -> None:
    """Draw path, histogram and intensity profile of one output."""
    over_time, *others = panels
    line, seen = blur.line, blur.measured
    top = float(np.nanmax(seen)) if np.isfinite(seen).any() else line.peak_density
    ends = [0, step.exposure.n_steps * rig.timing.fast_step_s * 1e3]
    grey: Any = {"cmap": "Greys", "vmin": 0, "vmax": 2.5 * max(top, 1e-12), "rasterized": True}
    over_time.pcolormesh(ends, line.edges, seen[:, None], **grey)
    draw_paths(over_time, rig, step, [blur.output])
    over_time.set(ylim=blur.limits)
    if not others:
        return
    histogram, intensity = others
    draw_intensity(intensity, blur, orientation="horizontal")
    low, high = blur.limits
    for name in blur.paths:
        stairs = blur.histogram(name, (high - low) / _BINS)
        histogram.stairs(*stairs, orientation="horizontal", color=colour(name), linewidth=0.9)
    for panel, what in ((histogram, "time at a position"), (intensity, "intensity")):
        panel.set_xlabel(f"{what}\n({PER_SLOPE})")
        panel.tick_params(labelleft=panel is histogram and is_narrow(panel.figure))
        panel.set_xlim(left=0)


def draw_intensity(
    axes: Axes, blur: Blur, *, orientation: Literal["horizontal", "vertical"] = "vertical",
) -> None:  # fmt: skip
    """Draw the measured intensity profile of one output, and what each path predicts for it."""
    drawn: Any = np.nan_to_num(blur.measured)
    axes.stairs(drawn, blur.line.edges, orientation=orientation, fill=True, color="0.8", label="measured")
    if not np.isfinite(blur.measured).any():
        axes.text(0.5, 0.5, "no pixel\narrived", ha="center", va="center", transform=axes.transAxes)
    for name in blur.paths:
        width = 1.8 if name == "truth" else 1.3
        stairs: Any = blur.predicted(name)
        axes.stairs(stairs, blur.line.edges, orientation=orientation, color=colour(name), linewidth=width, label=name)


def draw_paths(axes: Axes, rig: Rig, step: Step, outputs: Sequence[int]) -> None:
    """Draw paths of some outputs inside an exposure with the bands of their estimates; one that swings too fast for a
    line is drawn as its range."""
    length = rig.timing.fast_step_s * 1e3
    times: FloatArray = np.asarray(np.arange(step.exposure.n_steps) * length, dtype=np.float64)
    for name, paths in paths_of(step, outputs).items():
        shade = colour(name)
        for output, path in zip(outputs, paths, strict=True):
            if hides_swings(path, _SEGMENTS):
                low, high = extremes(path, _SEGMENTS)
                edges = np.linspace(times[0], times[-1], len(low))
                axes.fill_between(edges, low, high, color=shade, alpha=0.4, linewidth=0, label=f"{name} (range)")
            elif name == "truth":
                axes.plot(times, path, color=shade, linewidth=1.8, label=name)
            else:
                reach = BAND * step.estimates[name].path_sd[output]
                axes.plot(times, path, color=shade, linewidth=1.2, label=f"{name}, ±{BAND:g} sd")
                axes.fill_between(times, path - reach, path + reach, color=shade, alpha=0.2, linewidth=0)
    axes.set_xlim(0, step.exposure.n_steps * length)
    axes.set_xlabel("time in the exposure (ms)")


def _on_line(value: float, slope: float, at: float, place: FloatArray) -> FloatArray:
    """A straight line that has this value at a place."""
    return np.asarray(value + slope * (np.asarray(place) - at))


def draw_spot(axes: Axes, rig: Rig, step: Step, spot: int) -> None:
    """Draw the picture of one spot with the paths over it."""
    window, (low, high) = rig.sensor.window_of(spot), rig.sensor.field
    counts = np.where(step.exposure.mask[window], step.exposure.pixels[window].astype(float), np.nan)
    picture = axes.imshow(counts, cmap="Greys", extent=(low, high, high, low), interpolation="nearest")
    axes.figure.colorbar(picture, ax=axes, label="counts", orientation="horizontal", shrink=0.9)
    paths = paths_of(step, [2 * spot, 2 * spot + 1])
    for name, path in paths.items():
        axes.plot(*path, color=colour(name), linewidth=1.6 if name == "truth" else 1.0)
    axes.set(xlabel=f"x ({SLOPES})", ylabel=f"y ({SLOPES})", xlim=(low, high), ylim=(high, low))
    sensor = rig.sensor
    if sensor.row_time_s:  # beside the rows, when the exposure of each starts
        first, per_unit = 1e3 * sensor.row_starts_s[window[0]][0], 1e3 * sensor.row_time_s / sensor.pixel_width
        row = low + sensor.pixel_width / 2
        start, back = partial(_on_line, first, per_unit, row), partial(_on_line, row, 1 / per_unit, first)
        axes.secondary_yaxis("right", functions=(start, back)).set_ylabel("start of a row's exposure (ms)")
    if paths:  # the part of the window that they are in, as a square
        ends = np.array([limits_of(rig.sensor.profile, [path[k] for path in paths.values()]) for k in (0, 1)])
        half, (middle_x, middle_y) = float(np.ptp(ends, axis=1).max()) / 2, ends.mean(axis=1)
        axes.set(xlim=(middle_x - half, middle_x + half), ylim=(middle_y + half, middle_y - half))
