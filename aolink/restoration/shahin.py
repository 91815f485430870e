"""A. A. Shahin, *Application of Kalman filter in digital image processing*: a motion along the rows of a picture.

Each row of the picture is a line of its own, image = C scene (4), a moving average of the scene's pixels. III inverts
it. IV sees the scene as the output of a scanner (V), a small system that white noise drives, and gives the Kalman
filter's estimates: predictor, filter, fixed lag and fixed interval.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, ndimage

from aolink.errors import RestorationError
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.restoration import spectrum
from aolink.restoration.method import Blurred, Direction, Restored
from aolink.restoration.psf import STRAIGHT_PX, line_matrix
from aolink.restoration.scanner import Scanner, first_order

_Boundary = float | ArrayLike | None

# Zeros may lie on the unit circle, as those of a uniform PSF do: an error then keeps its size.
_ON_CIRCLE = 1e-6


def inverse(
    picture: Blurred, *, boundary: _Boundary = None, scanner: Scanner | None = None, direction: Direction | None = None
) -> Restored:
    """III: the scene whose blur is exactly this picture; noise and ``scanner`` are ignored."""
    values, origin = _without_delay(picture.psf.values, picture.psf.origin[0])
    way = stable_direction(values, _checked_direction(direction))
    lines = _Lines.of(picture, values, origin, boundary, way)
    scene = invert_lines(lines.rows, lines.values, lines.known)
    # Pixels that the PSF never brings into the frame take the value of the last pixel that it does bring in.
    place = np.arange(lines.rows.shape[1]) + lines.values.shape[-1] - 1 - lines.origin
    found = lines.picture(scene[:, np.clip(place, 0, scene.shape[1] - 1)], picture.planes.shape)
    return Restored(image=found, scanner=scanner, direction=way)


def why_not_inverse(picture: Blurred) -> str | None:
    if not picture.psf.on_line:
        return "the exact inverse needs a motion along the picture's rows or columns: use smoother"
    if picture.seen is not None:
        return "the exact inverse cannot do without a pixel: use the method smoother for masked ones"
    return None


def largest_zero(values: FloatArray) -> float:
    """Largest magnitude of the zeros of c_0 z^m + .. + c_m; where each pixel has its own PSF, the largest of all.

    An error of the initial state is multiplied by it from pixel to pixel: below one, the inverse is stable.
    """
    kept = (np.trim_zeros(taps) for taps in np.unique(values.reshape(-1, values.shape[-1]), axis=0))
    return max((float(np.abs(np.roots(taps)).max()) for taps in kept if len(taps) > 1), default=0.0)


def stable_direction(values: FloatArray, wanted: Direction | None = None) -> Direction:
    """The direction in which lines can be inverted exactly, or the requested one; backwards the PSF is reversed.

    Raises `RestorationError` where the inverse is unstable in the requested direction; or in both: the PSF has zeros on
    both sides of the unit circle.
    """
    zeros: dict[Direction, float] = {"forward": largest_zero(values), "backward": largest_zero(values[..., ::-1])}
    best: Direction = "forward" if zeros["forward"] <= zeros["backward"] else "backward"
    way = wanted or best
    if zeros[way] <= 1 + _ON_CIRCLE:
        return way
    raise RestorationError(
        f"the exact inverse is unstable{f' {wanted}s' if wanted else ''}: the PSF's largest zero is"
        f" {zeros['forward']:.3g} forwards and {zeros['backward']:.3g} with the line scanned backwards, and it must lie"
        " within the unit circle; take the direction in which it does, or the method smoother, gauss_markov or tv"
    )


def invert_lines(lines: FloatArray, values: FloatArray, known: FloatArray | None) -> FloatArray:
    """The scenes whose blur is exactly these lines (lines, columns), scanned forwards: (lines, columns + m), the m
    pixels of the initial state first. The PSF is (taps,) or (columns, taps), c_0 above zero.

    ``known`` are the scene's m pixels before the first that c_0 meets, in their order on the line, (lines or 1, m).
    None estimates them: of all scenes that give these lines, the one with the smallest differences.
    """
    columns, m = lines.shape[1], values.shape[-1] - 1
    C = line_matrix(values, columns)
    T = C[:, m:]
    free = linalg.solve_triangular(T, lines.T, lower=True)
    response = -linalg.solve_triangular(T, C[:, :m], lower=True)
    if known is None:
        whole = np.concatenate([np.eye(m), response])
        unmoved = np.concatenate([np.zeros((m, len(lines))), free])
        start = np.linalg.lstsq(np.diff(whole, axis=0), -np.diff(unmoved, axis=0), rcond=None)[0]
    else:
        start = np.broadcast_to(known, (len(lines), m)).T
    return np.concatenate([start, free + response @ start]).T


def kalman_estimate(
    picture: Blurred, which: str, *,
    boundary: _Boundary = None, scanner: Scanner | None = None, direction: Direction | None = None,
) -> Restored:  # fmt: skip
    """IV: the estimate ``which`` of each line: predictor, filter, lag or smoother."""
    way = _checked_direction(direction) or "forward"
    back = None
    if not picture.psf.on_line:
        planes, seen, back = _to_lines(picture.whole, picture.seen, picture.line.angle_rad)
        picture = replace(picture, planes=planes, psf=picture.line.psf, seen=seen)
    psf, noise = picture.psf, picture.noise_variance
    if scanner is None:
        scanner = first_order(
            *spectrum.correlation_and_variance(spectrum.line_spectrum(picture.whole, psf.mean), noise)
        )
    unexplained = line_variance(psf.modes, scanner)
    lines = _Lines.of(picture, psf.values, psf.origin[0], boundary, way)
    scene = lines.picture(_estimated(lines, which, scanner, noise + unexplained), picture.planes.shape)
    return Restored(
        image=scene if back is None else back(scene), noise_sd=math.sqrt(noise), psf_noise_sd=math.sqrt(unexplained),
        expected_gain_db=expected_gain_db(which, psf.mean, psf.origin[0], scanner, noise + unexplained),
        scanner=scanner, direction=way,
    )  # fmt: skip


def why_not_lines(picture: Blurred) -> str | None:
    if picture.psf.on_line or picture.line.deviation_px <= STRAIGHT_PX:
        return None
    return (
        f"the motion is not along a straight line: its light strays from one by {picture.line.deviation_px:.2g} pixels"
        f" rms, and a method on lines bears {STRAIGHT_PX:g}; use gauss_markov, tv or pnp"
    )


def line_variance(modes: FloatArray, scanner: Scanner) -> float:
    """Variance of the noise that a PSF's error makes of a scanner's scene: PSF modes (modes, .., taps) with the scene's
    covariance R add m' R m each, of which the mean over the pixels is taken where each has its own PSF."""
    if not len(modes):
        return 0.0
    R = linalg.toeplitz(scanner.correlation(modes.shape[-1] - 1))
    return float(np.einsum("...i,ij,...j->...", modes, R, modes).reshape(len(modes), -1).mean(axis=1).sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class LineModel:
    """The augmented model (12), with the prior of its state at the first pixel.

    The state is W(k) = (X(k), Z(k)): X holds the scene's last m pixels, X_i = scene(k - i), the canonical realisation
    (8) of the PSF's transfer function (7); Z is the scanner's.
    """

    A: FloatArray
    """The transition matrix, with B gamma and alpha in it, (states, states)."""
    Q: FloatArray
    """Process noise B-bar K B-bar', (states, states)."""
    rows: FloatArray
    """C-bar = (c_1 .. c_m, c_0 gamma) for each pixel, (columns, states)."""
    output: FloatArray
    """Row that gives the scene at k from W(k), (states,)."""
    start_mean: FloatArray
    """Mean of W(0), (lines or 1, states)."""
    start_covariance: FloatArray
    """Covariance P(0), (states, states)."""


def line_model(values: FloatArray, columns: int, scanner: Scanner, known: FloatArray | None = None) -> LineModel:
    """The model of lines of so many pixels of a scanner's scene, blurred by a PSF c_0 .. c_m, (taps,), or that of each
    pixel, (columns, taps).

    ``known`` are the m pixels of the scene before the first, about its mean, the nearest first, (lines or 1, m); None
    where they are not known and have the scanner's stationary covariance.
    """
    taps = np.broadcast_to(values, (columns, values.shape[-1]))
    m, q = taps.shape[1] - 1, len(scanner.gamma)
    n = m + q
    A, Q = np.zeros((n, n)), np.zeros((n, n))
    A[:m, :m] = np.eye(m, k=-1)
    A[:1, m:] = scanner.gamma
    A[m:, m:] = scanner.alpha
    Q[m:, m:] = scanner.noise
    # Stationary covariance of (scene(-1) .. scene(-m), Z(0)).
    P = np.empty((n, n))
    P[:m, :m], P[m:, m:] = linalg.toeplitz(scanner.correlation(m))[:m, :m], scanner.covariance
    reach = scanner.covariance @ scanner.gamma
    for i in range(m):
        reach = scanner.alpha @ reach
        P[m:, i] = P[i, m:] = reach
    mean = np.zeros((1, n))
    if known is not None and m:
        # The scanner's state, given the pixels that it has just put out.
        gain = np.linalg.lstsq(P[:m, :m], P[:m, m:], rcond=None)[0]
        mean = np.concatenate([known, known @ gain], axis=1)
        given = P[m:, m:] - P[m:, :m] @ gain
        P = np.zeros_like(P)
        P[m:, m:] = (given + given.T) / 2
    return LineModel(
        A=A, Q=Q, rows=np.concatenate([taps[:, 1:], taps[:, :1] * scanner.gamma], axis=1),
        output=np.concatenate([np.zeros(m), scanner.gamma]), start_mean=mean, start_covariance=P,
    )  # fmt: skip


def expected_gain_db(which: str, taps: FloatArray, origin: int, scanner: Scanner, noise_variance: float) -> float:
    """Error of the blurred picture over that of the ``predictor`` or ``filter`` far from the border, dB.

    NaN for the others: they use the blurred pixel itself and all that the pixel's light fell on, and gain.
    """
    if which not in ("predictor", "filter"):
        return math.nan
    r, model = scanner.correlation(len(taps)), line_model(taps, 1, scanner)
    blurred = r[0] - 2 * taps @ r[np.abs(np.arange(len(taps)) - origin)] + taps @ linalg.toeplitz(r[:-1]) @ taps
    row = model.rows[0]
    P = linalg.solve_discrete_are(model.A.T, row[:, None], model.Q, np.full((1, 1), noise_variance))
    if which == "filter":
        P = P - np.outer(P @ row, P @ row) / (row @ P @ row + noise_variance)
    return float(10 * np.log10((blurred + noise_variance) / (model.output @ P @ model.output)))


def kalman(
    model: LineModel, lines: FloatArray, noise_variance: float, seen: BoolArray | None, pixels: range, which: str,
    lag: int = 0, first: int = 0,
) -> FloatArray:  # fmt: skip
    """Pixels of the scenes of lines (lines, columns) by the ``predictor``, or the ``filter`` of so many pixels later.

    (13), with the barred B in B K B', in the usual two steps; F(k) there is A times the gain here. Lines that are seen
    alike share one covariance. Pixels before that of state ``first`` are taken from the past pixels X that this state
    holds, and the last ones from the last state; ``seen`` is False where a pixel was not measured.
    """
    n_lines, columns = lines.shape
    W = np.broadcast_to(model.start_mean, (n_lines, len(model.A)))
    weights = np.ones((1, columns)) if seen is None else seen.astype(np.float64)
    if (weights == weights[:1]).all():
        weights = weights[:1]
    P = np.repeat(model.start_covariance[None], len(weights), axis=0)
    lines = np.where(weights > 0, lines, 0.0)
    out, given_by = np.empty((n_lines, len(pixels))), defaultdict[int, list[int]](list)
    for pixel in pixels:
        given_by[min(max(pixel + lag, first), columns - 1)].append(pixel)
    for k, row in enumerate(model.rows):
        PC = P @ row
        gain = PC * (weights[:, k] / (PC @ row + noise_variance))[:, None]
        filtered = W + gain * (lines[:, k] - W @ row)[:, None]
        states = W if which == "predictor" else filtered
        for pixel in given_by[k]:
            out[:, pixel - pixels.start] = states @ model.output if pixel == k else states[:, k - pixel - 1]
        W = filtered @ model.A.T
        P = model.A @ (P - gain[:, :, None] * PC[:, None, :]) @ model.A.T + model.Q
        P = (P + P.swapaxes(1, 2)) / 2
    return out


def smooth(
    lines: FloatArray, values: FloatArray, scanner: Scanner, noise_variance: float, seen: BoolArray | None = None,
    known: FloatArray | None = None,
) -> FloatArray:  # fmt: skip
    """The fixed-interval smoother: E[scene | all pixels of its line], (lines, columns + m), m of them before the line.

    With the scanner's covariance R of the scene, S = C R C' + s^2, it is R C' S^-1 image. Pixels that were not measured
    (``seen``, (lines, columns)) take the values that the measured ones let expect, which leaves the result that of the
    measured ones alone. ``known`` as in `invert_lines`.
    """
    columns, m = lines.shape[1], values.shape[-1] - 1
    C, R = line_matrix(values, columns), linalg.toeplitz(scanner.correlation(columns + m - 1))
    mean = np.zeros((1, columns + m))
    if known is not None and m:
        gain = linalg.solve(R[:m, :m], R[:m], assume_a="pos")
        mean, R = known @ gain, R - R[:, :m] @ gain
    lines = lines - mean @ C.T
    CR = C @ R
    S = CR @ C.T
    S.flat[:: columns + 1] += noise_variance
    information = linalg.inv(S, overwrite_a=True)
    if seen is not None:
        for line, good in zip(lines, seen, strict=True):
            if not good.all():
                away = np.linalg.solve(information[np.ix_(~good, ~good)], information[~good][:, good] @ line[good])
                line[~good] = -away
    return np.asarray(lines @ (information @ CR) + mean)


def _estimated(scanned: _Lines, which: str, scanner: Scanner, variance: float) -> FloatArray:
    """Filter or smooth lines after subtracting their mean, since the model has zero mean."""
    lines, values, origin, seen, known = scanned.rows, scanned.values, scanned.origin, scanned.seen, scanned.known
    n_lines, columns = lines.shape
    m = values.shape[-1] - 1
    light = np.broadcast_to(values.sum(axis=-1), (columns,))
    mean = lines.mean() / light.mean() if seen is None else lines[seen].mean() / light.mean()
    lines = lines - mean * light
    if known is not None:
        known = known - mean
        # The first state lies before the frame: begin with the same number of pixels that are not measured.
        lines = np.pad(lines, ((0, 0), (origin, 0)))
        seen = np.pad(np.ones((n_lines, columns), bool) if seen is None else seen, ((0, 0), (origin, 0)))
        if values.ndim == 2:
            values = np.concatenate([np.repeat(values[:1], origin, axis=0), values])
    # The first state after a measured pixel, and the first pixel of the frame.
    first, start = (origin, 0) if known is not None else (0, -origin)
    if which == "smoother":
        whole = smooth(lines, values, scanner, variance, seen, known)
        return np.asarray(whole[:, m + start : m + start + columns] + mean)
    model = line_model(values, lines.shape[1], scanner, None if known is None else known[:, ::-1])
    lag = m if which == "lag" else 0
    found = kalman(model, lines, variance, seen, range(start, start + columns), which, lag, first)
    return np.asarray(found + mean)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lines:
    """All rows of a picture, in the direction in which they are scanned."""

    rows: FloatArray
    """(lines, columns)"""
    values: FloatArray
    origin: int
    seen: BoolArray | None
    """(lines, columns)"""
    known: FloatArray | None
    """Pixels before each line, (lines or 1, taps - 1)."""
    direction: Direction

    @classmethod
    def of(cls, picture: Blurred, values: FloatArray, origin: int, boundary: _Boundary, direction: Direction) -> _Lines:
        """The rows of a picture with the taps that blurred it."""
        batch, height, columns = picture.planes.shape
        known = _known(boundary, height, values.shape[-1] - 1)
        rows = picture.planes.reshape(batch * height, columns)
        seen = None if picture.seen is None else np.tile(picture.seen, (batch, 1))
        if known is not None and len(known) > 1:
            known = np.tile(known, (batch, 1))
        if direction == "backward":
            values = values[::-1, ::-1] if picture.psf.varies else values[::-1]
            origin = values.shape[-1] - 1 - origin
            rows = rows[:, ::-1]
            seen = None if seen is None else seen[:, ::-1]
            known = None if known is None else known[:, ::-1]
        return cls(rows=rows, values=values, origin=origin, seen=seen, known=known, direction=direction)

    def picture(self, scene: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Restored lines as pictures of a shape (batch, rows, columns)."""
        return np.ascontiguousarray(scene[:, ::-1] if self.direction == "backward" else scene).reshape(shape)


def _checked_direction(direction: Direction | None) -> Direction | None:
    if direction not in (None, *get_args(Direction)):
        raise RestorationError(f"direction is {direction!r}, expected one of {', '.join(get_args(Direction))}")
    return direction


def _without_delay(values: FloatArray, origin: int) -> tuple[FloatArray, int]:
    """The PSF and its origin without end taps that are zero for every pixel: the inverse divides by the first tap."""
    lit = np.flatnonzero(values.reshape(-1, values.shape[-1]).any(axis=0))
    first, last = int(lit[0]), int(lit[-1])
    kept = values[..., first : last + 1]
    if kept.ndim == 2 and not ((kept[:, 0] > 0).all() and (kept[:, -1] > 0).all()):
        raise RestorationError(
            "the exact inverse needs PSFs that all start and end at the same taps: use the method smoother"
        )
    return kept, origin - first


def _known(boundary: _Boundary, rows: int, m: int) -> FloatArray | None:
    """The known pixels before the line, (rows or 1, m)."""
    if boundary is None:
        return None
    given = np.asarray(boundary, dtype=np.float64)
    if given.ndim == 0:
        given = np.full((1, m), given)
    if given.shape not in ((rows, m), (1, m)) or not np.isfinite(given).all():
        raise RestorationError(
            f"the boundary has shape {given.shape}, expected one finite value, or the {m} pixels before each line:"
            f" ({rows}, {m})"
        )
    return given


def _to_lines(
    planes: FloatArray, good: BoolArray | None, angle_rad: float
) -> tuple[FloatArray, BoolArray, Callable[[FloatArray], FloatArray]]:
    """Turn pictures so that rows run along an angle from growing columns towards growing rows, by cubic splines.

    ``planes``, (batch, rows, columns), have a likely value in each pixel that was not measured; ``good``, (rows,
    columns), is True where one was. Returns the turned pictures, in a frame that holds all of them; the mask of the
    measured pixels; and a function that turns back.
    """
    rows, columns = planes.shape[1:]
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    # (row, column) in the picture from (row, column) in the turned one, about the centres.
    turn = np.array([[c, s], [-s, c]])
    size = np.ceil(np.abs(turn) @ (rows - 1, columns - 1)).astype(int) + 1
    shape = (int(size[0]), int(size[1]))
    here, there = (np.array([rows, columns]) - 1) / 2, (np.array(shape) - 1) / 2
    offset = here - turn @ there
    turned = np.stack([ndimage.affine_transform(p, turn, offset, shape, order=3, mode="nearest") for p in planes])
    weight = np.ones((rows, columns)) if good is None else good.astype(np.float64)
    seen = ndimage.affine_transform(weight, turn, offset, shape, order=1, mode="constant") > 0.999

    def back(scene: FloatArray) -> FloatArray:
        return np.stack([
            ndimage.affine_transform(p, turn.T, there - turn.T @ here, (rows, columns), order=3, mode="nearest")
            for p in scene
        ])  # fmt: skip

    return turned, seen, back
