"""Scores of estimates against the truth: RMSE, NIS, NEES; and the reasons why measurements were not used."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.verdict import Verdict
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.numerics.chi_square import chi_square_quantile


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """The mean of a normalised square, NIS or NEES, which is chi-square distributed where the covariance is right."""

    mean: float
    """NaN where there was nothing to average."""
    low: float
    high: float
    """``low`` and ``high``: 95 % bounds of a consistent estimator's mean, for independent samples."""

    @property
    def inside(self) -> bool:
        """Whether the mean is within its bounds."""
        return self.low <= self.mean <= self.high


@dataclass(frozen=True, kw_only=True)
class Unused:
    """Exposures whose measurement was not used, or not for every axis, all for the same reason."""

    exposures: int
    status: str
    """Name of the `Status` that their estimates have."""
    reason: str
    """The reason of the first of these estimates; those of the others may have other numbers in them."""
    first_frame: int
    """Frame of the first."""

    def text(self, estimated: int) -> str:
        """The count and its reason in words, for a series of ``estimated`` exposures."""
        what = self.status.lower().replace("_", " ")
        first = "" if self.exposures == 1 else ", the first"
        return f"{self.exposures} of {estimated} exposures {what}: {self.reason} (frame {self.first_frame}{first})"


class UnusedCounter:
    """Counts estimates that could not use their exposure, by status and reason."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], Unused] = {}

    def add(self, status: Status, reason: str, frame_id: int) -> None:
        """Count an estimate; one that used its exposure, or whose estimator takes no measurements, is not counted."""
        if status in (Status.OK, Status.PREDICTED):
            return
        # Reasons hold numbers, such as a NIS, that differ from frame to frame.
        key = (status.name, _NUMBER.sub("#", reason))
        first = Unused(exposures=0, status=status.name, reason=reason, first_frame=frame_id)
        before = self._found.get(key, first)
        self._found[key] = replace(before, exposures=before.exposures + 1)

    def result(self) -> tuple[Unused, ...]:
        """The counts so far, the most frequent first."""
        return tuple(sorted(self._found.values(), key=lambda each: -each.exposures))


_BEYOND_95 = 1.959964
"""Standard deviations to each side of a 95 % interval."""
_NUMBER = re.compile(r"\d+(\.\d+)?(e[+-]?\d+)?")


@dataclass(frozen=True, kw_only=True)
class Score:
    """An estimator's errors against the truth, their consistency, and how many frames gave a measurement."""

    exposures: int
    """Exposures with truth that were scored."""
    estimated: int
    """Exposures that were estimated, with truth or without."""
    measured: int
    """Estimated exposures whose frame gave a measurement, for one axis at least."""
    looks: bool
    """Whether the estimator takes measurements at all; `open-loop` does not."""
    unused: tuple[Unused, ...]
    """The reasons why measurements were not used, the most frequent first."""
    gated: int
    """Estimates whose measurement was too far from its prediction in some axis and was not used there (status GATED or
    DIVERGED); exposures without truth are counted, too."""
    start_rmse: float
    """Root mean square over exposures and axes of the norm of the error of the start state (Mishra & Wen, figure 5)."""
    end_rmse: float
    """The same error for the end state."""
    path_rmse: float
    """Root mean square error of the path, slope units."""
    coverage: float
    """Share of the path that is inside 95 % intervals."""
    nis: Consistency
    start_nees: Consistency
    end_nees: Consistency
    verdict: Verdict | None = None
    """Whether the model fits, by the last of the estimates; None where that is not judged."""

    @property
    def nothing_measured(self) -> str:
        """The reason why none of the exposures gave a measurement, in words; empty where one did or the estimator takes
        none."""
        if not self.looks or self.measured:
            return ""
        why = self.unused[0].reason if self.unused else "no reason is known"
        return f"none of {self.estimated} exposures gave a measurement: {why}"


