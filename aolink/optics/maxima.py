"""Spots on a frame before their lattice is known: background, maxima, centroids."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aolink.errors import FrameError
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.centroid import weighted_centroid

# A spot is a maximum this many standard deviations above the noise of the smoothed frame.
_SIGNIFICANCE = 8.0
# It must also exceed this share of the brightest spots: without noise, anything fainter is a ring of a spot.
_FAINTEST = 2e-3
# A pixel this many times as bright as its neighbours is hot: no pixel of a spot of sd 0.6 pixels or more is.
_HOT = 4.0
# Share of a frame's pixels that may be bad.
_MOST_BAD = 0.5
# Spots of a smaller standard deviation, pixels, may be taken for hot pixels.
_COARSE = 0.8
# The weight's width for the narrowest spots times theirs, pixels squared.
_COARSE_WEIGHT = 0.875
_TINY = float(np.finfo(np.float64).tiny)
# The height of the brightest spots is that of the maximum with this rank: a few may be cosmic rays.
_BRIGHT = 7
# The background is the medians of blocks with this many pixels along a side.
_BLOCK = 32
# Noise is measured in this many parts along each side of a frame; a part needs at least this many dark pixels.
_PARTS, _FEWEST_DARK = 4, 300
# Standard deviations of the Gaussians that frames are smoothed by, pixels; the one for usual spots is first.
_SCALES = (1.5, 3.0, 6.0, 0.75)


@dataclass(frozen=True, kw_only=True, eq=False)
class Maxima:
    """Maxima of a smoothed frame that exceed its noise."""

    places: FloatArray
    """Positions (x, y), pixels, (n, 2)."""
    heights: FloatArray
    """Value of the smoothed frame there, counts above the background, (n,)."""
    scale: float
    """Standard deviation of the Gaussian that the frame was smoothed by, pixels."""
    dense: bool
    """Whether they exceed the pixels' noise only, and not the spread of the whole frame."""


