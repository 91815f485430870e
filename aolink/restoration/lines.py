"""The methods on lines: exact inverse, and the Kalman filter's estimates (Shahin, III and IV)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aolink.errors import RestorationError
from aolink.restoration.banded import smooth_lines
from aolink.restoration.inverse import Direction, check_direction, invert_lines, stable_direction
from aolink.restoration.kalman import LineModel, kalman, line_model, scene_from_states, smooth
from aolink.restoration.psf import Psf
from aolink.restoration.scanner import Scanner

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LINE_METHODS = ("inverse", "predictor", "filter", "lag", "smoother")
# States of all lines kept at once, numbers.
_MOST_KEPT = 20_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class LineRequest:
    """How lines are to be restored; the fields are `restore`'s arguments."""

    method: str
    psf: Psf
    noise_variance: float
    scanner: Scanner | None
    boundary: float | ArrayLike | None
    direction: Direction | None
    seen: BoolArray | None


def restore_lines(planes: FloatArray, request: LineRequest) -> tuple[FloatArray, Direction]:
    """Restore pictures (batch, rows, columns) row by row; the direction in which the rows were scanned."""
    values, (origin,) = request.psf.values, request.psf.origin
    batch, rows, columns = planes.shape
    if request.method == "inverse":
        values, origin = _without_delay(values, origin)
        direction = request.direction or stable_direction(values)
        check_direction(values, direction)
    else:
        direction = request.direction or "forward"
    known = _known(request.boundary, rows, values.shape[-1] - 1)
    lines = planes.reshape(batch * rows, columns)
    seen = None if request.seen is None else np.tile(request.seen, (batch, 1))
    if known is not None and len(known) > 1:
        known = np.tile(known, (batch, 1))
    if direction == "backward":
        values = values[::-1, ::-1] if request.psf.varies else values[::-1]
        origin = values.shape[-1] - 1 - origin
        lines = lines[:, ::-1]
        seen = None if seen is None else seen[:, ::-1]
        known = None if known is None else known[:, ::-1]
    if request.method == "inverse":
        out = invert_lines(lines, values, known)
        # What the PSF never brings into the frame is as the last pixel that it does.
        place = np.arange(columns) + values.shape[-1] - 1 - origin
        out = out[:, np.clip(place, 0, out.shape[1] - 1)]
    else:
        out = _estimated(lines, values, origin, seen, known, request)
    if direction == "backward":
        out = out[:, ::-1]
    return np.ascontiguousarray(out).reshape(planes.shape), direction


def _without_delay(values: FloatArray, origin: int) -> tuple[FloatArray, int]:
    """Without taps at the ends that are zero in every pixel's PSF: the first one would divide."""
    lit = np.flatnonzero(values.reshape(-1, values.shape[-1]).any(axis=0))
    first, last = int(lit[0]), int(lit[-1])
    kept = values[..., first : last + 1]
    if kept.ndim == 2 and not ((kept[:, 0] > 0).all() and (kept[:, -1] > 0).all()):
        raise RestorationError(
            "the exact inverse needs PSFs that all start and end at the same taps: use the method smoother"
        )
    return kept, origin - first


def _known(boundary: float | ArrayLike | None, rows: int, m: int) -> FloatArray | None:
    """Pixels before the line, (rows or 1, m)."""
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


def _estimated(
    lines: FloatArray, values: FloatArray, origin: int, seen: BoolArray | None, known: FloatArray | None,
    request: LineRequest,
) -> FloatArray:  # fmt: skip
    """Filter or smooth lines whose mean is taken out first: the processing is for zero mean."""
    n_lines, columns = lines.shape
    m = values.shape[-1] - 1
    scanner = request.scanner
    assert scanner is not None
    light = np.broadcast_to(values.sum(axis=-1), (columns,))
    mean = lines.mean() / light.mean() if seen is None else lines[seen].mean() / light.mean()
    lines = lines - mean * light
    if known is not None:
        known = known - mean
        # A state all of which lies before the frame: begin as many unseen pixels earlier.
        lines = np.pad(lines, ((0, 0), (origin, 0)))
        seen = np.pad(np.ones((n_lines, columns), bool) if seen is None else seen, ((0, 0), (origin, 0)))
        if values.ndim == 2:
            values = np.concatenate([np.repeat(values[:1], origin, axis=0), values])
    # The first state that has seen a pixel, and the first pixel of the frame.
    first, start = (origin, 0) if known is not None else (0, -origin)
    pixels = range(start, start + columns)
    variance = request.noise_variance
    if request.method == "smoother" and len(scanner.gamma) == 1:
        correlation, power = float(scanner.alpha[0, 0]), float(scanner.gamma[0] ** 2 * scanner.covariance[0, 0])
        whole = smooth_lines(lines, values, correlation, power, variance, seen, known)
        return np.asarray(whole[:, m + pixels.start : m + pixels.stop] + mean)
    model = line_model(values, lines.shape[1], scanner, None if known is None else known[:, ::-1])
    each = lines.shape[1] * (len(model.A) ** 2 if seen is not None else len(model.A))
    step = max(1, _MOST_KEPT // each)
    out = np.empty((n_lines, columns))
    for k in range(0, n_lines, step):
        some = slice(k, k + step)
        here = model if known is None or len(model.start_mean) == 1 else _of_lines(model, some)
        result = kalman(
            here, lines[some], variance, None if seen is None else seen[some], keep=request.method == "smoother"
        )
        if request.method == "smoother":
            states = smooth(here, result)
        else:
            states = result.predicted if request.method == "predictor" else result.filtered
        out[some] = scene_from_states(model, states, pixels, lag=m if request.method == "lag" else 0, first=first)
    return np.asarray(out + mean)


def _of_lines(model: LineModel, some: slice) -> LineModel:
    return replace(model, start_mean=model.start_mean[some])
