"""Vibrations by one likelihood of what each exposure shows: the mean of the path in it, and its covariance about that.

A line p(t) = Re[a exp(i w t)], a complex for x and y (an ellipse with phase), gives an exposure of length T about t

    mean        s(f) Re[a exp(i w t)],                                              s(f) = sin(pi f T) / (pi f T)
    covariance  Re[a a*]/2 + s(2f) Re[a a' exp(2 i w t)]/2 - mean mean' + constant

The constant is what is not known of the kernel, or of the reference. The means alone cannot tell f from its aliases;
the covariance swings at 2f by s(2f)/s(f)^2 times as much, so that together they do (Mishra & Wen, Extracting Dynamics
from Blur). An amplitude may grow or decay linearly, and a slow drift of the means is free.

The likelihood is Gaussian. It is scanned over all frequencies, amplitudes profiled out of the means, and the best
minima are refined in all parameters (Levenberg and Marquardt). Sets hold the frequencies that are as likely as chance
allows. Where the means have more noise than their pixels, that of the neighbouring frequencies counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, special, stats

from aolink.numerics.arrays import ComplexArray, FloatArray
from aolink.optics.texture import turned_covariances

SLOWEST = 50
"""Frames in a cycle of the slowest vibration that is told from a drift."""
MOST_ALIASES = 10
"""Frequencies are looked for up to this many times the frame rate."""
_OVERSAMPLED = 5
"""Frequencies of the scan in the inverse of the film's length."""
_REFINED, _REFINED_BESIDE = 24, 8
"""Minima of the scan that are refined, of a first line and of one beside others."""
_HOPELESS = 0.6
"""Share of the best one's gain below which a maximum of the scan is not refined."""
_LEVEL = 0.95
_ALTERNATIVE = 15.0
"""Chi-square by which another frequency may be worse that is named beside the best: a model is never all right."""
CHANCE = 1e-3
"""Chance that noise alone has such a line."""
_AT_ONCE = 256
_PAIRS = ((0, 0), (0, 1), (1, 1))
_MOST_STEPS = 25
MOST_LINES = 3
_BAND, _FEWEST_OF_BAND = 1.5, 6
"""Bands in which the means' background is measured: the end over the begin, and the least width in inverses of the
film's length."""


@dataclass(frozen=True, eq=False)
class PathMoments:
    """What K exposures show of the path of R regions (spots, or parts of a picture) that move alike, pixels.

    Components are along a region's own two axes: a straight edge is seen across itself only. What is not known has an
    infinite variance.
    """

    times_s: FloatArray
    """Middle of each exposure, (K,)."""
    exposure_s: float
    rate_hz: float
    mean: FloatArray
    """(K, R, 2)"""
    mean_variance: FloatArray
    spread: FloatArray
    """Covariance of the path in the exposure about its mean and up to a constant: xx, xy, yy, (K, R, 3)."""
    spread_variance: FloatArray
    constant_sd: FloatArray
    """Standard deviation of the covariances' constants, which are about zero, (R, 3)."""
    axes: FloatArray
    """The regions' two axes as rows, (R, 2, 2)."""

    @property
    def span_s(self) -> float:
        """From the first exposure to the last."""
        return float(self.times_s[-1] - self.times_s[0]) or 1.0 / self.rate_hz

    def together(self) -> PathMoments:
        """Regions that have the same axes and one motion, as one."""
        mean, variance = _weighted(self.mean - _offset(self.mean, self.mean_variance), self.mean_variance)
        spread, of_spread = _weighted(self.spread - _offset(self.spread, self.spread_variance), self.spread_variance)
        return replace(
            self, mean=mean, mean_variance=variance, spread=spread + self.spread_offset, spread_variance=of_spread,
            axes=self.axes[:1], constant_sd=self.constant_sd[:1],
        )  # fmt: skip

    @property
    def spread_offset(self) -> FloatArray:
        """Mean over the film of the regions' covariances, (1, 1, 3)."""
        return np.asarray(_offset(self.spread, self.spread_variance).mean(axis=1, keepdims=True))

    def part(self, regions: Sequence[int]) -> PathMoments:
        """Of some regions."""
        chosen = list(regions)
        named = ("mean", "mean_variance", "spread", "spread_variance")
        own = {name: getattr(self, name)[chosen] for name in ("axes", "constant_sd")}
        return replace(self, **own, **{name: getattr(self, name)[:, chosen] for name in named})


