"""Whole frames of an exposure, without noise: those of a line sensor, or a spot in each of many windows."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import exposure_density, pixel_mass, pixel_masses
from aolink.optics.plane import exposure_density_2d
from aolink.optics.sensor import BaseSensor, Kernel, RegionSensor

Scalar = TypeVar("Scalar", bound=np.generic)

# Spots computed together: their masses stay in the processor's cache.
_AT_ONCE = 16
# Points of the table of masses in one sigma. The expansion leaves out half a step cubed times a sixth of the third
# derivative's maximum: 2e-9 of a spot's light.
_POINTS = 256
# A spot further than this many sigma from the pixels gives them no light.
_REACH = 6.0
# Most numbers in a table; a kernel so narrow that it needs more is integrated step by step.
_LARGEST_TABLE = 4_000_000


def frame_density(sensor: BaseSensor, path: FloatArray) -> FloatArray:
    """Mean density in each pixel of a frame, (rows, columns); the spot of a partly lit lenslet has that share of the
    light.

    ``path`` is the positions of all spots at each fast step, slope units, (n_outputs, n_steps), in the sensor's order.
    """
    if isinstance(sensor, RegionSensor):
        return sensor.moved(path)
    edges = sensor.profile.edges
    if sensor.directions == 1:
        return exposure_density(sensor.kernel, edges, path)
    (rows, columns), paths = sensor.grid, path.reshape(sensor.spots, 2, -1)
    if sensor.kernel.matrix is None:
        windows = spots_density(sensor.kernel, edges, paths)
    else:
        windows = exposure_density_2d(sensor.kernel.covariance, edges, edges, paths.swapaxes(1, 2))
    window = windows.shape[1:]
    if sensor.spot_light is not None:
        lit, windows = windows, np.zeros((rows * columns, *window))
        windows[sensor.lit] = lit * sensor.spot_light[:, None, None]
    tiled = windows.reshape(rows, columns, *window).swapaxes(1, 2)
    return np.asarray(np.ascontiguousarray(tiled).reshape(sensor.shape))


def spot_windows(sensor: BaseSensor, frame: NDArray[Scalar]) -> NDArray[Scalar]:
    """A frame cut into its spots' windows, (rows, columns) -> (spots, rows of a window, columns of a window)."""
    rows, columns = sensor.grid
    tiles = frame.reshape(rows, len(frame) // rows, columns, -1).swapaxes(1, 2)
    cut = tiles.reshape(-1, *tiles.shape[2:])
    return cut if sensor.spot_light is None else cut[sensor.lit]


def spots_density(kernel: Kernel, edges: FloatArray, path: FloatArray) -> FloatArray:
    """Mean density in the pixels of one square window for each spot, one over slope units squared, (spots, rows,
    columns).

    The density is (1/N) sum_i of the round kernel integrated over each pixel: the kernel is a product of its two
    directions, so the sum over the fast steps is one matrix product of their masses. ``edges`` are those of equal rows
    and of equal columns, slope units, (pixels + 1,); ``path`` is x and y at each fast step, slope units, (spots, 2,
    n_steps).
    """
    n, n_steps = len(edges) - 1, path.shape[-1]
    light = np.empty((len(path), n, n))
    for k in range(0, len(path), _AT_ONCE):
        some = slice(k, k + _AT_ONCE)
        masses = _masses(kernel, edges, path[some])
        np.matmul(masses[:, 1].swapaxes(1, 2), masses[:, 0], out=light[some])
    light /= n_steps * (edges[1] - edges[0]) ** 2
    return light


def _masses(kernel: Kernel, edges: FloatArray, positions: FloatArray) -> FloatArray:
    """The masses of `pixel_mass` to 2e-9, five times as fast: a table of them and their derivatives, expanded to the
    second order."""
    if _table_rows(kernel.sigma, edges) * (len(edges) - 1) > _LARGEST_TABLE:
        return pixel_mass(kernel, edges, positions)
    mass, first, second = _mass_table(kernel.sigma, tuple(edges.tolist()))
    place = (positions - edges[0]) * (_POINTS / kernel.sigma) + _REACH * _POINTS
    np.clip(place, 0, len(mass) - 1, out=place)
    row = np.rint(place)
    away = (place - row)[..., None]
    row = row.astype(np.intp)
    out = second.take(row, axis=0)
    out *= away
    out += first.take(row, axis=0)
    out *= away
    out += mass.take(row, axis=0)
    return np.asarray(out)


def _table_rows(sigma: float, edges: FloatArray) -> int:
    return math.ceil(float((edges[-1] - edges[0]) / sigma + 2 * _REACH) * _POINTS) + 1


@lru_cache(maxsize=8)
def _mass_table(sigma: float, pixel_edges: tuple[float, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Masses of the pixels at equal steps of the position, and their Taylor coefficients, each (rows, pixels)."""
    edges = np.array(pixel_edges)
    step = sigma / _POINTS
    positions = edges[0] - _REACH * sigma + step * np.arange(_table_rows(sigma, edges))
    mass, first, second = pixel_masses(sigma**2 / 2, edges, positions, 2)
    return mass, first * step, second * step**2 / 2
