"""Models of a disturbance of the slopes: all-pole processes driven by white noise, and sums of them.

All are linear and Gaussian in continuous time: a(d/dt) theta = e, with e white and a(s) = prod_i (s - lambda_i). A
random walk has the pole zero, an Ornstein-Uhlenbeck process one real pole, a resonance one pair of complex ones, a
process of second order two real ones. They are sampled at the fast rate exactly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

from aolink.errors import IdentificationError
from aolink.numerics.arrays import FloatArray

ComplexArray = NDArray[np.complex128]
PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "random-walk": ("intensity",),
    "ornstein-uhlenbeck": ("correlation_s", "intensity"),
    "second-order": ("correlation_s", "second_correlation_s", "sd"),
    "resonance": ("frequency_hz", "damping", "sd"),
}
"""The parameters of each kind of process; each is above zero.

``intensity`` is the variance per second that white noise adds, slope units squared per second; ``sd`` the stationary
standard deviation, slope units; ``correlation_s`` minus the inverse of a real pole, s; ``frequency_hz`` and ``damping``
the modulus of a pair of poles over 2 pi, Hz, and their damping ratio.
"""
UNITS: Mapping[str, str] = {
    "intensity": "slope^2/s", "sd": "slope", "damping": "", "frequency_hz": "Hz", "correlation_s": "s",
    "second_correlation_s": "s",
}  # fmt: skip
_FASTEST = 300.0
_APART = 1e-4
"""Least distance of two poles, as a share of their modulus: a double pole has no partial fractions."""


@dataclass(frozen=True)
class Process:
    """One process of a disturbance, with the values of its parameters in the order of `PARAMETERS`.

    Its covariance is a sum of exponentials, one for each of its poles.
    """

    kind: str
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.kind not in PARAMETERS:
            raise IdentificationError(f"{self.kind!r} is not a kind of process: use one of {', '.join(PARAMETERS)}")
        if len(self.values) != len(self.names) or not all(0 < value < math.inf for value in self.values):
            raise IdentificationError(f"{self.kind} has {', '.join(self.names)}, each above 0, not {self.values}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return PARAMETERS[self.kind]

    def __getitem__(self, name: str) -> float:
        return self.values[self.names.index(name)]

    @property
    def walk(self) -> float:
        """Intensity of a random walk, slope units squared per second; 0 of a stationary process."""
        return self["intensity"] if self.kind == "random-walk" else 0.0

    @cached_property
    def poles(self) -> ComplexArray:
        """lambda_i, 1/s, distinct."""
        if not self.is_stationary:
            return np.zeros(1, dtype=np.complex128)
        found: list[complex] = []
        for name, value in zip(self.names, self.values, strict=True):
            if name.endswith("correlation_s"):
                found.append(complex(-1 / value))
            elif name == "frequency_hz":
                omega, damping = 2 * math.pi * value, self["damping"]
                root = omega * complex(damping**2 - 1) ** 0.5
                found += [-omega * damping + root, -omega * damping - root]
        poles = np.array(found)
        for k in range(1, len(poles)):
            while np.abs(poles[k] - poles[:k]).min() < _APART * abs(poles[k]):
                poles[k] *= 1 + 2 * _APART
        return poles

    @property
    def variance(self) -> float:
        """Stationary variance, slope units squared; infinite of a random walk."""
        if not self.is_stationary:
            return math.inf
        if self.kind == "ornstein-uhlenbeck":
            return self["intensity"] * self["correlation_s"] / 2
        return self["sd"] ** 2

    @cached_property
    def residues(self) -> ComplexArray:
        """The residue of the stationary covariance at each pole, slope units squared."""
        poles = self.poles  # residues are proportional to 1 / (a'(lambda) a(-lambda))
        residues = np.array([1 / (np.prod(p - np.delete(poles, k)) * np.prod(-p - poles)) for k, p in enumerate(poles)])
        return np.asarray(residues * (self.variance / residues.sum().real))

    @property
    def is_stationary(self) -> bool:
        """Whether it has a stationary variance."""
        return self.walk == 0

    def covariance(self, lag_s: FloatArray) -> FloatArray:
        """Cov(theta(t), theta(t + lag)) of a stationary process, lags at least zero, shape of ``lag_s``."""
        return np.asarray((self.residues * np.exp(self.poles * lag_s[..., None])).sum(axis=-1).real)

    def covariance_across(self, apart_s: FloatArray, at_s: FloatArray) -> FloatArray:
        """Cov(theta(t + at_b), theta(t + apart + at_a)), (m, k, k), a first, for times (m,) and (k,), s; ``apart`` is
        more than all differences of ``at``."""
        poles = self._tamed(at_s)
        inside = self.residues[:, None, None] * np.exp(poles[:, None, None] * (at_s[:, None] - at_s))
        return np.asarray(np.tensordot(np.exp(np.outer(apart_s, poles)), inside, axes=1).real)

    def covariance_of_means(self, apart_s: FloatArray, at_s: FloatArray, weights: FloatArray) -> FloatArray:
        """The covariance of means with these ``weights`` over ``at``, (m,)."""
        poles = self._tamed(at_s)
        means = np.exp(np.outer(poles, at_s)) @ weights, np.exp(-np.outer(poles, at_s)) @ weights
        return np.asarray((np.exp(np.outer(apart_s, poles)) @ (self.residues * means[0] * means[1])).real)

    def _tamed(self, at_s: FloatArray) -> ComplexArray:
        """The poles, limited so that none decays within ``at`` so fast that its inverse overflows."""
        fastest = _FASTEST / max(float(np.ptp(at_s)), 1e-12)
        return np.asarray(np.maximum(self.poles.real, -fastest) + 1j * self.poles.imag)


@dataclass(frozen=True)
class StateSpace:
    """x(k+1) = A x(k) + B_w w(k), w ~ N(0, W), theta(k) = C x(k), in fast steps."""

    A: FloatArray
    """(n_states, n_states)"""
    B_w: FloatArray
    """(n_states, n_noises)"""
    W: FloatArray
    """(n_noises, n_noises)"""
    C: FloatArray
    """(1, n_states)"""
    initial_covariance: FloatArray
    """Stationary covariance, (n_states, n_states); that of the first state of a random walk is ``start_variance``."""


@dataclass(frozen=True)
class ProcessSum:
    """A sum of independent processes."""

    processes: tuple[Process, ...]

    @property
    def name(self) -> str:
        """Kinds, such as ``random-walk+resonance``."""
        return "+".join(process.kind for process in self.processes)

    @property
    def is_stationary(self) -> bool:
        """Whether all its processes are stationary."""
        return all(process.is_stationary for process in self.processes)

    def state_space(self, step_s: float, start_variance: float = 0.0) -> StateSpace:
        """The model sampled at the fast rate, exactly; ``start_variance`` is that of a random walk's start, slope units
        squared."""
        parts = [_sampled(process, step_s, start_variance) for process in self.processes]
        A, W, P = (linalg.block_diag(*(part[k] for part in parts)) for k in (0, 1, 2))
        C = np.concatenate([np.eye(1, len(part[0])) for part in parts], axis=1)
        return StateSpace(A, np.eye(len(A)), W, C, P)


def _sampled(process: Process, step_s: float, start_variance: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, W and the initial covariance of one process; its first state is theta."""
    if not process.is_stationary:
        return np.eye(1), np.array([[process["intensity"] * step_s]]), np.array([[start_variance]])
    poles = process.poles
    n = len(poles)
    # States are theta and its derivatives, each in units of a pole's modulus so that they are alike in size.
    unit = float(np.exp(np.log(np.abs(poles)).mean()))
    F = np.diag(np.ones(n - 1), 1)
    F[-1] = -np.poly(poles / unit).real[:0:-1]
    drive = np.zeros((n, n))
    drive[-1, -1] = 1.0
    P = linalg.solve_continuous_lyapunov(F, -drive)
    P = (P + P.T) / 2 * (process.variance / P[0, 0])
    A = linalg.expm(F * (unit * step_s))
    W = P - A @ P @ A.T
    values, vectors = np.linalg.eigh((W + W.T) / 2)
    return A, (vectors * np.maximum(values, 0.0)) @ vectors.T, P


