"""The slopes and the wavefront of one Shack-Hartmann frame against a reference frame of the same camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aolink.errors import FrameError
from aolink.files import writing
from aolink.frame_file import read_frame
from aolink.optics.lattice import Lattice, find_lattice, match
from aolink.optics.wavefront import ZonalReconstructor, residual_rms

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameSlopes:
    """What a frame shows against its reference. Grids are the reference's, NaN where the frame has no spot."""

    frame: FloatArray
    """(rows, columns) of pixels, counts."""
    lattice: Lattice
    """The frame's own."""
    reference: Lattice
    displacements_px: FloatArray
    """From the reference's spot to the frame's, without their mean, pixels, (rows, columns, 2)."""
    shift_px: FloatArray
    """The mean displacement, (2,): known up to whole steps of the lattice."""
    slopes: FloatArray
    """(rows, columns, 2): radians, or pixels where the optics are not known."""
    wavefront: FloatArray
    """(rows, columns), without piston and tilt: metres, or pixels times the pitch of a lenslet."""
    in_metres: bool

    @property
    def rms(self) -> float:
        """Of the wavefront."""
        return residual_rms(self.wavefront)

    @property
    def peak_to_valley(self) -> float:
        """Of the wavefront."""
        return float(np.nanmax(self.wavefront) - np.nanmin(self.wavefront))


def measure_slopes(
    frame: FloatArray, reference: FloatArray, *, pitch_m: float | None = None, focal_m: float | None = None
) -> FrameSlopes:
    """Find the spots of a frame and of its reference, and what lies between them.

    Parameters
    ----------
    frame, reference:
        Counts, (rows, columns), of the same camera.
    pitch_m, focal_m:
        Side and focal length of a lenslet, m; the pitch in pixels is the reference's own. Where both are None,
        slopes are left in pixels.

    Raises
    ------
    FrameError
        A frame has no spots, they lie on no grid, or the two grids are not of one instrument.
    """
    if frame.shape != reference.shape:
        raise FrameError(f"the frame has {frame.shape} pixels, the reference {reference.shape}: take one camera's")
    base = _found(reference, "the reference")
    lattice = match(_found(frame, "the frame"), base)
    grid = np.full((*base.shape, 2), np.nan)
    grid[base.nodes[:, 1], base.nodes[:, 0]] = base.spots
    column, row = lattice.nodes.T
    moved = lattice.spots - grid[row, column]
    displacements = np.full_like(grid, np.nan)
    displacements[row, column] = moved - moved.mean(axis=0)
    scale, pitch = 1.0, 1.0
    if pitch_m is not None and focal_m is not None:
        scale, pitch = pitch_m / base.pitch / focal_m, pitch_m
    slopes = scale * displacements
    wavefront = ZonalReconstructor(np.isfinite(slopes[..., 0]), pitch)(slopes)
    return FrameSlopes(
        frame=frame, lattice=lattice, reference=base, displacements_px=displacements, shift_px=moved.mean(axis=0),
        slopes=slopes, wavefront=wavefront, in_metres=pitch_m is not None and focal_m is not None,
    )  # fmt: skip


def _found(frame: FloatArray, name: str) -> Lattice:
    try:
        return find_lattice(frame)
    except FrameError as error:
        raise FrameError(f"{name}: {error}") from None


def measure_files(
    frame: str | Path, reference: str | Path, *, pitch_m: float | None = None, focal_m: float | None = None
) -> FrameSlopes:
    """`measure_slopes` of two files, .fits, .fits.gz or .npy. Raises `FrameError`."""
    return measure_slopes(read_frame(frame), read_frame(reference), pitch_m=pitch_m, focal_m=focal_m)


def save(result: FrameSlopes, path: Path, *, overwrite: bool = False) -> None:
    """Write slopes, wavefront and the spots' places as .npz. Raises `FrameError`."""
    target = writing(path, overwrite=overwrite, suffix=".npz", error=FrameError)
    with target as partial, partial.open("wb") as file:
        np.savez(
            file, slopes=result.slopes, wavefront=result.wavefront, displacements_px=result.displacements_px,
            spots_px=result.lattice.spots, nodes=result.lattice.nodes, shift_px=result.shift_px,
        )  # fmt: skip
