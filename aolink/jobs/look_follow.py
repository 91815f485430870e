"""What travels is followed in whole pixels, so that a moving window holds it: the travel is a part of the path.

The picture as a whole is followed by the correlation of its details with those of a frame before; a region in it, from
the frame in which it shows most, by its normalised correlation nearby.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy import fft, ndimage, signal

from aolink.errors import ImportingError
from aolink.numerics.arrays import BoolArray, FloatArray, Indices

REACH = 24
"""Pixels that a region may be from where the picture's own travel puts it."""
_COARSE = 256
"""Pixels along the longer side of what pictures are made smaller to, at most twice as many."""
_SURE = 0.1
"""By so much of the whole must a shift correlate better than none."""
_ABOUT = np.array([-1, 0, 1])
_FAR = 0.25
"""Share of a picture's side by which it may have travelled before it is compared with a later frame."""
_STEP = 10
"""Pixels that a region may go from one frame to the next."""
_LEAST_LIKE = 0.5
"""Correlation below which a region is not seen in a frame."""
_TYPICAL = 0.75
"""Rank, among the frames by how much a region shows, of the one that the others are compared with."""
_CUT = 0.4
"""Share of the correlation before below which the picture is another one."""
_BETTER = 0.8
"""Share of what differs at the place before that may be left at another one."""


def details(images: FloatArray) -> FloatArray:
    """What is between some two and eight pixels wide, (..., rows, columns)."""
    along = [0.0] * (images.ndim - 2)
    return np.asarray(
        ndimage.gaussian_filter(images, (*along, 1.5, 1.5)) - ndimage.gaussian_filter(images, (*along, 6.0, 6.0))
    )


def travels(frames: Iterable[FloatArray]) -> FloatArray:
    """How far the picture as a whole has gone since the first frame, x and y, pixels, (K, 2); zero up to one pixel.

    Raises `ImportingError` where a film is cut: it shows another thing from some frame on.
    """
    gone, likes = list[FloatArray](), list[float]()
    base, key, window, by = np.zeros(2), None, np.ones((1, 1)), 1
    for frame in frames:
        if key is None:
            by = max(1, max(frame.shape) // _COARSE)
        rows, columns = (n // by for n in frame.shape)
        small = details(frame[: rows * by, : columns * by].reshape(rows, by, columns, by).mean(axis=(1, 3)))
        if key is None:
            window = np.outer(np.hanning(rows), np.hanning(columns))
        spectrum = fft.rfft2(small * window)
        if key is None:
            key, power = spectrum, float((small * window).var() * small.size)
        alike = fft.irfft2(spectrum * key.conj(), s=small.shape)
        r, c = (int(k) for k in np.unravel_index(int(alike.argmax()), alike.shape))
        own = float((small * window).var() * small.size)
        likes.append(float(alike.max()) / math.sqrt(max(own * power, 1e-300)))
        if alike.max() - alike[0, 0] < _SURE * power:
            r = c = 0
        near = alike[np.ix_((r + _ABOUT) % rows, (c + _ABOUT) % columns)]
        fine = [_vertex(near[:, 1]), _vertex(near[1])]
        r, c = r - rows * (2 * r > rows), c - columns * (2 * c > columns)
        gone.append(base + by * (np.array([c, r]) + fine[::-1]))
        if abs(r) > _FAR * rows or abs(c) > _FAR * columns:
            base, key, power = gone[-1], spectrum, own
    for k in range(1, len(likes)):
        before = float(np.median(likes[:k]))
        if before > _LEAST_LIKE and max(likes[k:]) < _CUT * before:
            raise ImportingError(f"frame {k + 1} and those after it show something else: cut the film there")
    path = np.array(gone)
    return path if np.abs(path).max() > 1 else np.zeros_like(path)


def _vertex(values: FloatArray) -> float:
    """Where a parabola through values at -1, 0 and 1 is highest."""
    bend = values[0] - 2 * values[1] + values[2]
    return float(np.clip((values[0] - values[2]) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0


def window(frame: FloatArray, x: int, y: int, columns: int, rows: int) -> FloatArray:
    """The part of a frame (..., rows, columns) that begins at (x, y); NaN beyond the picture."""
    out = np.full((*frame.shape[:-2], rows, columns), np.nan)
    height, width = frame.shape[-2:]
    top, left = min(max(0, -y), rows), min(max(0, -x), columns)
    bottom, right = max(min(rows, height - y), top), max(min(columns, width - x), left)
    out[..., top:bottom, left:right] = frame[..., top + y : bottom + y, left + x : right + x]
    return out


def followed(cuts: FloatArray, reach: int) -> tuple[Indices, BoolArray]:
    """How far a region has gone from the middle of its cuts (K, rows, columns), x and y, whole pixels up to ``reach``,
    (K, 2); and in which frames it is seen, (K,)."""
    K = len(cuts)
    shown = details(np.nan_to_num(cuts))
    middle = np.s_[reach : cuts.shape[1] - reach, reach : cuts.shape[2] - reach]
    whole = np.isfinite(cuts[:, *middle]).all(axis=(1, 2))
    energy = np.where(whole, shown[:, *middle].var(axis=(1, 2)), -1.0)
    start = int(energy.argsort()[round(_TYPICAL * (K - 1))])  # no flash, and no frame without it
    template = shown[start][middle]
    shape, size = template.shape, float((template**2).sum())
    places, seen = np.zeros((K, 2), dtype=np.int64), np.zeros(K, dtype=np.bool_)
    for order in (range(start, K), range(start, -1, -1)):
        at = np.array([0, 0])
        for k in order:
            low = np.maximum(at - _STEP, -reach)
            high = np.minimum(at + _STEP, reach)
            part = np.s_[reach + low[1] : reach + high[1] + shape[0], reach + low[0] : reach + high[0] + shape[1]]
            alike = signal.fftconvolve(shown[k][part], template[::-1, ::-1], mode="valid")
            own = signal.fftconvolve(shown[k][part] ** 2, np.ones(shape), mode="valid")
            differs = own - 2 * alike + size
            r, c = np.unravel_index(int(differs.argmin()), differs.shape)
            before = at - low
            if differs[r, c] < _BETTER * differs[before[1], before[0]]:
                at = low + np.array([c, r])
            there = at - low
            like = alike[there[1], there[0]] / np.sqrt(max(own[there[1], there[0]] * size, 1e-300))
            places[k], seen[k] = at, like > _LEAST_LIKE and bool(np.isfinite(_at(cuts[k], at, reach)).all())
    return places, seen


def windows(cuts: FloatArray, places: Indices, reach: int) -> FloatArray:
    """The windows at these places of cuts (K, rows, columns), which are larger by ``reach`` on each side."""
    return np.stack([_at(cut, place, reach) for cut, place in zip(cuts, places, strict=True)])


def _at(cut: FloatArray, place: Indices, reach: int) -> FloatArray:
    rows, columns = (n - 2 * reach for n in cut.shape)
    x, y = reach + place
    return cut[y : y + rows, x : x + columns]
