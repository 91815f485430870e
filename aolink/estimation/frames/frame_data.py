"""Kinds of measurements of a frame (moments, profiles, windows), and an estimator's statement of its needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

from aolink.numerics.arrays import BoolArray, FloatArray, Indices

HALF = 0.5
"""Least share of a spot's pixels that estimators which take windows or profiles can use; and least share of the spots,
on a plant with hundreds of states."""


@dataclass(frozen=True, kw_only=True)
class Needs:
    """The measurements that an estimator takes of each frame, and the part of the frame that must be usable."""

    what: Literal["moments", "profile", "windows"]
    """"moments": a `Measurement`; "profile": a `Profile`; "windows": `SpotWindows`, only where one copy of the plant
    moves whole spots."""
    orders: tuple[int, ...] = ()
    """Orders of the moments, from 1."""
    least_usable: float = 1.0
    """Share of a spot's pixels that must be usable. Moments need all of them: whole spots."""
    least_spots: float = 1.0
    """Share of the spots of one copy of the plant that must be usable; the other spots are masked."""

    def __post_init__(self) -> None:
        if self.what == "moments" and (self.least_usable < 1 or self.least_spots < 1):
            raise ValueError("moments need whole spots: least_usable and least_spots must be 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """The measurements in one exposure, with Gaussian noise."""

    value: FloatArray
    """(axes, n_measurements)"""
    covariance: FloatArray
    """(axes, n_measurements, n_measurements), or blocks along its diagonal, (axes, blocks, size, size)."""
    usable: BoolArray | None = None
    """False for axes of which nothing was measured, (axes,); None if all were measured."""

    @property
    def single_block(self) -> FloatArray:
        """The covariance where it is one block, (axes, n_measurements, n_measurements)."""
        return self.covariance[:, 0] if self.covariance.ndim == 4 else self.covariance


@dataclass(frozen=True, kw_only=True, eq=False)
class Densities:
    """Densities of the pixels of each axis."""

    directions: ClassVar[int]
    """Directions that the pixels of a spot lie along: 1 for a row of pixels, 2 for a window."""
    density: FloatArray
    """(axes, ...)"""
    mask: BoolArray
    """True where the pixel can be used, shape of ``density``."""
    light: FloatArray | None = None
    """Light of each spot as a share of a whole one's, which densities are divided by; one where None."""
    usable: BoolArray | None = None
    """False for axes of which nothing was measured, (axes,); None if all were measured."""

    def part(self, axes: slice | Indices) -> Self:
        """The part of these axes, all of which were measured."""
        light = None if self.light is None else self.light[axes]
        return replace(self, density=self.density[axes], mask=self.mask[axes], light=light, usable=None)


class Profile(Densities):
    """Densities of one row of pixels for each axis; for each output of each axis, where an axis has several.

    One over slope units, (axes, pixels); light (axes,).
    """

    directions = 1


class SpotWindows(Densities):
    """Densities of the pixels about each spot of each copy of the plant.

    One over slope units squared, zero where the mask is, (axes, spots, rows, columns); light (axes, spots).
    """

    directions = 2

    def per_light(self, light: FloatArray | None) -> SpotWindows:
        """The same with densities divided by the light of each spot in the rig's order, (axes * spots,)."""
        if light is None:
            return self
        light = light.reshape(self.density.shape[:2])
        return replace(self, density=self.density / light[..., None, None], light=light)


FrameData = Measurement | Profile | SpotWindows
