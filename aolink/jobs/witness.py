"""The job of `aolink report --witness`: another instrument's log of the same motion, put on a recording's clock.

A log has a time and one to three columns: positions, rates (integrated once) or accelerations (twice), in any unit and
in axes of its own. The recording's outputs are a linear map of the columns, with something slow beside it, at an offset
between the clocks and a drift of one against the other. All offsets are tried by correlation; the best is refined
by least squares. It is refused where it explains less than half of the motion, or one in a hundred logs of the same
spectrum, their phases drawn at random, does as well at the best of their offsets. What is left then serves as the truth
of the recording's exposures.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import interpolate, signal

from aolink.errors import ExportError
from aolink.exposure import Exposure, Truth
from aolink.numerics.arrays import FloatArray
from aolink.series import Series

_ORDERS = {
    **dict.fromkeys(("pixel", "pixels", "px", "nm", "um", "mm", "m", "urad", "mrad", "rad", "deg", "slope", "v"), 0),
    **dict.fromkeys(("nm/s", "um/s", "mm/s", "m/s", "urad/s", "mrad/s", "rad/s", "deg/s", "pixel/s", "pixels/s"), 1),
    **dict.fromkeys(("m/s2", "m/s^2", "mm/s2", "mm/s^2", "g", "rad/s2", "rad/s^2"), 2),
}
"""How often a column of each unit is integrated."""
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_MOST_COLUMNS = 3
_POINTS = 16
"""Points of each exposure's path that are compared."""
_SLOWEST = 3.0
"""Swings in the recording of the slowest motion that integrated columns tell."""
_LARGEST = 2**18
"""Points of the grid on which offsets are tried."""
_SURROGATES = 100
_AS_WELL = 9.0
"""Chi-square by which another offset may be worse that fits as well."""
_DRIFT = 2e-4
"""Standard deviation of the drift of two clocks."""
_LEAST_EXPLAINED = 0.5
"""Share of the motion that a witness of it explains."""
_STEPS = 12


@dataclass(frozen=True, eq=False)
class Log:
    """What a witness wrote down."""

    name: str
    times_s: FloatArray
    """By its own clock, at equal distances, (n,)."""
    columns: FloatArray
    """As positions, up to their scale, (c, n)."""
    integrated: bool


@dataclass(frozen=True, eq=False)
class Aligned:
    """A witness on a recording's clock."""

    offset_s: float
    """What is added to the witness's time, at the recording's middle, for that since the first exposure began."""
    offset_sd_s: float
    drift: float
    """By how much more the witness's clock ran slow, s in a second."""
    drift_sd: float
    axes: FloatArray
    """Slope units for one of each column, (outputs, c)."""
    explained: float
    """Share of the estimates' variance that it explains."""
    also_s: FloatArray
    """Other offsets at which it fits as well: of a motion of one frequency those whole periods away."""
    estimator: str
    log: Log
    middle_s: float
    clock: tuple[int, float]
    """First step of the first exposure, and the length of a step, s."""
    slow: tuple[FloatArray, float]
    """Coefficients of what is slow beside it (terms, outputs), and the recording's length, s."""

    def path(self, t: FloatArray) -> FloatArray:
        """The outputs at times since the first exposure began, (outputs, n); NaN beyond the log."""
        own = self._own(t)
        at = interpolate.make_interp_spline(self.log.times_s, self.log.columns, k=3, axis=1)(own)
        beyond = (own < self.log.times_s[0]) | (own > self.log.times_s[-1])
        slow = _slow(t, self.slow[1], len(self.slow[0])) @ self.slow[0]
        return np.asarray(np.where(beyond, np.nan, self.axes @ at + slow.T))

    def _own(self, t: FloatArray) -> FloatArray:
        return np.asarray(self.middle_s - self.offset_s + (t - self.middle_s) * (1 - self.drift))

    def seen(self, exposure: Exposure) -> Exposure:
        """An exposure with the witness's path as its truth; its states are not known."""
        first_step, fast_step_s = self.clock
        steps = np.arange(exposure.n_steps, dtype=np.float64) + (exposure.first_step - first_step)
        path = self.path((steps + 0.5) * fast_step_s)
        states = np.full((len(path), 1), np.nan)
        return replace(exposure, truth=Truth(start_state=states, end_state=states, path=path))

    @property
    def text(self) -> str:
        """The alignment in words."""
        whole, other = "", np.sort(np.abs(self.also_s - self.offset_s))
        if len(other):
            whole = (
                f", or one of {len(other)} others that fit as well, the nearest {other[0]:.4g} s away, as whole periods"
                " of a motion of one frequency do"
            )
        axes = "; ".join(", ".join(f"{value:.4g}" for value in row) for row in self.axes)
        return (
            f"Compared with {self.log.name}, aligned by the motion itself ({self.estimator}): its clock is"
            f" {self.offset_s:.6g} +- {self.offset_sd_s:.2g} s behind{whole}, and drifts by {1e6 * self.drift:.3g} +-"
            f" {1e6 * self.drift_sd:.2g} ppm; slope units for one of each column: {axes}. It explains"
            f" {self.explained:.1%} of the path's variance"
            + (f"; what swings less than {_SLOWEST:g} times is not compared." if self.log.integrated else ".")
        )


