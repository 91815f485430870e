"""The optical parts of a rig file: lenslets, and mirrors whose plant follows from a description."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RigError
from aolink.numerics.arrays import FloatArray
from aolink.optics.lenslets import Lenslets
from aolink.optics.mirror import Membrane, MirrorPlant, VoltageLaw, mirror_plant, second_order, square_pads
from aolink.rig.toml_table import Table

_LEAST_LIGHT = 0.5


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


def read_optics(table: Table, grid: tuple[int, ...]) -> Optics:
    """Read the table ``[lenslets]``. Raises `RigError`."""
    rows, columns = grid
    lenslets = Lenslets(
        grid=(rows, columns),
        pitch_m=table.number("pitch_m", above=0.0),
        focal_length_m=table.number("focal_length_m", above=0.0),
        pupil_diameter_m=table.number("pupil_m", above=0.0) if table.has("pupil_m") else None,
        obstruction=_obstruction(table) if table.has("pupil_m") else 0.0,
    )
    optics = Optics(
        lenslets=lenslets,
        slope_unit_rad=table.number("slope_unit_rad", 1e-3, above=0.0),
        least_light=_LEAST_LIGHT if lenslets.pupil_diameter_m is None else _least_light(table),
    )
    if not optics.lit.any():
        raise RigError(
            f"{table.key('least_light')} = {optics.least_light:g}: no lenslet has that share of light,"
            f" the brightest has {lenslets.light.max():.2g} of its area in the pupil"
        )
    return optics


def _obstruction(table: Table) -> float:
    share = table.number("obstruction", 0.0, low=0.0)
    if share >= 1:
        raise RigError(f"{table.key('obstruction')} = {share:g} is a share of the pupil's diameter: it must be below 1")
    return share


def _least_light(table: Table) -> float:
    share = table.number("least_light", _LEAST_LIGHT, above=0.0)
    if share > 1:
        raise RigError(f"{table.key('least_light')} = {share:g} is a share of a lenslet: it must not be above 1")
    return share


def read_tip_tilt(table: Table, n_spots: int, fast_step_s: float) -> MirrorPlant:
    """Read a plant of kind ``tip-tilt``: two inputs that turn a flat mirror, and with it all spots alike."""
    gain = np.diag(table.vector("gain", 2, "slope units per input, along x and y"))
    coupling = table.number("coupling", 0.0)
    if abs(coupling) >= 1:
        raise RigError(f"{table.key('coupling')} = {coupling:g}: an axis must move its own slope more than the other's")
    gain = np.array([[1.0, coupling], [coupling, 1.0]]) @ gain
    return mirror_plant(np.tile(gain, (n_spots, 1)), *_dynamics(table, fast_step_s))


def read_membrane(table: Table, optics: Optics, fast_step_s: float) -> MirrorPlant:
    """Read a plant of kind ``membrane``: its inputs are in Pa, its states the pressures as the membrane follows
    them."""
    rows, columns = table.integers("actuators", 2, "rows and columns", low=1, high=32)
    try:
        membrane = Membrane(
            radius_m=table.number("radius_m", above=0.0),
            tension_n_per_m=table.number("tension_n_per_m", above=0.0),
            pads_m=square_pads(rows, columns, table.number("pitch_m", above=0.0)),
            pad_radius_m=table.number("pad_radius_m", above=0.0),
        )
    except ValueError as error:
        raise RigError(f"{table.key('radius_m')}: {error}") from None
    footprint = table.number("footprint_m", above=0.0)
    grid = optics.lenslets.grid
    corner = footprint / 2 * math.hypot(1.0, grid[0] / grid[1])
    if optics.lenslets.pupil_diameter_m:
        corner = min(corner, optics.lenslets.pupil_diameter_m / (optics.lenslets.pitch_m * grid[1]) * footprint / 2)
    if corner >= membrane.radius_m:
        raise RigError(
            f"{table.key('footprint_m')} = {footprint:g}: the lenslets' corners see {corner:.3g} m from the middle,"
            f" the membrane ends at {membrane.radius_m:g} m"
        )
    # The light goes to the mirror and back: the path is twice the deflection.
    gradients = 2 * optics.seen(footprint).mean_slopes(membrane.influence_gradient)[optics.lit]
    per_pascal = optics.slopes(gradients, footprint).reshape(-1, rows * columns)
    return mirror_plant(per_pascal, *_dynamics(table, fast_step_s))


def _dynamics(table: Table, fast_step_s: float) -> tuple[tuple[FloatArray, FloatArray], float | None]:
    """Resonance of an actuator, and the share of a drift that is left after a fast step."""
    frequency = table.frequency("resonance_hz", fast_step_s)
    dynamics = second_order(frequency, table.number("damping", above=0.0), fast_step_s)
    drift_s = table.number("drift_s", above=0.0) if table.has("drift_s") else None
    return dynamics, None if drift_s is None else math.exp(-fast_step_s / drift_s)


def read_voltage(table: Table) -> VoltageLaw:
    """Read the table ``[mirror.voltage]``. Raises `RigError`."""
    law = VoltageLaw(
        gamma=table.number("gamma", above=0.0),
        bias_v=table.number("bias_v", above=0.0),
        max_v=table.number("max_v", above=0.0),
    )
    if law.max_v <= law.bias_v:
        raise RigError(f"{table.key('bias_v')} = {law.bias_v:g} must be below max_v = {law.max_v:g}")
    return law
