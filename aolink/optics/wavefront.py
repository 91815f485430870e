"""Wavefront reconstruction from slopes: zonal and modal least squares; residual rms and Strehl ratio.

Slopes are means over lenslets as `aolink.optics.lenslets` has them, (rows, columns, 2) on a grid or (spots, 2);
wavefronts come in the unit of slopes times the lenslets' pitch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.special import gamma

from aolink.optics.lenslets import Lenslets
from aolink.optics.zernike import noll_to_orders, zernike, zernike_gradient

FloatArray = NDArray[np.float64]
Geometry = Literal["southwell", "fried"]
_Equations = tuple[sparse.csr_array, sparse.csr_array, FloatArray, NDArray[np.bool_]]


class _LeastSquares:
    """Sparse equations differences @ values = averages @ slopes, factored once.

    They leave the mean of values over each connected part, ``parts`` (points,), undetermined; it is set to zero.
    """

    def __init__(self, differences: sparse.csr_array, averages: sparse.csr_array, weights: FloatArray) -> None:
        self._points, self._averages = differences.shape[1], averages
        self._weighted = (differences.T * weights).tocsr()
        self.parts = _joined(differences)
        null = sparse.csr_array((np.ones(self._points), (self.parts, np.arange(self._points))))
        self._unknown = null.shape[0]
        right = sparse.vstack([null.T, sparse.csr_array((self._unknown, self._unknown))])
        bordered = sparse.hstack([sparse.vstack([self._weighted @ differences, null]), right])
        self._factor = splu(sparse.csc_array(bordered))

    def solve(self, slopes: FloatArray) -> FloatArray:
        """Values, (frames, points), from slopes, (frames, 2 spots)."""
        if not np.isfinite(slopes).all():
            raise ValueError("a lit lenslet has a slope that is not a number")
        right = self._weighted @ (self._averages @ slopes.T)
        right = np.concatenate([right, np.zeros((self._unknown, right.shape[1]))])
        return np.asarray(self._factor.solve(right)[: self._points].T)


class SpotReconstructor:
    """Least squares of a wavefront's values at spots anywhere, sparse, factored once for a pattern of spots.

    Southwell's geometry on the graph of neighbours, whatever lattice they are on: along each edge the wavefront
    changes by the mean slope of its two spots times the vector from one to the other. On a square lattice that is
    `ZonalReconstructor`. It is exact for wavefronts of the second degree.

    Parameters
    ----------
    positions:
        Positions of the spots' lenslets, (spots, 2) as (x, y); the wavefront's unit is that of slopes times theirs.
    edges:
        Pairs of neighbours, as numbers of spots, (edges, 2).
    weights:
        Weights of the slopes of each spot, (spots,); one where None.

    Raises
    ------
    ValueError
        There are no spots.
    """

    def __init__(self, positions: FloatArray, edges: NDArray[np.int64], weights: FloatArray | None = None) -> None:
        if not len(positions):
            raise ValueError("there are no spots")
        self._spots = len(positions)
        self._equations = _LeastSquares(*_along_edges(positions, edges, weights))

    @property
    def parts(self) -> NDArray[np.int64]:
        """The number, from 0, of the connected part that each spot belongs to, (spots,).

        Slopes do not determine the step from one part to another: the mean of each part is zero.
        """
        return self._equations.parts

    def __call__(self, slopes: FloatArray) -> FloatArray:
        """The wavefront, (..., spots), from slopes, (..., spots, 2)."""
        if slopes.shape[-2:] != (self._spots, 2):
            raise ValueError(f"slopes have shape {slopes.shape}, expected (..., {self._spots}, 2)")
        return self._equations.solve(slopes.reshape(-1, 2 * self._spots)).reshape(slopes.shape[:-1])


class ZonalReconstructor:
    """Least squares of a wavefront's values from its slopes, sparse, factored once for a pattern of lit lenslets.

    ``southwell`` puts a value in the middle of each lit lenslet; neighbours differ by the mean of their slopes
    times the pitch (Southwell, J. Opt. Soc. Am. 70, 998 (1980)). ``fried`` puts values on the corners of lit
    lenslets, whose opposite sides differ by the slope (Fried, J. Opt. Soc. Am. 67, 370 (1977)).

    What slopes do not determine is zero: the mean of each connected part, and in Fried's geometry waffle.

    Parameters
    ----------
    lit:
        Which lenslets have slopes, (rows, columns).
    pitch:
        Side of a lenslet.
    weights:
        Weights of the slopes of each lenslet, (rows, columns); one where None.

    Raises
    ------
    ValueError
        No lenslet is lit.
    """

    def __init__(
        self, lit: NDArray[np.bool_], pitch: float, geometry: Geometry = "southwell", weights: FloatArray | None = None
    ) -> None:
        if not lit.any():
            raise ValueError("no lenslet is lit")
        self._lit = lit
        weights = np.ones(lit.shape) if weights is None else weights
        differences, averages, w, self._where = (_southwell if geometry == "southwell" else _fried)(lit, weights, pitch)
        self._equations = _LeastSquares(differences, averages, w)

    @property
    def where(self) -> NDArray[np.bool_]:
        """Which points have a value: lenslets, (rows, columns), or their corners, (rows + 1, columns + 1)."""
        return self._where

    def __call__(self, slopes: FloatArray) -> FloatArray:
        """The wavefront, NaN where there is none, (..., *where.shape), from slopes (..., rows, columns, 2)."""
        lead = slopes.shape[:-3]
        if slopes.shape[-3:] != (*self._lit.shape, 2):
            raise ValueError(f"slopes have shape {slopes.shape}, expected (..., {self._lit.shape}, 2)")
        values = self._equations.solve(slopes[..., self._lit, :].reshape(-1, 2 * int(self._lit.sum())))
        out = np.full((len(values), *self._where.shape), np.nan)
        out[:, self._where] = values
        return out.reshape(*lead, *self._where.shape)


def _along_edges(
    positions: FloatArray, edges: NDArray[np.int64], weights: FloatArray | None
) -> tuple[sparse.csr_array, sparse.csr_array, FloatArray]:
    """Differences of values along edges, means of slopes, and weights: differences @ values = means @ slopes."""
    a, b = edges.T
    row, n = np.arange(len(edges)), len(positions)
    half_x, half_y = (positions[b] - positions[a]).T / 2
    differences = _matrix([(row, b, 1.0), (row, a, -1.0)], (len(edges), n))
    means = _matrix([(row, 2 * at + k, half) for k, half in ((0, half_x), (1, half_y)) for at in (a, b)],
                    (len(edges), 2 * n))  # fmt: skip
    w = np.ones(n) if weights is None else weights
    return differences, means, (w[a] + w[b]) / 2


def _southwell(lit: NDArray[np.bool_], weights: FloatArray, pitch: float) -> _Equations:
    """The equations, and which points have a value."""
    number = np.where(lit, np.cumsum(lit).reshape(lit.shape) - 1, -1)
    pairs = [np.stack([a.ravel(), b.ravel()], axis=1) for a, b in (
        (number[:, :-1], number[:, 1:]), (number[:-1], number[1:])
    )]  # fmt: skip
    edges = np.concatenate(pairs)
    positions = pitch * np.argwhere(lit)[:, ::-1].astype(np.float64)
    return *_along_edges(positions, edges[(edges >= 0).all(axis=1)], weights[lit]), lit.copy()


def _fried(lit: NDArray[np.bool_], weights: FloatArray, pitch: float) -> _Equations:
    corner = np.zeros((lit.shape[0] + 1, lit.shape[1] + 1), dtype=np.bool_)
    for dy in (0, 1):
        for dx in (0, 1):
            corner[dy : dy + lit.shape[0], dx : dx + lit.shape[1]] |= lit
    number = np.cumsum(corner).reshape(corner.shape) - 1
    y, x = np.nonzero(lit)
    spot, parts = np.arange(len(y)), []
    for dy in (0, 1):
        for dx in (0, 1):
            at = number[y + dy, x + dx]
            parts += [(2 * spot, at, dx - 0.5), (2 * spot + 1, at, dy - 0.5)]
    differences = _matrix(parts, (2 * len(y), int(corner.sum())))
    return differences, sparse.csr_array(pitch * sparse.eye_array(2 * len(y))), np.repeat(weights[lit], 2), corner


def _matrix(
    parts: Sequence[tuple[NDArray[np.int64], NDArray[np.int64], FloatArray | float]], shape: tuple[int, int]
) -> sparse.csr_array:
    rows, columns = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    values = np.concatenate([np.broadcast_to(part[2], len(part[0])) for part in parts])
    return sparse.csr_array((values, (rows, columns)), shape=shape)


def _joined(differences: sparse.csr_array) -> NDArray[np.int64]:
    """The number of the connected part that each point belongs to, (points,).

    Two points are connected where the normal matrix couples them; a constant over a part changes no difference.
    """
    joined = (differences.T @ differences).tocoo()
    pulls = joined.data < -1e-9
    n = differences.shape[1]
    graph = sparse.coo_array((joined.data[pulls], (joined.row[pulls], joined.col[pulls])), shape=(n, n))
    return np.asarray(connected_components(graph.tocsr(), directed=False)[1])


@dataclass(frozen=True, eq=False)
class ZernikeModes:
    """Zernike modes over a pupil, as slopes of lenslets."""

    indices: tuple[int, ...]
    """Noll's indices; 1, the piston, has no slopes and is left out."""
    slopes: FloatArray
    """Slopes of each mode of unit rms in the unit of path per m, (spots, 2, modes); NaN in the dark."""
    light: FloatArray
    """Lit share of each lenslet, (spots,)."""
    radius_m: float

    def wavefront(self, coefficients: FloatArray, points_m: FloatArray) -> FloatArray:
        """Sum of the modes, coefficients (modes,), at points (..., 2), m, (...)."""
        modes = [zernike(index, points_m / self.radius_m) for index in self.indices]
        return np.asarray(np.tensordot(coefficients, modes, axes=1))


