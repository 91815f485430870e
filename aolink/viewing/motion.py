"""Motion of the spots: paths, states, their errors and their consistency, for the truth and every estimator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import Colour, estimator_colour
from aolink.estimation.estimate import Estimate
from aolink.exporting.summary import estimate_scalars
from aolink.exposure import Exposure, Truth, residual_rms
from aolink.numerics.arrays import FloatArray
from aolink.plotting.overview import NIS_COVERAGE, nis_bounds
from aolink.plotting.style import BAND, extremes, hides_swings
from aolink.viewing import entities
from aolink.viewing.entities import ESTIMATE, PATH, PATH_ERROR, RESIDUAL, RMS_ERROR
from aolink.viewing.palette import TRUTH
from aolink.viewing.series import Drawing, Style, send_axes, send_line
from aolink.viewing.timebase import Timebase

MOST_STATES = 8
"""Most states that are drawn: a plant with more has its first ones drawn, and all of them are in the recording."""


def log_truth(drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """Path and states of a simulated rig: ``/path/truth``, ``/state/start/xI/truth``, ``/state/end/xI/truth``."""
    known = [(e, e.truth) for e in exposures if e.truth is not None]
    if not known:
        return
    style = Style("truth", TRUTH, width=2.5)
    _send_path(drawing, f"{PATH}/truth", timebase, [(e.first_step, truth.path) for e, truth in known], style)
    frames = [e.frame_id for e, _ in known]
    starts = np.array([e.first_step for e, _ in known])
    ends = starts + [e.n_steps for e, _ in known]
    for where, at, states in (
        ("start", starts, np.array([truth.start_state for _, truth in known])),
        ("end", ends, np.array([truth.end_state for _, truth in known])),
    ):
        times = timebase.at_steps(at, frames)
        for i in range(min(states.shape[2], MOST_STATES)):
            _send_state(drawing, entities.state(where, i, "truth"), times, states[:, :, i], style)


def log_estimates(drawing: Drawing, timebase: Timebase, estimates: Sequence[Estimate]) -> None:
    """One estimator's path with its band, states with theirs, NIS with its bounds, and status.

    ``/path/NAME/mean`` and ``/band`` (lines `BAND` standard deviations up and down, of the chosen outputs), or
    ``/path/NAME/range`` for a path that swings too often for a line, with ``/band`` outside of it;
    ``/state/start/xI/NAME/mean`` and ``/band``, likewise ``/state/end/...``, ``/nis/NAME``; and ``/estimate/NAME``,
    which is not drawn: columns for programs that read the file as a table.
    """
    if not estimates:
        return
    name, chosen = estimates[0].estimator, drawing.chosen
    line = Style(name, estimator_colour(name), width=1.8)
    band = Style(f"{name} ± {BAND:g} sd", line.colour, width=1.0, alpha=150)
    outputs = list(chosen.outputs)
    means = [(e.first_step, e.path) for e in estimates]
    deviations = [BAND * e.path_sd[outputs] for e in estimates]
    _send_path(drawing, f"{PATH}/{name}", timebase, means, line, deviations, band)

    frames = [e.frame_id for e in estimates]
    starts = np.array([e.first_step for e in estimates])
    ends = starts + [e.n_steps for e in estimates]
    axes = list(chosen.axes)
    for where, at, states, covariances in (
        ("start", starts, [e.start_state for e in estimates], [e.start_covariance[axes] for e in estimates]),
        ("end", ends, [e.end_state for e in estimates], [e.end_covariance[axes] for e in estimates]),
    ):
        times = timebase.at_steps(at, frames)
        every = np.array(states)
        deviation = np.sqrt(np.diagonal(np.array(covariances), axis1=2, axis2=3))
        for i in range(min(every.shape[2], MOST_STATES)):
            path = entities.state(where, i, name)
            _send_state(drawing, entities.mean(path), times, every[:, :, i], line)
            limits = _about(every[:, axes, i], BAND * deviation[:, :, i])
            send_line(drawing, entities.band(path), times, limits, band)
    _log_nis(drawing, timebase, estimates)
    _send_table(drawing, f"{ESTIMATE}/{name}", timebase.at_steps(starts, frames), estimates)


def log_errors(
    drawing: Drawing, timebase: Timebase, estimates: Sequence[Estimate], truths: Mapping[int, Truth]
) -> None:
    """Estimate minus truth of one estimator, where the truth is known.

    ``/error/path/NAME`` at every fast step, ``/error/path_rms/NAME`` once an exposure, ``/error/end/xI/NAME``.
    """
    known = [(e, truths[e.frame_id]) for e in estimates if e.frame_id in truths]
    if not known:
        return
    name = known[0][0].estimator
    style = Style(name, estimator_colour(name))
    errors = [e.path - truth.path for e, truth in known]
    paths = [(e.first_step, error) for (e, _), error in zip(known, errors, strict=True)]
    _send_path(drawing, f"{PATH_ERROR}/{name}", timebase, paths, style)
    frames = [e.frame_id for e, _ in known]
    starts = np.array([e.first_step for e, _ in known])
    rms = [np.sqrt(np.mean(error**2, axis=1)) for error in errors]
    chosen = drawing.chosen
    times = timebase.at_steps(starts, frames)
    send_axes(drawing, f"{RMS_ERROR}/{name}", times, np.array(rms), style, chosen.outputs, chosen.labels)
    ends = timebase.at_steps(starts + [e.n_steps for e, _ in known], frames)
    ended = np.array([e.end_state - truth.end_state for e, truth in known])
    for i in range(min(ended.shape[2], MOST_STATES)):
        _send_state(drawing, entities.end_error(i, name), ends, ended[:, :, i], style)


def log_residual(
    drawing: Drawing, timebase: Timebase, name: str, exposures: Iterable[Exposure], colour: Colour,
) -> None:  # fmt: skip
    """The slopes left by a loop in each exposure, true root mean square over its fast steps and all outputs, slope
    units: ``/residual/NAME``.

    The session may be another than that of the ``timebase``; its first exposure is then where that session's is.
    NaN where the truth is not known.
    """
    left = [(each.first_step, residual_rms([each])) for each in exposures]
    if left:
        steps = timebase.first_step + np.array([step for step, _ in left]) - left[0][0]
        times, values = timebase.at_steps(steps), [rms for _, rms in left]
        send_line(drawing, f"{RESIDUAL}/{name}", times, values, Style(name, colour))


def _send_table(drawing: Drawing, path: str, times: Sequence[rr.TimeColumn], estimates: Sequence[Estimate]) -> None:
    """Columns ``status`` and ``reason``, and those of `estimate_scalars` with a number for each axis."""
    words = rr.AnyValues.columns(status=[e.status.name for e in estimates], reason=[e.reason for e in estimates])
    scalars = [estimate_scalars(e) for e in estimates]
    joined = {name: np.concatenate([each[name] for each in scalars]) for name in scalars[0]}
    numbers = rr.AnyValues.columns(True, **joined)
    drawing.send_columns(path, times, [*words, *numbers.partition([len(e.start_state) for e in estimates])])


def _log_nis(drawing: Drawing, timebase: Timebase, estimates: Sequence[Estimate]) -> None:
    """``/nis/NAME/value`` and ``/bounds``; nothing for an estimator that measures nothing."""
    measured = [e for e in estimates if e.innovation.shape[1]]
    if not measured:
        return
    name = measured[0].estimator
    times = timebase.at_steps([e.first_step for e in measured], [e.frame_id for e in measured])
    line = Style(name, estimator_colour(name))
    values = np.array([e.nis for e in measured])
    _send_state(drawing, entities.nis_values(name), times, values, line)
    bounds = np.array([nis_bounds(e.innovation.shape[1]) for e in measured])
    # A constant is a line between its ends.
    kept = [0, *range(len(bounds) - 1, 0, -1)[:1]] if (bounds == bounds[0]).all() else list(range(len(bounds)))
    ends = timebase.at_steps([measured[k].first_step for k in kept], [measured[k].frame_id for k in kept])
    label = f"{name}, {NIS_COVERAGE:.0%} bounds"
    send_line(drawing, entities.nis_bounds(name), ends, bounds[kept], Style(label, line.colour, width=1.0, alpha=140))


def _send_path(
    drawing: Drawing, path: str, timebase: Timebase, paths: Sequence[tuple[int, FloatArray]], style: Style,
    reach: Sequence[FloatArray] = (), band: Style | None = None,
) -> None:  # fmt: skip
    """Send paths (first step, (n_outputs, n_steps)) end to end; where one does not follow at once, the line is broken.

    With a ``band`` the path is at ``path``/mean, and lines at ``reach`` from it, (outputs chosen, n_steps), at
    ``path``/band. For a path that swings more than its points would show, ``path``/range has its range.
    """
    chosen, points = drawing.chosen, drawing.points
    outputs = list(chosen.outputs)
    if path not in drawing.swinging:
        hidden = [hides_swings(one, points) for _, each in paths for one in each[outputs]] if points else [False]
        drawing.swinging[path] = float(np.mean(hidden)) > 0.5
    swings = drawing.swinging[path]
    steps: list[NDArray[np.int64]] = []
    lines: list[FloatArray] = []
    limits: list[FloatArray] = []
    after = paths[0][0]
    for (first, every), half in zip(paths, reach or [np.zeros((len(outputs), 1))] * len(paths), strict=True):
        if first > after:
            steps.append(np.array([after]))
            lines.append(np.full((1, lines[-1].shape[1]), np.nan))
            limits.append(np.full((1, limits[-1].shape[1]), np.nan))
        after = first + every.shape[1]
        places, line, outside = (_range if swings else _line)(every, half, outputs, points or every.shape[1])
        steps.append(first + places)
        lines.append(line)
        limits.append(outside)
    times, values = timebase.every_step(np.concatenate(steps)), np.concatenate(lines)
    if swings:
        labels = [f"{label}, {end}" for label in chosen.labels for end in ("highest", "lowest")]
        send_line(drawing, entities.extremes(path), times, values, replace(style, width=1.2), labels)
    else:
        send_axes(drawing, entities.mean(path) if band else path, times, values, style, outputs, chosen.labels)
    if band:
        send_line(drawing, entities.band(path), times, np.concatenate(limits), band)


def _line(
    every: FloatArray, half: FloatArray, outputs: list[int], points: int,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:  # fmt: skip
    """Some steps of a path, evenly spread: their numbers, the values, and the lines above and below them for each
    output."""
    steps = every.shape[1]
    kept = np.arange(steps) if steps <= points else np.linspace(0, steps - 1, points).astype(np.int64)
    ends = [(every[outputs] + sign * half)[:, kept].T for sign in (1, -1)]
    return kept, every[:, kept].T, np.asarray(np.stack(ends, axis=-1).reshape(len(kept), -1))


def _range(
    every: FloatArray, half: FloatArray, outputs: list[int], points: int,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:  # fmt: skip
    """The range of a path in each part of it: the parts' middles, the outputs' extremes, and those of the band."""
    parts = max(1, points // 2)
    middles = np.array([part[len(part) // 2] for part in np.array_split(np.arange(every.shape[1]), parts)])
    chosen = every[outputs]
    inside = [end for path in chosen for end in extremes(path, parts)[::-1]]
    above = [extremes(path, parts)[1] for path in chosen + half]
    below = [extremes(path, parts)[0] for path in chosen - half]
    outside = [end for pair in zip(above, below, strict=True) for end in pair]
    return middles, np.stack(inside, axis=1), np.stack(outside, axis=1)


def _about(middle: FloatArray, reach: FloatArray) -> FloatArray:
    """The values above and below each column of (rows, n), as (rows, 2 n)."""
    return np.asarray(np.stack([middle + reach, middle - reach], axis=-1).reshape(len(middle), -1))


def _send_state(drawing: Drawing, path: str, times: Sequence[rr.TimeColumn], values: FloatArray, style: Style) -> None:
    """Send a component of the states, (rows, axes)."""
    chosen = drawing.chosen
    labels = chosen.labels if len(chosen.axes) == len(chosen.labels) else ("",)
    send_axes(drawing, path, times, values, style, chosen.axes, labels)