def _offset(values: FloatArray, variance: FloatArray) -> FloatArray:
    """Means over the film, (1, R, n)."""
    weight = np.where(np.isfinite(variance), 1 / variance, 0.0)
    return np.asarray((weight * values).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300))[None]


def _weighted(values: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over the regions and their variances, (K, 1, n)."""
    weight = np.where(np.isfinite(variance), 1 / variance, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        return (weight * values).sum(axis=1, keepdims=True) / np.maximum(total, 1e-300), 1 / total


@dataclass(frozen=True, eq=False)
class Line:
    """One vibration."""

    hz: float
    amplitude: ComplexArray
    """a at the film's middle, pixels, (2,)."""
    growth: float = 0.0
    """Share by which it grows until the film's end."""

    def at(self, tau: FloatArray) -> ComplexArray:
        """a at places from -1, the film's begin, to 1, (n, 2)."""
        return np.asarray((1 + self.growth * tau)[:, None] * self.amplitude)

    @property
    def ellipse(self) -> tuple[float, float, float]:
        """Semi-axes, pixels, the longer first, and the angle of that one from x towards y, rad, in (-pi/2, pi/2]."""
        a = self.amplitude
        values, vectors = np.linalg.eigh(np.outer(a, a.conj()).real)
        angle = math.atan2(vectors[1, 1], vectors[0, 1])
        angle -= math.pi * round(angle / math.pi)
        return math.sqrt(max(values[1], 0.0)), math.sqrt(max(values[0], 0.0)), angle


@dataclass(frozen=True)
class Part:
    """An interval of frequencies of a set, Hz."""

    low: float
    best: float
    high: float


@dataclass(frozen=True, eq=False)
class Found:
    """The lines of a film, and how well they explain it."""

    lines: tuple[Line, ...]
    sets: tuple[tuple[Part, ...], ...]
    """Of each line the frequencies that explain the film as well, the best one first."""
    mean_misfit: float
    """Mean square of what is left of the means, over their noise."""
    spread_misfit: float
    constant: FloatArray
    """The covariances' unknown constants, (R, 3)."""
    residual: FloatArray
    """What is left of the means after lines and drift, (K, R, 2)."""
    drift: FloatArray
    """(K, R, 2)"""


@dataclass(frozen=True, eq=False)
class Refined:
    """A minimum of the misfit."""

    value: float
    lines: tuple[Line, ...]
    hz_variance: float
    """Of the last line's frequency."""

    def __lt__(self, other: Refined) -> bool:
        return self.value < other.value


class Vibration:
    """The likelihood of lines in a film."""

    def __init__(self, seen: PathMoments, slowest: int = SLOWEST) -> None:
        self.seen, self.slowest_hz = seen, seen.rate_hz / slowest
        K = len(seen.times_s)
        self.middle_s, self.half_s = float(seen.times_s.mean()), seen.span_s / 2
        self.t = seen.times_s - self.middle_s
        self.tau = self.t / self.half_s
        count = 2 + 2 * K // slowest
        # Cosines slower than any vibration: a drift.
        self.slow = np.cos(np.pi * np.arange(count) * ((self.tau + 1) / 2)[:, None])
        self.w_mean = np.where(np.isfinite(seen.mean_variance), 1 / seen.mean_variance, 0.0)
        self.w_spread = np.where(np.isfinite(seen.spread_variance), 1 / seen.spread_variance, 0.0)
        self.y = np.where(self.w_mean > 0, seen.mean, 0.0)
        self.S = np.where(self.w_spread > 0, seen.spread, 0.0)
        R = self.y.shape[1]
        # Q of the drift's weighted columns, for each component: what is orthogonal to them is left.
        self._root = np.sqrt(self.w_mean)
        self._drift = np.empty((R, 2, K, count))
        for r in range(R):
            for d in range(2):
                q, upper = np.linalg.qr(self._root[:, r, d, None] * self.slow)
                known = np.abs(np.diag(upper)) > 1e-9 * max(np.abs(np.diag(upper)).max(), 1e-300)
                self._drift[r, d] = q * known
        self._turn = [turned_covariances(each) for each in seen.axes]
        self.w_constant = np.where(np.isfinite(seen.constant_sd), seen.constant_sd**-2.0, 0.0)
        # Directions in which a region is seen at all, orthonormal rows (k, 2): an edge is seen across itself.
        known = np.concatenate([seen.axes[r, self._root[:, r].any(axis=0)] for r in range(R)])
        _, sizes, rows = np.linalg.svd(known, full_matrices=False)
        self.seen_along = rows[sizes > 1e-6 * sizes.max()]
        self.hz = np.arange(self.slowest_hz, MOST_ALIASES * seen.rate_hz, 1 / (_OVERSAMPLED * seen.span_s))

    def _without_drift(self, weighted: FloatArray) -> FloatArray:
        """Weighted means (..., K, R, 2) without what a drift explains."""
        inside = np.einsum("rdkc,...krd->...rdc", self._drift, weighted)
        return np.asarray(weighted - np.einsum("rdkc,...rdc->...krd", self._drift, inside))

    def _s(self, hz: FloatArray) -> FloatArray:
        return np.asarray(np.sinc(hz * self.seen.exposure_s))

    def linear(self, hz: FloatArray, white: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Amplitudes of the means at some frequencies, s a, (F, 2), and the chi-square that each takes away, (F,)."""
        turn = np.exp(2j * np.pi * hz[:, None] * self.t)
        basis = np.stack([turn.real, -turn.imag], axis=1)  # (F, 2, K)
        normal, right = np.zeros((len(hz), 2, 2, 2, 2)), np.zeros((len(hz), 2, 2))
        for r, d in np.argwhere(self._root.any(axis=0)):
            weighted, q = basis * self._root[:, r, d], self.seen.axes[r, d]
            inside = weighted @ self._drift[r, d]
            gram = weighted @ weighted.swapaxes(1, 2) - inside @ inside.swapaxes(1, 2)
            normal += q[:, None, None, None] * q[None, None, :, None] * gram[:, None, :, None, :]
            right += q[:, None] * (weighted @ white[:, r, d])[:, None]
        square, pulls = normal.reshape(-1, 4, 4), right.reshape(-1, 4)
        size = np.einsum("fii->f", square)[:, None, None] + 1e-300
        x = np.linalg.solve(square + 1e-9 * size * np.eye(4), pulls[..., None])[..., 0]
        parts = x.reshape(-1, 2, 2)
        a = parts[..., 0] + 1j * parts[..., 1]
        return a @ self.seen_along.T @ self.seen_along, np.einsum("fi,fi->f", x, pulls)

    def path_mean(self, lines: Sequence[Line]) -> FloatArray:
        """The mean in each exposure, along x and y, (K, 2)."""
        out = np.zeros((len(self.t), 2))
        for line in lines:
            turned = line.at(self.tau) * np.exp(2j * np.pi * line.hz * self.t)[:, None]
            out += float(self._s(np.array(line.hz))) * turned.real
        return out

    def path_spread(self, lines: Sequence[Line], mean: FloatArray) -> FloatArray:
        """Covariance in each exposure, xx, xy and yy, (K, 3)."""
        turned = [
            (hz, a)
            for line in lines
            for half in [line.at(self.tau) / 2]
            for hz, a in ((line.hz, half), (-line.hz, half.conj()))
        ]
        out = -np.stack([mean[:, i] * mean[:, j] for i, j in _PAIRS], axis=1)
        for k, (hz, a) in enumerate(turned):
            for other, b in turned[: k + 1]:
                both = hz + other
                phase = np.exp(2j * np.pi * both * self.t) * float(np.sinc(both * self.seen.exposure_s))
                twice = 1.0 if other == hz and b is a else 2.0
                for n, (i, j) in enumerate(_PAIRS):
                    product = (a[:, i] * b[:, j] + a[:, j] * b[:, i]) / 2
                    out[:, n] += twice * (product * phase).real
        return out

    def in_regions(self, mean: FloatArray) -> FloatArray:
        """Means along x and y (K, 2) along the regions' axes, (K, R, 2)."""
        return np.asarray(np.moveaxis(mean @ self.seen.axes.swapaxes(1, 2), 0, 1))

    def spread_in_regions(self, spread: FloatArray) -> FloatArray:
        """Covariances (..., K, 3) along the regions' axes, (..., K, R, 3)."""
        return np.stack([spread @ each.T for each in self._turn], axis=-2)

    def residuals(self, lines: Sequence[Line]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of means (drift taken out), covariances (constant taken out) and that constant, in their standard deviations,
        (K, R, 2), (K, R, 3) and (R, 3)."""
        mean = self.path_mean(lines)
        left = self._without_drift(self._root * (self.y - self.in_regions(mean)))
        off = self.S - self.spread_in_regions(self.path_spread(lines, mean))
        constant = self._constant(off)
        off = np.sqrt(self.w_spread) * (off - constant)
        return left, off, np.sqrt(self.w_constant) * constant

    def scan(self, before: Sequence[Line]) -> tuple[FloatArray, FloatArray, FloatArray, list[Line]]:
        """Chi-square of means, of covariances, and of their constants at each frequency of the scan with one more line,
        (F,) each, and that line."""
        m = self.path_mean(before)
        white = self._without_drift(self._root * (self.y - self.in_regions(m)))
        whole = float((white**2).sum())
        means, spreads, constants = (list[FloatArray]() for _ in range(3))
        lines = list[Line]()
        limit = 0.02
        for first in range(0, len(self.hz), _AT_ONCE):
            hz = self.hz[first : first + _AT_ONCE]
            a, gain = self.linear(hz, white)
            s = self._s(hz)
            a = a / np.where(np.abs(s) > limit, s, limit * np.where(s < 0, -1, 1))[:, None]
            means.append(whole - gain)
            for values, each in zip((spreads, constants), self._spreads(hz, a, before, m), strict=True):
                values.append(each)
            lines += [Line(float(f), each) for f, each in zip(hz, a, strict=True)]
        return np.concatenate(means), np.concatenate(spreads), np.concatenate(constants), lines

    def _spreads(
        self, hz: FloatArray, a: ComplexArray, before: Sequence[Line], mean: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Chi-square of the covariances and of their constants with a line of each frequency beside those before, (F,)
        each."""
        turn = np.exp(2j * np.pi * hz[:, None] * self.t)
        m = [self._s(hz)[:, None] * (a[:, d, None] * turn).real + mean[:, d] for d in range(2)]
        twice = self._s(2 * hz)[:, None] * turn**2
        old = self.path_spread(before, mean) + np.stack([mean[:, i] * mean[:, j] for i, j in _PAIRS], axis=1)
        beats = []
        for line in before:
            b = line.at(self.tau)
            for hz_of, other in ((line.hz, b), (-line.hz, b.conj())):
                phase = self._s(hz + hz_of)[:, None] * turn * np.exp(2j * np.pi * hz_of * self.t)
                beats.append((phase, other))
        spread = np.empty((len(hz), len(self.t), 3))
        for n, (i, j) in enumerate(_PAIRS):
            one = 0.5 * (a[:, i] * a[:, j].conj()).real[:, None] + 0.5 * ((a[:, i] * a[:, j])[:, None] * twice).real
            for phase, other in beats:
                one = one + 0.5 * ((a[:, i, None] * other[:, j] + a[:, j, None] * other[:, i]) * phase).real
            spread[..., n] = one + old[:, n] - m[i] * m[j]
        off = self.S - self.spread_in_regions(spread)
        constant = self._constant(off)
        left = (self.w_spread * (off - constant[:, None]) ** 2).sum(axis=(1, 2, 3))
        return left, (self.w_constant * constant**2).sum(axis=(1, 2))

    def _constant(self, off: FloatArray) -> FloatArray:
        """The likeliest constants of covariances (..., K, R, 3), (..., R, 3)."""
        weight = self.w_spread.sum(axis=0) + self.w_constant
        return np.asarray((self.w_spread * off).sum(axis=-3) / np.maximum(weight, 1e-300))

    def refined(self, lines: Sequence[Line], scale: tuple[float, float]) -> Refined:
        """The nearest minimum in all parameters of all lines."""
        unit = max(float(np.abs(np.concatenate([each.amplitude for each in lines])).max()), 1e-3)
        size = 2 + 2 * len(self.seen_along)
        finest = 1 / (2 * np.pi * self.half_s)

        def unpacked(x: FloatArray) -> tuple[Line, ...]:
            return tuple(self._unpacked(part, finest, unit) for part in x.reshape(-1, size))

        def misfit(x: FloatArray) -> FloatArray:
            left, off, constant = self.residuals(unpacked(x))
            scaled = left.ravel() / math.sqrt(scale[0]), off.ravel() / math.sqrt(scale[1])
            return np.concatenate([*scaled, constant.ravel()])

        start = np.concatenate([self._packed(each, finest, unit) for each in lines])
        done = optimize.least_squares(misfit, start, xtol=1e-7, ftol=1e-6, x_scale="jac", max_nfev=_MOST_STEPS)
        slopes = np.asarray(done.jac)
        covariance = np.linalg.pinv(slopes.T @ slopes)
        return Refined(2 * float(done.cost), unpacked(done.x), float(covariance[-size, -size]) * finest**2)

    def _packed(self, line: Line, finest: float, unit: float) -> FloatArray:
        a = self.seen_along @ line.amplitude / unit
        return np.array([line.hz / finest, *a.real, *a.imag, line.growth])

    def _unpacked(self, x: FloatArray, finest: float, unit: float) -> Line:
        real, imaginary = x[1:-1].reshape(2, -1)
        return Line(float(x[0] * finest), (real + 1j * imaginary) @ self.seen_along * unit, float(x[-1]))

    def chi_squares(self, lines: Sequence[Line]) -> tuple[float, float, float]:
        """Of means, of covariances, and of their constants."""
        return tuple(float((each**2).sum()) for each in self.residuals(lines))  # type: ignore[return-value]

    def value(self, lines: Sequence[Line], scale: tuple[float, float]) -> float:
        """Chi-square over the noise's scale."""
        return sum(each / of for each, of in zip(self.chi_squares(lines), (*scale, 1.0), strict=True))

    def pieces(self, refined: Sequence[Refined], scale: tuple[float, float]) -> tuple[Part, ...]:
        """The frequencies of the last line that explain the film nearly as well as the best, which comes first, from
        refined minima."""
        least = min(each.value for each in refined)
        worst = max(1.0, *(a / b for a, b in zip(self.misfits(min(refined).lines), scale, strict=True)))
        allowed = float(special.gammainccinv(0.5, 1 - _LEVEL) * 2)
        found: list[Part] = []
        for each in sorted(refined):
            more = (each.value - least) / worst
            if more > _ALTERNATIVE:
                break
            hz, sd = each.lines[-1].hz, math.sqrt(max(each.hz_variance * worst, 0.0))
            reach = sd * math.sqrt(max(allowed - more, 0.25 * allowed))
            if hz > 0 and not any(one.low <= hz <= one.high for one in found):
                found.append(Part(hz - reach, hz, hz + reach))
        return tuple(found)

    def misfits(self, lines: Sequence[Line]) -> tuple[float, float]:
        """Chi-squares over their degrees of freedom."""
        means, spreads, _ = self.chi_squares(lines)
        known = (self.w_mean > 0).any(axis=0)
        free = int((self.w_mean > 0).sum()) - int(known.sum()) * self.slow.shape[1] - 3 * len(lines)
        others = int((self.w_spread > 0).sum()) - int((self.w_spread > 0).any(axis=0).sum()) - 3 * len(lines)
        return means / max(free, 1), spreads / max(others, 1)

    def scale(self, lines: Sequence[Line]) -> tuple[float, float]:
        """How many times larger than by the pixels' noise is what lines leave of the means about the last one's
        frequency, and of the covariances; at least one each."""
        band = self.hz[self.hz <= self.seen.rate_hz / 2]
        own = self.in_regions(self.path_mean(lines))
        _, gain = self.linear(band, self._without_drift(self._root * (self.y - own)))
        return float(self.background(gain, np.array([lines[-1].hz]))[0]), max(1.0, self.misfits(lines)[1])

    def background(self, gain: FloatArray, at: FloatArray) -> FloatArray:
        """How many times larger than by the pixels' noise the means' chi-square gain is about frequencies, from that at
        those of the scan below half the rate: its median in a band about the alias there, at least one."""
        rate, known = self.seen.rate_hz, self._root.any(axis=0)
        degrees = 2 * int(np.linalg.matrix_rank(self.seen.axes[known]))
        alias = self._alias(at)
        inside = self.hz <= rate / 2
        hz, gain = self.hz[inside], gain / stats.chi2.median(degrees)
        # Medians of bands, the wider the higher, in between by straight lines of logarithms: a random walk is steep.
        middles, medians, first = [], [], 0
        while first < len(hz):
            end = int(np.searchsorted(hz, max(_BAND * hz[first], hz[first] + _FEWEST_OF_BAND / self.seen.span_s)))
            end = len(hz) if len(hz) - end < _FEWEST_OF_BAND * _OVERSAMPLED else end
            middles.append(math.log(float(np.median(hz[first:end]))))
            medians.append(math.log(max(float(np.median(gain[first:end])), 1e-9)))
            first = end
        if len(middles) > 1:  # below the first band's middle it goes on as steeply
            slope = min(0.0, (medians[1] - medians[0]) / (middles[1] - middles[0]))
            medians.insert(0, medians[0] - slope * (middles[0] - math.log(hz[0])))
            middles.insert(0, math.log(hz[0]))
        log = np.log(np.clip(alias, hz[0], hz[-1]))
        return np.maximum(1.0, np.exp(np.interp(log, middles, medians)))

    def _alias(self, hz: FloatArray) -> FloatArray:
        """Distance from the nearest multiple of the rate."""
        return np.asarray(np.abs(hz - self.seen.rate_hz * np.round(hz / self.seen.rate_hz)))

    def search(self, before: Sequence[Line]) -> tuple[float, list[Line], tuple[float, float]]:
        """With one more line: how much better the best frequency of the scan is than none, in chi-square; the lines at
        the best local maxima; and the noise's scale there, of means and of covariances."""
        rate = self.seen.rate_hz
        means, spreads, constants, lines = self.scan(before)
        none, off, constant = self.chi_squares(before)
        noise = self.background((none - means)[self.hz <= self.seen.rate_hz / 2], self.hz)
        count = int((self.w_spread > 0).sum())
        other = max(1.0, float(spreads.min()) / max(count, 1))
        score = (none - means) / noise + (off - spreads) / other + constant - constants
        # The means show no line that is as slow as a drift, and of one at half the rate one phase only.
        blind = self._alias(self.hz)
        score[(blind < self.slowest_hz) | (blind > rate / 2 - 1 / self.seen.span_s)] = -np.inf
        for line in before:  # what the model of a line leaves of it, and the aliases of that
            alias = np.minimum(self._alias(self.hz - line.hz), self._alias(self.hz + line.hz))
            score[alias < 2 / self.seen.span_s] = -np.inf
        peaks = np.flatnonzero((score >= np.roll(score, 1)) & (score >= np.roll(score, -1)) & np.isfinite(score))
        peaks = peaks[np.argsort(-score[peaks])][: _REFINED if not before else _REFINED_BESIDE]
        peaks = peaks[score[peaks] > _HOPELESS * score[peaks[:1]]]
        if not len(peaks):
            return 0.0, [], (1.0, 1.0)
        return float(score[peaks[0]]), [lines[k] for k in peaks], (float(noise[peaks[0]]), other)

    def constants(self, lines: Sequence[Line]) -> FloatArray:
        """The covariances' constants, (R, 3)."""
        mean = self.path_mean(lines)
        return self._constant(self.S - self.spread_in_regions(self.path_spread(lines, mean)))

    def left(self, lines: Sequence[Line]) -> tuple[FloatArray, FloatArray]:
        """What is left of the means after lines and drift, and that drift, pixels, (K, R, 2)."""
        off = self._root * (self.y - self.in_regions(self.path_mean(lines)))
        left = self._without_drift(off)
        inverse = np.where(self._root > 0, 1 / np.maximum(self._root, 1e-300), 0.0)
        return left * inverse, (off - left) * inverse


def find(
    seen: PathMoments, most: int = MOST_LINES, tell: Callable[[int, int], None] = lambda done, of: None,
    slowest: int = SLOWEST,
) -> Found:  # fmt: skip
    """The lines of a film, at most so many, the strongest first; none where chance explains what is seen.

    What is slower than ``slowest`` frames a cycle is a drift.
    """
    of = Vibration(seen, slowest)
    trials = MOST_ALIASES * 2 * len(seen.times_s)
    threshold = 2 * float(special.gammainccinv(6 / 2, CHANCE / trials))
    lines: tuple[Line, ...] = ()
    sets: list[tuple[Part, ...]] = []

    def again(refined: list[Refined]) -> tuple[tuple[Line, ...], list[Refined], tuple[float, float]]:
        scale = of.scale(min(refined).lines)
        refined = [of.refined(each.lines, scale) for each in refined]
        return min(refined).lines, refined, scale

    for number in range(most):
        tell(number, most)
        gained, tops, scale = of.search(lines)
        if gained < threshold:
            break
        refined = [of.refined((*lines, each), scale) for each in tops]
        if of.value(lines, scale) - min(refined).value < threshold:
            break
        # A strong line leaks into the background: what it leaves is the noise.
        lines, refined, scale = again(refined)
        sets = [of.pieces(refined, scale)]
        for _ in range(len(lines) - 1):  # each of several lines beside the others
            _, tops, scale = of.search(lines[1:])
            lines, refined, scale = again([of.refined((*lines[1:], each), scale) for each in (lines[0], *tops)])
            sets.append(of.pieces(refined, scale))
    order = np.argsort([-each.ellipse[0] for each in lines])
    sets = [sets[k] for k in order] if len(lines) > 1 else sets
    misfit, (residual, drift) = of.misfits(lines), of.left(lines)
    return Found(
        lines=tuple(lines[k] for k in order), sets=tuple(sets), mean_misfit=misfit[0], spread_misfit=misfit[1],
        constant=of.constants(lines), residual=residual, drift=drift,
    )  # fmt: skip
