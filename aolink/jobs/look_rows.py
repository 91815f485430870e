"""Lines and edges in the films of cameras that expose their rows one after the other: where they are, and their bands.

A target that goes through many rows, as a bolt's edge, tape, or a line of light, is seen at another time in each row.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from aolink.identification.bands import Bands, BandsFound
from aolink.identification.row_time import Pair
from aolink.identification.vibration import Found, Line, Part, PathMoments
from aolink.jobs.look_texture import Region
from aolink.numerics.arrays import BoolArray, FloatArray

BAND_S = 0.2e-3
"""Longest time from the first row of a band to that of the next."""
_BIN = 8
"""Rows that are summed to find a target."""
_SMOOTH = 1.5
_FLANKS = 5.0
"""Standard deviation of the Gaussian that makes one place of both sides of a line, pixels."""
_WINDOW = 32
"""Columns about a target that are looked at."""
_LEAST_ROWS = 128
"""Rows that a target must go through: spots are smaller."""
_NEAR = 4.0
"""Pixels from a parabola within which a place belongs to it."""
_INLIERS = 0.7
_TRIES = 300
_LEAST_GAIN = 35.0
"""Chi-square of a vibration that is seen."""
_MISFIT = 2.0
"""Mean square of what is left of the places, over their noise, from which on the path is not believed."""
_MOST_NAMED = 6
"""Pairs of a frequency and a row time that are named."""
_STEEP = 1.0
"""Columns that a target may go aside within a band."""


@dataclass(frozen=True, eq=False)
class Target:
    """A line or an edge through many rows."""

    first: int
    """First row."""
    places: FloatArray
    """Column in each row, (rows,)."""
    mean: FloatArray
    """Mean of the frames, (rows, columns)."""


def find_target(frames: Iterator[FloatArray], at: tuple[float, float] | None, size: int) -> Target | None:
    """The line or edge that moves most, or is strongest where none does; about the place ``at`` (x, y) where one is
    given, as wide as ``size``. None where nothing goes through many rows."""
    count, total, squares, whole = 0, *(np.zeros(()) for _ in range(3))
    for frame in frames:
        height = len(frame) // _BIN * _BIN
        if height < _LEAST_ROWS or frame.shape[1] < _WINDOW + 2:
            return None
        binned = ndimage.gaussian_filter1d(
            frame[:height].reshape(-1, _BIN, frame.shape[1]).mean(axis=1), _SMOOTH, axis=1
        )
        total, squares, whole, count = total + binned, squares + binned**2, whole + frame, count + 1
    mean = total / count
    variance = squares / count - mean**2
    slope = np.gradient(mean, axis=1) ** 2
    usual = float(np.median(variance))
    moving = np.maximum(variance - 2 * usual, 0.0) * slope
    for score in (moving, slope):
        shown = ndimage.gaussian_filter1d(score, _FLANKS, axis=1)
        shown[:, : _WINDOW // 4], shown[:, -(_WINDOW // 4) :] = 0, 0
        if at is not None:
            columns = np.arange(shown.shape[1])
            shown[:, np.abs(columns - at[0]) > size / 2] = 0
        best = shown.argmax(axis=1).astype(np.float64)
        strength = shown.max(axis=1)
        found = _parabola(best, strength > 0.02 * float(strength.max()) if strength.max() > 0 else strength > 0, at)
        if found is not None:
            first, last, curve = found
            rows = np.arange(first * _BIN, (last + 1) * _BIN)
            return Target(
                first * _BIN, np.asarray(np.polyval(curve, (rows - (_BIN - 1) / 2) / _BIN), np.float64), whole / count
            )
    return None


def _parabola(best: FloatArray, good: BoolArray, at: tuple[float, float] | None) -> tuple[int, int, FloatArray] | None:
    """First and last bin of a parabola through most of the places, and its coefficients."""
    rows = np.flatnonzero(good)
    if len(rows) * _BIN < _LEAST_ROWS:
        return None
    rng, most, curve = np.random.default_rng(0), 0, np.zeros(3)
    for _ in range(_TRIES):
        three = rng.choice(rows, 3, replace=False)
        tried = np.polyfit(three, best[three], 2)
        inside = int((np.abs(np.polyval(tried, rows) - best[rows]) < _NEAR).sum())
        if inside > most:
            most, curve = inside, tried
    for _ in range(3):
        inliers = rows[np.abs(np.polyval(curve, rows) - best[rows]) < _NEAR]
        curve = np.polyfit(inliers, best[inliers], 2)
    first, last = int(inliers[0]), int(inliers[-1])
    if (last - first + 1) * _BIN < _LEAST_ROWS or len(inliers) < _INLIERS * (last - first + 1):
        return None
    return first, last, curve


def bands_of(
    frames: Iterator[FloatArray], target: Target, times_s: FloatArray, row_time_s: float, exposure_s: float,
    rate_hz: float,
) -> tuple[Bands, Region]:  # fmt: skip
    """The bands of a target, and the part of the picture that they are in; ``times_s`` are the middles of the exposures
    of each frame's first row."""
    slope = float(np.abs(np.diff(target.places)).max())
    n = max(1, min(int(BAND_S / abs(row_time_s)), int(_STEEP / max(slope, 1e-9)), len(target.places) // 8))
    count = len(target.places) // n
    places = target.places[: count * n].reshape(count, n)
    rows = target.first + np.arange(count * n).reshape(count, n)
    columns = target.mean.shape[1]
    first = np.clip(np.rint(places.mean(axis=1) - (_WINDOW - 1) / 2).astype(int), 0, columns - _WINDOW)
    y, x = rows[:, :, None], (first[:, None] + np.arange(_WINDOW))[:, None]
    images = np.array([frame[y, x].mean(axis=1) for frame in frames])
    delays_s = np.asarray(rows * row_time_s, np.float64)
    bands = Bands(
        images=images, rest=places - first[:, None], times_s=times_s, delays_s=delays_s,
        exposure_s=exposure_s, rate_hz=rate_hz,
    )  # fmt: skip
    left, right = int(first.min()), int(first.max()) + _WINDOW
    return bands, Region(left, target.first, right - left, count * n)


def as_moments(found: BandsFound, exposure_s: float, rate_hz: float) -> tuple[PathMoments, Found]:
    """What was found in bands as that of one region, whose exposures are those of all bands, in order of time."""
    order = np.argsort(found.times_s.ravel())
    n = len(order)

    def along_x(values: FloatArray, other: float = 0.0) -> FloatArray:
        out = np.full((n, 1, 2), other)
        out[:, 0, 0] = values.ravel()[order]
        return out

    drift = np.repeat(found.drift[:, None], found.times_s.shape[1], axis=1)
    seen = PathMoments(
        times_s=found.times_s.ravel()[order], exposure_s=exposure_s, rate_hz=rate_hz,
        mean=along_x(found.places + drift + found.left), mean_variance=along_x(found.variance, np.inf),
        spread=np.zeros((n, 1, 3)), spread_variance=np.full((n, 1, 3), np.inf), constant_sd=np.zeros((1, 3)),
        axes=np.eye(2)[None],
    )  # fmt: skip
    lines = tuple(Line(hz, np.array([a, 0j])) for a, hz in found.tones)
    return seen, Found(
        lines=lines, sets=found.sets, mean_misfit=found.misfit, spread_misfit=1.0, constant=np.zeros((1, 3)),
        residual=along_x(np.where(np.isfinite(found.variance), found.left, 0.0)), drift=along_x(drift),
    )  # fmt: skip


def is_shared(hz: float, found: BandsFound, rate_hz: float) -> bool:
    """Whether a vibration at a frequency shows the same in all frames: a multiple of the frame rate."""
    return abs(hz - rate_hz * round(hz / rate_hz)) < 1 / float(np.ptp(found.times_s))


def grade_of(found: BandsFound, exposure_s: float, rate_hz: float) -> tuple[int, str]:
    """Index of the grade of the strongest line, and why it is no better."""
    if not found.tones:
        unseen = f"of {1 / exposure_s:.4g} Hz, whole swings in an exposure"
        unseen += f", or of {rate_hz:.4g} Hz, as it is bent at rest" * found.bent
        known = found.variance[np.isfinite(found.variance)]
        least = math.sqrt(2 * _LEAST_GAIN / float((1 / known).sum())) if len(known) else math.inf
        return 2, (
            f"no vibration up to {found.hz[-1]:.4g} Hz moves it by {least:.1g} pixels or more: it is still, or vibrates"
            f" at a multiple {unseen}"
        )
    why = []
    if len(found.sets[0]) > 1:
        why.append("these frames are not enough to tell it from its aliases")
    if is_shared(found.tones[0][1], found, rate_hz):
        why.append(
            f"it is a multiple of {rate_hz:.4g} Hz, and a target that at rest is bent so, and not straight or a"
            " parabola, looks the same"
        )
    if any(is_shared(one - other, found, rate_hz) for (_, one), (_, other) in itertools.combinations(found.tones, 2)):
        why.append("vibrations that are aliases of one another explain it, and so may one that is larger")
    if found.misfit > _MISFIT:
        why.append("the places move in another way too")
    return int(bool(why)), "; ".join(why)


def of_pairs(found: Found, pairs: Sequence[Pair], grade: int, because: str) -> tuple[Found, int, str]:
    """What was found with the first pair, its grade and why it is no better, where a row time was not known."""
    if len(pairs) == 1:
        return found, grade, because
    k = min(range(len(found.lines)), key=lambda k: abs(found.lines[k].hz - pairs[0].hz))
    best = found.sets[k][0]
    reach = best.high - best.best
    parts = tuple(Part(pair.hz - reach, pair.hz, pair.hz + reach) for pair in pairs[1:])
    named = ", ".join(f"{pair.hz:.5g} Hz and {1e6 * pair.row_time_s:.4g} us" for pair in pairs[:_MOST_NAMED])
    said = f"the row time is not known, and these go together: {named}{' and so on' * (len(pairs) > _MOST_NAMED)}"
    sets = (*found.sets[:k], (best, *parts), *found.sets[k + 1 :])
    return replace(found, sets=sets), max(grade, 1), "; ".join(filter(None, (said, because)))


def assumed(found: BandsFound, row_time_s: float, exposure_s: float) -> Iterator[str]:
    """What was taken for granted."""
    yield (
        f"each row begins {row_time_s:.4g} s after the one above: with another row time the frequency is another, by a"
        " part of the frame rate or more"
    )
    yield (
        f"whole swings in an exposure are unseen: vibrations at {1 / exposure_s:.4g} Hz and its multiples; also those"
        f" beyond {found.hz[-1]:.4g} Hz"
    )
    if found.bent:
        yield "the target is not straight at rest: vibrations at multiples of the frame rate are unseen"
    else:
        yield "the target is straight or a parabola at rest"
