"""The time from row to row found with the frequency: what one vibration shows, and what two decide.

The phase of a vibration of f goes on by f / rate from frame to frame and by f r from row to row, r being the row time.
Frames say the first up to whole swings, f = f0 + n rate, and rows the second, g = f r: each n gives a pair (f, r). A
readout takes no longer than a frame, and a far swing would make the target wider than it is. Two vibrations have one r.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from aolink.identification.bands import BandFit
from aolink.identification.vibration import CHANCE, SLOWEST
from aolink.numerics.arrays import ComplexArray, FloatArray

_OVERSAMPLED = 4
_SHORTEST = 0.1
"""Readout, in the time from frame to frame, below which none is."""
_WIDER = 4.0
"""Amplitude, in widths of the target as it is seen, beyond which none is."""
_DRIFT = 1.5
"""Turns from the first row to the last below which slow motion is a drift."""
_LEAST_SECOND = 0.05
"""Size of a second vibration over the first one's; what is smaller may be left of that."""
_AS_WELL = stats.chi2.ppf(0.999, 1)
"""Chi-square by which a second vibration may miss the row time of a first one."""


@dataclass(frozen=True)
class Pair:
    """A frequency, and the time from the start of one row's exposure to that of the next, that go together."""

    hz: float
    row_time_s: float
    sd_s: float
    """Of the row time, the frequency known."""


def pairs(fit: BandFit, rows: FloatArray, height: int) -> list[Pair]:
    """The pairs that explain a target's vibrations, the slowest first; empty where none is seen.

    Parameters
    ----------
    fit:
        Its bands; what they say of delays is not used.
    rows:
        Middle row of each band, (B,).
    height:
        Rows that the camera reads in a frame.
    """
    rate, exposure_s = fit.of.rate_hz, fit.of.exposure_s
    place, info, sigma2 = fit.readings(fit.start)
    tones = _tones(fit, place, info / sigma2, rows)
    slope = fit.shown(fit.start)[1] ** 2
    at = (slope * fit.x).sum(axis=2) / slope.sum(axis=2)
    width = math.sqrt(float((slope * (fit.x - at[..., None]) ** 2).sum() / slope.sum()))
    longest = 1 / (rate * height)
    found = []
    for hz, turn, size, sd in tones:
        n = np.arange(math.ceil(abs(turn) / (_SHORTEST * longest * rate)) + 1)
        f = np.abs(hz + math.copysign(1, turn) * n * rate)
        far = size > _WIDER * width * np.abs(np.sinc(f * exposure_s))
        r = abs(turn) / np.maximum(f, 1e-9)
        good = (r <= longest) & (r >= _SHORTEST * longest) & ~far
        found.append([Pair(float(a), float(b), sd / float(a)) for a, b in zip(f[good], r[good], strict=True)])
    return found[0] if len(found) == 1 else _shared(found) if found else []


def _shared(found: Sequence[Sequence[Pair]]) -> list[Pair]:
    """Pairs of the first vibration whose row time the second has too."""
    first, second = (np.array([[each.row_time_s, each.sd_s] for each in one]).reshape(-1, 2) for one in found)
    apart = (first[:, None, 0] - second[:, 0]) ** 2 / (first[:, None, 1] ** 2 + second[:, 1] ** 2)
    return [one for one, good in zip(found[0], (apart < _AS_WELL).any(axis=1), strict=True) if good]


def _tones(
    fit: BandFit, place: FloatArray, weight: FloatArray, rows: FloatArray, *, bent: bool = False
) -> list[tuple[float, ...]]:
    """Of up to two vibrations the frequency that frames alone would say, Hz, turns from row to row, amplitude as
    exposures leave it, and the standard deviation of the turns. A target that is not ``bent`` is a parabola at rest."""
    rate, t, at = fit.of.rate_hz, fit.t, rows - rows.mean()
    across, counts = at / np.ptp(rows), weight.sum(axis=0)

    def pattern(left: FloatArray) -> FloatArray:
        """What all frames share."""
        return np.asarray((left * weight).sum(axis=0) / np.maximum(counts, 1e-300))

    shared = pattern(place)
    place = place - (shared if bent else np.polyval(np.polyfit(across, shared, 2, w=np.sqrt(counts)), across))
    original = place
    hz = np.arange(rate / SLOWEST if bent else 0.0, rate / 2, 1 / (_OVERSAMPLED * fit.span_s))
    step = float(np.abs(np.diff(rows)).mean())
    turns = np.arange(-0.5 / step, 0.5 / step, 1 / (_OVERSAMPLED * np.ptp(rows)))
    along, turned = np.exp(-2j * np.pi * hz[:, None] * t), np.exp(-2j * np.pi * turns[:, None] * at)  # (F, K), (G, B)
    drift = (hz[:, None] < rate / SLOWEST) & (np.abs(turns) < _DRIFT / np.ptp(rows))
    scale = np.array([1 / fit.span_s, 1 / np.ptp(rows)])
    total, found = float(weight.sum()), list[tuple[float, ...]]()
    for _ in range(2):
        y = place * weight
        power = 2 * np.abs(along @ y @ turned.T) ** 2 / total
        noise = max(1.0, float(np.median(power)) / float(stats.chi2.median(2)))
        power[drift] = 0.0
        k, m = np.unravel_index(int(power.argmax()), power.shape)
        if power[k, m] < 2 * noise * math.log(power.size / _OVERSAMPLED**2 / CHANCE):
            break

        def worse(u: FloatArray, y: FloatArray = y) -> float:
            return -_wave(y, weight, scale * u, t, at)[1]

        x = scale * optimize.minimize(worse, np.array([hz[k], turns[m]]) / scale, method="Nelder-Mead").x
        a, _, wave = _wave(y, weight, x, t, at)
        if found and abs(a) < _LEAST_SECOND * found[0][2]:
            break
        spread = float((weight.sum(axis=0) * at**2).sum())
        found.append((float(x[0]), float(x[1]), abs(a), math.sqrt(2 * noise / spread) / (2 * np.pi * abs(a))))
        place = place - (a * wave).real
    left = float((pattern(place) ** 2 * counts).sum())
    if not bent and left > float(stats.chi2.ppf(1 - CHANCE, int((counts > 0).sum()))) * noise:
        return _tones(fit, original, weight, rows, bent=True)
    return found


def _wave(
    y: FloatArray, weight: FloatArray, x: FloatArray, t: FloatArray, at: FloatArray
) -> tuple[complex, float, ComplexArray]:
    """Amplitude of a wave in weighted places (K, B), the chi-square that it takes away, and itself."""
    wave = np.exp(2j * np.pi * (x[0] * t[:, None] + x[1] * at))
    c = np.stack([wave.real, -wave.imag]).reshape(2, -1)
    right = c @ y.ravel()
    a = np.linalg.solve((c * weight.ravel()) @ c.T, right)
    return complex(*a), float(a @ right), wave
