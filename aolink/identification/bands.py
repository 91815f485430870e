"""Vibrations of a line or an edge that a camera exposes row by row: each band of rows is a sample of its own.

A band of rows, exposed for T about t, shows the profile S of the target where it was meanwhile. In the Fourier domain,
with the band's place at rest x and the path p(t) = sum_j Re[a_j exp(i w_j t)] across the rows, that is

    S(q) exp(-i q x) (1/T) int exp(-i q p) dt,
    (1/T) int exp(-i q A cos(w t + phi)) dt = sum_n (-i)^n J_n(q A) sinc(n f T) exp(i n (w t + phi))   (Jacobi, Anger)

so the exposure's low-pass, its zeros (whole swings in an exposure) and its blur are in the model, however far the path
goes. All bands share S; their places at rest are a parabola along the rows with a slow drift in time. Readings of what
a model leaves are scanned up to half the rate of the bands, and lines are refined with S, rest and drift in the pixels
(Gauss and Newton, damped), which is as exact as these say.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, special, stats

from aolink.identification.vibration import CHANCE, MOST_LINES, SLOWEST, Part
from aolink.numerics.arrays import ComplexArray, FloatArray
from aolink.numerics.single_thread import by_one_thread

Tones = tuple[tuple[complex, float], ...]
"""Amplitude at the film's middle, pixels, and frequency, Hz, of each line."""
_OVERSAMPLED = 5
"""Frequencies of the scan in the inverse of the film's length."""
_AT_ONCE = 4096
_BEYOND = 6.0
"""Pixels beyond a window to either side until the profile repeats itself."""
_LEAST_TERM = 1e-5
"""Terms of the series that are left out are smaller."""
_STEPS = 25
_ENOUGH = 3e-7
"""Relative gain of a step below which it was the last."""
_RIDGE = 1e-9
_ALTERNATIVE = 15.0
"""Chi-square by which another frequency may be worse that is named beside the best."""
_APART = 1.5
"""Frequencies are another peak of the scan beyond so many inverses of the film's length."""
_MOST_ALTERNATIVES = 8
_LIKELY = 0.8
"""Aliases with this share of the best one's gain are refined too: readings of large motion are not exact."""
_BLIND = 0.02
"""Least low-pass of the exposure by which amplitudes of the scan are divided."""
_LARGE = 0.5
"""Amplitude, pixels, from which on the blur hides the target's profile, so that several amplitudes are tried."""
_SIZES = 2.0 ** np.arange(-1, 2.25, 0.25)
"""Those, over what the scan says."""
_EVERY = 4
"""Of so many frames one tells the profile for each of them."""
_DARKEST = 0.1
"""Contrast of a band, over the usual one's, from which on it is used."""
_FRAMES_AT_ONCE = 64
_BACKGROUND_HZ = 60.0
"""Width of the band of frequencies that tells the noise about one."""


@dataclass(frozen=True, eq=False)
class Bands:
    """What K frames show of a target in B bands of n rows and W columns each."""

    images: FloatArray
    """Mean light of a band's rows, (K, B, W)."""
    rest: FloatArray
    """First guess of the target's place in each row, from the band's first column, pixels, (B, n)."""
    times_s: FloatArray
    """Middle of the exposure of the film's first row in each frame, (K,)."""
    delays_s: FloatArray
    """How much later each row is, (B, n)."""
    exposure_s: float
    rate_hz: float

    @property
    def highest_hz(self) -> float:
        """Half the rate of the bands."""
        centres = self.delays_s.mean(axis=1)
        return float(0.5 / np.abs(np.diff(centres)).mean())


@dataclass(frozen=True, eq=False)
class State:
    """Lines, places at rest and profile."""

    tones: Tones
    rest: FloatArray
    """Coefficients of slope and bend along the rows, and of the drift's cosines."""
    profile: FloatArray
    """A constant, a slope, and cosines and sines of the profile."""


