"""The methods on lines: exact inverse, and the Kalman filter's estimates (Shahin, III and IV)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from aolink.errors import RestorationError
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.restoration import spectrum
from aolink.restoration.banded import smooth_lines
from aolink.restoration.inverse import Direction, invert_lines, stable_direction
from aolink.restoration.kalman import kalman, line_model, scene_from_states, smooth
from aolink.restoration.method import Blurred, Restored
from aolink.restoration.psf import STRAIGHT_PX
from aolink.restoration.scanner import Scanner, first_order
from aolink.restoration.uncertainty import line_variance

# The most numbers in the states of all lines that are kept at once.
_MOST_KEPT = 20_000_000
_Boundary = float | ArrayLike | None


def inverse(
    picture: Blurred, *, boundary: _Boundary = None, scanner: Scanner | None = None, direction: Direction | None = None
) -> Restored:
    """The scene whose blur is exactly this picture; noise and ``scanner`` are ignored."""
    values, origin = _without_delay(picture.psf.values, picture.psf.origin[0])
    way = stable_direction(values, _checked_direction(direction))
    lines = _Lines.of(picture, values, origin, boundary, way)
    columns = lines.rows.shape[1]
    out = invert_lines(lines.rows, lines.values, lines.known)
    # Pixels that the PSF never brings into the frame take the value of the last pixel that it does bring in.
    place = np.arange(columns) + lines.values.shape[-1] - 1 - lines.origin
    scene = lines.picture(out[:, np.clip(place, 0, out.shape[1] - 1)], picture.planes.shape)
    return Restored(image=scene, scanner=scanner, direction=way)


def why_not_inverse(picture: Blurred) -> str | None:
    if not picture.psf.on_line:
        return "the exact inverse needs a motion along the picture's rows or columns: use smoother"
    if picture.seen is not None:
        return "the exact inverse cannot do without a pixel: use the method smoother for masked ones"
    return None


def kalman_estimate(
    picture: Blurred, which: str, *,
    boundary: _Boundary = None, scanner: Scanner | None = None, direction: Direction | None = None,
) -> Restored:  # fmt: skip
    """The Kalman filter's estimate ``which`` of each line: predictor, filter, lag or smoother."""
    way = _checked_direction(direction) or "forward"
    back = None
    if not picture.psf.on_line:
        planes, seen, back = _to_lines(picture.whole, picture.seen, picture.line.angle_rad)
        picture = replace(picture, planes=planes, psf=picture.line.psf, seen=seen)
    psf, noise = picture.psf, picture.noise_variance
    if scanner is None:
        found = spectrum.correlation_and_variance(spectrum.line_spectrum(picture.whole, psf.mean), noise)
        scanner = first_order(*found)
    unexplained = line_variance(psf.modes, scanner)
    lines = _Lines.of(picture, psf.values, psf.origin[0], boundary, way)
    scene = lines.picture(_estimated(lines, which, scanner, noise + unexplained), picture.planes.shape)
    return Restored(
        image=scene if back is None else back(scene), noise_sd=math.sqrt(noise), psf_noise_sd=math.sqrt(unexplained),
        scanner=scanner, direction=way,
    )  # fmt: skip


def why_not_lines(picture: Blurred) -> str | None:
    if picture.psf.on_line or picture.line.deviation_px <= STRAIGHT_PX:
        return None
    return (
        f"the motion is not along a straight line: its light strays from one by {picture.line.deviation_px:.2g} pixels"
        f" rms, and a method on lines bears {STRAIGHT_PX:g}; use gauss_markov, tv or pnp"
    )


def _checked_direction(direction: Direction | None) -> Direction | None:
    if direction not in (None, *get_args(Direction)):
        raise RestorationError(f"direction is {direction!r}, expected one of {', '.join(get_args(Direction))}")
    return direction


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


def _known(boundary: float | ArrayLike | None, rows: int, m: int) -> FloatArray | None:
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
    pixels = range(start, start + columns)
    if which == "smoother" and len(scanner.gamma) == 1:
        correlation, power = float(scanner.alpha[0, 0]), float(scanner.gamma[0] ** 2 * scanner.covariance[0, 0])
        whole = smooth_lines(lines, values, correlation, power, variance, seen, known)
        return np.asarray(whole[:, m + pixels.start : m + pixels.stop] + mean)
    model = line_model(values, lines.shape[1], scanner, None if known is None else known[:, ::-1])
    each = lines.shape[1] * (len(model.A) ** 2 if seen is not None else len(model.A))
    step = max(1, _MOST_KEPT // each)
    out = np.empty((n_lines, columns))
    for k in range(0, n_lines, step):
        some = slice(k, k + step)
        here = model if len(model.start_mean) == 1 else replace(model, start_mean=model.start_mean[some])
        result = kalman(here, lines[some], variance, None if seen is None else seen[some], keep=which == "smoother")
        if which == "smoother":
            states = smooth(here, result)
        else:
            states = result.predicted if which == "predictor" else result.filtered
        out[some] = scene_from_states(model, states, pixels, lag=m if which == "lag" else 0, first=first)
    return np.asarray(out + mean)


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
