"""The point spread function (PSF) of a motion, with its uncertainty.

Convention of the centre: a scene point at pixel p, moved by d pixels, lands on pixel p + d. Tap j of a PSF stands
for a displacement of j - origin, so that

    image[k] = sum_j values[j] scene[k + origin - j]

and a picture that is restored with it lies where the scene lies when the displacement is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from aolink.errors import RestorationError
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.optics.kernel import pixel_masses
from aolink.optics.sensor import Kernel

# Light beyond this many standard deviations of the kernel is left out, as are taps below this share of the largest.
_REACH = 5.0
_NEGLIGIBLE = 1e-5
# Correlation of x and y in one step's light below which it is left out. Above, points to integrate over it: a first
# number, and a second one times its ratio to the uncorrelated part.
_UNCORRELATED = 1e-3
_POINTS, _MORE_POINTS, _MOST_POINTS = 6, 8, 256
# PSF modes (patterns of the PSF's error) that together hold less than this share of its variance are left out.
_MODES_LEFT_OUT = 1e-4
# A path is straight for the line methods if its light strays from the line by less than this, rms, pixels.
STRAIGHT_PX = 0.35


@dataclass(frozen=True, kw_only=True, eq=False)
class Psf:
    """A point spread function on whole pixels. Its taps are not negative."""

    values: FloatArray
    """(taps,) along the rows of an image; (rows, columns) on the plane; (columns of the image, taps) along rows
    where every pixel of a line has its own: row k makes image pixel k."""
    origin: tuple[int, ...]
    """Tap that stands for no displacement: (column,) along the rows, (row, column) on the plane."""
    modes: FloatArray = field(default_factory=lambda: np.zeros((0,)))
    """PSF modes: the error of the values as independent patterns, each at one standard deviation, (modes,
    *values.shape)."""

    def __post_init__(self) -> None:
        values = np.asarray(self.values, dtype=np.float64)
        modes = np.asarray(self.modes, dtype=np.float64)
        if not modes.size:
            modes = np.zeros((0, *values.shape))
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "modes", modes)
        _check(values, self.origin)
        if modes.shape[1:] != values.shape or not np.isfinite(modes).all():
            raise RestorationError(
                f"the PSF's modes have shape {modes.shape}, expected finite numbers of shape (modes, *{values.shape})"
            )

    @property
    def varies(self) -> bool:
        """Whether each pixel of a line has a PSF of its own."""
        return len(self.origin) == 1 and self.values.ndim == 2

    @property
    def on_line(self) -> bool:
        """Whether the motion is along the rows only."""
        return len(self.origin) == 1

    @property
    def mean(self) -> FloatArray:
        """The values; where each pixel of a line has its own, their mean."""
        return np.asarray(self.values.mean(axis=0)) if self.varies else self.values

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of each value, shape of ``values``."""
        return np.asarray(np.sqrt((self.modes**2).sum(axis=0)))


def _check(values: FloatArray, origin: tuple[int, ...]) -> None:
    if values.ndim not in (1, 2) or not values.size:
        raise RestorationError(
            f"the PSF has shape {values.shape}: expected at least one tap, (taps,) along the rows or (rows, columns)"
        )
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).sum())
        raise RestorationError(f"{bad} of the PSF's {values.size} values are not finite: repair them")
    if values.min() < 0:
        raise RestorationError(
            f"the PSF's smallest value is {values.min():.3g}: light cannot be negative; clip the PSF, or check its sign"
        )
    axes = values.shape[1:] if values.ndim == 2 and len(origin) == 1 else values.shape
    if not (values.reshape(-1, *axes).sum(axis=tuple(range(1, len(axes) + 1))) > 0).all():
        raise RestorationError("the PSF is zero everywhere: expected some light")
    if len(origin) != len(axes) or any(not 0 <= o < n for o, n in zip(origin, axes, strict=True)):
        raise RestorationError(
            f"the PSF's origin is {origin}, expected a tap inside {axes}: pad the PSF with zeros up to no displacement"
        )