def read_log(path: Path) -> Log:
    """A log as CSV: a column of time first, then one to three of the motion, their units in the names, as time_s,
    gyro_x [rad/s]. Raises ExportError for what it does not understand."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first, *lines = [line for line in csv.reader(file) if line]
        values = np.array(lines, dtype=np.float64)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ExportError(f"{path} is no table of numbers under a line of names: {error}") from None
    units = [_unit(name) for name in first]
    if not 2 <= len(first) <= 1 + _MOST_COLUMNS or values.ndim != 2 or len(values) < 8:
        raise ExportError(f"{path}: give a time and one to {_MOST_COLUMNS} columns of numbers, 8 lines or more")
    if units[0] not in _TIMES:
        raise ExportError(f"{path}: the first column is {first[0]}: name it time_s, time_ms, time_us or time_ns")
    if unknown := [name for name, unit in zip(first[1:], units[1:], strict=True) if unit not in _ORDERS]:
        raise ExportError(f"{path}: the unit of {unknown[0]} is not known: name it such as x_um, x [rad/s], x [m/s^2]")
    times = values[:, 0] * _TIMES[units[0]]
    if not (np.isfinite(values).all() and (np.diff(times) > 0).all()):
        raise ExportError(f"{path}: times must grow from line to line, and all be numbers")
    even = np.linspace(times[0], times[-1], len(times))
    columns = np.array([np.interp(even, times, column) for column in values[:, 1:].T])
    orders = [_ORDERS[unit] for unit in units[1:]]
    return Log(path.name, even, _integrated(columns, orders, float(even[1] - even[0])), any(orders))


def _unit(name: str) -> str:
    match = re.fullmatch(r".*?(?:[\[(]([^\])]+)[\])]|_([^_\s]+))\s*", name.strip())
    return "" if match is None else (match[1] or match[2]).strip().lower()


def _integrated(columns: FloatArray, orders: Sequence[int], step_s: float) -> FloatArray:
    """Columns as positions, by the trapezium rule, each time without its mean."""
    out = []
    for column, order in zip(columns, orders, strict=True):
        one = column - column.mean()
        for _ in range(order):
            one = np.concatenate([[0.0], np.cumsum((one[1:] + one[:-1]) / 2)]) * step_s
            one -= one.mean()
        out.append(one)
    return np.array(out)


def _slow(t: FloatArray, length: float, count: int) -> FloatArray:
    """Cosines from a constant on, (n, count)."""
    return np.asarray(np.cos(np.pi * np.arange(count) * t[:, None] / length))


def align(recording: Series, log: Log, estimator: str | None = None) -> Aligned:
    """Find the clock, scale and axes of a witness by the paths that an estimator found.

    Raises ExportError where there are no estimates, or chance aligns other motions as well.
    """
    names = recording.estimators
    if not names:
        raise ExportError(f"{recording.path} holds no estimates: `aolink estimate` makes them")
    name = estimator or names[-1]
    times, paths, first = list[FloatArray](), list[FloatArray](), None
    for step in recording.steps([name]):
        if (estimate := step.estimates.get(name)) is None:
            continue
        first = step.exposure.first_step if first is None else first
        some = np.unique(np.linspace(0, estimate.path.shape[1] - 1, _POINTS).astype(int))
        times.append((step.exposure.first_step - first + some + 0.5) * recording.rig.timing.fast_step_s)
        paths.append(estimate.path[:, some])
    if len(times) < 8:
        raise ExportError(f"{recording.path} has {len(times)} estimates of {name}: 8 are needed to align a witness")
    clock = (first or 0, recording.rig.timing.fast_step_s)
    return aligned(np.concatenate(times), np.concatenate(paths, axis=1), len(times), log, clock, name)


def aligned(
    t: FloatArray, p: FloatArray, exposures: int, log: Log, clock: tuple[int, float] = (0, 1.0), name: str = ""
) -> Aligned:
    """Align a log with paths (outputs, n) at times since the first exposure began; see `align`."""
    length = float(t[-1])
    if length > log.times_s[-1] - log.times_s[0]:
        raise ExportError(f"{log.name} is shorter than the recording: it must hold all of it")
    count = 1 + (math.ceil(2 * _SLOWEST) if log.integrated else 0)
    slow = _slow(t, length, count)
    moved = p - (slow @ np.linalg.lstsq(slow, p.T, rcond=None)[0]).T
    columns = _without_slow(log, length) if log.integrated else log.columns
    coarse = _Coarse(t, moved, log.times_s, columns)
    shares, rng = coarse.explained(columns), np.random.default_rng(0)
    best = int(shares.argmax())
    top = float(shares[best])
    others = [float(coarse.explained(_phases_drawn(columns, rng)).max()) for _ in range(_SURROGATES)]
    # As many degrees of freedom as exposures: an estimator's errors last one.
    worse = exposures * len(p) * np.log((1 - shares) / (1 - min(top, 1 - 1e-9)))
    peaks = np.flatnonzero((shares >= np.roll(shares, 1)) & (shares >= np.roll(shares, -1)) & (worse < _AS_WELL))
    # Of a motion of one frequency a random log of the same spectrum does as well, and so do other offsets.
    if max(others) >= top and len(peaks) < 2:
        raise ExportError(
            f"{log.name} does not show the motion of this recording: at the best offset it explains {top:.0%}, and one"
            f" in a hundred random logs does as well. {_frequencies(t, moved, log.times_s, columns)}"
        )
    also = -coarse.grid[peaks[peaks != best]]
    found = _refined(replace(log, columns=columns), t, p, count, float(coarse.grid[best]), exposures)
    if found.explained < _LEAST_EXPLAINED:
        raise ExportError(
            f"{log.name} explains {found.explained:.0%} of the motion of this recording, and {_LEAST_EXPLAINED:.0%} are"
            " needed to trust its offset: integrals of noisy rates or accelerations explain little."
            f" {_frequencies(t, moved, log.times_s, columns)}"
        )
    return replace(found, also_s=also + found.offset_s + float(coarse.grid[best]), clock=clock, estimator=name)


def _frequencies(t: FloatArray, moved: FloatArray, own: FloatArray, columns: FloatArray) -> str:
    """Frequencies at which both move most, in words, as of two runs of one thing."""
    step = float(own[1] - own[0])
    hz = np.arange(1, 0.5 / max(step, float(np.diff(t).min())), 0.5 / t[-1])
    recorded = sum(abs(np.exp(-2j * np.pi * hz[:, None] * t) @ row) ** 2 for row in moved)
    said, spectrum = signal.periodogram(columns, 1 / step, "hann", nfft=4 * columns.shape[1])
    logged = said[int(spectrum.sum(axis=0).argmax())]
    reach = 1 / t[-1]
    return (
        f"If it is another run of the same thing, compare frequencies: the recording moves most at"
        f" {hz[int(np.argmax(recorded))]:.5g} Hz, the log at {logged:.5g} Hz, told to some {reach:.2g} Hz"
    )


def _without_slow(log: Log, length: float) -> FloatArray:
    """Columns without what swings less often than tells anything, as a drift of the integrals."""
    spectrum = np.fft.rfft(log.columns, axis=1)
    spectrum[:, np.fft.rfftfreq(log.columns.shape[1], log.times_s[1] - log.times_s[0]) < _SLOWEST / length] = 0
    return np.asarray(np.fft.irfft(spectrum, log.columns.shape[1], axis=1))


def _phases_drawn(columns: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Columns of the same spectra."""
    spectrum = np.fft.rfft(columns, axis=1)
    turned = spectrum * np.exp(2j * np.pi * rng.random(spectrum.shape[1]))
    turned[:, 0] = spectrum[:, 0]
    return np.asarray(np.fft.irfft(turned, columns.shape[1], axis=1))


