"""Motion of the spots: paths, states, their errors and their consistency, for the truth and every estimator."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import Colour
from aolink.estimation.estimate import Estimate
from aolink.exporting.summary import estimate_scalars
from aolink.exposure import Exposure, Truth, residual_rms
from aolink.gathered import BAND, NIS_COVERAGE, extremes, hides_swings, nis_bounds
from aolink.numerics.arrays import FloatArray
from aolink.series import Step
from aolink.viewing.camera import colour_of
from aolink.viewing.entities import END_ERROR, ESTIMATE, NIS, PATH, PATH_ERROR, RESIDUAL, RMS_ERROR, STATE, mean
from aolink.viewing.entities import band as band_of
from aolink.viewing.series import Drawing, Style, send_axes, send_line
from aolink.viewing.timebase import Timebase

MOST_STATES = 8
"""Most states that are drawn: a plant with more has its first ones drawn, and all of them are in the recording."""


def log_truth(drawing: Drawing, timebase: Timebase, steps: Sequence[Step]) -> None:
    """Path and states of a simulated rig: ``/path/truth``, ``/state/start/xI/truth``, ``/state/end/xI/truth``."""
    known = [(each.exposure, each.exposure.truth) for each in steps if each.exposure.truth is not None]
    if known:
        style = Style("truth", colour_of("truth"), width=2.5)
        _send_path(drawing, f"{PATH}/truth", timebase, [(e.first_step, truth.path) for e, truth in known], style)
        _send_states(drawing, timebase, "truth", known, style)


def log_estimates(drawing: Drawing, timebase: Timebase, name: str, steps: Sequence[Step]) -> None:
    """One estimator's path with its band, states with theirs, NIS with its bounds, and status; where the truth is
    known, their errors.

    ``/path/NAME/mean`` and ``/band`` (lines `BAND` standard deviations up and down, of the chosen outputs), or
    ``/path/NAME/range`` for a path that swings too often for a line, with ``/band`` outside of it;
    ``/state/start/xI/NAME/mean`` and ``/band``, likewise ``/state/end/...``, ``/nis/NAME``; and ``/estimate/NAME``,
    which is not drawn: columns for programs that read the file as a table. Errors are ``/error/path/NAME`` at fast
    steps, ``/error/path_rms/NAME`` once an exposure, ``/error/end/xI/NAME``.
    """
    known = [(each.exposure, each.estimates[name]) for each in steps if name in each.estimates]
    if not known:
        return
    line = Style(name, colour_of(name), width=1.8)
    band = Style(f"{name} ± {BAND:g} sd", line.colour, width=1.0, alpha=150)
    paths = [(e.first_step, estimate.path) for e, estimate in known]
    reach = [BAND * estimate.path_sd[drawing.outputs] for _, estimate in known]
    _send_path(drawing, f"{PATH}/{name}", timebase, paths, line, reach, band)
    _send_states(drawing, timebase, name, known, line, band)
    style = Style(name, line.colour)
    _log_nis(drawing, timebase, [both for both in known if both[1].innovation.shape[1]], style)
    _send_table(drawing, f"{ESTIMATE}/{name}", timebase.at_starts([e for e, _ in known]), [each for _, each in known])
    judged = [(e, estimate, e.truth) for e, estimate in known if e.truth is not None]
    if judged:
        errors = [estimate.path - truth.path for _, estimate, truth in judged]
        paths = [(e.first_step, error) for (e, _, _), error in zip(judged, errors, strict=True)]
        _send_path(drawing, f"{PATH_ERROR}/{name}", timebase, paths, style)
        exposures = [e for e, _, _ in judged]
        rms = np.array([np.sqrt(np.mean(error**2, axis=1)) for error in errors])
        times = timebase.at_starts(exposures)
        send_axes(drawing, f"{RMS_ERROR}/{name}", times, rms, style, drawing.outputs, drawing.labels)
        ended = np.array([estimate.end_state - truth.end_state for _, estimate, truth in judged])
        for i in range(min(ended.shape[2], MOST_STATES)):
            _send_axes(drawing, f"{END_ERROR}/x{i + 1}/{name}", timebase.at_ends(exposures), ended[:, :, i], style)


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


def _log_nis(drawing: Drawing, timebase: Timebase, measured: Sequence[tuple[Exposure, Estimate]], style: Style) -> None:
    """``/nis/NAME/value`` and ``/bounds``; nothing for an estimator that measures nothing."""
    if not measured:
        return
    name, exposures = style.name, [exposure for exposure, _ in measured]
    values = np.array([each.nis for _, each in measured])
    _send_axes(drawing, f"{NIS}/{name}/value", timebase.at_starts(exposures), values, style)
    bounds = np.array([nis_bounds(each.innovation.shape[1]) for _, each in measured])
    # A constant is a line between its ends.
    kept = sorted({0, len(bounds) - 1}) if (bounds == bounds[0]).all() else range(len(bounds))
    times, label = timebase.at_starts([exposures[k] for k in kept]), f"{name}, {NIS_COVERAGE:.0%} bounds"
    thin = replace(style, name=label, width=1.0, alpha=140)
    send_line(drawing, f"{NIS}/{name}/bounds", times, bounds[list(kept)], thin)


def _send_path(
    drawing: Drawing, path: str, timebase: Timebase, paths: Sequence[tuple[int, FloatArray]], style: Style,
    reach: Sequence[FloatArray] = (), band: Style | None = None,
) -> None:  # fmt: skip
    """Send paths (first step, (n_outputs, n_steps)) end to end; where one does not follow at once, the line is broken.

    With a ``band`` the path is at ``path``/mean, and lines at ``reach`` from it, (outputs chosen, n_steps), at
    ``path``/band. For a path that swings more than its points would show, ``path``/range has its range.
    """
    outputs, points = drawing.outputs, drawing.points
    if path not in drawing.swinging:
        hidden = [hides_swings(one, points) for _, each in paths for one in each[outputs]] if points else [False]
        drawing.swinging[path] = float(np.mean(hidden)) > 0.5
    swings = drawing.swinging[path]
    steps: list[NDArray[np.int64]] = []
    lines: list[FloatArray] = []
    limits: list[FloatArray] = []
    after = drawing.ends.get(path, paths[0][0])
    for (first, every), half in zip(paths, reach or [np.zeros((len(outputs), 1))] * len(paths), strict=True):
        places, line, outside = (_range if swings else _line)(every, half, outputs, points or every.shape[1])
        if first > after:
            steps.append(np.array([after]))
            for rows, own in ((lines, line), (limits, outside)):
                rows.append(np.full((1, own.shape[1]), np.nan))
        after = drawing.ends[path] = first + every.shape[1]
        steps.append(first + places)
        lines.append(line)
        limits.append(outside)
    times, values = timebase.every_step(np.concatenate(steps)), np.concatenate(lines)
    if swings:
        labels = [f"{label}, {end}" for label in drawing.labels for end in ("highest", "lowest")]
        send_line(drawing, f"{path}/range", times, values, replace(style, width=1.2), labels)
    else:
        send_axes(drawing, mean(path) if band else path, times, values, style, outputs, drawing.labels)
    if band:
        send_line(drawing, band_of(path), times, np.concatenate(limits), band)


def _line(
    every: FloatArray, half: FloatArray, outputs: list[int], points: int,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:  # fmt: skip
    """Some steps of a path, evenly spread: their numbers, the values, and the lines above and below them for each
    output."""
    kept = np.linspace(0, every.shape[1] - 1, min(points, every.shape[1])).astype(np.int64)
    return kept, every[:, kept].T, _about(every[outputs].T, half.T)[kept]


def _range(
    every: FloatArray, half: FloatArray, outputs: list[int], points: int,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:  # fmt: skip
    """The range of a path in each part of it: the parts' middles, the outputs' extremes, and those of the band."""
    parts = max(1, points // 2)
    middles = np.array([part[len(part) // 2] for part in np.array_split(np.arange(every.shape[1]), parts)])
    inside = [end for path in every[outputs] for end in extremes(path, parts)[::-1]]
    above = [extremes(path, parts)[1] for path in every[outputs] + half]
    below = [extremes(path, parts)[0] for path in every[outputs] - half]
    outside = [end for pair in zip(above, below, strict=True) for end in pair]
    return middles, np.stack(inside, axis=1), np.stack(outside, axis=1)


def _about(middle: FloatArray, reach: FloatArray) -> FloatArray:
    """The values above and below each column of (rows, n), as (rows, 2 n)."""
    return np.asarray(np.stack([middle + reach, middle - reach], axis=-1).reshape(len(middle), -1))


def _send_states(
    drawing: Drawing, timebase: Timebase, name: str, known: Sequence[tuple[Exposure, Truth | Estimate]], style: Style,
    band: Style | None = None,
) -> None:  # fmt: skip
    """Send the states at both ends, with the ``band`` of an estimator."""
    axes, exposures = drawing.axes, [exposure for exposure, _ in known]
    for where, times in (("start", timebase.at_starts(exposures)), ("end", timebase.at_ends(exposures))):
        states = np.array([getattr(each, f"{where}_state") for _, each in known])
        for i in range(min(states.shape[2], MOST_STATES)):
            path = f"{STATE}/{where}/x{i + 1}/{name}"
            _send_axes(drawing, mean(path) if band else path, times, states[:, :, i], style)
            if band:
                variance = np.array([getattr(each, f"{where}_covariance")[axes, i, i] for _, each in known])
                limits = _about(states[:, axes, i], BAND * np.sqrt(variance))
                send_line(drawing, band_of(path), times, limits, band)


def _send_axes(drawing: Drawing, path: str, times: Sequence[rr.TimeColumn], values: FloatArray, style: Style) -> None:
    """Send one number for each axis, (rows, axes)."""
    labels = drawing.labels if len(drawing.axes) == len(drawing.labels) else ("",)
    send_axes(drawing, path, times, values, style, drawing.axes, labels)
