"""The regions of a film that move, whatever they show, and the moments of their paths in each exposure
(`aolink.optics.texture`): the reference is the mean of the frames, each shifted back by its mean displacement."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, signal

from aolink.identification.vibration import PathMoments
from aolink.jobs.look_follow import REACH, followed, window, windows
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.optics.texture import INSIDE, MARGIN, SMOOTH, Texture, turned_covariances

_ROUNDS = 2
_LEAST_LIVELY = 0.03
"""Share of the most lively region's motion below which another is not looked at."""
_ENOUGH_EDGES = 0.2
"""Share of the greatest mean square of gradients from which on a part has enough edges."""
_FEWEST = 8
"""Frames in which a region must be seen."""
_LEAST_QUARTER = 12
"""Pixels along a quarter of a region."""
_MIXED = 0.5
"""Share of a region's motion by which that of a quarter differs where something else is in it."""
_CERTAIN = 4.0
_LEAST_WIDTH = 0.25
"""Least variance of an edge, pixels squared."""


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the picture: its first pixel (x, y) and its size (columns, rows)."""

    x: int
    y: int
    columns: int
    rows: int

    def cut(self, frame: FloatArray, margin: int = 0, moved: tuple[int, int] = (0, 0)) -> FloatArray:
        """The region's pixels of a frame (rows, columns), and so many about it; NaN beyond the picture."""
        x, y = self.x + moved[0] - margin, self.y + moved[1] - margin
        return window(frame, x, y, self.columns + 2 * margin, self.rows + 2 * margin)


def moments_of(
    frames: FloatArray, times_s: FloatArray, exposure_s: float, rate_hz: float, smooth: float = SMOOTH
) -> tuple[PathMoments, FloatArray]:
    """The moments of a region, from its pixels with `MARGIN` more on each side, (K, rows, columns), and the reference.

    Noise is what the fits leave, frame by frame.
    """
    images = ndimage.gaussian_filter(frames, (0, smooth, smooth))
    texture = Texture(frames.mean(axis=0), smooth)
    moved = np.zeros((len(frames), 2))
    for _ in range(_ROUNDS):
        fits = [texture.fit(image, shift) for image, shift in zip(images, moved, strict=True)]
        moved = np.array([each.mean for each in fits]) @ texture.axes
        back = [ndimage.shift(image, -each[::-1], mode="nearest") for image, each in zip(images, moved, strict=True)]
        texture.take(np.mean(back, axis=0))
    names = ("mean", "mean_variance", "spread", "spread_variance")
    mean, mean_variance, spread, spread_variance = (
        np.array([getattr(each, n) for each in fits])[:, None] for n in names
    )
    reference, Q = texture.reference, texture.axes
    return PathMoments(
        times_s=times_s, exposure_s=exposure_s, rate_hz=rate_hz, mean=mean, mean_variance=mean_variance,
        spread=spread, spread_variance=spread_variance, axes=Q[None],
        constant_sd=_sharpness(reference, Q, smooth)[None] / 2,
    ), reference  # fmt: skip


def _sharpness(reference: FloatArray, Q: FloatArray, smooth: float) -> FloatArray:
    """The most that the mean blur of a reference can be, uu, uv and vv, (3,): the variance of its edges, which would be
    wider otherwise. Of a Gaussian edge that is half the mean square of its first derivative over its second's."""
    y, x = np.gradient(reference)
    widths = []
    for d in range(2):
        first = Q[d, 0] * x + Q[d, 1] * y
        hy, hx = np.gradient(first)
        second = Q[d, 0] * hx + Q[d, 1] * hy
        width = float((first[INSIDE] ** 2).mean() / max(2 * float((second[INSIDE] ** 2).mean()), 1e-300)) - smooth**2
        widths.append(max(width, _LEAST_WIDTH))
    return np.array([widths[0], math.sqrt(widths[0] * widths[1]), widths[1]])