class Scorer:
    """A score that grows exposure by exposure, in the same memory however many there are."""

    def __init__(self) -> None:
        self._exposures = self._states = 0
        self._start, self._end, self._path = RunningMean(), RunningMean(), RunningMean()
        self._coverage = RunningMean()
        self._start_nees, self._end_nees, self._nis = RunningMean(), RunningMean(), RunningMean()
        self._measurements = self._estimated = self._measured = self._gated = 0
        self._looks = False
        self._verdict: Verdict | None = None
        self._unused = UnusedCounter()

    def add(self, exposure: Exposure, estimate: Estimate) -> None:
        """Count one exposure's estimate; its errors only where the exposure has a truth."""
        self._estimated += 1
        self._gated += estimate.status in (Status.GATED, Status.DIVERGED)
        self._looks |= estimate.status != Status.PREDICTED
        self._verdict = estimate.verdict
        self._unused.add(estimate.status, estimate.reason, estimate.frame_id)
        if estimate.innovation.shape[1]:
            seen = estimate.nis > 0  # nothing was measured of the other axes
            self._measured += bool(seen.any())
            self._nis.add(estimate.nis[seen])
            self._measurements += estimate.innovation.shape[1] * int(seen.sum())
        truth = exposure.truth
        if truth is None:
            return
        self._exposures += 1
        error = (estimate.path - truth.path)[truth.known]
        self._path.add(np.mean(error**2, keepdims=True))
        self._coverage.add(np.mean(np.abs(error) <= _BEYOND_95 * estimate.path_sd[truth.known], keepdims=True))
        if estimate.end_state.shape != truth.end_state.shape:
            return  # states of another rig file's plant
        at_start, at_end = estimate.start_state - truth.start_state, estimate.end_state - truth.end_state
        known = np.isfinite(at_start).all(axis=1) & np.isfinite(at_end).all(axis=1)
        if not known.any():
            return  # the truth of a film is its path
        at_start, at_end = at_start[known], at_end[known]
        self._states += at_start.size
        self._start.add((at_start**2).sum(axis=1))
        self._end.add((at_end**2).sum(axis=1))
        self._start_nees.add(_normalised(at_start, estimate.start_covariance[known]))
        self._end_nees.add(_normalised(at_end, estimate.end_covariance[known]))

    def result(self) -> Score:
        """The score of what was added so far."""
        return Score(
            exposures=self._exposures, estimated=self._estimated, measured=self._measured, looks=self._looks,
            unused=self._unused.result(), gated=self._gated, start_rmse=math.sqrt(self._start.mean),
            end_rmse=math.sqrt(self._end.mean), path_rmse=math.sqrt(self._path.mean), coverage=self._coverage.mean,
            nis=_consistency(self._nis, self._measurements),
            start_nees=_consistency(self._start_nees, self._states),
            end_nees=_consistency(self._end_nees, self._states), verdict=self._verdict,
        )  # fmt: skip


def score(exposures: Sequence[Exposure], estimates: Sequence[Estimate], skip: int = 0) -> Score:
    """Score estimates, one for each exposure, against their truth; the first ``skip`` are left out."""
    if len(exposures) != len(estimates):
        raise ValueError(f"{len(estimates)} estimates for {len(exposures)} exposures")
    scorer = Scorer()
    for exposure, estimate in itertools.islice(zip(exposures, estimates, strict=True), skip, None):
        scorer.add(exposure, estimate)
    return scorer.result()


class RunningMean:
    """A running mean that compensates for the rounding of long sums (Kahan, in Neumaier's form)."""

    def __init__(self) -> None:
        self.count = 0
        self._total = self._lost = 0.0

    def add(self, values: FloatArray) -> None:
        value = float(values.sum())
        total = self._total + value
        large, small = (self._total, value) if abs(self._total) >= abs(value) else (value, self._total)
        self._lost += (large - total) + small
        self._total = total
        self.count += values.size

    @property
    def mean(self) -> float:
        """NaN where there was nothing to average."""
        return (self._total + self._lost) / self.count if self.count else math.nan


