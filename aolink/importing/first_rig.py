"""A first rig file for a film: the kernel, noise and plant that its single frames show, each with its uncertainty."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import optimize, signal

from aolink.errors import ImportingError
from aolink.importing.film import Film
from aolink.importing.frames import Settings
from aolink.importing.survey import Survey, reach, survey
from aolink.importing.tracker import find_objects
from aolink.importing.tracking import STRAY
from aolink.numerics.arrays import FloatArray

_COUNTS = 62_000
"""Counts of the brightest pixel of a resting spot with its noise; there are 65,535."""
_NOISE_SDS = 6
"""Standard deviations of a pixel's noise that fit below black and above the brightest pixel."""
_SETTLED = 1e-9
"""A smaller change of a gain counts as none."""
_LAGS = range(2, 11)
"""Frames over which innovations must not be correlated. Over one they are where a frame is exposed throughout."""
_CORRELATED = 0.15
"""Correlation of innovations from which on a motion is another one than the fitted, if it is no chance."""
_LEAST_WINDOW = 12
_ANYWHERE = 0.1
"""Variance of the place of an object in its window before it is seen, slope units squared."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A random walk or an Ornstein-Uhlenbeck process that fits the objects' motion from frame to frame.

    x(k+1) = a x(k) + w(k), Var w = q; a frame shows x with an error of variance r. All by maximum likelihood.
    """

    a: float
    """One for a random walk."""
    a_sd: float
    q: float
    """Variance of a step, pixels squared."""
    q_sd: float
    r: float
    """Variance of the error of a place, pixels squared."""
    spread: float
    """Standard deviation of the places about their mean, pixels."""
    unexplained: float
    """Largest correlation of innovations some frames apart; zero where it is small or may be by chance."""


def fit_motion(places: FloatArray) -> Motion:
    """Fit series of places along one direction each, (frames, series), pixels; NaN where nothing was seen.

    A random walk is fitted and an Ornstein-Uhlenbeck process (a < 1). The latter is taken where the Bayesian
    information criterion favours it.

    Raises
    ------
    ImportingError
        There are too few places.
    """
    seen = np.isfinite(places)
    if seen.sum() < 20 or len(places) < 10:
        raise ImportingError(f"{int(seen.sum())} places are too few to fit a motion to: 20 or more are needed")
    steps = np.diff(places, axis=0)
    start = math.log(max(float(np.nanvar(steps)), 1e-12))

    # The part between two gaps is a series of its own; an Ornstein-Uhlenbeck process moves about its mean.
    runs = [(one, one - one.mean(axis=0)) for one in _runs(places)]

    def cost(values: FloatArray, bound: bool) -> float:
        q, r = math.exp(values[0]), math.exp(values[1])
        a = 1 / (1 + math.exp(-values[2])) if bound else 1.0
        total = 0.0
        for series in (about if a < 1 else one for one, about in runs):
            innovations, variances = _innovations(series, a, q, r)
            logs = series.shape[1] * float(np.log(2 * np.pi * variances).sum())
            total += float((innovations**2 / variances[:, None]).sum()) + logs
        return total / 2

    walk = optimize.minimize(cost, [start, start - 2], args=(False,), method="Nelder-Mead")
    bound = optimize.minimize(cost, [*walk.x, 3.0], args=(True,), method="Nelder-Mead", options={"maxiter": 600})
    # The mean of each series is a parameter of the second, too.
    penalty = (1 + places.shape[1]) * math.log(int(seen.sum())) / 2
    is_bound = bound.fun + penalty < walk.fun
    best = bound.x if is_bound else walk.x
    variances = _inverse_curvature(lambda values: cost(values, is_bound), best)
    a = 1 / (1 + math.exp(-best[2])) if is_bound else 1.0
    q, r = math.exp(best[0]), math.exp(best[1])
    a_sd = a * (1 - a) * math.sqrt(variances[2]) if is_bound else 0.0
    spread = float(np.sqrt(np.nanmean((places - np.nanmean(places, axis=0)) ** 2)))
    unexplained = _correlation([_innovations(about if is_bound else one, a, q, r)[0] for one, about in runs])
    return Motion(a=a, a_sd=a_sd, q=q, q_sd=q * math.sqrt(variances[0]), r=r, spread=spread, unexplained=unexplained)


def _runs(places: FloatArray) -> list[FloatArray]:
    """Series without their gaps: those of the same length in one array, (frames, series)."""
    whole = np.isfinite(places).all(axis=0)
    runs = [places[:, whole]] if whole.any() else []
    for one in places[:, ~whole].T:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], np.isfinite(one), [False]]).astype(np.int8)))
        runs += [one[first:end, None] for first, end in edges.reshape(-1, 2) if end - first > 1]
    return runs


