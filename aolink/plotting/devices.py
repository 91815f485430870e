"""Figures about a session's devices: losses along time, and the time at which each step of the loop was done."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from aolink.errors import ExportError
from aolink.estimation.estimate import Status
from aolink.numerics.arrays import FloatArray
from aolink.plotting.overview import Overview, need_exposures
from aolink.plotting.session import thinned, time_label
from aolink.plotting.style import TimeUnit, axes_or_new, legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LANES = {
    Status.GATED: ("gated", "tab:orange"),
    Status.DIVERGED: ("diverged", "tab:red"),
    Status.REINITIALISED: ("reinitialised", "tab:purple"),
    Status.INPUT_INVALID: ("not usable", "tab:brown"),
}
"""Labels for an estimate whose exposure was not used normally."""


def incidents(view: Overview) -> dict[str, FloatArray]:
    """Incidents by their kind, each with its fast steps, counted from the first exposure.

    The kinds are frames lost and incomplete, exposures with inputs that the mirror did not report, estimates that were
    gated, diverged, began anew or could not use their exposure, and those that the session had no time for.
    """
    steps = view.steps.astype(np.float64)
    found = {
        "frames lost": steps[view.frames_lost > 0],
        "frames incomplete": steps[view.missing > 0],
        "inputs not reported": steps[view.assumed > 0],
    }
    for name, status in view.status.items():
        for kind, (text, _) in _LANES.items():
            found[f"{name}: {text}"] = steps[status == kind]
    for name, first in view.skipped.items():
        found[f"{name}: no time for it"] = (first - view.first_steps[:1]).astype(np.float64)
    return {name: at for name, at in found.items() if len(at)}


def plot_losses(view: Overview, axes: Axes | None = None, *, unit: TimeUnit = "s") -> Axes:
    """Draw what went wrong and when: a row of marks for each kind of incident (`incidents`), with their number.

    Raises
    ------
    ExportError
        There is no exposure, or matplotlib is missing.
    """
    need_exposures(view)
    axes, scale, found = axes_or_new(axes), view.scale(unit), incidents(view)
    colours = dict(_LANES.values())
    for place, (name, at) in enumerate(found.items()):
        shade = colours.get(name.partition(": ")[2], "0.2")
        axes.vlines(at * scale, place - 0.35, place + 0.35, color=shade, linewidth=1.0, rasterized=len(at) > 500)
    labels = [f"{name} ({len(at)})" for name, at in found.items()]
    axes.set_yticks(range(len(found)), labels)
    if not found:
        axes.text(0.5, 0.5, "nothing was lost, nothing was gated", ha="center", transform=axes.transAxes)
    end = float(view.steps[-1] + view.n_steps[-1]) * scale
    axes.set(xlabel=time_label(unit), xlim=(0, end), ylim=(max(len(found), 1) - 0.4, -0.6))
    return axes


def plot_latency(view: Overview, axes: Axes | None = None, *, unit: TimeUnit = "s") -> Axes:
    """Draw the time from the end of an exposure until each step of the loop was done, and the time of each estimate,
    ms.

    Raises
    ------
    ExportError
        The series holds no latencies, or matplotlib is missing.
    """
    need_exposures(view)
    by_frame = dict(zip(view.frame_ids.tolist(), view.steps.tolist(), strict=True))
    lines = {
        name: [(by_frame[frame], took_ms) for frame, took_ms in points if frame in by_frame]
        for name, points in view.timings.items()
    }
    known = {name: np.array(points).T for name, points in lines.items() if points}
    if not known:
        raise ExportError(f"{view.series.path} holds no latencies: it was recorded on virtual time, or imported")
    axes = axes_or_new(axes)
    for name, (at, took) in known.items():
        style = "--" if name.endswith(" takes") else "-"
        axes.plot(*thinned(at * view.scale(unit), took), style, linewidth=0.8, label=name)
    axes.set(xlabel=time_label(unit), ylabel="after the exposure's end, or taken (ms)", yscale="log")
    axes.grid(alpha=0.3)
    legend_above(axes, 3)
    return axes
