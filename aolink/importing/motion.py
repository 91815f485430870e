"""Fits of the motion of objects to their places in single frames: at random, bound, vibrating, with a drift or without.

All are one plant, for each object and direction: a damped rotation (x, y) with the random kicks of a process, and
beside it an offset that walks at random and drifts; a frame shows x + offset with an error. Parts that a film does not
show are left out of it.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from aolink.errors import ImportingError
from aolink.estimation.compiled.small import compiled
from aolink.numerics.arrays import FloatArray

_LAGS = range(2, 11)
"""Frames over which innovations must not be correlated. Over one they are where a frame is exposed throughout."""
_CORRELATED = 0.15
"""Correlation of innovations from which on a motion is another one than the fitted, if it is no chance."""
_SMOOTHED = (1, 5, 15)
"""Neighbouring frequencies whose mean is taken to find a vibration's: the longer it lasts, the fewer."""
_LASTS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Periods that a vibration lasts, of which the best one starts its fit."""
_SLOWEST = 4
"""Periods in a film of the slowest vibration."""


class FrameMean(NamedTuple):
    """The mean over a frame of the motion: z times ``process``, and the offset, less ``step`` of the last step."""

    process: float
    step: float


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The process that fits the objects' motion from frame to frame, by maximum likelihood; pixels and frames.

    z(k+1) = a exp(i turn) z(k) + w(k), where Var w = q in its real and in its imaginary part; offset(k+1) = offset(k) +
    velocity + Gaussian of variance ``walk``; a frame shows Re z + offset with an error of variance ``r``.
    """

    a: float
    """One: there is no z."""
    a_sd: float
    turn: float
    """Angle of a vibration in a frame; zero for an Ornstein-Uhlenbeck process."""
    turn_sd: float
    q: float
    q_sd: float
    walk: float
    walk_sd: float
    drift: float
    """Variance of the constant velocities of the objects about zero; zero: there is none."""
    drift_sd: float
    r: float
    unexplained: float
    """Largest correlation of innovations some frames apart; zero where it is small or may be by chance."""

    @property
    def variance(self) -> float:
        """The variance of Re z, pixels squared."""
        return self.q / (1 - self.a**2) if self.a < 1 else 0.0

    @property
    def frame_mean(self) -> FrameMean:
        """The mean over a frame as an output, with the covariances that `_filter` takes.

        Those of a walk's mean are those of the walk less .211 of its last step. With a process of variance s about
        zero, z g - h (last step) has those of z less q / 6 at lag zero for g h = (g^2 - 1) s / q = u, where
        u^2 (1 - q / s) - u (1 - q / 6 s) + 1 / 6 = 0. A vibration's own kicks are small beside its motion.
        """
        if self.turn and not self.walk:
            return FrameMean(1.0, 0.0)
        share = 0.0 if self.a == 1 or self.turn else self.q / self.variance
        b = 1 - share / 6
        u = (1 / 3) / (b + math.sqrt(b * b - (2 / 3) * (1 - share)))
        g = math.sqrt(1 + u * share)
        return FrameMean(g, u / g)

    @property
    def kind(self) -> str:
        """The process in words."""
        if self.a == 1:
            return "random walk"
        return "vibration" if self.turn else "Ornstein-Uhlenbeck process"


_Q, _R, _DECAY, _TURN, _WALK, _DRIFT = range(6)
"""Parameters of a fit: logarithms of variances and of a / (1 - a), and the angle."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A process whose parameters ``free`` are fitted; the others are at the values of their absence."""

    free: tuple[int, ...]
    values: FloatArray
    cost: float
    """Negative logarithm of the likelihood, with half of the Bayesian information criterion's penalty."""