@dataclass(frozen=True, eq=False)
class Followed:
    """A region that was followed through a film."""

    region: Region
    """Where it is in the first frame."""
    windows: FloatArray
    """Its pixels with `MARGIN` more on each side, (K, rows, columns); the last ones seen where it is not."""
    known: BoolArray
    """In which frames it is seen, (K,)."""
    travel: FloatArray
    """How far its window has gone since the first of these, x and y, pixels, (K, 2)."""
    moments: PathMoments

    @classmethod
    def of(
        cls, region: Region, windows: FloatArray, known: BoolArray, travel: FloatArray, times_s: FloatArray,
        exposure_s: float, rate_hz: float,
    ) -> Followed:  # fmt: skip
        """With its moments."""
        part, _ = moments_of(windows[known], times_s[known], exposure_s, rate_hz)
        K = len(known)
        mean, spread = np.zeros((K, 1, 2)), np.zeros((K, 1, 3))
        mean_variance, spread_variance = np.full((K, 1, 2), np.inf), np.full((K, 1, 3), np.inf)
        mean[known], mean_variance[known] = part.mean + (travel[known] @ part.axes[0].T)[:, None], part.mean_variance
        spread[known], spread_variance[known] = part.spread, part.spread_variance
        moments = replace(
            part, times_s=times_s, mean=mean, mean_variance=mean_variance, spread=spread,
            spread_variance=spread_variance,
        )  # fmt: skip
        return cls(region, windows, known, travel, moments)

    @property
    def reach(self) -> float:
        """How far it goes from where it is on the mean, pixels."""
        return float(np.abs(self._places - self._places.mean(axis=0)).max())

    @property
    def _places(self) -> FloatArray:
        """Mean place in each frame in which it is seen, x and y, pixels; as on the mean along an edge."""
        mean, known = self.moments.mean[self.known, 0], np.isfinite(self.moments.mean_variance[self.known, 0])
        return np.asarray(np.where(known, mean, 0.0) @ self.moments.axes[0])

    def reference(self) -> tuple[FloatArray, float]:
        """What it looks like where it is on the mean, (rows, columns), and a pixel's noise in a frame."""
        seen, away = self.windows[self.known], self._places - self._places.mean(axis=0) - self.travel[self.known]
        back = [ndimage.shift(each, -move[::-1], mode="nearest") for each, move in zip(seen, away, strict=True)]
        # Immerkaer, Computer Vision and Image Understanding 64 (1996).
        rough = ndimage.convolve(seen, np.array([[[1, -2, 1], [-2, 4, -2], [1, -2, 1]]]))
        return np.mean(back, axis=0), float(np.abs(rough).mean() * math.sqrt(math.pi / 2) / 6)

    def quarter(self, number: int) -> Followed:
        """One of its quarters, along the rows."""
        row, column = divmod(number, 2)
        columns, rows = self.region.columns // 2, self.region.rows // 2
        x, y, of = column * columns, row * rows, self.moments
        windows = self.windows[:, y : y + rows + 2 * MARGIN, x : x + columns + 2 * MARGIN]
        region = Region(self.region.x + x, self.region.y + y, columns, rows)
        return self.of(region, windows, self.known, self.travel, of.times_s, of.exposure_s, of.rate_hz)

    def livelier_quarter(self, hz: float) -> Followed | None:
        """The quarter that moves most at a frequency, where one moves in another way than all of it: something else is
        in it. None where none does, or that is not seen."""
        if min(self.region.columns, self.region.rows) < 2 * _LEAST_QUARTER:
            return None
        whole = _swing(self.moments, hz)[0]
        quarters = [self.quarter(number) for number in range(4)]
        apart = [beside(each.moments, self.moments) for each in quarters]
        swings = [_swing(each, hz) for each in apart if each is not None]
        if not any(swing > max(_MIXED * whole, _CERTAIN * chance) for swing, chance in swings):
            return None
        return max(quarters, key=lambda each: _swing(each.moments, hz)[0])


def _swing(seen: PathMoments, hz: float) -> tuple[float, float]:
    """How far the mean places go at a frequency, pixels, and what chance shows of that."""
    total = chance = 0.0
    for d in range(2):
        known = np.isfinite(seen.mean_variance[:, 0, d])
        if known.sum() > _FEWEST:
            place = signal.detrend(seen.mean[known, 0, d])
            turn = np.exp(-2j * np.pi * hz * seen.times_s[known])
            total += float(np.abs(turn @ place) * 2 / len(place)) ** 2
            chance += 4 * float(place.var()) / len(place)
    return math.sqrt(total), math.sqrt(chance)


