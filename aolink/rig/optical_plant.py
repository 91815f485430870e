"""The optical parts of a rig file: lenslets, and mirrors whose plant follows from a description."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RigError
from aolink.keys import Positive, Shape, Within, array, read
from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.optics.lenslets import Lenslets
from aolink.optics.mirror import Membrane, mirror_plant, second_order, square_pads
from aolink.rig.parts import Plant


@dataclass(frozen=True, kw_only=True)
class Optics:
    """The lenslets in front of the camera, and the rig's slope unit."""

    lenslets: Lenslets
    slope_unit_rad: float
    least_light: float
    """Least lit share of a lenslet whose spot is used."""

    @cached_property
    def lit(self) -> NDArray[np.bool_]:
        """Mask of the lenslets that have a spot, along the rows of their grid, (lenslets,)."""
        return np.asarray(self.lenslets.light >= self.least_light)

    @property
    def light(self) -> tuple[float, ...] | None:
        """Lit share of each lenslet as in `SpotSensor.light`; None without a pupil."""
        if self.lenslets.pupil_diameter_m is None:
            return None
        return tuple(np.where(self.lit, self.lenslets.light, 0.0).tolist())

    @property
    def field(self) -> tuple[float, float]:
        """Slopes at the edges of a lenslet's window, slope units."""
        half = self.lenslets.pitch_m / 2 / self.lenslets.focal_length_m / self.slope_unit_rad
        return -half, half

    def seen(self, width_m: float) -> Lenslets:
        """The lenslets as imaged onto a surface, where all columns together cover ``width_m``."""
        ours = self.lenslets
        pitch = width_m / ours.grid[1]
        pupil = ours.pupil_diameter_m and ours.pupil_diameter_m * pitch / ours.pitch_m
        return replace(ours, pitch_m=pitch, focal_length_m=1.0, pupil_diameter_m=pupil)

    def slopes(self, surface_slopes: FloatArray, width_m: float) -> FloatArray:
        """Slopes behind the lenslets, slope units, for gradients of the optical path over a surface that is imaged onto
        them."""
        shrink = width_m / (self.lenslets.grid[1] * self.lenslets.pitch_m)
        return surface_slopes * (shrink / self.slope_unit_rad)


@dataclass(frozen=True, kw_only=True)
class _Lenslets:
    pitch_m: Positive
    focal_length_m: Positive
    slope_unit_rad: Positive = 1e-3
    pupil_m: Positive | None = None
    """Diameter of the round pupil, m."""
    obstruction: Annotated[float, Within(0.0, below=1.0)] = 0.0
    """Diameter of its central obstruction, as a share of the pupil's."""
    least_light: Annotated[float, Within(above=0.0, high=1.0)] = 0.5
    """Least lit share of a lenslet whose spot is used."""


def read_optics(values: dict[str, Any], grid: tuple[int, int]) -> Optics:
    """Read the table ``[lenslets]``. Raises `RigError`."""
    table = read(_Lenslets, values, "lenslets")
    if table.pupil_m is None and (alone := sorted({"obstruction", "least_light"} & values.keys())):
        raise RigError(f"lenslets.{alone[0]} needs lenslets.pupil_m")
    lenslets = Lenslets(
        grid=grid, pitch_m=table.pitch_m, focal_length_m=table.focal_length_m, pupil_diameter_m=table.pupil_m,
        obstruction=table.obstruction,
    )  # fmt: skip
    optics = Optics(lenslets=lenslets, slope_unit_rad=table.slope_unit_rad, least_light=table.least_light)
    if not optics.lit.any():
        raise RigError(
            f"lenslets.least_light = {optics.least_light:g}: no lenslet has that share of light,"
            f" the brightest has {lenslets.light.max():.2g} of its area in the pupil"
        )
    return optics