def _innovations(y: FloatArray, a: float, q: float, r: float) -> tuple[FloatArray, FloatArray]:
    """Innovations of a Kalman filter, which settles after some frames, for series (frames, series), and their
    variances: (frames - 1, series) and (frames - 1,).

    The first place of each series starts the filter, of a random walk and of an Ornstein-Uhlenbeck process alike, so
    that their likelihoods can be compared.
    """
    innovations, variances = np.empty((len(y) - 1, y.shape[1])), np.empty(len(y) - 1)
    x, P, gain = a * y[0], a * a * r + q, math.nan
    for k in range(len(y) - 1):
        S = P + r
        before, gain = gain, P / S
        innovations[k], variances[k] = y[k + 1] - x, S
        x, P = a * (x + gain * innovations[k]), a * a * P * (1 - gain) + q
        if abs(gain - before) < _SETTLED:
            seen, _ = signal.lfilter([0.0, a * gain], [1.0, -a * (1 - gain)], y[k + 2 :], axis=0, zi=x[None])
            innovations[k + 1 :], variances[k + 1 :] = y[k + 2 :] - seen, S
            break
    return innovations, variances


def _correlation(series: list[FloatArray]) -> float:
    """The largest correlation of innovations that are some frames apart; zero if it is small or may be by chance."""
    power = sum(float((one**2).sum()) for one in series)
    pairs = [sum(one[lag:].size for one in series) for lag in _LAGS]
    sums = [sum(float((one[lag:] * one[:-lag]).sum()) for one in series) for lag in _LAGS]
    count = sum(one.size for one in series)
    found = max((total / n / (power / count) for total, n in zip(sums, pairs, strict=True) if n), key=abs, default=0.0)
    return found if abs(found) > max(_CORRELATED, 4 / math.sqrt(count)) else 0.0


