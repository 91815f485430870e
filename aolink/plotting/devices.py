"""Figures about a session's devices: losses along time, and the time at which each step of the loop was done."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from aolink.errors import ExportError
from aolink.gathered import REFUSED
from aolink.plotting.overview import Overview, need_exposures
from aolink.plotting.session import TIME, thinned
from aolink.plotting.style import axes_or_new, legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHADES = dict(zip(REFUSED.values(), ("tab:orange", "tab:red", "tab:purple", "tab:brown"), strict=True))


def plot_losses(view: Overview, axes: Axes | None = None) -> Axes:
    """Draw what went wrong and when: a row of marks for each kind of incident, with their number.

    Raises
    ------
    ExportError
        There is no exposure, or matplotlib is missing.
    """
    need_exposures(view)
    axes, step_s, found = axes_or_new(axes), view.series.rig.timing.fast_step_s, view.incidents
    for place, (name, at) in enumerate(found.items()):
        shade = _SHADES.get(name.partition(": ")[2], "0.2")
        axes.vlines(at * step_s, place - 0.35, place + 0.35, color=shade, linewidth=1.0, rasterized=len(at) > 500)
    labels = [f"{name} ({len(at)})" for name, at in found.items()]
    axes.set_yticks(range(len(found)), labels)
    if not found:
        axes.text(0.5, 0.5, "nothing was lost, nothing was gated", ha="center", transform=axes.transAxes)
    end = float(view.steps[-1] + view.n_steps[-1]) * step_s
    axes.set(xlabel=TIME, xlim=(0, end), ylim=(max(len(found), 1) - 0.4, -0.6))
    return axes


def plot_latency(view: Overview, axes: Axes | None = None) -> Axes:
    """Draw the time from the end of an exposure until each step of the loop was done, and the time of each estimate,
    ms.

    Raises
    ------
    ExportError
        The series holds no latencies, or matplotlib is missing.
    """
    need_exposures(view)
    by_frame = dict(zip(view.frame_ids.tolist(), view.times_s.tolist(), strict=True))
    lines = {
        name: np.array([(by_frame[frame], took_ms) for frame, took_ms in points if frame in by_frame])
        for name, points in view.timings.items()
    }
    if not any(map(len, lines.values())):
        raise ExportError(f"{view.series.path} holds no latencies: it was recorded on virtual time, or imported")
    axes = axes_or_new(axes)
    for name, points in lines.items():
        if len(points):
            axes.plot(*thinned(*points.T), "--" if name.endswith(" takes") else "-", linewidth=0.8, label=name)
    axes.set(xlabel=TIME, ylabel="latency since exposure end, or taken (ms)", yscale="log")
    axes.grid(alpha=0.3)
    legend_above(axes, 3)
    return axes