@dataclass(frozen=True, kw_only=True)
class _Mirror:
    """A mirror whose actuators have one resonance."""

    process_noise: Any
    """Variance of the noise that adds to each input in a fast step, units of the input squared; with ``drift_s`` of
    the noise that drives each drift."""
    resonance_hz: Positive
    """Of each actuator, Hz."""
    damping: Positive
    """Share of critical damping."""
    drift_s: Positive | None = None
    """Time in which the inputs' drift falls to 1/e, s."""
    unmodelled: Any = None

    def plant(self, slopes: FloatArray, fast_step_s: float) -> Plant:
        """The plant, from slopes for each input at rest, (outputs, inputs)."""
        check_frequency(self.resonance_hz, "plant.resonance_hz", fast_step_s)
        dynamics = second_order(self.resonance_hz, self.damping, fast_step_s)
        model = mirror_plant(slopes, dynamics, self.drift_s and math.exp(-fast_step_s / self.drift_s))
        W = variances(self.process_noise, "plant.process_noise", {"noises": model.B_w.shape[1]})
        return Plant(
            A=model.A, B=model.B, B_w=model.B_w, C=model.C, process_noise=W, initial_mean=np.zeros(len(model.A)),
            initial_covariance=stationary_covariance(model.A, model.B_w @ W @ model.B_w.T),
            unmodelled=self.unmodelled,
        )  # fmt: skip


def check_frequency(frequency_hz: float, key: str, fast_step_s: float) -> None:
    """Raise RigError for a frequency that fast steps cannot follow."""
    if frequency_hz >= 0.5 / fast_step_s:
        most = f"steps of {fast_step_s:g} s can follow, {0.5 / fast_step_s:g} Hz"
        raise RigError(f"{key} = {frequency_hz:g} is beyond what {most}")


def variances(value: Any, key: str, sizes: dict[str, int]) -> FloatArray:
    """A diagonal matrix of variances; a number is that of each noise."""
    matrix = np.diag(array(value, key, ("noises",), sizes))
    if (matrix < 0).any():
        raise RigError(f"{key} has a variance below zero")
    return matrix


@dataclass(frozen=True, kw_only=True)
class _TipTilt(_Mirror):
    gain: Annotated[FloatArray, Shape("x, y")]
    """Slope units per unit of an input, along x and y."""
    coupling: Annotated[float, Within(above=-1.0, below=1.0)] = 0.0
    """Share of its slope that an axis moves of the other's."""


def plant_of_tip_tilt(values: dict[str, Any], n_spots: int, fast_step_s: float) -> Plant:
    """A plant of kind ``tip-tilt``: two inputs that turn a flat mirror, and with it all spots alike."""
    table = read(_TipTilt, values, "plant", {"x, y": 2})
    gain = np.array([[1.0, table.coupling], [table.coupling, 1.0]]) @ np.diag(table.gain)
    return table.plant(np.tile(gain, (n_spots, 1)), fast_step_s)


@dataclass(frozen=True, kw_only=True)
class _Membrane(_Mirror):
    actuators: tuple[Annotated[int, Within(1, 32)], Annotated[int, Within(1, 32)]]
    """Rows and columns."""
    pitch_m: Positive
    pad_radius_m: Positive
    radius_m: Positive
    tension_n_per_m: Positive
    footprint_m: Positive
    """Width that all columns of lenslets see of the membrane, m."""


def plant_of_membrane(values: dict[str, Any], optics: Optics, fast_step_s: float) -> Plant:
    """A plant of kind ``membrane``: its inputs are in Pa, its states the pressures as the membrane follows them."""
    table = read(_Membrane, values, "plant")
    rows, columns = table.actuators
    try:
        membrane = Membrane(
            radius_m=table.radius_m, tension_n_per_m=table.tension_n_per_m,
            pads_m=square_pads(rows, columns, table.pitch_m), pad_radius_m=table.pad_radius_m,
        )  # fmt: skip
    except ValueError as error:
        raise RigError(f"plant.radius_m: {error}") from None
    footprint = table.footprint_m
    grid = optics.lenslets.grid
    corner = footprint / 2 * math.hypot(1.0, grid[0] / grid[1])
    if optics.lenslets.pupil_diameter_m:
        corner = min(corner, optics.lenslets.pupil_diameter_m / (optics.lenslets.pitch_m * grid[1]) * footprint / 2)
    if corner >= membrane.radius_m:
        raise RigError(
            f"plant.footprint_m = {footprint:g}: the lenslets' corners see {corner:.3g} m from the middle,"
            f" the membrane ends at {membrane.radius_m:g} m"
        )
    # The light goes to the mirror and back: the path is twice the deflection.
    gradients = 2 * optics.seen(footprint).mean_slopes(membrane.influence_gradient)[optics.lit]
    return table.plant(optics.slopes(gradients, footprint).reshape(-1, rows * columns), fast_step_s)