def fit_motion(places: FloatArray) -> Motion:
    """Fit series of places along one direction each, (frames, series), pixels; NaN where nothing was seen.

    A random walk, an Ornstein-Uhlenbeck process, and a vibration without and with a random walk beside it are fitted,
    each without and with a drift. The Bayesian information criterion, by the same places, says which one is taken.
    Raises `ImportingError` where there are too few places.
    """
    places = np.ascontiguousarray(places, dtype=np.float64)
    count = int(np.isfinite(places).sum())
    if count < 20 or len(places) < 10:
        raise ImportingError(
            f"{count} places in {len(places)} frames are too few to fit a motion to: 20 in 10 frames or more are needed"
        )
    steps = np.diff(places, axis=0)
    step = math.log(max(float(np.nanvar(steps)), 1e-12))

    def fitted(free: tuple[int, ...], start: Sequence[float]) -> _Fit:
        at = np.array(start, dtype=np.float64)
        options: Any = {"maxiter": 300 * len(free), "fatol": 1e-3, "xatol": 1e-3}
        options["initial_simplex"] = np.vstack(
            [at, at + np.diag([_width(which, at, free, len(places)) for which in free])]
        )

        def cost(values: FloatArray) -> float:
            return _cost(places, free, values)

        found = optimize.minimize(cost, at, method="Nelder-Mead", options=options)
        return _Fit(free, found.x, float(found.fun) + len(free) * math.log(count) / 2)

    def with_drift(fit: _Fit, start: Sequence[float] | None = None) -> _Fit:
        known = np.isfinite(steps)
        means = np.where(known, steps, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        speed = math.log(max(float(np.mean(means**2)), 1e-12))
        return fitted((*fit.free, _DRIFT), [*(fit.values if start is None else start), speed])

    walk = fitted((_WALK, _R), [step, step - 2])
    bound = fitted((_Q, _R, _DECAY), [walk.values[0], walk.values[1], 3.0])
    # A drift makes the fit of a bound motion without one a walk's.
    best = min((walk, bound, with_drift(walk), with_drift(bound, [step, step - 2, 1.0])), key=lambda fit: fit.cost)
    drifts = _DRIFT in best.free
    for more in ((), (_WALK,)):
        free = (_Q, _R, _DECAY, _TURN, *more, *best.free[-1:] * drifts)
        starts = _vibrations(places, best, step, len(more))
        start = min(
            ([*one, *best.values[-1:]] if drifts else one for one in starts), key=lambda x: _cost(places, free, x)
        )
        best = min(best, fitted(free, start), key=lambda fit: fit.cost)
        drifts = _DRIFT in best.free
    if not drifts and _TURN in best.free:
        best = min(best, with_drift(best), key=lambda fit: fit.cost)
    return _motion(places, best)


def _width(which: int, at: FloatArray, free: tuple[int, ...], frames: int) -> float:
    """First step of the search along a parameter: for an angle a part of a resonance's width."""
    if which != _TURN:
        return 0.7
    return max(0.3 / (1 + math.exp(at[free.index(_DECAY)])), 0.5 / frames)


def _vibrations(places: FloatArray, best: _Fit, step: float, walks: int) -> list[list[float]]:
    """Values to start a vibration from: at the peaks of the power that the best fit without one leaves unexplained."""
    left = _innovations(places, best.free, best.values)[1]
    power = (np.abs(np.fft.rfft(np.nan_to_num(left), axis=0)) ** 2).sum(axis=1)
    starts = []
    for width in _SMOOTHED:
        smooth = np.convolve(power, np.ones(width) / width, mode="same")
        peak = _SLOWEST + int(np.argmax(smooth[_SLOWEST:-1])) if len(smooth) > _SLOWEST + 1 else len(smooth) // 2
        turn = 2 * math.pi * peak / len(places)
        variance = math.exp(step) / (2 * (1 - math.cos(turn)))
        for lasts in _LASTS:
            lost = min(turn / (2 * math.pi * lasts), 0.5)
            starts += [
                [math.log(share * variance * 2 * lost), step - 4, math.log(1 / lost - 1), turn, *[step - 2] * walks]
                for share in (1.0, 0.1)
            ]
    return starts


def _parameters(free: tuple[int, ...], values: FloatArray | Sequence[float]) -> tuple[float, ...]:
    """Decay, angle, variances of kicks, walk and drift, and of the error of a place."""
    found = dict(zip(free, values, strict=True))
    q, r, walk, drift = (math.exp(min(found[k], 50.0)) if k in found else 0.0 for k in (_Q, _R, _WALK, _DRIFT))
    a = 1 / (1 + math.exp(-found[_DECAY])) if _DECAY in found else 0.0
    return min(a, 1 - 1e-9), found.get(_TURN, 0.0), q, walk, drift, r


def _innovations(
    places: FloatArray, free: tuple[int, ...], values: FloatArray | Sequence[float]
) -> tuple[float, FloatArray]:
    """The negative logarithm of the likelihood, and the innovations in their standard deviations, as ``places``."""
    left = np.full(places.shape, np.nan)
    a, turn, q, walk, drift, r = _parameters(free, values)
    cross, less = vibration_mean(a, turn) if turn > 0 else (0.0, (1 - a * a) / 6)
    error = r - walk / 6 - less * q / (1 - a * a)
    return _filter(places, a, turn, q, walk, drift, error, cross, left), left


def vibration_mean(a: float, turn: float) -> tuple[float, float]:
    """Covariance of z's imaginary part with the mean over a frame, and what the mean's variance lacks, both over Var z.

    With z(t) = exp(l t) z(0) and kicks, the covariance of means some frames k apart is the real part of S exp(l k) for
    S = (exp(l) - 2 + exp(-l)) / l^2, but in the same frame that of 2 (exp(l) - 1 - l) / l^2. A filter whose Re z is the
    mean has Re S for the variance of z, which so becomes one.
    """
    rate = complex(math.log(max(a, 1e-9)), turn)
    apart = (2 * cmath.cosh(rate) - 2) / rate**2
    less = 2 * (cmath.sinh(rate) - rate) / rate**2
    return apart.imag / apart.real, -less.real / apart.real


def _cost(places: FloatArray, free: tuple[int, ...], values: FloatArray | Sequence[float]) -> float:
    cost = _innovations(places, free, values)[0]
    turn = dict(zip(free, values, strict=True)).get(_TURN, 1.0)
    return cost if math.isfinite(cost) and 0 < turn <= math.pi else math.inf


def _motion(places: FloatArray, fit: _Fit) -> Motion:
    """The fit's parameters with their standard deviations, and what it leaves unexplained."""
    a, turn, q, walk, drift, r = _parameters(fit.free, fit.values)
    variances = dict(zip(fit.free, _inverse_curvature(places, fit), strict=True))

    def sd(which: int, scale: float) -> float:
        return scale * math.sqrt(variances.get(which, 0.0))

    return Motion(
        a=a if _DECAY in fit.free else 1.0, a_sd=sd(_DECAY, a * (1 - a)), turn=turn, turn_sd=sd(_TURN, 1.0), q=q,
        q_sd=sd(_Q, q), walk=walk, walk_sd=sd(_WALK, walk), drift=drift, drift_sd=sd(_DRIFT, drift), r=r,
        unexplained=_correlation(_innovations(places, fit.free, fit.values)[1]),
    )  # fmt: skip


def _inverse_curvature(places: FloatArray, fit: _Fit) -> FloatArray:
    """Diagonal of the inverse Hessian, by differences: variances of maximum-likelihood estimates."""
    n = len(fit.free)
    h = np.diag([_width(k, fit.values, fit.free, len(places)) / 10 for k in fit.free])
    signs = [(a, b) for a in (1, -1) for b in (1, -1)]
    cost = [[sum(a * b * _cost(places, fit.free, fit.values + a * p + b * q) for a, b in signs) for q in h] for p in h]
    H = np.array(cost) / (4 * np.outer(np.diagonal(h), np.diagonal(h)))
    if not np.isfinite(H).all():  # an angle at the end of its range
        return np.full(n, np.nan)
    return np.asarray(np.clip(np.diagonal(np.linalg.pinv(H)), 0.0, None))


def _correlation(left: FloatArray) -> float:
    """The largest correlation of innovations that are some frames apart; zero if it is small or may be by chance."""
    count = int(np.isfinite(left).sum())
    pairs = (left[lag:] * left[:-lag] for lag in _LAGS)
    sums = [(float(np.nansum(each)), int(np.isfinite(each).sum())) for each in pairs]
    power = float(np.nanmean(left**2))
    found = max((total / n / power for total, n in sums if n and power), key=abs, default=0.0)
    return found if abs(found) > max(_CORRELATED, 4 / math.sqrt(count)) else 0.0


@compiled
def _filter(
    places: FloatArray, a: float, turn: float, q: float, walk: float, drift: float, error: float, cross: float,
    left: FloatArray,
) -> float:  # fmt: skip
    """A Kalman filter of each series, (frames, series); fills in ``left``, innovations in their standard deviations.

    The first place of each series starts the filter, whatever the process, so that likelihoods can be compared: z has
    the variance that it settles at, and the offset is unknown before.

    A frame that is exposed throughout sees a random walk's mean in it. Its steps have the covariances of a walk's whose
    places have an ``error`` of variance r - q / 6 (Berglund, Phys. Rev. E 82, 011917, 2010). The means of a vibration
    are those of a z whose parts have the covariance ``cross`` q / (1 - a^2).
    """
    frames, series = places.shape
    c, s = a * math.cos(turn), a * math.sin(turn)
    A = np.array([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    settled = q / (1 - a * a)
    both = cross * settled
    twice = 2 * turn
    noise = np.array([q + a * a * both * math.sin(twice), q - a * a * both * math.sin(twice), walk, 0.0])
    noise_both = both * (1 - a * a * math.cos(twice))
    total = 0.0
    x, P, AP, gain = np.empty(4), np.empty((4, 4)), np.empty((4, 4)), np.empty(4)
    before = np.empty(4)
    for k in range(series):
        started = False
        for t in range(frames):
            y = places[t, k]
            seen = math.isfinite(y)
            if not started:
                if seen:
                    started = True
                    x[:] = 0.0
                    x[2] = y
                    P[:] = 0.0
                    P[0, 0] = P[1, 1] = settled
                    P[0, 1] = P[1, 0] = both
                    P[0, 2] = P[2, 0] = -settled
                    P[1, 2] = P[2, 1] = -both
                    P[2, 2] = settled + error
                    P[3, 3] = drift
                continue
            for i in range(4):
                before[i] = x[i]
            for i in range(4):
                x[i] = 0.0
                for j in range(4):
                    x[i] += A[i, j] * before[j]
                    AP[i, j] = 0.0
                    for m in range(4):
                        AP[i, j] += A[i, m] * P[m, j]
            for i in range(4):
                for j in range(4):
                    P[i, j] = 0.0
                    for m in range(4):
                        P[i, j] += AP[i, m] * A[j, m]
                P[i, i] += noise[i]
            P[0, 1] += noise_both
            P[1, 0] += noise_both
            if not seen:
                continue
            S = P[0, 0] + 2 * P[0, 2] + P[2, 2] + error
            e = y - x[0] - x[2]
            for i in range(4):
                gain[i] = P[i, 0] + P[i, 2]
            for i in range(4):
                x[i] += gain[i] * e / S
                for j in range(4):
                    P[i, j] -= gain[i] * gain[j] / S
            left[t, k] = e / math.sqrt(S)
            total += (e * e / S + math.log(2 * math.pi * S)) / 2
    return total