def _inverse_curvature(cost: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    """Diagonal of the inverse Hessian, by differences: variances of maximum-likelihood estimates."""
    n, h = len(at), 0.05
    H = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            total = 0.0
            for a in (1, -1):
                for b in (1, -1):
                    x = np.array(at, dtype=np.float64)
                    x[i] += a * h
                    x[j] += b * h
                    total += a * b * cost(x)
            H[i, j] = total / (4 * h * h)
    return np.clip(np.diagonal(np.linalg.pinv(H)), 0.0, None)


class FirstRig(NamedTuple):
    """A rig file for a film."""

    text: str
    notes: tuple[str, ...]
    """What in the film contradicts the rig file, or is left out of it; the text has these notes, too."""


def first_rig(film: Film, settings: Settings, name: str, progress: Callable[[int], None] | None = None) -> FirstRig:
    """A rig file for the objects of a film, ``settings.track`` of them: for an import with these settings.

    The slope unit is half a window. The plant has a copy for each object and direction; its input is the shift of the
    window that follows the object.

    Raises
    ------
    ImportingError
        There are fewer objects, or the frame rate is not known.
    """
    if film.slopes:
        raise ImportingError(f"{film.name} has slopes and no pictures: a first rig file is made from pictures")
    if not settings.track:
        raise ImportingError("a first rig file is about objects in the film: say how many with --track N")
    objects = find_objects(film, settings)
    known = survey(film, settings, objects, progress)
    rate = settings.rate_hz or film.rate_hz
    if rate is None and film.times_ns is not None and film.count > 1:
        rate = 1e9 / float(np.median(np.diff(film.times_ns)))
    if rate is None:
        raise ImportingError(f"it is not known how many frames a second {film.name} has: give --rate")
    places = known.places.reshape(len(known.places), -1)
    motion = fit_motion(places)
    K = settings.frames_per_exposure
    # The window moves before its object has strayed too far from the middle.
    side = max(_LEAST_WINDOW, 2 * math.ceil(reach(known, K) / (1 - 2 * STRAY)))
    notes = tuple(_notes(known, motion))
    return FirstRig(_text(film, settings, name, known, motion, side, rate, notes), notes)


def _notes(known: Survey, motion: Motion) -> Iterator[str]:
    """What the user should know of the film before using the rig file."""
    yield from known.notes()
    if known.left_out:
        yield (
            f"{known.left_out:.2%} of the pixels about the objects are saturated or no numbers: kernel, light and noise"
            " are fitted without them"
        )
    if motion.unexplained:
        kind = "a random walk" if motion.a == 1 else "an Ornstein-Uhlenbeck process"
        yield (
            f"the motion is not {kind}: what it leaves unexplained is correlated by {motion.unexplained:.2f} from one"
            " frame to one some frames later, as of a vibration, and intervals will be too narrow. Import with this"
            " rig file, then try `aolink identify` with --model resonance"
        )


def _text(
    film: Film, settings: Settings, name: str, known: Survey, motion: Motion, side: int, rate: float,
    notes: tuple[str, ...],
) -> str:  # fmt: skip
    unit = side / 2  # pixels
    n, K = settings.track, settings.frames_per_exposure
    sigma, sigma_sd = known.sd * math.sqrt(2) / unit, known.sd_sd * math.sqrt(2) / unit
    width_sd = f"+- {sigma_sd:.2g}" if math.isfinite(sigma_sd) else "no +- from one object"
    area = (2 / side) ** 2
    read, read_sd, electrons = _noise(known, 2 / side)
    peak = 1 / (2 * math.pi * (sigma**2 / 2 + area / 12))
    noise = math.sqrt(read / area) if read else 0.0
    counts = _COUNTS / (peak + 2 * _NOISE_SDS * noise)
    step_ns = round(1e9 / rate)
    walk = motion.a == 1
    if walk:
        A, B, B_w, C = "[[1.0]]", "[[1.0]]", "[[1.0]]", "[[1.0]]"
        kind, initial = "random walk", f"[[{_ANYWHERE}]]"
    else:  # the window's shifts add up in a state of their own
        A, B, B_w, C = f"[[{motion.a:.8g}, 0.0], [0.0, 1.0]]", "[[0.0], [1.0]]", "[[1.0], [0.0]]", "[[1.0, 1.0]]"
        variance = motion.q / (1 - motion.a**2) / unit**2
        kind, initial = "Ornstein-Uhlenbeck process", f"[[{variance:.4g}, 0.0], [0.0, {_ANYWHERE}]]"
    memory = "" if walk else f": a = {motion.a:.5g} +- {motion.a_sd:.2g} a frame"
    summary = (
        f"{n} objects of {film.name}, each in a window of {side} pixels that follows it; slope unit: {unit:g} pixels"
    )
    said = "".join(f"# Note: {note}.\n" for note in notes)
    return f"""# Written by `aolink rig --from {film.name}` from its single frames. +- is one standard deviation.
{said}name = {json.dumps(name)}
summary = {json.dumps(summary)}

[plant]               # a copy for each object along x and along y
axes = {2 * n}
A = {A}  # {kind}{memory}
B = {B}           # the input shifts the window
B_w = {B_w}
C = {C}
process_noise = {motion.q / unit**2:.6g}  # +- {motion.q_sd / unit**2:.2g}: {math.sqrt(motion.q):.4g} pixels rms a frame
initial_covariance = {initial}

[timing]
fast_step_s = {step_ns / 1e9!r}  # {rate:.6g} frames/s
exposure_steps = {K}
frame_period_steps = {K}

[sensor]
kind = "spots"
grid = [1, {n}]
window = [{side}, {side}]
field = [-1.0, 1.0]
noise_density = {read:.6g}  # +- {read_sd:.2g}: what the Gaussian leaves of single frames
bit_depth = 16
black_level = {math.ceil(_NOISE_SDS * noise * counts)}
counts_per_density = {counts:.6g}
photoelectrons = {electrons:.4g}

[sensor.kernel]
shape = "gaussian"
sigma = {sigma:.6g}  # {width_sd}: {known.sd:.4g} pixels rms in one direction

[mirror]              # the shift of each window, of which the importer makes the inputs
input_min = -4.0
input_max = 4.0
dac_bits = 0
block_steps = 1
queue_steps = 16
"""


def _noise(known: Survey, width: float) -> tuple[float, float, float]:
    """V of a window two slope units wide, its standard deviation, and electrons of a spot (0: many).

    They come from a least-squares fit of the squared residuals of sums over a window's rows and columns to the light
    there.
    """
    square, light = (known.residual / width) ** 2, np.maximum(known.model / width, 0.0)
    columns = np.column_stack([np.ones(len(light)), light])
    (read, gain), *_ = np.linalg.lstsq(columns, square, rcond=None)
    errors = square - columns @ np.array([read, gain])
    read_sd, gain_sd = np.sqrt(np.diagonal(np.linalg.inv(columns.T @ columns)) * errors.var())
    density = width / 2  # the factor from such a variance to V
    if gain > 3 * gain_sd and read > 0:
        return float(read * density), float(read_sd * density), float(1 / (gain * width))
    return float(square.mean() * density), float(square.std() / math.sqrt(len(square)) * density), 0.0
