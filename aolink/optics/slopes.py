"""The slopes and the wavefront of one Shack-Hartmann frame against a reference frame of the same camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from aolink.errors import FrameError
from aolink.files import writing
from aolink.films.pictures import read_frame
from aolink.numerics.arrays import FloatArray, IntArray
from aolink.optics.lattice import Lattice, find_lattice, match
from aolink.optics.wavefront import SpotReconstructor, modal_reconstructor, wavefront_rms, zernike_slopes
from aolink.optics.zernike import zernike

# Highest fitted Zernike mode by Noll's index, that of the fourth order; fewer modes are fitted where the spots do not
# determine them.
_HIGHEST = (15, 10, 6, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class ZernikeFit:
    """The wavefront as Zernike modes over the smallest circle that holds all lenslets of the reference."""

    centre_px: FloatArray
    """Middle of the circle, pixels, (2,)."""
    radius_px: float
    indices: tuple[int, ...]
    """Noll's indices, from 2."""
    coefficients: FloatArray
    """Rms of each mode over the pupil, in the unit of the wavefront, (modes,)."""
    wavefront: FloatArray
    """Sum of the modes at each lenslet, NaN where the frame has no spot, (rows, columns)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameSlopes:
    """Displacements, slopes and wavefront of a frame against its reference; NaN where the frame has no spot.

    Row j and column i of a grid are node (i, j) of the reference's lattice, square or hexagonal, and lie on the frame
    at ``positions_px``. Vectors are (x, y) along the frame's columns and rows, however the lattice is turned.
    """

    frame: FloatArray
    """(rows, columns) of pixels, counts."""
    lattice: Lattice
    """Lattice of the frame's spots."""
    reference: Lattice
    positions_px: FloatArray
    """Positions of the nodes of the reference's lattice, with spots or without, pixels, (rows, columns, 2)."""
    displacements_px: FloatArray
    """Displacements from the reference's spot to the frame's, without their mean, pixels, (rows, columns, 2)."""
    shift_px: FloatArray
    """The mean displacement, (2,): known up to whole steps of the lattice."""
    slopes: FloatArray
    """Slopes, (rows, columns, 2), in radians, or in pixels where the optics are not known."""
    wavefront: FloatArray
    """Zonal wavefront, (rows, columns), without piston and tilt: metres, or pixels times the pitch of a lenslet."""
    pieces: IntArray
    """Number of the connected piece that each lenslet belongs to, from 0, -1 where the frame has no spot, (rows,
    columns).

    Slopes do not determine the step from one piece to another; the wavefront's mean is zero in each.
    """
    zernikes: ZernikeFit
    in_metres: bool

    @property
    def rms(self) -> float:
        """Root mean square of the wavefront."""
        return wavefront_rms(self.wavefront)

    @property
    def peak_to_valley(self) -> float:
        """Highest less lowest value of the wavefront."""
        return float(np.nanmax(self.wavefront) - np.nanmin(self.wavefront))


def measure_slopes(
    frame: NDArray[np.generic], reference: NDArray[np.generic], *, pitch_m: float | None = None,
    focal_m: float | None = None,
) -> FrameSlopes:  # fmt: skip
    """Slopes and wavefront of a frame against its reference, from the displacements of their spots.

    Raises `FrameError` where a frame has no spots, they do not lie on a grid, or the two grids do not belong to one
    instrument.

    Parameters
    ----------
    frame, reference:
        Counts of any real type and scale, (rows, columns), of the same camera; NaN where a pixel is bad.
    pitch_m, focal_m:
        Distance from a lenslet's middle to the next one's, and focal length, m; the pitch in pixels is the reference's
        own. Where both are None, slopes are left in pixels.
    """
    if frame.shape != reference.shape:
        raise FrameError(f"the frame has {frame.shape} pixels, the reference {reference.shape}: take one camera's")
    base = _found(reference, "the reference")
    lattice = match(_found(frame, "the frame"), base)
    rows, columns = base.shape
    column, row = lattice.nodes.T

    def on_grid(values: FloatArray) -> FloatArray:
        grid = np.full((rows, columns, *values.shape[1:]), np.nan)
        grid[row, column] = values
        return grid

    rest = np.empty((rows, columns, 2))
    rest[base.nodes[:, 1], base.nodes[:, 0]] = base.spots
    moved = lattice.spots - rest[row, column]
    in_metres = pitch_m is not None and focal_m is not None
    pitch = pitch_m if pitch_m is not None and in_metres else 1.0
    slopes = moved - moved.mean(axis=0)
    if focal_m is not None and in_metres:
        slopes = slopes * (pitch / base.pitch / focal_m)
    zonal = SpotReconstructor(base.node_positions(lattice.nodes) * (pitch / base.pitch), lattice.neighbours)
    pieces = np.full((rows, columns), -1, dtype=np.int64)
    pieces[row, column] = zonal.parts
    indices, coefficients, values, (centre, radius) = _zernikes(base, lattice.nodes, slopes, pitch)
    everywhere = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    return FrameSlopes(
        frame=frame.astype(np.float64), lattice=lattice, reference=base, positions_px=base.node_positions(everywhere),
        displacements_px=on_grid(moved - moved.mean(axis=0)), shift_px=moved.mean(axis=0), slopes=on_grid(slopes),
        wavefront=on_grid(zonal(slopes)), pieces=pieces, in_metres=in_metres,
        zernikes=ZernikeFit(
            centre_px=centre, radius_px=radius, indices=indices, coefficients=coefficients, wavefront=on_grid(values)
        ),
    )  # fmt: skip


