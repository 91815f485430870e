"""Figures of a whole session, each on given axes or new ones: blur and paths, NIS, errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ExportError
from aolink.estimation.estimate import Status
from aolink.gathered import NIS_COVERAGE, PER_SLOPE, SLOPES, limits_of, nis_bounds, some_rows
from aolink.numerics.arrays import FloatArray
from aolink.plotting.overview import Overview, need_exposures, overview
from aolink.plotting.style import axes_or_new, colour, colour_bar, figure_or_new, is_narrow, legend_above
from aolink.series import Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIME = "time (s)"
_SIZE_IN = (10.0, 6.0)
_BRIGHTEST = 98.0
"""Percentile of the columns' brightest pixels that is drawn black."""
_RUNNING = 20
"""The errors are averaged over one part in this many of the session."""
_MOST_POINTS = 3000
"""Most points of a curve: a longer one is drawn as the range of its values."""


def plot_series(
    series: Series, estimators: Sequence[str] | None = None, *, output: int = 0, axes: tuple[Axes, Axes] | None = None
) -> tuple[Axes, Axes]:
    """The blur with the paths and, below it, the NIS: `aolink.series.Series.plot`."""
    view = overview(series, estimators, output=output)
    need_exposures(view)
    if axes is None:
        axes = figure_or_new(None, _SIZE_IN).subplots(2, 1, sharex=True, height_ratios=(3, 1))
    plot_blur(view, axes[0], names=["truth", *view.names])
    if view.nis:
        plot_nis(view, axes[1])
    axes[0].set_xlabel("")
    return axes


def plot_blur(view: Overview, axes: Axes | None = None, *, names: Sequence[str] | None = None) -> Axes:
    """Draw the camera's blur of one output, exposure by exposure, and the positions of the spot.

    Parameters
    ----------
    names:
        Names whose paths are drawn: ``truth`` or estimators; by default the truth and the estimator with the highest
        rank.

    Raises
    ------
    ExportError
        There is no exposure, or matplotlib is missing.
    """
    need_exposures(view)
    axes, rig = axes_or_new(axes), view.series.rig
    line, step_s = rig.sensor.profile, rig.timing.fast_step_s
    blur = np.full((line.pixels, 2 * len(view.spans) - 1), np.nan)
    blur[:, ::2] = view.blur.T  # a lost frame leaves its place empty
    brightest = [float(np.nanmax(each)) for each in view.blur if np.isfinite(each).any()]
    top = float(np.percentile(brightest, _BRIGHTEST)) if brightest else line.peak_density
    grey = axes.pcolormesh(
        np.ravel(view.spans) * step_s, line.edges, blur, cmap="Greys", vmin=0, vmax=1.2 * max(top, 1e-12),
        rasterized=True,
    )  # fmt: skip
    colour_bar(grey, axes, PER_SLOPE if is_narrow(axes.figure) else f"intensity ({PER_SLOPE})")
    chosen = ["truth", *view.names[-1:]] if names is None else names
    for name in [each for each in chosen if each in view.paths]:
        _draw_paths(axes, view, name, step_s)
    axes.set(ylabel=f"output {view.output} ({SLOPES})", xlabel=TIME, xlim=(0, view.spans[-1, 1] * step_s))
    drawn = [each for name, of in view.paths.items() if name in chosen for each in (of.low, of.high)]
    axes.set_ylim(limits_of(line, drawn))
    legend_above(axes)
    return axes


