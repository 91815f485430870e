"""Wavefront reconstruction from slopes, by zonal and modal least squares; residual rms.

Slopes are means over lenslets as in `aolink.optics.lenslets`, (rows, columns, 2) on a grid or (spots, 2);
wavefronts come in the unit of slopes times the lenslets' pitch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from aolink.numerics.arrays import FloatArray, IntArray
from aolink.optics.lenslets import Lenslets
from aolink.optics.zernike import zernike_gradient


class SpotReconstructor:
    """A least-squares reconstructor of a wavefront's values at spots anywhere, sparse, factored once for a pattern of
    spots.

    It has Southwell's geometry (J. Opt. Soc. Am. 70, 998 (1980)) on the graph of neighbours, for any lattice: along
    each edge the wavefront changes by the mean slope of its two spots times the vector from one to the other. It is
    exact for wavefronts of the second degree.

    ``positions`` of the spots' lenslets are (spots, 2) as (x, y): the wavefront's unit is that of slopes times theirs.
    ``edges`` are pairs of neighbours, as numbers of spots, (edges, 2). Raises `ValueError` where there are no spots.
    """

    def __init__(self, positions: FloatArray, edges: IntArray) -> None:
        if not len(positions):
            raise ValueError("there are no spots")
        (a, b), row, n = edges.T, np.arange(len(edges)), len(positions)
        ones = np.ones(len(edges))
        half_x, half_y = (positions[b] - positions[a]).T / 2
        # differences @ values = means @ slopes
        differences = _matrix([(row, b, ones), (row, a, -ones)], (len(edges), n))
        self._means = _matrix(
            [(row, 2 * at + k, half) for k, half in ((0, half_x), (1, half_y)) for at in (a, b)], (len(edges), 2 * n)
        )
        self._spots, self._gathered = n, differences.T.tocsr()
        self.parts = connected_components(_matrix([(a, b, ones)], (n, n)), directed=False)[1].astype(np.int64)
        """The number, from 0, of the connected part that each spot belongs to, (spots,).

        Slopes do not determine the step from one part to another: the mean of each part is zero.
        """
        null = _matrix([(self.parts, np.arange(n), np.ones(n))], (int(self.parts.max()) + 1, n))
        right = sparse.vstack([null.T, sparse.csr_array((null.shape[0], null.shape[0]))])
        bordered = sparse.hstack([sparse.vstack([self._gathered @ differences, null]), right])
        self._factor = splu(sparse.csc_array(bordered))

    def __call__(self, slopes: FloatArray) -> FloatArray:
        """The wavefront, (..., spots), from slopes, (..., spots, 2)."""
        if slopes.shape[-2:] != (self._spots, 2):
            raise ValueError(f"slopes have shape {slopes.shape}, expected (..., {self._spots}, 2)")
        if not np.isfinite(slopes).all():
            raise ValueError("a lit lenslet has a slope that is not a number")
        right = self._gathered @ (self._means @ slopes.reshape(-1, 2 * self._spots).T)
        right = np.concatenate([right, np.zeros((self.parts.max() + 1, right.shape[1]))])
        return np.asarray(self._factor.solve(right)[: self._spots].T).reshape(slopes.shape[:-1])


def _matrix(parts: Sequence[tuple[IntArray, IntArray, FloatArray]], shape: tuple[int, int]) -> sparse.csr_array:
    """A sparse matrix of entries, given as rows, columns and values."""
    rows, columns, values = (np.concatenate(each) for each in zip(*parts, strict=True))
    return sparse.csr_array((values, (rows, columns)), shape=shape)


def lenslet_zernike_slopes(lenslets: Lenslets, highest: int) -> FloatArray:
    """Slopes of Zernike modes 2 .. ``highest`` on the lenslets' round pupil, or on the circle about the whole grid.

    Mode 1, the piston, has no slopes.

    Returns
    -------
    Slopes of each mode of unit rms in the unit of path per m, (spots, 2, modes); NaN in the dark.
    """
    radius = (lenslets.pupil_diameter_m or lenslets.pitch_m * math.hypot(*lenslets.grid)) / 2
    return lenslets.mean_slopes(
        lambda p: np.stack([zernike_gradient(i, p / radius) / radius for i in range(2, highest + 1)], axis=-1)
    )


def zernike_slopes(
    positions: FloatArray, indices: tuple[int, ...], radius: float, within: FloatArray | None = None
) -> FloatArray:
    """Slopes of Zernike modes of unit rms at spots anywhere on the pupil, as `modal_reconstructor` takes them, (spots,
    2, modes).

    Positions of the spots' lenslets are from the middle of the pupil, (spots, 2), and the pupil's radius is in their
    unit. ``within`` are points that fill a lenslet evenly, from its middle, (points, 2): the slope is the mean over
    them. None: at its middle.
    """
    points = (positions[:, None] + (np.zeros((1, 2)) if within is None else within)) / radius
    return np.stack([zernike_gradient(i, points).mean(axis=1) / radius for i in indices], axis=-1)


def modal_reconstructor(slopes: FloatArray, weights: FloatArray) -> FloatArray:
    """The matrix from slopes to coefficients, by least squares, (modes, 2 spots), for slopes in the order x of spot 0,
    y of spot 0, x of spot 1, ...

    ``slopes`` are those of each mode, (spots, 2, modes); ``weights`` that of each lenslet's, (spots,), such as its
    light: zero leaves it out. Raises `ValueError` where the slopes do not determine the modes.
    """
    both = np.repeat(weights, 2)
    H = np.where(both[:, None] > 0, slopes.reshape(len(both), -1), 0.0)
    normal = (H.T * both) @ H
    # The modes may have any size: only the similarity of their slopes matters.
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    if np.linalg.cond(normal / np.outer(size, size)) > 1e10:
        raise ValueError("the lit lenslets do not determine the modes: use fewer modes")
    return np.asarray(linalg.solve(normal, H.T * both, assume_a="pos"))


def wavefront_rms(wavefront: FloatArray) -> float:
    """Standard deviation of a wavefront over the pupil; points that are NaN do not count."""
    return float(wavefront[np.isfinite(wavefront)].std())
