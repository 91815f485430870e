"""The data of a whole series for the figures, read in one pass: a few numbers for each exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.estimation.estimate import Status
from aolink.estimation.frames.measure import profiles_of
from aolink.estimation.score import Score, Scorer
from aolink.exporting.common import Progress, check_frame, no_progress
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray, IntArray
from aolink.numerics.chi_square import chi_square_quantile
from aolink.numerics.rms import rms
from aolink.optics.camera import to_density
from aolink.optics.sensor import BaseSensor, Sensor
from aolink.plotting.style import TimeUnit, extremes, hides_swings
from aolink.recording import topics
from aolink.recording.schemas_pb2 import Estimation, Latency
from aolink.series import NOTHING, Also, Series, Step

NIS_COVERAGE = 0.95
"""Probability that a consistent estimator's NIS lies inside the bounds drawn."""
_COLUMNS = 1500
"""Columns of the blur over a session: a longer session has several exposures in a column."""
_POINTS = 17
"""Points of a path within its exposure."""
_KERNELS = 4.0
"""The drawn field reaches this many of the kernel's standard deviations beyond the paths."""
LATENCY_STEPS = (
    ("first_byte_ns", "first byte"),
    ("complete_ns", "frame complete"),
    ("estimated_ns", "estimated"),
    ("command_sent_ns", "command sent"),
    ("command_acknowledged_ns", "acknowledged"),
)
"""Fields of a Latency in the order in which they happen, and their names."""
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
    missing: FloatArray
    """Share of the frame's pixels that never came, (n,)."""
    assumed: IntArray
    """Steps of each exposure whose input the mirror did not report, (n,)."""
    moved: FloatArray
    """Motion of the spots: RMS of the path about its mean, slope units, (n,), from the truth or from the last name's
    estimates."""
    apart: FloatArray
    """RMS of the last name's path minus the truth, or without a truth minus the first name's, slope units, (n,)."""
    errors: dict[str, FloatArray]
    """RMS of the path minus the truth by estimator, slope units, (n,)."""
    status: dict[str, IntArray]
    """The `Status` by estimator, -1 where there is no estimate, (n,)."""
    nis: dict[str, FloatArray]
    """NIS of the output's axis by estimator, for those that measure something, (n,)."""
    mean_nis: dict[str, FloatArray]
    """Mean NIS over all axes with a measurement, by estimator, (n,)."""
    measurements: dict[str, int]
    """Number of measurements of an estimator for an axis."""
    scores: dict[str, Score]
    skipped: dict[str, IntArray]
    """First steps of the exposures that an estimator had no time for in the session, by estimator."""
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
    def frames_lost(self) -> IntArray:
        """Frames lost between each exposure and the one before it, (n,)."""
        return np.asarray(np.maximum(np.diff(self.frame_ids, prepend=self.frame_ids[:1] - 1) - 1, 0))

    def scale(self, unit: TimeUnit) -> float:
        """The length of a fast step in a unit."""
        return self.series.rig.timing.fast_step_s if unit == "s" else 1.0

    def telling(self) -> dict[int, str]:
        """The most telling exposures, by number, each with the reason; fewer where one exposure has several reasons."""
        reasons: dict[int, str] = {}

        def tell(number: int, why: str) -> None:
            reasons[number] = f"{reasons[number]}; {why}" if number in reasons else why

        if np.isfinite(self.moved).any():
            tell(int(np.nanargmax(self.moved)), "the largest blur")
        if np.isfinite(self.apart).any():
            against = "the truth" if self.errors else f"{self.names[0]}"
            tell(int(np.nanargmax(self.apart)), f"{self.names[-1]} is furthest from {against}")
        refused = [
            (int(np.flatnonzero(bad)[0]), name)
            for name, status in self.status.items()
            if (bad := (status == Status.GATED) | (status == Status.DIVERGED)).any()
        ]
        if refused:
            number, name = min(refused)
            tell(number, f"the first that was gated, by {name}")
        if not reasons and len(self):
            tell(0, "the first")
        return reasons