class _Coarse:
    """All offsets at once, on a grid of time."""

    def __init__(self, t: FloatArray, moved: FloatArray, own: FloatArray, columns: FloatArray) -> None:
        self.step = max(float(own[1] - own[0]), float(t[-1] + own[-1] - own[0]) / _LARGEST)
        at = np.rint(t / self.step).astype(int)
        self.own = own
        self.grid = np.arange(own[0], own[-1], self.step)
        self.n = int(2 ** math.ceil(math.log2(len(self.grid) + at[-1] + 1)))
        sums = np.zeros((1 + len(moved), self.n))
        np.add.at(sums[0], at, 1.0)
        for row, values in zip(sums[1:], moved, strict=True):
            np.add.at(row, at, values)
        self.counted, self.total, self.reach = float(len(t)), float((moved**2).sum()), int(at[-1])
        self.seen = np.conj(np.fft.rfft(sums, axis=1))

    def explained(self, columns: FloatArray) -> FloatArray:
        """Share that columns explain at each offset where the log holds all of the recording, (offsets,)."""
        w = np.array([np.interp(self.grid, self.own, each / (each.std() or 1.0)) for each in columns])
        c = len(w)
        pairs = [(i, j) for i in range(c) for j in range(i, c)]
        ours = np.fft.rfft(np.array([*w, *(w[i] * w[j] for i, j in pairs)]), self.n, axis=1)
        keep = max(1, len(self.grid) - self.reach)
        counts = np.fft.irfft(ours * self.seen[0], self.n, axis=1)[:, :keep]
        products = np.fft.irfft(ours[:c, None] * self.seen[None, 1:], self.n, axis=2)[..., :keep]  # (c, outputs, o)
        N = np.empty((keep, c, c))
        for k, (i, j) in enumerate(pairs):
            N[:, i, j] = N[:, j, i] = counts[c + k] - counts[i] * counts[j] / self.counted
        y = products.transpose(2, 0, 1)
        size = np.einsum("oii->o", N)[:, None, None] + 1e-300
        x = np.linalg.solve(N + 1e-9 * size * np.eye(c), y)
        return np.asarray((x * y).sum(axis=(1, 2)) / self.total)