PLANTS: Mapping[str, tuple[str, ...]] = {
    "first-order": ("gain", "correlation_s", "sd"),
    "second-order": ("gain", "frequency_hz", "damping", "sd"),
}
"""The parameters of each kind of plant whose input moves one output.

``gain`` is the slope for a resting input of one, slope units; the poles are given as in `PARAMETERS`; ``sd`` is the
standard deviation of the slope by noise at the plant's input, slope units.
"""


@dataclass(frozen=True)
class IdentifiedPlant:
    """A plant from one input to one output, with white noise at its input."""

    kind: str
    values: tuple[float, ...]
    """Values of the parameters, in the order of `PLANTS`."""

    def __getitem__(self, name: str) -> float:
        return self.values[PLANTS[self.kind].index(name)]

    @property
    def noise(self) -> Process:
        """The disturbance of the output by the plant's noise."""
        if self.kind == "first-order":
            tau = self["correlation_s"]
            return Process("ornstein-uhlenbeck", (tau, 2 * self["sd"] ** 2 / tau))
        return Process("resonance", (self["frequency_hz"], self["damping"], abs(self["sd"])))

    def state_space(self, step_s: float) -> tuple[StateSpace, FloatArray]:
        """The plant sampled at the fast rate, with inputs held for a step, and its B, (n_states, 1)."""
        space = ProcessSum((self.noise,)).state_space(step_s)
        # At rest the first state is the gain times the input and the others, its derivatives, are zero.
        rest = np.eye(len(space.A), 1) * self["gain"]
        return space, rest - space.A @ rest

    def response(self, inputs: FloatArray, step_s: float) -> FloatArray:
        """Outputs from rest at each fast step and one more, (outputs, steps + 1), from inputs (outputs, steps)."""
        space, B = self.state_space(step_s)
        # C (z - A)^-1 B as a difference equation.
        poles = np.poly(space.A)
        impulse = [float((space.C @ np.linalg.matrix_power(space.A, k) @ B)[0, 0]) for k in range(len(space.A))]
        numerator = np.append(0.0, np.convolve(poles, impulse)[: len(space.A)])
        padded = np.concatenate([inputs, np.zeros((len(inputs), 1))], axis=1)
        return np.asarray(signal.lfilter(numerator, poles, padded, axis=1))


def kinds_of(name: str) -> tuple[str, ...]:
    """The kinds of a sum such as ``random-walk+resonance``. Raises IdentificationError."""
    kinds = tuple(part.strip() for part in name.split("+"))
    if wrong := [kind for kind in kinds if kind not in PARAMETERS]:
        raise IdentificationError(
            f"{wrong[0]!r} is not a kind of process: use one of {', '.join(PARAMETERS)}, or sums of them"
        )
    return kinds