def flatten(frame: NDArray[np.generic]) -> tuple[FloatArray, FloatArray]:
    """A frame without its background and its isolated hot pixels, and that background, each (rows, columns).

    Bad pixels are NaN, and interpolated. Raises `FrameError` where the frame is not a picture, or has no good pixels.
    """
    if frame.ndim != 2 or min(frame.shape) < _BLOCK or frame.dtype.kind not in "biuf":
        raise FrameError(
            f"a frame of {_BLOCK} x {_BLOCK} real numbers or more is needed, found {frame.shape} of {frame.dtype}"
        )
    counts = frame.astype(np.float64)
    if (bad := ~np.isfinite(counts)).any():
        if bad.mean() > _MOST_BAD:
            raise FrameError(f"{int(bad.sum())} of {bad.size} pixels are not numbers")
        counts = mended(counts, bad)
    if counts.min() == counts.max():
        raise FrameError(
            f"no usable spots: every pixel is {counts.flat[0]:g}; check whether the camera is saturated or dark"
        )
    rows, columns = (max(1, n // _BLOCK) for n in counts.shape)
    blocks = [[np.median(part) for part in np.array_split(strip, columns, 1)] for strip in np.array_split(counts, rows)]
    smooth = ndimage.zoom(
        np.array(blocks), (counts.shape[0] / rows, counts.shape[1] / columns), order=1, mode="nearest", grid_mode=True
    )
    flat = counts - smooth
    ring = np.ones((3, 3), dtype=np.bool_)
    ring[1, 1] = False
    # A hot pixel, or one of a pair, is far brighter than its second brightest neighbour; light through a lens is not.
    second = ndimage.rank_filter(flat, -2, footprint=ring)
    alone = flat - _HOT * np.maximum(second, 0) > 6 * spread(flat)
    around = ndimage.median_filter(flat, 3)
    return np.where(alone, around, flat), smooth


def mended(values: FloatArray, defects: BoolArray) -> FloatArray:
    """A picture whose ``defects`` are interpolated from the pixels about them, (rows, columns).

    The weights of the neighbours are those of a product of parabolas along x and y; where another defect is among
    them, their median is taken.
    """
    known = np.pad(np.where(defects, np.nan, values), 1, mode="reflect")
    rows, columns = np.nonzero(defects)
    around = np.array([[known[rows + i, columns + j] for j in range(3)] for i in range(3)])
    if (lost := np.isnan(around).all(axis=(0, 1))).any():
        around[1, 1, lost] = np.median(values[~defects])
    beside = around[0, 1] + around[2, 1] + around[1, 0] + around[1, 2]
    across = around[0, 0] + around[0, 2] + around[2, 0] + around[2, 2]
    middle = np.nanmedian(around.reshape(9, -1), axis=0)
    whole = values.copy()
    whole[defects] = np.where(np.isfinite(beside + across), beside / 2 - across / 4, middle)
    return whole


def find_maxima(flat: FloatArray) -> Iterator[Maxima]:
    """The maxima of a flattened frame for several widths of smoothing and two estimates of its noise, one at a time.

    Where most pixels are dark, the noise is the standard deviation of all pixels. Where spots stand close together that
    would be the spots' own spread, so the noise is estimated from second differences from pixel to pixel.
    """
    for scale in _SCALES:
        smooth = ndimage.gaussian_filter(flat, scale)
        wide = spread(smooth)
        narrow = smoothed_noise(flat, scale)
        for noise in (wide, narrow) if narrow < wide / 2 else (wide,):
            dense = noise < wide
            yield maxima_above(smooth, scale, noise, float(np.quantile(smooth, 0.25 if dense else 0.5)), dense=dense)


def smoothed_noise(flat: FloatArray, scale: float) -> float:
    """Standard deviation of independent noise after smoothing by a Gaussian of sd ``scale``, counts.

    The pixels' noise is estimated from their second differences along both axes.
    """
    fine = np.abs(np.diff(np.diff(flat, 2, axis=0), 2, axis=1))
    # A quarter of a normal variable's values lie within .3186 sd; there are fewer spots among them than in the half.
    return float(np.quantile(fine, 0.25)) / (0.3186 * 6) / (2 * math.sqrt(math.pi) * scale)


def noise_map(smooth: FloatArray, dark: BoolArray) -> FloatArray:
    """Standard deviation of the dark pixels near each pixel, (rows, columns): noise grows with stray light."""
    noise = np.full(smooth.shape, spread(smooth[dark]))
    for rows in np.array_split(np.arange(smooth.shape[0]), _PARTS):
        for columns in np.array_split(np.arange(smooth.shape[1]), _PARTS):
            part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            if dark[part].sum() > _FEWEST_DARK:
                noise[part] = spread(smooth[part][dark[part]])
    return noise


def maxima_above(
    smooth: FloatArray, scale: float, noise: FloatArray | float, dark: float, *, dense: bool = False
) -> Maxima:
    """Maxima of a frame smoothed by a Gaussian of sd ``scale`` that are far above its ``noise``.

    ``dark`` is the smoothed frame's level without spots, which is above zero where a camera clips its noise at zero.
    """
    smooth = smooth - dark
    at_top = smooth == ndimage.maximum_filter(smooth, 2 * math.ceil(2 * scale) + 1)
    heights = np.sort(smooth[at_top])
    threshold = np.maximum(_SIGNIFICANCE * noise, _FAINTEST * heights[-min(_BRIGHT, len(heights))])
    # A saturated spot's top is flat: its pixels are one maximum.
    label, n = ndimage.label(at_top & (smooth > threshold), np.ones((3, 3)))
    y, x = np.nonzero(label)
    which = label[y, x] - 1
    size = np.maximum(np.bincount(which, minlength=n), 1)
    places = np.stack([np.bincount(which, weights=v, minlength=n) / size for v in (x, y)], axis=1)
    tops = np.zeros(n)
    tops[which] = smooth[y, x]
    return Maxima(places=places, heights=tops, scale=scale, dense=dense)


def spread(values: FloatArray) -> float:
    """Standard deviation from the median absolute deviation, which spots do not change."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), _TINY)


def refine(flat: FloatArray, places: FloatArray, pitch: float) -> FloatArray:
    """Each spot's weighted centroid, pixels, (n, 2); the weight's width is that of the spots.

    A centroid further than a quarter of the pitch from its maximum is not used.
    """
    windows, corners = cut_windows(flat, places, _half(pitch))
    # A wider weight would include neighbouring spots, and a narrower one than some pixels is no Gaussian on pixels.
    sd = spot_sd(flat, places, pitch)
    weight_sd = max(min(1.5 * sd, pitch / 6), min(_COARSE_WEIGHT / sd, pitch / 4))
    found = corners + weighted_centroid(windows, weight_sd, start=places - corners)
    moved = np.linalg.norm(found - places, axis=1) < pitch / 4
    return np.where(moved[:, None], found, places)


def with_sharp_spots(
    frame: NDArray[np.generic], flat: FloatArray, ground: FloatArray, places: FloatArray, pitch: float
) -> FloatArray:
    """A flattened frame with the middles of its spots, at ``places`` (n, 2), where these are undersampled: `flatten`
    takes some of them for hot pixels."""
    raw = frame.astype(np.float64) - ground
    at = np.zeros(flat.shape, dtype=np.bool_)
    columns, rows = np.clip(np.rint(places).astype(np.int64).T, 0, np.array(flat.shape[::-1])[:, None] - 1)
    at[rows, columns] = True
    at = ndimage.binary_dilation(at, np.ones((3, 3), dtype=np.bool_)) & np.isfinite(raw)
    whole = np.where(at, raw, flat)
    return whole if spot_sd(whole, places, pitch) < _COARSE else flat


def likeness(flat: FloatArray, places: FloatArray, models: FloatArray, pitch: float) -> FloatArray:
    """Correlation of the light at each place with the median spot at the models' places, (n,), 1 for the same shape.

    It is the largest over shifts by a pixel, and not below zero.
    """
    sd = spot_sd(flat, models, pitch)
    half = min(math.ceil(3 * sd), _half(pitch))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    weight = np.exp(-(x**2 + y**2) / (2 * (1.5 * sd) ** 2))  # it has little light of neighbouring spots
    weight /= weight.sum()

    def even(windows: FloatArray) -> FloatArray:
        return np.asarray(windows - (weight * windows).sum(axis=(-2, -1), keepdims=True))

    model = even(_median_spot(cut_windows(flat, models, half)[0]))
    best = np.zeros(len(places))
    # A spot between two pixels may be centred on either: the models may be centred on the other pixel.
    for shift in np.ndindex(3, 3):
        windows = even(cut_windows(flat, places + np.array(shift) - 1, half)[0])
        power = (weight * windows**2).sum(axis=(1, 2)) * (weight * model**2).sum()
        best = np.maximum(best, (weight * windows * model).sum(axis=(1, 2)) / np.sqrt(np.maximum(power, _TINY)))
    return best


def _median_spot(windows: FloatArray) -> FloatArray:
    """The median of windows, each of height one, (side, side)."""
    height = windows.max(axis=(1, 2), keepdims=True)
    return np.asarray(np.median(windows / np.where(height > 0, height, 1.0), axis=0))


def _half(pitch: float) -> int:
    """Pixels from the middle of a window to its edge, so that it holds one spot."""
    return max(2, math.floor(pitch / 2 - 0.5))


def spot_sd(flat: FloatArray, places: FloatArray, pitch: float) -> float:
    """Standard deviation of the median spot, pixels, from half a pixel to a quarter of the pitch.

    Under a Gaussian weight of sd w a Gaussian spot of sd s has the variance 1 / (1/s^2 + 1/w^2).
    """
    half = _half(pitch)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    square, sd = x**2 + y**2, min(1.5, pitch / 4)
    spot = np.maximum(_median_spot(cut_windows(flat, places, half)[0]), 0)
    for _ in range(20):
        weight = np.exp(-square / (2 * sd**2)) * spot
        seen = float((weight * square).sum() / max(weight.sum(), _TINY)) / 2
        steepness = 1 / max(seen, 0.1) - 1 / sd**2
        sd = float(np.clip(steepness**-0.5 if steepness > 0 else np.inf, 0.5, pitch / 4))
    return sd


def cut_windows(frame: FloatArray, middles: FloatArray, half: int) -> tuple[FloatArray, FloatArray]:
    """Square windows of 2 half + 1 pixels about the pixels nearest to ``middles``, zero beyond the frame, (n, side,
    side), and the middle of each window's first pixel on the frame as (x, y), (n, 2)."""
    side = 2 * half + 1
    corners = np.rint(middles).astype(np.int64) - half
    padded = np.pad(frame, side)
    view = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    inside = np.clip(corners + side, 0, np.array(view.shape[1::-1]) - 1)
    return view[inside[:, 1], inside[:, 0]].copy(), corners.astype(np.float64)