def as_psf(psf: Psf | ArrayLike) -> Psf:
    """A PSF from plain numbers: divided by their sum, with the origin at tap ``n // 2`` of each axis."""
    if isinstance(psf, Psf):
        return psf
    values = np.asarray(psf, dtype=np.float64)
    given = Psf(values=values, origin=tuple(n // 2 for n in values.shape))
    return replace(given, values=values / values.sum())


def motion_psf(
    path: ArrayLike, path_covariance: ArrayLike | None, kernel: Kernel, pixel_scale: float,
    shares: ArrayLike | None = None,
) -> Psf:  # fmt: skip
    """The PSF that a path gives: its histogram convolved with the image kernel, integrated over pixels.

    Parameters
    ----------
    path:
        Displacement at each fast step, slope units, (n_steps,) along the rows of the picture, or (2, n_steps): x in the
        direction of growing column numbers, y in that of growing row numbers.
    path_covariance:
        Covariance of the path, slope units squared, (n_steps, n_steps), or (2 n_steps, 2 n_steps) with all of x first;
        None where the path is known exactly.
    kernel:
        The picture's image kernel.
    pixel_scale:
        Width of one pixel of the picture, slope units.
    shares:
        Share of the exposure in each step, (n_steps,), see `aolink.exposure.step_shares`; None where all are the same.

    Returns
    -------
    The expected PSF (a kernel widened by each step's own covariance, exact for Gaussian errors), and its error to first
    order in the path's.

    Raises
    ------
    RestorationError
        Numbers that are not finite, or shapes that do not fit together.

    References
    ----------
    Mishra & Wen (2), (3); Shahin (5).
    """
    root = None if path_covariance is None else _path_root(path_covariance, np.size(path))
    return motion_psf_by_root(path, root, kernel, pixel_scale, shares)


def motion_psf_by_root(
    path: ArrayLike, root: FloatArray | None, kernel: Kernel, pixel_scale: float, shares: ArrayLike | None = None
) -> Psf:
    """The PSF as by `motion_psf`, where the path's covariance R R' is given by its root R, (n_steps or 2 n_steps,
    any)."""
    steps = np.asarray(path, dtype=np.float64)
    on_line = steps.ndim == 1 or (steps.ndim == 2 and len(steps) == 1)
    steps = np.atleast_2d(steps)
    if steps.ndim != 2 or len(steps) not in (1, 2) or not steps.shape[1] or not np.isfinite(steps).all():
        raise RestorationError(
            f"the path has shape {np.shape(path)}: expected finite positions, (n_steps,) or (2, n_steps)"
        )
    if not (math.isfinite(pixel_scale) and pixel_scale > 0):
        raise RestorationError(f"the pixel scale is {pixel_scale}: expected the width of a pixel, above zero")
    axes, n = steps.shape
    share = _checked_shares(shares, n)
    error = (np.zeros((steps.size, 1)) if root is None else root).reshape(axes, n, -1) / pixel_scale
    # Covariance of the position of each step's light, (n_steps, axes, axes).
    spread = np.einsum("aim,bim->iab", error, error) + kernel.covariance[:axes, :axes] / pixel_scale**2
    together, points, weights = _correlated_part(spread)
    variance = spread[:, range(axes), range(axes)].T - together**2
    places = (steps / pixel_scale)[:, :, None] + together[:, :, None] * points
    mass, slope, origin = zip(*map(_pixels_of, places, variance), strict=True)
    if on_line:
        values = share @ mass[0][:, 0]
        modes = (error[0].T * share) @ slope[0][:, 0]
    else:
        (along, down), (along_slope, down_slope) = mass, slope
        down, down_slope = ((each * weights[:, None]).swapaxes(1, 2) for each in (down, down_slope))
        values = np.tensordot(share, down @ along, axes=1)
        modes = np.tensordot(error[0].T * share, down @ along_slope, axes=1)
        modes += np.tensordot(error[1].T * share, down_slope @ along, axes=1)
    return _trimmed(values, modes, origin[::-1])


def _checked_shares(shares: ArrayLike | None, n: int) -> FloatArray:
    if shares is None:
        return np.full(n, 1 / n)
    found = np.asarray(shares, dtype=np.float64)
    if found.shape != (n,) or not np.isfinite(found).all() or found.min() < 0 or found.sum() <= 0:
        raise RestorationError(
            f"the shares have shape {found.shape}: expected {n}, of which none is negative, and some not zero"
        )
    return np.asarray(found / found.sum())


def _correlated_part(spread: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariances (n_steps, axes, axes) as the sum of c c' and a remainder in which x and y are independent: c, (axes,
    n_steps), and points and weights by which a mean over a normal distribution along c is taken."""
    n, axes, _ = spread.shape
    xx, xy, yy = spread[:, 0, 0], spread[:, 0, -1], spread[:, -1, -1]
    largest = float((abs(xy) / np.sqrt(xx * yy)).max()) if axes == 2 else 0.0
    if largest < _UNCORRELATED:
        return np.zeros((axes, n)), np.zeros(1), np.ones(1)
    more = math.ceil(min(_MORE_POINTS * largest / max(1 - largest, 1e-9), _MOST_POINTS))
    points, weights = np.polynomial.hermite_e.hermegauss(min(_POINTS + more, _MOST_POINTS))
    near = abs(points) < _REACH
    c = np.sqrt(abs(xy)) * np.stack([(xx / yy) ** 0.25, np.sign(xy) * (yy / xx) ** 0.25])
    return c, points[near], weights[near] / weights[near].sum()


def _path_root(covariance: ArrayLike, size: int) -> FloatArray:
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise RestorationError(
            f"the path's covariance has shape {matrix.shape}, expected finite numbers, {size} x {size}"
        )
    return psd_root(matrix)


def _pixels_of(positions: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Masses in pixels and their derivatives by position, (n_steps, points, pixels), and the pixel of no displacement.

    Positions (n_steps, points), variances (n_steps,).
    """
    reach = _REACH * math.sqrt(float(variance.max()))
    low = min(0, math.floor(positions.min() - reach))
    high = max(0, math.ceil(positions.max() + reach))
    mass, slope = pixel_masses(variance[:, None], np.arange(low, high + 2, dtype=np.float64) - 0.5, positions, 1)
    return mass, slope, -low


def _trimmed(values: FloatArray, modes: FloatArray, origin: tuple[int, ...]) -> Psf:
    """The PSF of unit sum, without negligible edges (the origin stays inside) and negligible modes."""
    keep = []
    for axis, centre in enumerate(origin):
        others = tuple(a for a in range(values.ndim) if a != axis)
        lit = np.flatnonzero(values.max(axis=others) > _NEGLIGIBLE * values.max())
        keep.append(slice(min(centre, int(lit[0])), max(centre, int(lit[-1])) + 1))
    values, modes = values[tuple(keep)], modes[(slice(None), *keep)]
    total = values.sum()
    _, size, rows = np.linalg.svd(modes.reshape(len(modes), -1) / total, full_matrices=False)
    left = (size**2)[::-1].cumsum()[::-1]
    rank = int((left > _MODES_LEFT_OUT * left[0]).sum())
    return Psf(
        values=values / total,
        origin=tuple(c - k.start for c, k in zip(origin, keep, strict=True)),
        modes=(size[:rank, None] * rows[:rank]).reshape(rank, *values.shape),
    )


def line_matrix(values: FloatArray, columns: int) -> FloatArray:
    """The matrix that blurs a line, (columns, columns + taps - 1), Shahin (4): image = C scene.

    The scene goes beyond the frame by as much as the PSF reaches; pixel 0 of the frame is element taps - 1 - origin.
    Values are (taps,), or (columns, taps).
    """
    m = values.shape[-1] - 1
    taps = np.broadcast_to(values, (columns, m + 1))
    C = np.zeros((columns, columns + m))
    k = np.arange(columns)
    for j in range(m + 1):
        C[k, k + m - j] = taps[:, j]
    return C


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectedPsf:
    """Projection of a PSF on the plane onto a straight line."""

    angle_rad: float
    """Angle of the line, from the direction of growing columns towards growing rows."""
    psf: Psf
    deviation_px: float
    """Root mean square distance of the light from the line, without the width of the pixels."""


def along_line(psf: Psf) -> ProjectedPsf:
    """Project a PSF on the plane onto its principal axis; each pixel's light goes to the two nearest taps."""
    values, total = psf.values, psf.values.sum()
    y, x = (np.indices(values.shape) - np.array(psf.origin)[:, None, None]).astype(np.float64)
    mean = np.array([(values * x).sum(), (values * y).sum()]) / total
    away = np.stack([x - mean[0], y - mean[1]])
    spread = np.einsum("irc,jrc,rc->ij", away, away, values) / total
    sizes, axes = np.linalg.eigh(spread)
    direction = axes[:, 1] * (1 if axes[np.argmax(abs(axes[:, 1])), 1] > 0 else -1)
    place = direction[0] * x + direction[1] * y
    low = min(0, math.floor(place.min()))
    size = max(0, math.ceil(place.max())) - low + 2
    tap = np.floor(place - low).astype(int)
    part = place - low - tap

    def project(light: FloatArray) -> FloatArray:
        near = np.bincount(tap.ravel(), (light * (1 - part)).ravel(), size)
        return np.asarray(near + np.bincount(tap.ravel() + 1, (light * part).ravel(), size))

    modes = np.array([project(mode) for mode in psf.modes]).reshape(len(psf.modes), size)
    return ProjectedPsf(
        angle_rad=math.atan2(direction[1], direction[0]),
        psf=_trimmed(project(values), modes if len(modes) else np.zeros((1, size)), (-low,)),
        # A line that is drawn on pixels strays by the variance of a pixel's own width, 1/12 of its square.
        deviation_px=math.sqrt(max(float(sizes[0]) - 1 / 12, 0.0)),
    )
