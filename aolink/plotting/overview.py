"""The data of a whole series for the figures, read in one pass: a few numbers for each exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.estimation.score import Score, Scorer
from aolink.exporting.common import Progress, check_frame, no_progress
from aolink.exposure import Exposure
from aolink.gathered import FRAME_INCIDENTS, NO_TIME, REFUSED, Blur, extremes, hides_swings, incidents_of
from aolink.numerics.arrays import FloatArray, IntArray
from aolink.numerics.rms import rms
from aolink.recording import topics
from aolink.series import NOTHING, Also, Series, Step

_COLUMNS = 1500
"""Columns of the blur over a session: a longer session has several exposures in a column."""
_POINTS = 17
"""Points of a path within its exposure."""
_NONE = -1
"""The number instead of a status where there is no estimate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Paths:
    """One output's paths over a series, by column of the blur."""

    points: FloatArray
    """Some points of each path, slope units, (columns, points); NaN where there is no path."""
    places: FloatArray
    """Positions of the points in their column, from 0 to 1, (points,)."""
    low: FloatArray
    high: FloatArray
    """``low`` and ``high`` are the limits of the path around each point, slope units, (columns, points)."""
    envelope: bool
    """Whether the path swings more than its points show."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Overview:
    """The data of a series of n exposures that `aolink.plotting` draws. Arrays by name have NaN where there is no
    estimate."""

    series: Series
    names: list[str]
    """The estimators in the order of their ranks."""
    output: int
    """Number of the output of ``blur`` and ``paths``."""
    frame_ids: IntArray
    first_steps: IntArray
    n_steps: IntArray
    moved: FloatArray
    """Motion of the spots: RMS of the path about its mean, slope units, (n,), from the truth or from the last name's
    estimates."""
    errors: dict[str, FloatArray]
    """RMS of the path minus the truth by estimator, slope units, (n,)."""
    status: dict[str, IntArray]
    """The `Status` by estimator, -1 where there is no estimate, (n,)."""
    nis: dict[str, FloatArray]
    """Mean NIS over all axes with a measurement, by estimator, for those that measure something, (n,)."""
    measurements: dict[str, int]
    """Number of measurements of an estimator for an axis."""
    scores: dict[str, Score]
    incidents: dict[str, FloatArray]
    """What went wrong: fast steps, from the first exposure on, by the kinds of `incidents_of`."""
    timings: dict[str, list[tuple[int, float]]]
    """When each step of the loop was done, after the end of its exposure, and how long estimates took: frame ids and
    ms, by name."""
    spans: FloatArray
    """First step and end of each column of the blur, from the first exposure on, (columns, 2)."""
    blur: FloatArray
    """Intensity density over the output's positions, one over slope units, (columns, pixels); NaN where a pixel never
    came."""
    paths: dict[str, Paths] = field(default_factory=dict)
    """Paths by name, which is ``truth`` or an estimator that has any."""

    def __len__(self) -> int:
        return len(self.frame_ids)

    @property
    def steps(self) -> IntArray:
        """First step of each exposure, from that of the first one on, (n,)."""
        return self.first_steps - self.first_steps[:1]

    @property
    def times_s(self) -> FloatArray:
        """Start of each exposure since the first one's, (n,)."""
        return np.asarray(self.steps * self.series.rig.timing.fast_step_s, dtype=np.float64)

    @property
    def most_blurred(self) -> int:
        """Number of the exposure in which the spots moved most; 0 where that is not known."""
        return int(np.nanargmax(self.moved)) if np.isfinite(self.moved).any() else 0


def overview(
    series: Series, estimators: Sequence[str] | None = None, *, output: int = 0, progress: Progress = no_progress,
    also: Also = NOTHING, known: Callable[[Exposure], Exposure] | None = None,
) -> Overview:  # fmt: skip
    """Read a series once, for any of the figures.

    Parameters
    ----------
    estimators:
        The estimators to draw; all by default.
    output:
        Number of the output (a row of a path) whose blur and paths are drawn.
    progress:
        Called with the number of exposures read.
    also:
        Functions that get the messages of other topics, as `aolink.series.Series.steps` takes them.
    known:
        Gives exposures with what a witness knows of them as their truth.

    Raises
    ------
    RecordingError
        There are no estimates of such a name.
    ExportError
        There is no such output, or the frames are not those of the rig's sensor.
    """
    names = by_rank(list(series.named(estimators)))
    if not 0 <= output < series.rig.n_outputs:
        raise ExportError(f"there is no output {output}: {series.path} has {series.rig.n_outputs}, counted from 0")
    gathered = _Gathered(series, names, output)
    for number, step in enumerate(series.steps(names, also=gathered.beside(also)), 1):
        check_frame(series, step.exposure)
        step.exposure = known(step.exposure) if known else step.exposure
        gathered.add(step)
        progress(number)
    return gathered.result()


def need_exposures(view: Overview) -> None:
    """Raise ExportError where there is no exposure to draw."""
    if not len(view):
        raise ExportError(f"{view.series.path} holds no exposure to draw; `aolink info` says what it holds")