def zernike_modes(lenslets: Lenslets, highest: int) -> ZernikeModes:
    """Modes 2 .. ``highest`` on the lenslets' round pupil, or on the circle about the whole grid."""
    round_pupil = lenslets.pupil_diameter_m or lenslets.pitch_m * math.hypot(*lenslets.grid)
    radius, indices = round_pupil / 2, tuple(range(2, highest + 1))
    slopes = lenslets.mean_slopes(
        lambda p: np.stack([zernike_gradient(i, p / radius) / radius for i in indices], axis=-1)
    )
    return ZernikeModes(indices=indices, slopes=slopes, light=lenslets.light, radius_m=radius)


def zernike_slopes(
    positions: FloatArray, indices: tuple[int, ...], radius: float, within: FloatArray | None = None
) -> FloatArray:
    """Slopes of Zernike modes of unit rms at spots anywhere on the pupil, as `modal_reconstructor` takes them.

    Parameters
    ----------
    positions:
        Positions of the spots' lenslets from the middle of the pupil, (spots, 2).
    radius:
        Radius of the pupil, in the unit of the positions.
    within:
        Points that fill a lenslet evenly, from its middle, (points, 2): the slope is the mean over them. None: at its
        middle.

    Returns
    -------
    (spots, 2, modes)
    """
    points = (positions[:, None] + (np.zeros((1, 2)) if within is None else within)) / radius
    return np.stack([zernike_gradient(i, points).mean(axis=1) / radius for i in indices], axis=-1)