def measured(
    region: Region, cuts: FloatArray, gone: Indices, times_s: FloatArray, exposure_s: float, rate_hz: float
) -> Followed | None:
    """A region that is followed in its cuts, `REACH` and `MARGIN` larger on each side, after the picture as a whole has
    gone so far, (K, 2); None where it is hardly seen."""
    places, known = followed(cuts, REACH)
    if known.sum() < _FEWEST:
        return None
    latest = np.maximum(np.maximum.accumulate(np.where(known, np.arange(len(known)), -1)), int(known.argmax()))
    travel = (gone + places - (gone + places)[known.argmax()]).astype(np.float64)
    held = windows(cuts, places, REACH)[latest]
    return Followed.of(region, held, known, travel, times_s, exposure_s, rate_hz)


def beside(seen: PathMoments, rest: PathMoments) -> PathMoments | None:
    """The motion of a region beside that of another one; None where that one is seen along one direction only."""
    if not np.isfinite(rest.mean_variance).any(axis=(0, 1)).all():
        return None
    turn = seen.axes[0] @ rest.axes[0].T
    squares = turned_covariances(turn)
    unknown = ~np.isfinite(rest.mean_variance).all(axis=2, keepdims=True)
    variance = [np.where(np.isfinite(each), each, 0.0) for each in (rest.mean_variance, rest.spread_variance)]
    return replace(
        seen, mean=seen.mean - rest.mean @ turn.T, spread=seen.spread - rest.spread @ squares.T,
        mean_variance=np.where(unknown, np.inf, seen.mean_variance + variance[0] @ (turn**2).T),
        spread_variance=np.where(unknown, np.inf, seen.spread_variance + variance[1] @ (squares**2).T),
    )  # fmt: skip


def lively(
    frames: Iterable[FloatArray], size: int, most: int, gone: FloatArray
) -> tuple[list[Region], Region | None, FloatArray]:
    """The regions that move most, none over another: where variance in time times gradient is largest; one that has
    edges and moves least, if there is any; and the mean of the frames (rows, columns).

    Frames are moved back by the picture's own travel.
    """
    total = squares = common = None
    left, top = np.ceil(np.maximum(-gone.min(axis=0), 0)).astype(int)
    right, bottom = np.ceil(np.maximum(gone.max(axis=0), 0)).astype(int)
    for frame, (x, y) in zip(frames, gone, strict=True):
        image = ndimage.gaussian_filter(frame, SMOOTH)
        if gone.any():
            image = ndimage.shift(image, (-y, -x), order=1, mode="nearest")
            inner = np.s_[top : image.shape[0] - bottom : 2, left : image.shape[1] - right : 2]
            if common is None:  # and what is left of that: a shift of all, and the light
                common = np.stack([*np.gradient(image), image, np.ones_like(image)], axis=-1)
            fit = np.linalg.lstsq(common[inner].reshape(-1, 4), image[inner].ravel() - common[inner][..., 2].ravel())
            image = image - common @ fit[0]
        total = image if total is None else total + image
        squares = image**2 if squares is None else squares + image**2
    assert total is not None
    assert squares is not None
    mean = total / len(gone)
    variance = np.maximum(squares / len(gone) - mean**2, 0.0)
    # What noise makes everywhere is no motion.
    variance = np.maximum(variance - 2 * np.median(variance), 0.0)
    y, x = np.gradient(mean)
    gradient = x * x + y * y
    moving, edges = (ndimage.uniform_filter(each, size) for each in (variance * gradient, gradient))
    rows, columns = moving.shape
    half = size // 2 + MARGIN + 1
    whole = np.zeros(moving.shape, dtype=np.bool_)
    whole[half + top : rows - half - bottom, half + left : columns - half - right] = True
    if not whole.any():
        whole[half : rows - half, half : columns - half] = True
    moving = np.where(whole, moving, 0.0)
    found: list[Region] = []
    brightest = float(moving.max())
    still = np.where(
        whole & (edges > _ENOUGH_EDGES * edges[whole].max(initial=0.0)), edges**2 / (moving + 1e-3 * brightest), 0.0
    )
    while len(found) < most and moving.max() > _LEAST_LIVELY * brightest:
        r, c = (int(k) for k in np.unravel_index(int(moving.argmax()), moving.shape))
        found.append(Region(c - size // 2, r - size // 2, size, size))
        for each in (moving, still):
            each[max(0, r - size) : r + size, max(0, c - size) : c + size] = 0
    r, c = (int(k) for k in np.unravel_index(int(still.argmax()), still.shape))
    return found, Region(c - size // 2, r - size // 2, size, size) if still[r, c] else None, mean