def _normalised(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Error' covariance^+ error for each axis, (axes,). A direction without variance counts nothing."""
    weighted = np.linalg.pinv(covariance, hermitian=True) @ error[..., None]
    return np.asarray((error * weighted[..., 0]).sum(axis=1))


def _consistency(values: RunningMean, degrees: int) -> Consistency:
    if not values.count:
        return Consistency(mean=math.nan, low=math.nan, high=math.nan)
    low, high = (chi_square_quantile(share, degrees) / values.count for share in (0.025, 0.975))
    return Consistency(mean=values.mean, low=low, high=high)


@dataclass(frozen=True)
class ScoreTable:
    """Scores as texts, for the screen, a page and the viewer."""

    heads: list[str]
    rows: dict[str, list[str]]
    """Cells by the estimator's name; "!" ends one that is outside its bounds."""
    notes: list[str]
    """Sentences below it: the bounds, and why measurements were not used."""


_MOST_REASONS = 3
"""How many reasons of one estimator are said."""


def score_table(by_name: Mapping[str, Score], only: Container[str] = ()) -> ScoreTable:
    """RMSE against truth, NIS and NEES with their 95 % bounds; without a truth NIS alone.

    Where any exposure was gated, a column says how many. ``only`` names the columns, all by default.
    """
    scores = by_name.values()
    columns: dict[str, Callable[[Score], str]] = {"NIS": lambda each: _mean(each.nis)}
    if any(each.exposures for each in scores):
        columns = {
            "RMSE start": lambda each: _rmse(each.start_rmse), "RMSE end": lambda each: _rmse(each.end_rmse),
            "RMSE path": lambda each: _rmse(each.path_rmse),
            "path in 95 %": lambda each: "-" if math.isnan(each.coverage) else f"{each.coverage:.2f}", **columns,
            "NEES start": lambda each: _mean(each.start_nees), "NEES end": lambda each: _mean(each.end_nees),
        }  # fmt: skip
    if any(each.gated for each in scores):
        columns["gated"] = lambda each: f"{each.gated} of {each.estimated}"
    columns = {name: column for name, column in columns.items() if not only or name in only}
    notes = []
    rows = {name: [column(each) for column in columns.values()] for name, each in by_name.items()}
    marked = any("!" in value for row in rows.values() for value in row)
    if bounds := _bounds(by_name):
        of_states = "RMSE start" in columns and any(math.isfinite(each.start_rmse) for each in scores)
        norm = "RMSE of states: norm over the states. " if of_states else ""
        what = "Marked !: outside the" if marked else "Inside the"
        notes += [f"{norm}{what} 95 % bounds of a consistent filter:", bounds]
    verdicts = [
        f"{name}: {each.verdict.text}" for name, each in by_name.items() if each.verdict and each.verdict.exposures
    ]
    return ScoreTable(list(columns), rows, [*notes, *unused_lines(by_name), *verdicts])


def unused_lines(by_name: Mapping[str, Score]) -> list[str]:
    """The number of exposures that each estimator could not use, and why, in words; empty where every estimator used
    all."""
    lines = []
    for name, each in by_name.items():
        lines += [f"{name}: {unused.text(each.estimated)}" for unused in each.unused[:_MOST_REASONS]]
        if (more := len(each.unused) - _MOST_REASONS) > 0:
            lines.append(f"{name}: and {more} other reasons, which --json has")
    return lines


def _rmse(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _mean(value: Consistency) -> str:
    return "-" if math.isnan(value.mean) else f"{value.mean:.2f}{'' if value.inside else ' !'}"


def _bounds(by_name: Mapping[str, Score]) -> str:
    """NEES and NIS bounds; those of NIS depend on how many moments an estimator takes."""
    nis: dict[str, list[str]] = {}
    for name, each in by_name.items():
        if not math.isnan(each.nis.mean):
            nis.setdefault(f"{each.nis.low:.2f} to {each.nis.high:.2f}", []).append(name)
    parts = [f"NIS {bounds} for {', '.join(names)}" for bounds, names in nis.items()]
    nees = next((each.end_nees for each in by_name.values() if not math.isnan(each.end_nees.mean)), None)
    if nees:
        parts.insert(0, f"NEES {nees.low:.2f} to {nees.high:.2f}")
    return "; ".join(parts)