def _draw_paths(axes: Axes, view: Overview, name: str, step_s: float) -> None:
    """Draw paths as one line with gaps between exposures; where they swing too fast for that, draw their range."""
    paths = view.paths[name]
    begin, end = view.spans[:, :1], view.spans[:, 1:]
    places = np.linspace(0, 1, len(paths.places) + 1).repeat(2)[1:-1] if paths.envelope else paths.places

    def joined(values: FloatArray) -> FloatArray:
        return np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan).ravel()

    times = joined((begin + (end - begin) * places) * step_s)
    look: Any = {"color": colour(name)}
    if paths.envelope:
        low, high = (joined(np.repeat(each, 2, axis=1)) for each in (paths.low, paths.high))
        look |= {"alpha": 0.35, "linewidth": 0.3, "label": f"{name} (range)", "rasterized": True}
        axes.fill_between(times, low, high, **look)
        return
    # In a long session lines lie close to each other: thin ones leave the blur to be seen.
    room = 20 * axes.figure.bbox.width / axes.figure.dpi / len(begin)
    width = max(0.25, (1.4 if name == "truth" else 0.9) * min(1.0, room))
    axes.plot(times, joined(paths.points), linewidth=width, label=name, **look)


def plot_nis(view: Overview, axes: Axes | None = None) -> Axes:
    """Draw the NIS of each estimator with the interval that holds 95 % of its values if the filter is consistent.

    With many axes it is their mean, whose interval is narrower. Gated exposures are crosses.

    Raises
    ------
    ExportError
        There is no NIS: no estimates, or only of estimators that measure nothing; or matplotlib is missing.
    """
    need_exposures(view)
    if not view.nis:
        raise ExportError(f"{view.series.path} holds no NIS: it has no estimates by an estimator that measures")
    axes, times, count = axes_or_new(axes), view.times_s, view.series.rig.plant.axes
    drawn: dict[int, list[str]] = {}
    for name, values in view.nis.items():
        marker = ".-" if len(times) <= 200 else "-"
        axes.plot(*thinned(times, values), marker, color=colour(name), linewidth=0.6, markersize=3, label=name)
        drawn.setdefault(view.measurements[name], []).append(name)
        gated = np.isin(view.status[name], (Status.GATED, Status.DIVERGED))
        if gated.any():
            axes.plot(times[gated], values[gated], "x", color=colour(name), markersize=5, label=f"{name}, gated")
    for degrees, names in drawn.items():
        for bound in nis_bounds(degrees * count):
            axes.axhline(bound / count, color=colour(names[-1]), linewidth=0.7, linestyle="--", zorder=1)
    positive = any((values > 0).any() for values in view.nis.values())
    mean = " (mean over the axes)" if count > 1 else ""
    axes.set(ylabel=f"NIS{mean}", xlabel=f"{TIME};  - - -  {NIS_COVERAGE:.0%} bounds")
    if positive:
        axes.set_yscale("log")
    legend_above(axes)
    return axes


def plot_errors(view: Overview, axes: Axes | None = None) -> Axes:
    """Draw the RMSE of each estimator's path along the session, as a running mean over a twentieth of it.

    Raises
    ------
    ExportError
        The series holds no truth or no estimates, or matplotlib is missing.
    """
    need_exposures(view)
    if not view.errors:
        raise ExportError(f"{view.series.path} holds no errors: it has no truth or no estimates")
    axes = axes_or_new(axes)
    for name, errors in view.errors.items():
        known = np.isfinite(errors)
        if not known.any():
            continue
        width = max(1, int(known.sum()) // _RUNNING)
        kernel = np.full(width, 1 / width)
        times = np.convolve(view.times_s[known], kernel, mode="valid")
        running = np.sqrt(np.convolve(errors[known] ** 2, kernel, mode="valid"))
        axes.plot(*thinned(times, running), color=colour(name), label=name)
    axes.set(yscale="log", xlabel=TIME, ylabel=f"RMSE of the path ({SLOPES})")
    axes.grid(alpha=0.3)
    legend_above(axes)
    return axes


def thinned(times: NDArray[Any], values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A curve of at most some thousand points that shows the same ranges: it has the extremes of each run of points."""
    chosen = some_rows(values[:, None], _MOST_POINTS)
    return np.asarray(times, dtype=np.float64)[chosen], values[chosen]
