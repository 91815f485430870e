"""A rig file's ``[disturbance]``: slopes that a simulated rig adds to those of its plant, and a model of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from aolink.errors import RigError
from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.optics.mirror import second_order
from aolink.optics.turbulence import Layer
from aolink.rig.toml_table import Table


@dataclass(frozen=True, kw_only=True)
class Vibration:
    """A sinusoidal vibration of all spots' slopes; its phase depends on the seed."""

    frequency_hz: float
    amplitude: tuple[float, float]
    """Amplitude along x and y, slope units; a line sensor sees x."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DisturbanceModel:
    """Slopes as a linear system driven by noise, x(k+1) = A x(k) + B_w w(k), that add C x(k) to the plant's outputs.

    It belongs to one copy of the plant; each copy has its own. The mirror's inputs do not reach its states.
    """

    A: FloatArray
    """State transition over one fast step, (n_states, n_states)."""
    B_w: FloatArray
    """Noise input matrix, (n_states, n_noises)."""
    C: FloatArray
    """Output matrix, (n_outputs, n_states)."""
    process_noise: FloatArray
    """Covariance of w(k) per fast step, (n_noises, n_noises)."""
    initial_covariance: FloatArray
    """Covariance of x(0), whose mean is zero, (n_states, n_states)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Disturbance:
    """Slopes that are added to the plant's outputs."""

    plant_noise: bool
    """Whether the simulated plant and ``model`` make their own noise as well. If not, ``plant.process_noise`` and
    ``model`` are only the model that estimators and controllers use."""
    layers: tuple[Layer, ...]
    """Layers of turbulence."""
    pupil_m: float
    """Width of the turbulence that all columns of lenslets cover together, m."""
    vibrations: tuple[Vibration, ...]
    zernike_m: FloatArray
    """Static aberration: Noll's index and metres rms over the circle about the lenslets, (k, 2)."""
    recorded: str
    """A file with slopes at each fast step, slope units, (steps, outputs), played in a loop; empty for none."""
    model: DisturbanceModel | None
    """The model of the disturbance; the rig's plant has its states beside the mirror's. None where there is no
    model."""


def read_disturbance(table: Table, n_outputs: int, fast_step_s: float) -> Disturbance:
    """Read the table ``[disturbance]`` of a rig whose plant has ``n_outputs`` outputs a copy. Raises `RigError`."""
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
        model=_sum(table.read_all("model", _model, n_outputs, fast_step_s)),
    )


def _sum(parts: Sequence[DisturbanceModel]) -> DisturbanceModel | None:
    """The parts of a model side by side, their outputs added."""
    if not parts:
        return None
    A, B_w, W, initial = (
        np.asarray(scipy.linalg.block_diag(*(getattr(part, name) for part in parts)))
        for name in ("A", "B_w", "process_noise", "initial_covariance")
    )
    C = np.hstack([part.C for part in parts])
    return DisturbanceModel(A=A, B_w=B_w, C=C, process_noise=W, initial_covariance=initial)


def _model(table: Table, n_outputs: int, fast_step_s: float) -> DisturbanceModel:
    """One part of ``disturbance.model``: a system given by its kind, for each of its mode shapes, or by its
    matrices."""
    kind = table.choice("kind", ("resonance", "ornstein-uhlenbeck", "random-walk", "ar", "matrices"))
    if kind == "matrices":
        return _model_by_matrices(table, n_outputs)
    modes = table.matrix("modes", (n_outputs, None), "outputs x modes") if table.has("modes") else np.eye(n_outputs)
    if kind == "resonance":
        frequency = table.frequency("frequency_hz", fast_step_s)
        A, B_w = second_order(frequency, table.number("damping", above=0.0), fast_step_s)
    elif kind == "ornstein-uhlenbeck":
        A, B_w = np.array([[math.exp(-fast_step_s / table.number("correlation_s", above=0.0))]]), np.eye(1)
    elif kind == "random-walk":
        A, B_w = np.eye(1), np.eye(1)
    else:
        A, B_w = _autoregressive(table)
    if kind == "random-walk":
        noise = table.vector("step_sd", modes.shape[1], "modes") ** 2
        # The random walk may have lasted for a second before the first exposure.
        one = np.eye(1) / fast_step_s
    else:
        one = stationary_covariance(A, B_w @ B_w.T)
        noise = table.vector("sd", modes.shape[1], "modes") ** 2 / one[0, 0]
    each = np.eye(len(noise))
    return DisturbanceModel(
        A=np.asarray(np.kron(each, A)), B_w=np.asarray(np.kron(each, B_w)),
        C=np.asarray(np.kron(modes, np.eye(1, len(A)))), process_noise=np.diag(noise),
        initial_covariance=np.asarray(np.kron(np.diag(noise), one)),
    )  # fmt: skip


def _autoregressive(table: Table) -> tuple[FloatArray, FloatArray]:
    """The process x(k) = a_1 x(k-1) + ... + a_p x(k-p) + w(k), whose state is the last p values, the newest first."""
    coefficients = table.numbers("coefficients", "a_1 to a_p", most=4)
    A = np.vstack([coefficients, np.eye(len(coefficients) - 1, len(coefficients))])
    _check_dies_out(table, "coefficients", A)
    return A, np.eye(len(A), 1)


def _model_by_matrices(table: Table, n_outputs: int) -> DisturbanceModel:
    A = table.square("A", "states x states")
    n = len(A)
    _check_dies_out(table, "A", A)
    B_w = table.matrix("B_w", (n, None), "states x process noises")
    W = table.variances("process_noise", B_w.shape[1], "noises: the variance of each")
    return DisturbanceModel(
        A=A, B_w=B_w, C=table.matrix("C", (n_outputs, n), "outputs x states"), process_noise=W,
        initial_covariance=stationary_covariance(A, B_w @ W @ B_w.T),
    )  # fmt: skip


def _check_dies_out(table: Table, name: str, A: FloatArray) -> None:
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius > 1 - 1e-9:
        raise RigError(
            f"{table.key(name)} makes a disturbance that does not decay (an eigenvalue has modulus {radius:.6g}, it"
            " must be below 1): for one that wanders off use kind = 'random-walk'"
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
