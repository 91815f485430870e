"""Lenslets over a pupil: where they are, how much light they get, and the slopes that a wavefront has over them.

Positions are (x, y) from the middle of the grid, x along its columns and y along its rows. Spots are counted
along the rows of the grid, as frames have them. A wavefront W is an optical path difference in metres, and its
slope over a lenslet the mean of its gradient there, in radians: the spot's displacement over the focal length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from aolink.numerics.arrays import BoolArray, FloatArray

# Points along a lenslet's side to compute how much of it is lit; and for means of a wavefront that is smooth over it.
_EDGE_POINTS = 64
_SMOOTH_POINTS = 8


@dataclass(frozen=True, kw_only=True)
class Lenslets:
    """A grid of square lenslets without gaps, and the pupil in front of it."""

    grid: tuple[int, int]
    """Rows and columns."""
    pitch_m: float
    """Side of a lenslet, m."""
    focal_length_m: float
    """Distance from the lenslets to the camera, m."""
    pupil_diameter_m: float | None = None
    """Diameter of the round pupil, centred on the grid, m; None where the light covers the whole grid."""
    obstruction: float = 0.0
    """Diameter of the pupil's central obstruction over that of the pupil."""

    def __post_init__(self) -> None:
        if min(*self.grid, self.pitch_m, self.focal_length_m) <= 0 or not 0 <= self.obstruction < 1:
            raise ValueError(f"not lenslets: {self}; sizes must be above zero and 0 <= obstruction < 1")

    @property
    def spots(self) -> int:
        """Number of lenslets."""
        return self.grid[0] * self.grid[1]

    @cached_property
    def centres_m(self) -> FloatArray:
        """Middles of the lenslets, m, (spots, 2)."""
        rows, columns = self.grid
        y, x = np.mgrid[:rows, :columns].astype(np.float64)
        return self.pitch_m * np.stack([x - (columns - 1) / 2, y - (rows - 1) / 2], axis=-1).reshape(-1, 2)

    def is_lit(self, points_m: FloatArray) -> BoolArray:
        """Whether points (..., 2) lie in the pupil, (...)."""
        if self.pupil_diameter_m is None:
            return np.ones(points_m.shape[:-1], dtype=np.bool_)
        radius = np.linalg.norm(points_m, axis=-1) * 2 / self.pupil_diameter_m
        return np.asarray((radius <= 1) & (radius >= self.obstruction))

    @cached_property
    def light(self) -> FloatArray:
        """Share of each lenslet's area that is lit, (spots,): the weight of its slopes."""
        if self.pupil_diameter_m is None:
            return np.ones(self.spots)
        return np.array([self.lit_part(spot).mean() for spot in range(self.spots)])

    def offsets_m(self, per_side: int = _EDGE_POINTS) -> FloatArray:
        """Evenly spaced points along a lenslet's side, m from its middle, (per_side,)."""
        return self.pitch_m * ((np.arange(per_side) + 0.5) / per_side - 0.5)

    def lit_part(self, spot: int, per_side: int = _EDGE_POINTS) -> BoolArray:
        """Mask of a lenslet's evenly spaced points that are in the pupil, (per_side, per_side), y before x."""
        points = self.centres_m[spot] + _square(self.offsets_m(per_side))
        return self.is_lit(points).reshape(per_side, per_side)

    def mean_slopes(self, gradient: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Mean gradient over the lit part of each lenslet, (spots, 2, *more); NaN for lenslets in the dark.
        ``gradient`` is a function from points (..., 2), m, to gradients (..., 2, *more), of one wavefront or of many at
        once."""
        nodes, weights = np.polynomial.legendre.leggauss(_SMOOTH_POINTS)
        smooth, smooth_weight = _square(nodes * self.pitch_m / 2), np.outer(weights, weights).ravel() / 4
        fine, slopes = _square(self.offsets_m()), []
        # Lenslets that the pupil's edge cuts need finer points than a smooth wavefront does.
        for spot, light in enumerate(self.light):
            points, weight = self.centres_m[spot] + smooth, smooth_weight
            if light < 1:
                points = self.centres_m[spot] + fine[self.lit_part(spot).ravel()]
                weight = np.full(len(points), 1 / max(len(points), 1))
            mean = np.tensordot(weight, gradient(points), axes=1)
            slopes.append(mean if light else np.full_like(mean, np.nan))
        return np.array(slopes)


def _square(offset: FloatArray) -> FloatArray:
    """The points of a square from those along its sides, (n^2, 2)."""
    return np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