def _zernikes(
    base: Lattice, nodes: IntArray, slopes: FloatArray, pitch: float
) -> tuple[tuple[int, ...], FloatArray, FloatArray, tuple[FloatArray, float]]:
    """Indices and coefficients of the modes, their sum at the nodes, centre and radius of the pupil in pixels."""
    middles = base.node_positions(base.nodes)
    centre, radius = _circle((middles[:, None] + base.lenslet).reshape(-1, 2))
    scale = pitch / base.pitch
    positions = (base.node_positions(nodes) - centre) * scale
    for highest in _HIGHEST:
        indices = tuple(range(2, highest + 1))
        modes = zernike_slopes(positions, indices, radius * scale, base.lenslet * scale)
        try:
            matrix = modal_reconstructor(modes, np.ones(len(nodes)))
        except ValueError:
            continue
        coefficients = matrix @ slopes.ravel()
        values = np.tensordot(coefficients, [zernike(i, positions / (radius * scale)) for i in indices], axes=1)
        return indices, coefficients, np.asarray(values), (centre, radius)
    raise AssertionError("two tilts can always be distinguished")


def _circle(points: FloatArray) -> tuple[FloatArray, float]:
    """Middle (2,) and radius of the smallest circle about points (n, 2), to a thousandth.

    The middle moves towards the point that is furthest from it, by a smaller and smaller share of the distance; Badoiu
    and Clarkson, Smaller core-sets for balls, SODA (2003).
    """
    points = points[ConvexHull(points).vertices]
    middle = points.mean(axis=0)
    for k in range(2, 1002):
        middle = middle + (points[np.linalg.norm(points - middle, axis=1).argmax()] - middle) / k
    return middle, float(np.linalg.norm(points - middle, axis=1).max())


def _found(frame: NDArray[np.generic], name: str) -> Lattice:
    try:
        return find_lattice(frame)
    except FrameError as error:
        raise FrameError(f"{name}: {error}") from None


def measure_files(
    frame: str | Path, reference: str | Path, *, pitch_m: float | None = None, focal_m: float | None = None,
    bad: str | Path | None = None,
) -> FrameSlopes:  # fmt: skip
    """The result of `measure_slopes` for the files of two pictures; the picture in ``bad`` is not zero where the
    camera's pixels are bad. Raises `FrameError`."""
    pictures = [read_frame(path, FrameError) for path in (frame, reference)]
    if bad is not None:
        wrong = read_frame(bad, FrameError) != 0
        if wrong.shape != pictures[0].shape:
            raise FrameError(f"{bad} has {wrong.shape} pixels, the frame {pictures[0].shape}: take one camera's")
        pictures = [np.where(wrong, np.nan, picture) for picture in pictures]
    return measure_slopes(*pictures, pitch_m=pitch_m, focal_m=focal_m)


def save(result: FrameSlopes, path: Path, *, overwrite: bool = False) -> None:
    """Write slopes, wavefront, Zernike coefficients and the spots' places as .npz. Raises `FrameError`."""
    target = writing(path, overwrite=overwrite, suffix=".npz", error=FrameError)
    with target as partial, partial.open("wb") as file:
        np.savez(
            file, slopes=result.slopes, wavefront=result.wavefront, displacements_px=result.displacements_px,
            spots_px=result.lattice.spots, nodes=result.lattice.nodes, shift_px=result.shift_px,
            grid=result.reference.kind, positions_px=result.positions_px, pieces=result.pieces,
            zernike_indices=result.zernikes.indices, zernike_coefficients=result.zernikes.coefficients,
            zernike_wavefront=result.zernikes.wavefront, pupil_centre_px=result.zernikes.centre_px,
            pupil_radius_px=result.zernikes.radius_px,
        )  # fmt: skip