@dataclass(frozen=True, eq=False)
class BandsFound:
    """The lines of a target, the strongest first."""

    tones: Tones
    sets: tuple[tuple[Part, ...], ...]
    places: FloatArray
    """Of each band in each frame about its place at rest, pixels, (K, B), as the model without its noise has it."""
    left: FloatArray
    """What the model leaves of the places, (K, B)."""
    variance: FloatArray
    """Of that, by the pixels' noise, (K, B); infinite where a band shows nothing."""
    times_s: FloatArray
    """Middle of each band's exposures, (K, B)."""
    drift: FloatArray
    """(K,)"""
    rest: FloatArray
    """Place at rest of each band, from its first column, (B,)."""
    bent: bool
    """Whether it is bent at rest, so that a line at a multiple of the frame rate cannot be seen."""
    hz: FloatArray
    gain: FloatArray
    """Chi-square that a line of each of these frequencies takes away, (F,) each."""
    misfit: float
    """What is left of the places over their noise, mean square."""


class BandFit:
    """The likelihood of lines in bands."""

    def __init__(self, bands: Bands) -> None:
        self.of = bands
        K, B, W = bands.images.shape
        self.delays = bands.delays_s - bands.delays_s.mean()
        times = bands.times_s + float(bands.delays_s.mean())
        self.middle_s = float(times.mean())
        self.t = times - self.middle_s
        self.span_s = float(np.ptp(self.t)) + 1 / bands.rate_hz
        length = W + 2 * _BEYOND
        # Below half a wave a pixel, of which pixels show one phase only where all places at rest are alike.
        self.q = 2 * np.pi * np.arange(1, math.ceil(length / 2)) / length
        self.x = np.arange(W) - (W - 1) / 2
        self.wave = np.exp(1j * self.q[:, None] * self.x)  # (M, W)
        along = self.delays / max(float(np.abs(self.delays).max()), 1e-300)
        self.bend = np.stack([along, along**2])  # (2, B, n)
        count = 1 + 2 * K // SLOWEST
        self.slow = np.cos(np.pi * np.arange(1, count + 1)[:, None] * (self.t / (2 * self.t.max()) + 0.5))
        self.images = bands.images.copy()
        self.weight = np.full(B, float(bands.rest.shape[1]))
        self.hz = np.arange(bands.rate_hz / SLOWEST, bands.highest_hz, 1 / (_OVERSAMPLED * self.span_s))
        self.offset = np.zeros(B)
        """Of each band from the parabola, where the target is bent at rest, pixels."""
        self.free = False
        """Whether it is."""
        self.start = State((), np.zeros(2 + len(self.slow)), np.zeros(2 + 2 * len(self.q)))
        for _ in range(2):
            self.start = self.profiled(self.start)
            self.level(self.start)
        self.start = self.profiled(self.start)

    def level(self, state: State) -> None:
        """Take the light of each band in units of a state's profile, its ground off; both are the same in all
        frames."""
        shown, slope = (each.mean(axis=0) for each in self.shown(state))  # (B, W)
        for b, mean in enumerate(self.images.mean(axis=0)):
            A = np.stack([shown[b], np.ones_like(self.x), slope[b]], axis=1)
            gain, ground, _ = np.linalg.lstsq(A, mean, rcond=None)[0]
            good = gain > _DARKEST
            self.images[:, b] = (self.images[:, b] - ground) / gain if good else 0.0
            self.weight[b] *= gain**2 if good else 0.0

    def places(self, state: State) -> tuple[FloatArray, FloatArray]:
        """At rest, of each row (B, n), and the drift of each frame (K,)."""
        rest = self.of.rest - (len(self.x) - 1) / 2 + np.tensordot(state.rest[:2], self.bend, axes=1)
        return rest + self.offset[:, None], state.rest[2:] @ self.slow

    def moved(self, tones: Tones) -> FloatArray:
        """Mean place of each band in each exposure by lines, (K, B)."""
        out = np.zeros((len(self.t), len(self.delays)))
        for a, hz in tones:
            turn = np.exp(2j * np.pi * hz * self.delays).mean(axis=1)
            out += (a * np.sinc(hz * self.of.exposure_s) * np.exp(2j * np.pi * hz * self.t)[:, None] * turn).real
        return out

    def transfer(self, state: State) -> ComplexArray:
        """What becomes of each wave of the profile in each band, (K, B, M)."""
        rest, drift = self.places(state)
        orders = [range(-top, top + 1) for top in (math.ceil(self.q[-1] * abs(a)) + 6 for a, _ in state.tones)]
        terms, hz = [], []
        series = [
            {n: (-1j) ** n * special.jv(n, self.q * abs(a)) * np.exp(1j * n * np.angle(a)) for n in each}
            for (a, _), each in zip(state.tones, orders, strict=True)
        ]
        for numbers in itertools.product(*orders):
            total = sum(n * f for n, (_, f) in zip(numbers, state.tones, strict=True))
            term = np.full(len(self.q), np.sinc(total * self.of.exposure_s), dtype=np.complex128)
            if abs(term[0]) < _LEAST_TERM:
                continue
            for n, each in zip(numbers, series, strict=True):
                term = term * each[n]
            if np.abs(term).max() > _LEAST_TERM:
                terms.append(term)
                hz.append(float(total))
        C, F = np.array(terms), np.array(hz)
        turned = np.exp(2j * np.pi * F[:, None] * self.delays[:, None])  # (B, L, n)
        H = turned @ np.exp(-1j * rest[..., None] * self.q) / rest.shape[1] * C  # (B, L, M)
        E = np.exp(2j * np.pi * self.t[:, None] * F)  # (K, L)
        G = np.tensordot(E, H, axes=(1, 1))
        return np.asarray(G * np.exp(-1j * drift[:, None, None] * self.q))

    def shown(self, state: State, G: ComplexArray | None = None) -> tuple[FloatArray, FloatArray]:
        """The bands' images by a state, and their derivatives along x, (K, B, W) each."""
        G = self.transfer(state) if G is None else G
        rest, drift = self.places(state)
        at = rest.mean(axis=1) + drift[:, None] + self.moved(state.tones)
        M = len(self.q)
        S = G * (state.profile[2 : 2 + M] - 1j * state.profile[2 + M :])
        ramp = state.profile[1] * (self.x - at[..., None])
        return state.profile[0] + ramp + (S @ self.wave).real, state.profile[1] + ((1j * self.q * S) @ self.wave).real

    def normal(self, state: State, every: int = 1) -> tuple[FloatArray, FloatArray, float]:
        """Normal matrix and right side of Gauss and Newton's step, and the weighted sum of squares of what is left, of
        one in so many frames."""
        G = self.transfer(state)
        image, D = self.shown(state, G)
        steps = []
        for k, (a, hz) in enumerate(state.tones):
            for da, df in ((1e-4, 0.0), (1e-4j, 0.0), (0.0, 1e-4 / self.span_s)):
                tones = (*state.tones[:k], (a + da, hz + df), *state.tones[k + 1 :])
                steps.append((self.shown(replace(state, tones=tones))[0] - image) / (abs(da) or df))
        rest, drift = self.places(state)
        at = rest.mean(axis=1) + drift[:, None] + self.moved(state.tones)
        bend = self.bend.mean(axis=2)
        size = len(steps) + len(state.rest) + len(state.profile)
        N, y, total = np.zeros((size, size)), np.zeros(size), 0.0
        root = np.sqrt(self.weight)[None, :, None]
        for first in range(0, len(image), _FRAMES_AT_ONCE):
            part = slice(first, first + _FRAMES_AT_ONCE, every)
            waves = G[part, :, :, None] * self.wave
            columns = [each[part] for each in steps]
            columns += [-D[part] * each[:, None] for each in bend]
            columns += [-D[part] * each[part, None, None] for each in self.slow]
            columns += [np.ones_like(D[part]), self.x - at[part, :, None]]
            J = np.concatenate([np.stack(columns, axis=2), waves.real, waves.imag], axis=2)  # (k, B, P, W)
            flat = (J * root[..., None]).swapaxes(1, 2).swapaxes(0, 1).reshape(size, -1)
            left = (root * (self.images[part] - image[part])).ravel()
            N += flat @ flat.T
            y += flat @ left
            total += float(left @ left)
        return N, y, total

    def profiled(self, state: State, every: int = 1) -> State:
        """With the likeliest profile of one in so many frames, all else as it is."""
        N, y, _ = self.normal(replace(state, profile=np.zeros_like(state.profile)), every)
        P = len(state.profile)
        return replace(state, profile=_solved(N[-P:, -P:], y[-P:], _RIDGE))

    def starts(self, state: State, a: complex, hz: float) -> list[State]:
        """A state with another line, from where its minima are searched: a wide profile that moves little and a
        narrow one that moves far are two of them. Beside a line the profile is known."""
        if state.tones or abs(a) < _LARGE:
            return [replace(state, tones=(*state.tones, (a, hz)))]
        tried = [self.profiled(replace(state, tones=((a * size, hz),)), _EVERY) for size in _SIZES]
        left = np.array([math.inf, *map(self.misfit, tried), math.inf])
        lowest = np.flatnonzero((left[1:-1] < left[:-2]) & (left[1:-1] < left[2:]))
        return [tried[k] for k in lowest[np.argsort(left[1:-1][lowest])][:2]]

    def misfit(self, state: State) -> float:
        """Weighted sum of squares of what a state leaves."""
        return float((self.weight[:, None] * (self.images - self.shown(state)[0]) ** 2).sum())

    def refined(self, state: State) -> tuple[State, FloatArray]:
        """The nearest minimum in all unknowns, and the covariance of the lines' parameters (real
        and imaginary part, frequency) over the pixels' variance."""
        damping, T = 1e-3, 3 * len(state.tones)
        N, y, value = self.normal(state)
        for _ in range(_STEPS):
            step = _solved(N, y, damping)
            new = self._moved(state, step)
            after = self.misfit(new)
            if not after < value:
                if damping > 1e3:
                    break
                damping *= 10
                continue
            gained = value - after
            state, damping = new, max(damping / 10, _RIDGE)
            N, y, value = self.normal(state)
            if gained < _ENOUGH * value:
                break
        scale = 1 / np.sqrt(np.diag(N) + 1e-300)
        C = np.linalg.inv(N * scale[:, None] * scale + _RIDGE * np.eye(len(N))) * scale[:, None] * scale
        return state, C[:T, :T]

    def _moved(self, state: State, step: FloatArray) -> State:
        T = 3 * len(state.tones)
        parts = step[:T].reshape(-1, 3)
        tones = tuple(
            (a + complex(re, im), hz + float(df)) for (a, hz), (re, im, df) in zip(state.tones, parts, strict=True)
        )
        split = T + len(state.rest)
        return State(tones, state.rest + step[T:split], state.profile + step[split:])

    def readings(self, state: State) -> tuple[FloatArray, FloatArray, float]:
        """Place of each band beyond the model's, (K, B), its information for pixels of variance one, and the pixels'
        variance."""
        image, D = self.shown(state)
        left = self.images - image
        info = (D**2).sum(axis=2) * self.weight
        place = -(D * left).sum(axis=2) / np.maximum((D**2).sum(axis=2), 1e-300)
        free = left.size * float((self.weight > 0).mean()) - len(state.profile) - len(state.rest)
        sigma2 = float((self.weight[:, None] * left**2).sum()) / max(free, 1.0)
        return place, info, sigma2

    def scan(self, place: FloatArray, info: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Sum of squares that a line of each frequency takes away, places at rest and drift free, and its amplitude
        times the exposure's low-pass, (F,) each."""
        w = info.mean(axis=0)  # of each band: times and bands stay apart
        y = place * w
        centre = self.delays.mean(axis=1)
        v = np.concatenate([np.ones((1, len(w))), self.bend.mean(axis=2), np.ones((len(self.slow), len(w)))])
        u = np.concatenate([np.ones((3, len(self.t))), self.slow])  # columns u_k v_b
        if self.free:
            v, u = np.concatenate([v, np.eye(len(w))]), np.concatenate([u, np.ones((len(w), len(self.t)))])
        N = (u @ u.T) * ((v * w) @ v.T)
        inverse = np.linalg.pinv(N)
        right = np.einsum("ck,kb,cb->c", u, y, v)
        gains, amplitudes = [], []
        for first in range(0, len(self.hz), _AT_ONCE):
            hz = self.hz[first : first + _AT_ONCE]
            e, d = np.exp(2j * np.pi * hz[:, None] * self.t), np.exp(2j * np.pi * hz[:, None] * centre)
            shown = ((e @ y) * d).sum(axis=1)
            cross = (e @ u.T) * (d @ (w * v).T)  # (F, C)
            twice = (e**2).sum(axis=1) * ((d**2) @ w)
            one = len(self.t) * w.sum()
            # Columns cos and -sin of the line: real and imaginary part of its amplitude.
            A = np.empty((len(hz), 2, 2))
            A[:, 0, 0], A[:, 1, 1] = (one + twice.real) / 2, (one - twice.real) / 2
            A[:, 0, 1] = A[:, 1, 0] = -twice.imag / 2
            c = np.stack([cross.real, -cross.imag], axis=1)
            A -= c @ inverse @ c.swapaxes(1, 2)
            b = np.stack([shown.real, -shown.imag], axis=1) - c @ (inverse @ right)
            x = np.linalg.solve(A + 1e-6 * one * np.eye(2), b[..., None])[..., 0]
            gains.append((x * b).sum(axis=1))
            amplitudes.append(x[:, 0] + 1j * x[:, 1])
        return np.concatenate(gains), np.concatenate(amplitudes)

    def background(self, gain: FloatArray) -> FloatArray:
        """The usual gain about each frequency over that of noise of variance one, (F,)."""
        width = max(3, round(_BACKGROUND_HZ / (self.hz[1] - self.hz[0])))
        return np.asarray(ndimage.percentile_filter(gain, 50, width, mode="nearest") / stats.chi2.median(2))

    def alias(self, hz: FloatArray) -> FloatArray:
        """Distance from the nearest multiple of the frame rate."""
        return np.asarray(hz - self.of.rate_hz * np.round(hz / self.of.rate_hz))

    def is_bent(self, state: State, place: FloatArray) -> bool:
        """Whether a straight line or a parabola at rest, and one line at a multiple of the frame rate, leave a pattern
        that all frames share."""
        if self.has_patterns(state):
            return True
        good = self.weight > 0
        shared, noise = place.mean(axis=0)[good], place.var(axis=0)[good] / len(place)
        return float((shared**2 / noise).sum()) > float(stats.chi2.ppf(1 - CHANCE, int(good.sum())))

    def has_patterns(self, state: State) -> bool:
        """Whether more than one line is at a multiple of the frame rate."""
        return sum(abs(float(self.alias(np.array(hz)))) < 1 / self.span_s for _, hz in state.tones) > 1

    def let_bend(self) -> None:
        """Take each band to be at rest where it is in the mean of the frames."""
        for _ in range(2):
            self.offset += self.readings(self.start)[0].mean(axis=0)
            self.start = self.profiled(self.start)
        self.free = True

    def parts(
        self, state: State, number: int, hz_variance: float, seen: tuple[FloatArray, FloatArray], usual: FloatArray
    ) -> tuple[Part, ...]:
        """The frequencies of a line that explain the readings nearly as well as its own, which comes first; the
        variance of that is for pixels of variance one, ``usual`` is the noise about each frequency."""
        tone = state.tones[number]
        gain, _ = self.scan(seen[0] + self.moved((tone,)), seen[1])
        noise = float(np.interp(tone[1], self.hz, usual))
        near = np.abs(self.hz - tone[1]) < _APART / self.span_s
        best = float(gain[near].max()) if near.any() else float(gain.max())
        peaks = np.flatnonzero((gain >= np.roll(gain, 1)) & (gain >= np.roll(gain, -1)) & ~near)
        peaks = peaks[gain[peaks] > best - _ALTERNATIVE * noise]
        peaks = peaks[np.argsort(-gain[peaks])][:_MOST_ALTERNATIVES]
        reach = stats.norm.ppf(0.975) * math.sqrt(hz_variance * noise)
        return tuple(Part(hz - reach, hz, hz + reach) for hz in (tone[1], *(float(self.hz[k]) for k in peaks)))


def _solved(N: FloatArray, y: FloatArray, damping: float) -> FloatArray:
    scale = 1 / np.sqrt(np.diag(N) + 1e-300)
    return np.asarray(np.linalg.solve(N * scale[:, None] * scale + damping * np.eye(len(N)), y * scale) * scale)


@by_one_thread
def find(bands: Bands, most: int = MOST_LINES, tell: Callable[[int, int], None] = lambda done, of: None) -> BandsFound:
    """The lines of a target, at most so many, the strongest first; none where chance explains what is seen.

    Where more than one line at multiples of the frame rate would be needed, or they leave a pattern that all frames
    share, the target is bent at rest: then each band's place is free, and no such line can be seen.
    """
    fit = BandFit(bands)
    found = _lines(fit, most, tell)
    if fit.is_bent(*found[:2]):
        fit.let_bend()
        found = _lines(fit, most, tell)
    state, place, info, sigma2, covariance = found
    order = sorted(range(len(state.tones)), key=lambda k: -abs(state.tones[k][0]))
    gain, _ = fit.scan(place, info)
    usual = np.maximum(fit.background(gain), sigma2)
    sets = [fit.parts(state, k, float(covariance[3 * k + 2, 3 * k + 2]), (place, info), usual) for k in order]
    all_lines, _ = fit.scan(place + fit.moved(state.tones), info)
    rest, drift = fit.places(state)
    known = info > 0
    variance = np.where(known, sigma2 / np.maximum(info, 1e-300), np.inf)
    return BandsFound(
        tones=tuple(state.tones[k] for k in order), sets=tuple(sets), places=fit.moved(state.tones), left=place,
        variance=variance, drift=drift, rest=rest.mean(axis=1) + (bands.images.shape[2] - 1) / 2, bent=fit.free,
        times_s=fit.t[:, None] + fit.middle_s + fit.delays.mean(axis=1), hz=fit.hz, gain=all_lines / usual,
        misfit=float((place**2 / variance)[known].mean()),
    )  # fmt: skip


def _lines(
    fit: BandFit, most: int, tell: Callable[[int, int], None]
) -> tuple[State, FloatArray, FloatArray, float, FloatArray]:
    """A state with its lines, readings of what it leaves with their information and the pixels' variance, and the
    covariance of the lines' parameters over that."""
    state, covariance = fit.start, np.zeros((0, 0))
    threshold = 2 * math.log(len(fit.hz) / _OVERSAMPLED / CHANCE)
    place, info, sigma2 = fit.readings(state)
    for number in range(most):
        tell(number, most)
        gain, amplitudes = fit.scan(place, info)
        score = gain / np.maximum(fit.background(gain), sigma2)
        for _, hz in state.tones:  # what the model of a line leaves of it
            score[np.abs(fit.hz - hz) < 1 / fit.span_s] = 0.0
        if fit.free:
            score[np.abs(fit.alias(fit.hz)) < 1 / fit.span_s] = 0.0
        top = int(score.argmax())
        if score[top] < threshold:
            break
        # A strong line raises what is taken for noise about it, so that its aliases are told apart without that.
        family = np.flatnonzero((np.abs(fit.alias(fit.hz - fit.hz[top])) < 1 / fit.span_s) & (score > threshold))
        family = family[np.argsort(-gain[family])]
        tried = list[tuple[float, State, FloatArray]]()
        chosen = list[float]()
        for k in family[gain[family] > _LIKELY * gain[family[0]]]:
            hz = float(fit.hz[k])
            if any(abs(hz - other) < _APART / fit.span_s for other in chosen):
                continue
            chosen.append(hz)
            low_pass = float(np.sinc(hz * fit.of.exposure_s))
            a = complex(amplitudes[k]) / math.copysign(max(abs(low_pass), _BLIND), low_pass)
            for start in fit.starts(state, a, hz):
                new, covariance = fit.refined(start)
                tried.append((fit.misfit(new), new, covariance))
        _, state, covariance = min(tried, key=lambda each: each[0])
        fit.level(state)  # lines that beat slowly blur each band in its own way
        state, covariance = fit.refined(state)
        place, info, sigma2 = fit.readings(state)
        if fit.has_patterns(state):
            break
    return state, place, info, sigma2, covariance