class _Gathered:
    """The overview as it grows."""

    def __init__(self, series: Series, names: list[str], output: int) -> None:
        self.series, self.names, self.output = series, names, output
        self.stride = max(1, -(-len(series) // _COLUMNS))
        self.points = _POINTS if self.stride == 1 else 1
        self.facts: list[tuple[int, int, int, float]] = []
        self.of_names: list[list[tuple[float, float, float]]] = []
        """Of each exposure and estimator: status, mean NIS, error."""
        self.measurements: dict[str, int] = {}
        self.scorers = {name: Scorer() for name in names}
        self.incidents: dict[str, list[int]] = {}
        self.timings: dict[str, list[tuple[int, float]]] = {}
        self.last: Exposure | None = None
        self.column: list[Blur] = []
        self.spans: list[tuple[int, int]] = []
        self.blur: list[FloatArray] = []
        self.paths: dict[str, list[FloatArray]] = {name: [] for name in ("truth", *names)}
        """Points, low and high of each column, and whether the path swings more than its points show, (4, points)."""

    def beside(self, also: Also) -> Also:
        """``also``, with the function that takes the messages about times."""
        timed = [topics.LATENCY, *map(topics.estimation_topic, self.names)]
        return {**also, **{topic: partial(self._see, also.get(topic)) for topic in timed}}

    def _see(self, before: Callable[[str, int, Any], None] | None, topic: str, time_ns: int, message: Any) -> None:
        if before is not None:
            before(topic, time_ns, message)
        row = topics.named(topic)
        name = topic.removeprefix(row.name)
        for curve in row.curves:
            if curve.is_in(message):
                points = self.timings.setdefault(f"{name} {curve.label}".strip(), [])
                points.append((message.frame_id, curve.value(message)))

    def add(self, step: Step) -> None:
        e, estimates = step.exposure, step.estimates
        for kind, _ in incidents_of(self.last, step):
            self.incidents.setdefault(kind, []).append(e.first_step)
        self.last = e
        truth = None if e.truth is None else e.truth.path
        known = slice(None) if e.truth is None else e.truth.known
        rows = []
        for name in self.names:
            status, nis, error = float(_NONE), np.nan, np.nan
            if (estimate := estimates.get(name)) is not None:
                status = float(estimate.status)
                error = np.nan if truth is None else rms((estimate.path - truth)[known])
                self.scorers[name].add(e, estimate)
                if estimate.innovation.shape[1]:
                    self.measurements[name] = estimate.innovation.shape[1]
                    seen = estimate.nis[estimate.nis > 0]
                    nis = float(seen.mean()) if len(seen) else np.nan
            rows.append((status, nis, error))
        self.of_names.append(rows)
        last = estimates.get(self.names[-1]) if self.names else None
        path = truth if truth is not None or last is None else last.path
        moved = np.nan if path is None else rms((path - path.mean(axis=1, keepdims=True))[known])
        self.facts.append((e.frame_id, e.first_step, e.n_steps, moved))
        self.column.append(Blur.of(self.series.rig, step, self.output))
        if len(self.column) == self.stride:
            self._close_column()

    def _close_column(self) -> None:
        """Finish a column: the mean blur of its exposures, and the range of their paths."""
        if not self.column:
            return
        begin, end = self.column[0].exposure, self.column[-1].exposure
        self.spans.append((begin.first_step, end.first_step + end.n_steps))
        seen = np.stack([each.measured for each in self.column])
        counted = np.isfinite(seen).sum(axis=0)
        self.blur.append(np.where(counted > 0, np.nansum(seen, axis=0) / np.maximum(counted, 1), np.nan))
        for name, columns in self.paths.items():
            known = [each.paths[name] for each in self.column if name in each.paths]
            if not known:
                columns.append(np.full((4, self.points), np.nan))
                continue
            path = np.concatenate(known)
            path = np.resize(path, max(len(path), self.points))  # one of fewer steps than points
            some = np.linspace(0, len(path) - 1, self.points).astype(int)
            swings = np.full(self.points, hides_swings(path, self.points), dtype=np.float64)
            columns.append(np.stack([path[some], *extremes(path, self.points), swings]))
        self.column = []

    def result(self) -> Overview:
        self._close_column()
        frame_ids, first_steps, n_steps, moved = np.array(self.facts, dtype=np.float64).reshape(-1, 4).T
        of_names = np.array(self.of_names).reshape(len(self.facts), len(self.names), 3).transpose(2, 1, 0)
        status, nis, errors = (dict(zip(self.names, rows, strict=True)) for rows in of_names)
        spans = np.array(self.spans, dtype=np.float64).reshape(-1, 2)
        steps = n_steps[0] if len(n_steps) else 1
        places = np.linspace(0, (steps - 1) / steps, self.points) if self.points > 1 else np.array([0.5])
        paths = {}
        for name, columns in self.paths.items():
            points, low, high, swings = np.array(columns).reshape(-1, 4, self.points).swapaxes(0, 1)
            if np.isfinite(swings).any():
                envelope = self.stride > 1 or float(np.nanmean(swings)) > 0.5
                paths[name] = Paths(points=points, places=places, low=low, high=high, envelope=envelope)
        words = (*REFUSED.values(), NO_TIME)
        kinds = [*FRAME_INCIDENTS, *(f"{name}: {word}" for name in self.names for word in words)]
        since = first_steps[0] if len(first_steps) else 0
        return Overview(
            series=self.series, names=self.names, output=self.output, frame_ids=frame_ids.astype(np.int64),
            first_steps=first_steps.astype(np.int64), n_steps=n_steps.astype(np.int64), moved=moved,
            errors=errors if any(np.isfinite(each).any() for each in errors.values()) else {},
            status={name: values.astype(np.int64) for name, values in status.items()},
            nis={name: nis[name] for name in self.measurements}, measurements=self.measurements,
            scores={name: scorer.result() for name, scorer in self.scorers.items()},
            incidents={kind: np.array(self.incidents[kind]) - since for kind in kinds if kind in self.incidents},
            timings=self.timings, spans=spans - (spans[0, 0] if len(spans) else 0), blur=np.array(self.blur),
            paths=paths,
        )  # fmt: skip