def modal_reconstructor(
    slopes: FloatArray, weights: FloatArray, noise_variance: float = 0.0, prior_variance: FloatArray | None = None
) -> FloatArray:
    """The matrix from slopes to coefficients: least squares, or with a prior the minimum mean square error estimate.

    Parameters
    ----------
    slopes:
        Slopes of each mode, (spots, 2, modes).
    weights:
        Weight of each lenslet's slopes, (spots,), such as its light; zero leaves it out.
    noise_variance:
        Variance of a slope of weight one.
    prior_variance:
        Variance of each coefficient about zero, (modes,); None: no prior.

    Returns
    -------
    (modes, 2 spots), for slopes in the order x of spot 0, y of spot 0, x of spot 1, ...

    Raises
    ------
    ValueError
        There is no prior, and the slopes do not determine the modes.
    """
    both = np.repeat(weights, 2)
    H = np.where(both[:, None] > 0, slopes.reshape(len(both), -1), 0.0)
    normal = (H.T * both) @ H
    if prior_variance is not None:
        normal += np.diag(noise_variance / prior_variance)
    # The modes may have any size: what counts is how alike their slopes are.
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    if np.linalg.cond(normal / np.outer(size, size)) > 1e10:
        raise ValueError("the lit lenslets do not determine the modes: use fewer modes, or a prior")
    return np.asarray(linalg.solve(normal, H.T * both, assume_a="pos"))


def kolmogorov_variances(indices: tuple[int, ...], diameter_m: float, r0_m: float) -> FloatArray:
    """Variances of Zernike coefficients in Kolmogorov turbulence, rad^2; Noll (1976), equation (25)."""

    n = np.array([noll_to_orders(index)[0] for index in indices], dtype=np.float64)
    scale = (24 / 5 * gamma(6 / 5)) ** (5 / 6) * gamma(11 / 6) ** 2 * gamma(14 / 3) / (2 ** (8 / 3) * math.pi)
    value = scale * (n + 1) * gamma(n - 5 / 6) / (gamma(17 / 6) ** 2 * gamma(n + 23 / 6))
    return np.asarray(value * (diameter_m / r0_m) ** (5 / 3))


def residual_rms(wavefront: FloatArray, weights: FloatArray | None = None) -> float:
    """Standard deviation of a wavefront over the pupil; points that are NaN do not count."""
    known = np.isfinite(wavefront)
    w = np.ones(known.sum()) if weights is None else weights[known]
    values = wavefront[known]
    return float(np.sqrt(np.average((values - np.average(values, weights=w)) ** 2, weights=w)))


def strehl(wavefront_m: FloatArray, wavelength_m: float, weights: FloatArray | None = None) -> float:
    """Strehl ratio of a wavefront in metres of path, |mean exp(i phase)|^2; points that are NaN do not count."""
    known = np.isfinite(wavefront_m)
    w = np.ones(known.sum()) if weights is None else weights[known]
    return float(abs(np.average(np.exp(2j * math.pi * wavefront_m[known] / wavelength_m), weights=w)) ** 2)
