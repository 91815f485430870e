"""The tracker's error on objects like those of a film: it follows made ones, with their light, noise and motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import interpolate

from aolink.importing.tracker import Objects, Tracker, trackpy_locator
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import pixel_masses

_SHAPES = 7
"""Numbers of a Gaussian's fit: ground, light, place, and the width in each direction."""
_TIMES = 5
"""Moments in a frame at which a made object is shown, those of Gauss's quadrature."""
_DEGREE = 7
"""Degree of the spline through the sums of places: it follows vibrations down to some three frames."""
_BEYOND = 8
"""Frames by which places are continued beyond the ends of a film, so that the spline's ends are outside."""
_NUMBERS = 3000
"""Errors that are made at least: their rms is then certain to about one part in a hundred."""
_TINY = float(np.finfo(np.float64).tiny)


def pixel_noise(windows: FloatArray, centres: FloatArray, sd: float) -> tuple[float, float]:
    """Variance of a dark pixel, and what light adds to it, for one unit of light.

    They are of what a Gaussian with a place, width and direction of its own leaves of each window, (windows, side,
    side), NaN where a pixel is left out; ``centres`` are (windows, 2) as (x, y). So light that has another shape than
    the Gaussian counts as noise, and the blur of an object that moves in a frame does not.
    """
    edges = np.arange(windows.shape[1] + 1) - 0.5
    squares, light = [], []
    for window, centre in zip(windows, centres, strict=True):
        known = np.isfinite(window)
        if not np.isfinite(centre).all() or known.sum() <= 2 * _SHAPES:
            continue
        x, y = (pixel_masses(sd**2, edges, np.asarray(centre[d]), 2) for d in (0, 1))
        terms = [np.outer(y[i], x[j]) for i in range(3) for j in range(3 - i)]
        columns = np.column_stack([np.ones(int(known.sum())), *(each[known] for each in terms)])
        found, *_ = np.linalg.lstsq(columns, window[known], rcond=None)
        left = window[known] - columns @ found
        squares.append(left**2 * len(left) / (len(left) - _SHAPES))
        light.append(np.maximum(found[1] * columns[:, 1], 0.0))
    if not squares:
        return 0.0, 0.0
    square, shown = np.concatenate(squares), np.concatenate(light)
    (dark, gain), *_ = np.linalg.lstsq(np.column_stack([np.ones(len(shown)), shown]), square, rcond=None)
    return (float(dark), float(gain)) if dark > 0 and gain > 0 else (float(square.mean()), 0.0)


def tracker_errors(
    places: FloatArray, samples: Sequence[int], light: FloatArray, sd: float, noise: tuple[float, float], follows: float
) -> FloatArray:
    """Standard deviation of the tracker's error along one direction, for each object, pixels, (n,).

    A tracker for objects of standard deviation ``follows`` follows Gaussians of the objects' size and light in the
    given noise. Each comes from its place in the frame before and moves in the frame as `within_frames` says of its
    places, (frames, n, 2).
    """
    nodes, weights = np.polynomial.legendre.leggauss(_TIMES)
    weights = weights / 2
    rng = np.random.default_rng(1)
    steps = np.nan_to_num(np.diff(places, axis=0, prepend=places[:1]))[samples]

    def followed(places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors in the sampled frames, (samples, n, 2), and the third moments of the motion in each frame."""
        motion = within_frames(places, (nodes + 1) / 2)
        motion -= np.einsum("t, ktnd -> knd", weights, motion)[:, None]
        errors = _followed(motion[samples], weights, steps, light, sd, noise, follows, rng)
        return errors, np.einsum("t, ktnd -> knd", weights, motion**3)

    errors, third = followed(places)
    # A place is off towards the end of its frame's motion where the object was longer. Places that are off make the
    # objects move too far, so the motion of the second round is that of places without it.
    known = np.isfinite(errors)
    off = np.sum(errors[known] * third[samples][known]) / max(np.sum(third[samples][known] ** 2), _TINY)
    rounds = math.ceil(_NUMBERS / max(errors.size, 1))
    each = [np.mean(followed(places - off * third)[0] ** 2, axis=2) for _ in range(rounds)]
    squares = np.where(np.isfinite(places[samples]).all(axis=2), np.mean(each, axis=0), np.nan)
    known = np.isfinite(squares)
    counted = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return np.asarray(np.sqrt(np.where(known, squares, 0.0).sum(axis=0) / counted))


def _followed(
    motion: FloatArray, weights: FloatArray, steps: FloatArray, light: FloatArray, sd: float,
    noise: tuple[float, float], follows: float, rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """The tracker's errors, (frames, n, 2), for objects that move in a frame by ``motion``, (frames, moments, n, 2),
    about their mean place, after ``steps``, (frames, n, 2)."""
    n = motion.shape[2]
    half = math.ceil(4 * max(sd, follows) + np.abs(steps).max())
    side = 2 * half + 1
    middles = np.column_stack([np.arange(n) * side + half, np.full(n, half)]).astype(np.float64)
    edges = [np.arange(count + 1, dtype=np.float64) - 0.5 for count in (n * side, side)]
    locate = trackpy_locator(follows)
    errors = np.full(steps.shape, np.nan)
    for k, during in enumerate(motion):
        true = middles + rng.uniform(-0.5, 0.5, (n, 2))
        picture = np.zeros((side, n * side))
        for j in range(n):
            x, y = (pixel_masses(sd**2, edges[d], true[j, d] + during[:, j, d], 0)[0] for d in (0, 1))
            picture += np.nan_to_num(light[j]) * ((y.T * weights) @ x)
        variance = np.maximum(noise[0] + noise[1] * picture, 0.0)
        tracker = Tracker(Objects(middles - steps[k], follows), locate)
        errors[k] = tracker.follow(picture + np.sqrt(variance) * rng.normal(size=picture.shape)) - true
    return errors


def within_frames(places: FloatArray, moments: FloatArray) -> FloatArray:
    """Places at moments in each frame, (moments,) from 0 to 1, of which the given ones, (frames, n, 2), are the means.

    Sums of means are integrals: the path is the derivative of a spline through them. Where an object is not seen, its
    place goes straight on from the last one to the next; gives (frames, moments, n, 2).
    """
    frames = len(places)
    flat = places.reshape(frames, -1)
    filled = np.zeros_like(flat)
    for k, series in enumerate(flat.T):
        seen = np.flatnonzero(np.isfinite(series))
        if len(seen):
            filled[:, k] = np.interp(np.arange(frames), seen, series[seen])
    more = np.pad(filled, ((_BEYOND, _BEYOND), (0, 0)), mode="reflect", reflect_type="odd")
    sums = np.vstack([np.zeros(flat.shape[1]), np.cumsum(more, axis=0)])
    spline = interpolate.make_interp_spline(np.arange(len(sums)), sums, k=_DEGREE).derivative()
    times = _BEYOND + np.arange(frames)[:, None] + moments
    return np.asarray(spline(times.ravel()).reshape(frames, len(moments), *places.shape[1:]))
