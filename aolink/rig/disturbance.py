"""A rig file's ``[disturbance]``: slopes that a simulated rig adds to those of its plant, and a model of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import scipy

from aolink.errors import RigError
from aolink.keys import Positive, Shape, checked, pair, read
from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.optics.mirror import second_order
from aolink.optics.turbulence import Layer
from aolink.rig.optical_plant import check_frequency, variances


@dataclass(frozen=True, kw_only=True)
class Vibration:
    """A sinusoidal vibration of all spots' slopes; its phase depends on the seed."""

    frequency_hz: Positive
    amplitude: Annotated[tuple[float, float], pair]
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


@dataclass(frozen=True, kw_only=True)
class _Turbulence:
    pupil_m: Positive
    """Width that all columns of lenslets cover together, m."""
    layers: tuple[dict[str, Any], ...]
    outer_scale_m: Positive = 25.0
    wavelength_m: Positive = 500e-9


@dataclass(frozen=True, kw_only=True)
class _Table:
    plant_noise: bool = True
    """Whether the simulated plant and ``model`` make their own noise as well."""
    turbulence: _Turbulence | None = None
    vibration: tuple[Vibration, ...] = ()
    zernike_m: Annotated[FloatArray, Shape("terms", "Noll's index and metres")] | None = None
    """Static aberration: Noll's index and metres rms over the circle about the lenslets, (terms, 2)."""
    recorded: str = ""
    """A file with slopes at each fast step, slope units, (steps, outputs), played in a loop."""
    model: tuple[dict[str, Any], ...] = ()


def read_disturbance(values: dict[str, Any], n_outputs: int, fast_step_s: float) -> Disturbance:
    """Read the table ``[disturbance]`` of a rig whose plant has ``n_outputs`` outputs a copy. Raises `RigError`."""
    table = read(_Table, values, "disturbance", {"Noll's index and metres": 2})
    zernike, air = table.zernike_m, table.turbulence
    if zernike is not None and not all(index >= 2 and index == round(index) for index in zernike[:, 0]):
        raise RigError("disturbance.zernike_m: each row begins with one of Noll's indices, a whole number from 2")
    if air and not air.layers:
        raise RigError("disturbance.turbulence.layers is empty: give each layer's r0_m and wind_m_s")
    shared: dict[str, Any] = {"outer_scale_m": air.outer_scale_m, "wavelength_m": air.wavelength_m} if air else {}
    layers = tuple(
        read(Layer, each, f"disturbance.turbulence.layers[{k}]", **shared)
        for k, each in enumerate(air.layers if air else ())
    )
    models = [_model(each, f"disturbance.model[{k}]", n_outputs, fast_step_s) for k, each in enumerate(table.model)]
    return Disturbance(
        plant_noise=table.plant_noise, layers=layers, pupil_m=air.pupil_m if air else 0.0, vibrations=table.vibration,
        zernike_m=np.zeros((0, 2)) if zernike is None else zernike, recorded=table.recorded, model=_sum(models),
    )  # fmt: skip


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


@dataclass(frozen=True, kw_only=True)
class _Modes:
    modes: Annotated[FloatArray, Shape("outputs", "modes")] | None = None
    """Mode shapes, (outputs, modes); by default one for each output."""
    sd: Annotated[FloatArray, Shape("modes")]
    """Standard deviation of each mode, slope units."""


@dataclass(frozen=True, kw_only=True)
class _Resonance(_Modes):
    frequency_hz: Positive
    damping: Positive


@dataclass(frozen=True, kw_only=True)
class _OrnsteinUhlenbeck(_Modes):
    correlation_s: Positive


@dataclass(frozen=True, kw_only=True)
class _Autoregressive(_Modes):
    coefficients: Annotated[FloatArray, Shape("1 to 4 numbers")]
    """a_1 to a_p of x(k) = a_1 x(k-1) + ... + a_p x(k-p) + w(k), at the fast rate."""


@dataclass(frozen=True, kw_only=True)
class _RandomWalk:
    modes: Annotated[FloatArray, Shape("outputs", "modes")] | None = None
    """As above."""
    step_sd: Annotated[FloatArray, Shape("modes")]
    """Standard deviation of each mode's step in a fast step, slope units."""


@dataclass(frozen=True, kw_only=True)
class _Matrices:
    A: Annotated[FloatArray, Shape("states", "states")]
    B_w: Annotated[FloatArray, Shape("states", "noises")]
    C: Annotated[FloatArray, Shape("outputs", "states")]
    process_noise: Any
    """Variance of each noise in a fast step."""


_MODELS: dict[str, Any] = {
    "resonance": _Resonance, "ornstein-uhlenbeck": _OrnsteinUhlenbeck, "random-walk": _RandomWalk,
    "ar": _Autoregressive, "matrices": _Matrices,
}  # fmt: skip


def _model(values: dict[str, Any], key: str, n_outputs: int, fast_step_s: float) -> DisturbanceModel:
    """One part of ``disturbance.model``: a system given by its kind, for each of its mode shapes, or by its
    matrices."""
    kind = checked(Literal[*_MODELS], values.get("kind"), f"{key}.kind")
    sizes = {"outputs": n_outputs} | ({} if "modes" in values else {"modes": n_outputs})
    table = read(_MODELS[kind], {name: each for name, each in values.items() if name != "kind"}, key, sizes)
    if kind == "matrices":
        _check_dies_out(f"{key}.A", table.A)
        W = variances(table.process_noise, f"{key}.process_noise", sizes)
        return DisturbanceModel(
            A=table.A, B_w=table.B_w, C=table.C, process_noise=W,
            initial_covariance=stationary_covariance(table.A, table.B_w @ W @ table.B_w.T),
        )  # fmt: skip
    modes = np.eye(n_outputs) if table.modes is None else table.modes
    A = B_w = np.eye(1)
    if kind == "resonance":
        check_frequency(table.frequency_hz, f"{key}.frequency_hz", fast_step_s)
        A, B_w = second_order(table.frequency_hz, table.damping, fast_step_s)
    elif kind == "ornstein-uhlenbeck":
        A = np.array([[math.exp(-fast_step_s / table.correlation_s)]])
    elif kind == "ar":
        # Its state is the last p values, the newest first.
        order = len(table.coefficients)
        if order > 4:
            raise RigError(f"{key}.coefficients has shape {order}, expected 1 to 4 numbers (a_1 to a_p)")
        A, B_w = np.vstack([table.coefficients, np.eye(order - 1, order)]), np.eye(order, 1)
        _check_dies_out(f"{key}.coefficients", A)
    if kind == "random-walk":
        noise = table.step_sd**2
        # The random walk may have lasted for a second before the first exposure.
        one = np.eye(1) / fast_step_s
    else:
        one = stationary_covariance(A, B_w @ B_w.T)
        noise = table.sd**2 / one[0, 0]
    each = np.eye(len(noise))
    return DisturbanceModel(
        A=np.asarray(np.kron(each, A)), B_w=np.asarray(np.kron(each, B_w)),
        C=np.asarray(np.kron(modes, np.eye(1, len(A)))), process_noise=np.diag(noise),
        initial_covariance=np.asarray(np.kron(np.diag(noise), one)),
    )  # fmt: skip


def _check_dies_out(key: str, A: FloatArray) -> None:
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius > 1 - 1e-9:
        raise RigError(
            f"{key} makes a disturbance that does not decay (an eigenvalue has modulus {radius:.6g}, it"
            " must be below 1): for one that wanders off use kind = 'random-walk'"
        )