def _refined(log: Log, t: FloatArray, p: FloatArray, count: int, shift: float, exposures: int) -> Aligned:
    """Offset, drift, axes and what is slow by least squares, from the log's time at the recording's begin."""
    length = float(t[-1])
    middle, slow = length / 2, _slow(t, length, count)
    spline = interpolate.make_interp_spline(log.times_s, log.columns, k=3, axis=1)
    slope = spline.derivative()
    behind, drift, c = -shift, 0.0, len(log.columns)
    for last in range(_STEPS):
        own = np.clip(middle - behind + (t - middle) * (1 - drift), log.times_s[0], log.times_s[-1])
        A = np.concatenate([spline(own).T, slow], axis=1)
        x = np.linalg.lstsq(A, p.T, rcond=None)[0]
        left = p - (A @ x).T
        moved = -(x[:c].T @ slope(own))  # by a later offset, (outputs, n)
        # The other unknowns' part is taken out: what remains is the slope along offset and drift.
        J = np.stack([moved, moved * (t - middle)])
        J = J - np.einsum("nk,jok->jon", A, np.einsum("kn,jon->jok", np.linalg.pinv(A), J))
        J = J.reshape(2, -1)
        # An estimator's errors last an exposure: those of one count together, of several apart.
        noise = float((left**2).mean())
        inverse = np.linalg.inv(J @ J.T / noise + np.diag([0.0, _DRIFT**-2]))
        pulls = (J * left.ravel() / noise).reshape(2, len(p), exposures, -1).sum(axis=(1, 3))
        covariance = inverse @ (pulls @ pulls.T + np.diag([0.0, _DRIFT**-2])) @ inverse
        step = inverse @ (J @ left.ravel() / noise - np.array([0.0, drift * _DRIFT**-2]))
        if last < _STEPS - 1:
            behind, drift = behind + float(step[0]), drift + float(step[1])
    sd = np.sqrt(np.diag(covariance))
    whole = p - (slow @ np.linalg.lstsq(slow, p.T, rcond=None)[0]).T
    return Aligned(
        offset_s=behind, offset_sd_s=float(sd[0]), drift=drift, drift_sd=float(sd[1]), axes=x[:c].T,
        explained=1 - float((left**2).sum() / (whole**2).sum()), also_s=np.zeros(0), estimator="", log=log,
        middle_s=middle, clock=(0, 1.0), slow=(x[c:], length),
    )  # fmt: skip
