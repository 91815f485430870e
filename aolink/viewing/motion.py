"""Motion of the spots: paths, states, their errors and their consistency, for the truth and every estimator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import estimator_colour
from aolink.estimation.estimate import Estimate
from aolink.exporting.summary import estimate_scalars
from aolink.exposure import Exposure, Truth
from aolink.plotting.overview import NIS_COVERAGE, nis_bounds
from aolink.plotting.style import BAND
from aolink.viewing.palette import TRUTH
from aolink.viewing.series import Style, send_axes, send_line, send_states
from aolink.viewing.timebase import Timebase

FloatArray = NDArray[np.float64]


def log_truth(stream: rr.RecordingStream, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """Path and states of a simulated rig: ``/path/truth``, ``/state/start/xI/truth``, ``/state/end/xI/truth``."""
    known = [(e, e.truth) for e in exposures if e.truth is not None]
    if not known:
        return
    style = Style("truth", TRUTH, width=2.5)
    paths = [(e.first_step, truth.path) for e, truth in known]
    steps, values = _joined(paths)
    send_axes(stream, "path/truth", timebase.every_step(steps), values, style)
    frames = [e.frame_id for e, _ in known]
    starts = np.array([e.first_step for e, _ in known])
    ends = starts + [e.n_steps for e, _ in known]
    for where, at, states in (
        ("start", starts, [truth.start_state for _, truth in known]),
        ("end", ends, [truth.end_state for _, truth in known]),
    ):
        times = timebase.at_steps(at, frames)
        for i, column in enumerate(np.moveaxis(np.array(states), 2, 0)):
            send_axes(stream, f"state/{where}/x{i + 1}/truth", times, column, style)


def log_estimates(stream: rr.RecordingStream, timebase: Timebase, estimates: Sequence[Estimate]) -> None:
    """One estimator's path with its band, states with theirs, NIS with its bounds, and status.

    ``/path/NAME/mean`` and ``/band`` (two lines, `BAND` standard deviations up and down, of the first output),
    ``/state/start/xI/NAME/mean`` and ``/band``, ``/state/end/...`` alike, ``/nis/NAME``, ``/status/NAME``; and
    ``/estimate/NAME``, which is not drawn: columns for whoever reads the file as a table.
    """
    if not estimates:
        return
    name = estimates[0].estimator
    line, band = Style(name, estimator_colour(name), width=1.8), _band_style(name)
    steps, mean = _joined([(e.first_step, e.path) for e in estimates])
    _, sd = _joined([(e.first_step, e.path_sd[:1]) for e in estimates])
    times = timebase.every_step(steps)
    send_axes(stream, f"path/{name}/mean", times, mean, line)
    send_line(stream, f"path/{name}/band", times, mean[:, :1] + BAND * sd * [1.0, -1.0], band)

    frames = [e.frame_id for e in estimates]
    starts = np.array([e.first_step for e in estimates])
    ends = starts + [e.n_steps for e in estimates]
    for where, at, states, covariances in (
        ("start", starts, [e.start_state for e in estimates], [e.start_covariance[0] for e in estimates]),
        ("end", ends, [e.end_state for e in estimates], [e.end_covariance[0] for e in estimates]),
    ):
        times = timebase.at_steps(at, frames)
        deviation = np.sqrt(np.diagonal(np.array(covariances), axis1=1, axis2=2))
        for i, column in enumerate(np.moveaxis(np.array(states), 2, 0)):
            send_axes(stream, f"state/{where}/x{i + 1}/{name}/mean", times, column, line)
            limits = column[:, :1] + BAND * deviation[:, i : i + 1] * [1.0, -1.0]
            send_line(stream, f"state/{where}/x{i + 1}/{name}/band", times, limits, band)
    _log_nis(stream, timebase, estimates)
    times = timebase.at_steps(starts, frames)
    send_states(stream, f"status/{name}", times, [e.status.name for e in estimates])
    _send_table(stream, f"estimate/{name}", times, estimates)


def log_errors(
    stream: rr.RecordingStream, timebase: Timebase, estimates: Sequence[Estimate], truths: Mapping[int, Truth]
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
    steps, values = _joined([(e.first_step, error) for (e, _), error in zip(known, errors, strict=True)])
    send_axes(stream, f"error/path/{name}", timebase.every_step(steps), values, style)
    frames = [e.frame_id for e, _ in known]
    starts = np.array([e.first_step for e, _ in known])
    rms = [np.sqrt(np.mean(error**2, axis=1)) for error in errors]
    send_axes(stream, f"error/path_rms/{name}", timebase.at_steps(starts, frames), np.array(rms), style)
    ends = timebase.at_steps(starts + [e.n_steps for e, _ in known], frames)
    for i, column in enumerate(np.moveaxis(np.array([e.end_state - truth.end_state for e, truth in known]), 2, 0)):
        send_axes(stream, f"error/end/x{i + 1}/{name}", ends, column, style)


def _send_table(
    stream: rr.RecordingStream, path: str, times: Sequence[rr.TimeColumn], estimates: Sequence[Estimate]
) -> None:
    """Columns ``status`` and ``reason``, and those of `estimate_scalars` with a number for each axis."""
    words = rr.AnyValues.columns(status=[e.status.name for e in estimates], reason=[e.reason for e in estimates])
    scalars = [estimate_scalars(e) for e in estimates]
    numbers = rr.AnyValues.columns(
        True, **{name: np.concatenate([each[name] for each in scalars]) for name in scalars[0]}
    )
    stream.send_columns(path, times, [*words, *numbers.partition([len(e.start_state) for e in estimates])])


def _log_nis(stream: rr.RecordingStream, timebase: Timebase, estimates: Sequence[Estimate]) -> None:
    """``/nis/NAME/value`` and ``/bounds``; nothing for an estimator that measures nothing."""
    measured = [e for e in estimates if e.innovation.shape[1]]
    if not measured:
        return
    name = measured[0].estimator
    times = timebase.at_steps([e.first_step for e in measured], [e.frame_id for e in measured])
    send_axes(
        stream, f"nis/{name}/value", times, np.array([e.nis for e in measured]), Style(name, estimator_colour(name))
    )
    bounds = np.array([nis_bounds(e.innovation.shape[1]) for e in measured])
    label = f"{name}, {NIS_COVERAGE:.0%} bounds"
    send_line(stream, f"nis/{name}/bounds", times, bounds, Style(label, estimator_colour(name), width=1.0, alpha=140))


def _band_style(name: str) -> Style:
    return Style(f"{name} ± {BAND:g} sd", estimator_colour(name), width=1.0, alpha=150)


def _joined(paths: Sequence[tuple[int, FloatArray]]) -> tuple[NDArray[np.int64], FloatArray]:
    """Paths (first step, (n_outputs, n_steps)) end to end: steps (n,) and values (n, n_outputs).

    Where the next one does not follow at once a row of NaN breaks the line.
    """
    steps, values, after = [], [], None
    for first, path in paths:
        if after is not None and first > after:
            steps.append(np.array([after]))
            values.append(np.full((1, path.shape[0]), np.nan))
        after = first + path.shape[1]
        steps.append(np.arange(first, after))
        values.append(path.T)
    return np.concatenate(steps), np.concatenate(values)
