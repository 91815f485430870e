"""A rig file's ``[disturbance]``: slopes that a simulated rig adds to those of its plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RigError
from aolink.optics.turbulence import Layer
from aolink.rig.toml_table import Table

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Vibration:
    """A sinusoidal vibration of all spots' slopes; its phase depends on the seed."""

    frequency_hz: float
    amplitude: tuple[float, float]
    """Along x and y, slope units; a line of pixels sees x."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Disturbance:
    """Slopes that are added to the plant's outputs."""

    plant_noise: bool
    """Whether the plant makes its own process noise as well. If not, ``plant.process_noise`` is only what
    estimators expect the disturbance to be."""
    layers: tuple[Layer, ...]
    """Layers of turbulence."""
    pupil_m: float
    """Width of the turbulence that all columns of lenslets cover together, m."""
    vibrations: tuple[Vibration, ...]
    zernike_m: FloatArray
    """Static aberration: Noll's index and metres rms over the circle about the lenslets, (k, 2)."""
    recorded: str
    """A file with slopes at each fast step, slope units, (steps, outputs), played in a loop; empty for none."""


def read_disturbance(table: Table) -> Disturbance:
    """The table ``[disturbance]``. Raises `RigError`."""
    pupil, layers = table.read_any("turbulence", _turbulence) or (0.0, ())
    zernike = table.matrix("zernike_m", (None, 2), "Noll's index and metres") if table.has("zernike_m") else None
    if zernike is not None and not all(index >= 2 and index == round(index) for index in zernike[:, 0]):
        raise RigError(f"{table.key('zernike_m')}: each row begins with one of Noll's indices, a whole number from 2")
    return Disturbance(
        plant_noise=table.flag("plant_noise", True),
        layers=layers,
        pupil_m=pupil,
        vibrations=table.read_all("vibration", _vibration),
        zernike_m=np.zeros((0, 2)) if zernike is None else zernike,
        recorded=table.text("recorded", ""),
    )


def _turbulence(table: Table) -> tuple[float, tuple[Layer, ...]]:
    """Width that the lenslets cover, m, and the layers."""
    pupil = table.number("pupil_m", above=0.0)
    outer, wavelength = table.number("outer_scale_m", 25.0, above=0.0), table.number("wavelength_m", 500e-9, above=0.0)
    layers = table.read_all("layers", _layer, outer, wavelength)
    if not layers:
        raise RigError(f"{table.key('layers')} is empty: give each layer's r0_m and wind_m_s")
    return pupil, layers


def _layer(table: Table, outer_scale_m: float, wavelength_m: float) -> Layer:
    wind = table.vector("wind_m_s", 2, "along x and y")
    return Layer(
        r0_m=table.number("r0_m", above=0.0),
        wind_m_s=(float(wind[0]), float(wind[1])),
        outer_scale_m=outer_scale_m,
        wavelength_m=wavelength_m,
    )


def _vibration(table: Table) -> Vibration:
    amplitude = table.vector("amplitude", 2, "along x and y")
    return Vibration(
        frequency_hz=table.number("frequency_hz", above=0.0), amplitude=(float(amplitude[0]), float(amplitude[1]))
    )
