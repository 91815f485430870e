"""Deformable mirrors: a membrane that electrostatic actuators pull, and a rigid mirror that tips and tilts.

The membrane is round, clamped at its edge, under even tension T: T laplacian(w) = -p. Each actuator is a round
pad that pulls with an even pressure. Green's function of the disc and the mean value property of harmonic
functions give its deflection exactly, inside the pad and outside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from aolink.keys import Positive
from aolink.numerics.arrays import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Membrane:
    """A clamped round membrane over round actuator pads."""

    radius_m: float
    tension_n_per_m: float
    pads_m: FloatArray
    """Middles of the pads, from the membrane's middle, m, (actuators, 2)."""
    pad_radius_m: float

    def __post_init__(self) -> None:
        if min(self.radius_m, self.tension_n_per_m, self.pad_radius_m) <= 0:
            raise ValueError("a membrane's radius, tension and pad radius must be above zero")
        reach = float(np.linalg.norm(self.pads_m, axis=1).max()) + self.pad_radius_m
        if reach >= self.radius_m:
            raise ValueError(f"a pad reaches {reach:.4g} m from the middle, the membrane ends at {self.radius_m:.4g} m")

    def influence(self, points_m: FloatArray) -> FloatArray:
        """Deflection for a pressure of 1 Pa on each pad, m/Pa, (..., actuators), positive towards the actuators, at
        points on the membrane, m, (..., 2)."""
        z, source, pad = self._scaled(points_m)
        away = np.abs(z - source)
        direct = np.where(away > pad, -np.log(np.maximum(away, pad)), (1 - (away / pad) ** 2) / 2 - math.log(pad))
        return self._strength * (direct + np.log(np.abs(1 - z * source.conj())))

    def influence_gradient(self, points_m: FloatArray) -> FloatArray:
        """Gradient of `influence`, 1/Pa, (..., 2, actuators)."""
        z, source, pad = self._scaled(points_m)
        away = z - source
        # For the real part of an analytic f, the gradient is the conjugate of f'.
        direct = -away / np.maximum(np.abs(away), pad) ** 2
        image = (-source.conj() / (1 - z * source.conj())).conj()
        total = self._strength / self.radius_m * (direct + image)
        return np.stack([total.real, total.imag], axis=-2)

    @property
    def _strength(self) -> float:
        """Pad area over 2 pi T, m/Pa."""
        return self.pad_radius_m**2 / (2 * self.tension_n_per_m)

    def _scaled(self, points_m: FloatArray) -> tuple[NDArray[np.complex128], NDArray[np.complex128], float]:
        """Points (..., 1), pads (actuators,) and pad radius on the unit disc."""
        points, pads = points_m / self.radius_m, self.pads_m / self.radius_m
        z = points[..., 0, None] + 1j * points[..., 1, None]
        return z, pads[:, 0] + 1j * pads[:, 1], self.pad_radius_m / self.radius_m


def square_pads(rows: int, columns: int, pitch_m: float) -> FloatArray:
    """Middles of a grid of pads, row by row, m, (rows * columns, 2)."""
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    return pitch_m * np.stack([x - (columns - 1) / 2, y - (rows - 1) / 2], axis=-1).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class VoltageLaw:
    """An electrostatic actuator pulls with gamma V^2, Mishra & Wen, section II; inputs are relative to the bias."""

    gamma: Positive
    """Input units per V^2."""
    bias_v: Positive
    max_v: Positive

    @property
    def input_range(self) -> tuple[float, float]:
        """Inputs at zero and at the highest voltage."""
        return -self.gamma * self.bias_v**2, self.gamma * (self.max_v**2 - self.bias_v**2)

    def force(self, volts: FloatArray) -> FloatArray:
        """The input for voltages, shape of ``volts``."""
        return np.asarray(self.gamma * (volts**2 - self.bias_v**2))

    def volts(self, force: FloatArray) -> FloatArray:
        """The inverse map: voltages for inputs within `input_range`."""
        return np.sqrt(np.maximum(force / self.gamma + self.bias_v**2, 0.0))


def second_order(frequency_hz: float, damping: float, fast_step_s: float) -> tuple[FloatArray, FloatArray]:
    """A resonance with unit gain at rest, driven by an input that is held over each fast step: A (2, 2) and B (2, 1) of
    the state (position, velocity times the fast step), exactly discretised."""
    omega = 2 * math.pi * frequency_hz * fast_step_s
    A = np.asarray(scipy.linalg.expm(np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]])))
    return A, (np.eye(2) - A)[:, :1]


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorPlant:
    """The matrices A_f, B_f, B_w and C_f of a mirror, Mishra & Wen (1)."""

    A: FloatArray
    B: FloatArray
    B_w: FloatArray
    C: FloatArray


def mirror_plant(
    slopes: FloatArray, dynamics: tuple[FloatArray, FloatArray], drift_per_step: float | None = None
) -> MirrorPlant:
    """A mirror whose actuators all have the same dynamics.

    The states are the inputs as the mirror follows them. Actuators are coupled by their influence functions (in C), not
    in their dynamics: A is block diagonal, and a mirror of a thousand actuators can be computed.

    Parameters
    ----------
    slopes:
        Slopes for each input, at rest, (outputs, inputs), from the deflection that the actuators make together.
    dynamics:
        A (n, n) and B (n, 1) of one actuator, whose first state follows its input with unit gain.
    drift_per_step:
        None: process noise adds to each input. Otherwise each input has one more state, which keeps this share of
        itself over a fast step and adds to the input, and noise adds to that: disturbances slower than the mirror.
    """
    one_A, one_B = dynamics
    inputs = slopes.shape[1]
    A, B = np.asarray(np.kron(np.eye(inputs), one_A)), np.asarray(np.kron(np.eye(inputs), one_B))
    C = np.asarray(np.kron(slopes, np.eye(1, len(one_A))))
    if drift_per_step is None:
        return MirrorPlant(A=A, B=B, B_w=B.copy(), C=C)
    n = len(A)
    none = np.zeros((inputs, n))
    return MirrorPlant(
        A=np.asarray(np.block([[A, B], [none, drift_per_step * np.eye(inputs)]]), dtype=np.float64),
        B=np.vstack([B, np.zeros((inputs, inputs))]),
        B_w=np.vstack([np.zeros((n, inputs)), np.eye(inputs)]),
        C=np.hstack([C, np.zeros((len(C), inputs))]),
    )