def overview(
    series: Series, estimators: Sequence[str] | None = None, *, output: int = 0, progress: Progress = no_progress,
    also: Also = NOTHING,
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
        self.axis = output // series.rig.plant.n_outputs
        self.stride = max(1, -(-len(series) // _COLUMNS))
        self.facts: list[tuple[int, int, int, float, int]] = []
        self.moved: list[float] = []
        self.apart: list[float] = []
        self.errors: dict[str, list[float]] = {name: [] for name in names}
        self.status: dict[str, list[int]] = {name: [] for name in names}
        self.nis: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
        self.measurements: dict[str, int] = {}
        self.scorers = {name: Scorer() for name in names}
        self.skipped: dict[str, list[int]] = {name: [] for name in names}
        self.timings: dict[str, list[tuple[int, float]]] = {}
        self.column: list[tuple[Exposure, dict[str, FloatArray]]] = []
        self.spans: list[tuple[int, int]] = []
        self.blur: list[FloatArray] = []
        self.paths: dict[str, list[tuple[FloatArray, FloatArray, FloatArray, bool]]] = {}

    def beside(self, also: Also) -> Also:
        """``also``, with the function that takes the messages about times."""
        timed = [topics.LATENCY, *map(topics.estimation_topic, self.names)]
        return {**also, **{topic: partial(self._see, also.get(topic)) for topic in timed}}

    def _see(self, before: Callable[[Any], None] | None, recorded: Any) -> None:
        if before is not None:
            before(recorded)
        message = recorded.message
        if isinstance(message, Latency):
            for key, name in LATENCY_STEPS:
                if (done := getattr(message, key)) > 0:
                    took_ms = (done - message.exposure_end_ns) / 1e6
                    self.timings.setdefault(name, []).append((message.frame_id, took_ms))
        elif isinstance(message, Estimation) and not message.skipped:
            taken = self.timings.setdefault(f"{message.estimator} takes", [])
            taken.append((message.frame_id, message.took_ns / 1e6))

    def add(self, step: Step) -> None:
        exposure, estimates = step.exposure, step.estimates
        for name in step.skipped:
            self.skipped[name].append(exposure.first_step)
        missing = 0.0 if exposure.slopes is not None else 1 - float(np.mean(exposure.mask))
        self.facts.append((exposure.frame_id, exposure.first_step, exposure.n_steps, missing, exposure.inputs_assumed))
        truth = None if exposure.truth is None else exposure.truth.path
        known = slice(None) if exposure.truth is None else exposure.truth.known
        found = {"truth": truth} if truth is not None else {}
        for name in self.names:
            estimate = estimates.get(name)
            self.status[name].append(_NONE if estimate is None else int(estimate.status))
            nis, error = (np.nan, np.nan), np.nan
            if estimate is not None:
                error = np.nan if truth is None else rms((estimate.path - truth)[known])
                self.scorers[name].add(exposure, estimate)
                found[name] = estimate.path
                if estimate.innovation.shape[1]:
                    self.measurements[name] = estimate.innovation.shape[1]
                    seen = estimate.nis[estimate.nis > 0]
                    nis = (float(estimate.nis[self.axis]), float(seen.mean()) if len(seen) else np.nan)
            self.errors[name].append(error)
            self.nis[name].append(nis)
        last = self.names[-1] if self.names else ""
        about = truth if truth is not None else found.get(last)
        self.moved.append(np.nan if about is None else rms((about - about.mean(axis=1, keepdims=True))[known]))
        other = truth if truth is not None else found.get(self.names[0]) if len(self.names) > 1 else None
        self.apart.append(np.nan if other is None or last not in found else rms((found[last] - other)[known]))
        shown = {name: path[self.output] for name, path in found.items() if np.isfinite(path[self.output]).all()}
        self.column.append((exposure, shown))
        if len(self.column) == self.stride:
            self._close_column()

    def _close_column(self) -> None:
        """Finish a column: the mean blur of its exposures, and the range of their paths."""
        if not self.column:
            return
        exposures = [exposure for exposure, _ in self.column]
        self.spans.append((exposures[0].first_step, exposures[-1].first_step + exposures[-1].n_steps))
        seen = np.stack([profile_density(self.series.rig.sensor, each, self.output) for each in exposures])
        counted = np.isfinite(seen).sum(axis=0)
        self.blur.append(np.where(counted > 0, np.nansum(seen, axis=0) / np.maximum(counted, 1), np.nan))
        for name in ("truth", *self.names):
            known = [paths[name] for _, paths in self.column if name in paths]
            lines = self.paths.setdefault(name, [])
            count = _POINTS if self.stride == 1 else 1
            if not known:
                unknown = np.full(count, np.nan)
                lines.append((unknown, unknown, unknown, False))
                continue
            path = np.concatenate(known)
            low, high = extremes(path, count)
            if len(low) < count:  # a path of fewer steps than points
                low, high = np.resize(low, count), np.resize(high, count)
            some = np.linspace(0, len(path) - 1, count).astype(int)
            points = path[some] if count > 1 else path.mean(keepdims=True)
            lines.append((points, low, high, hides_swings(path, count)))
        self.column = []

    def result(self) -> Overview:
        self._close_column()
        facts = np.array(self.facts, dtype=np.float64).reshape(-1, 5)
        frame_ids, first_steps, n_steps, missing, assumed = facts.T
        spans = np.array(self.spans, dtype=np.float64).reshape(-1, 2)
        count = _POINTS if self.stride == 1 else 1
        paths = {}
        for name, lines in self.paths.items():
            points, low, high = (np.array([line[k] for line in lines]) for k in range(3))
            if np.isfinite(points).any():
                swings = [line[3] for line in lines if np.isfinite(line[0]).any()]
                steps = float(n_steps[0])
                places = np.linspace(0, (steps - 1) / steps, count) if count > 1 else np.array([0.5])
                envelope = self.stride > 1 or float(np.mean(swings)) > 0.5
                paths[name] = Paths(points=points, places=places, low=low, high=high, envelope=envelope)
        truth = any(np.isfinite(each).any() for each in self.errors.values())
        nis = {name: np.array(values).reshape(-1, 2).T for name, values in self.nis.items()}
        return Overview(
            series=self.series, names=self.names, output=self.output, frame_ids=frame_ids.astype(np.int64),
            first_steps=first_steps.astype(np.int64), n_steps=n_steps.astype(np.int64), missing=missing,
            assumed=assumed.astype(np.int64), moved=np.array(self.moved), apart=np.array(self.apart),
            errors={name: np.array(values) for name, values in self.errors.items()} if truth else {},
            status={name: np.array(values, dtype=np.int64) for name, values in self.status.items()},
            nis={name: nis[name][0] for name in self.measurements},
            mean_nis={name: nis[name][1] for name in self.measurements},
            measurements=self.measurements,
            scores={name: scorer.result() for name, scorer in self.scorers.items()},
            skipped={name: np.array(steps, dtype=np.int64) for name, steps in self.skipped.items()},
            timings=self.timings,
            spans=spans - (spans[0, 0] if len(spans) else 0), blur=np.array(self.blur), paths=paths,
        )  # fmt: skip


def profile_density(sensor: BaseSensor, exposure: Exposure, output: int) -> FloatArray:
    """Intensity density over the positions of one output, one over slope units, (pixels,); NaN where a pixel never
    came."""
    found = profiles_of(sensor, exposure.pixels, exposure.mask)
    return np.where(found.mask[output], to_density(sensor.profile, found.counts[output]), np.nan)


def limits_of(line: Sensor, paths: Sequence[FloatArray]) -> tuple[float, float]:
    """The part of the field that holds the paths and their blur, slope units; the whole field where there are no
    paths."""
    known = [path for path in paths if np.isfinite(path).any()]
    if not known:
        return line.field
    reach = _KERNELS * line.kernel.sigma
    low = max(min(float(np.nanmin(path)) for path in known) - reach, line.field[0])
    high = min(max(float(np.nanmax(path)) for path in known) + reach, line.field[1])
    return (low, high) if low < high else line.field


@lru_cache(maxsize=64)
def nis_bounds(degrees_of_freedom: int) -> tuple[float, float]:
    """The bounds of a consistent estimator's NIS in `NIS_COVERAGE` of the exposures (two-sided)."""
    tail = (1 - NIS_COVERAGE) / 2
    return chi_square_quantile(tail, degrees_of_freedom), chi_square_quantile(1 - tail, degrees_of_freedom)
