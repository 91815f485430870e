"""The disturbance that a rig file describes, so that the likelihood can judge it beside identified models.

The noise of the plant and the model of the disturbance drive one linear system, x(k+1) = A x(k) + B_w w(k). With A =
V diag(mu) V^-1 each eigenvalue is a pole log(mu) / T_f of the covariance of C x, in one sum of exponentials.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from aolink.errors import IdentificationError
from aolink.identification.models import ComplexArray, Covariance, Process
from aolink.numerics.covariance import psd_root
from aolink.rig import Rig

_WALK = 1e-9
"""An eigenvalue this near to one belongs to a random walk."""
_LEAST = 1e-12
"""Least modulus that is assumed for an eigenvalue: a process with eigenvalue zero decays within a step."""
_MOST_CONDITION = 1e10
"""Condition number of the eigenvectors: beyond it, two poles are equal except for rounding."""
_NUDGE = 1e-5
"""Relative distance by which such poles are moved apart."""
_NOTHING = 1e-6
"""A pole with less than this share of the variance is left out: a fast one would cost the likelihood many nodes."""


@dataclass(frozen=True, eq=False)
class _Stationary(Covariance):
    of_poles: tuple[ComplexArray, ComplexArray]

    @property
    def poles(self) -> ComplexArray:
        return self.of_poles[0]

    @property
    def residues(self) -> ComplexArray:
        return self.of_poles[1]

    @property
    def walk(self) -> float:
        return 0.0


@dataclass(frozen=True, eq=False)
class RigModel:
    """The disturbance of one output by a rig file; a `aolink.identification.models.DisturbanceProcesses`."""

    processes: tuple[Covariance, ...]

    def text(self) -> str:
        """Its poles in words, those of the largest residue first."""
        words = []
        for process in self.processes:
            if not process.is_stationary:
                words.append(f"a random walk of {process.walk:.3g} /s")
                continue
            for k in np.argsort(-np.abs(process.residues)):
                pole, size = process.poles[k], abs(process.poles[k])
                if pole.imag > 0:
                    words.append(f"{size / (2 * math.pi):.4g} Hz of damping {-pole.real / size:.2g}")
                elif pole.imag == 0:
                    words.append(f"{1 / size:.3g} s")
        return " and ".join(words)


def rig_model(rig: Rig, output: int) -> RigModel:
    """The disturbance of one output of a copy of the plant by a rig's plant noise and its model of the disturbance.

    Raises
    ------
    IdentificationError
        By the rig file nothing disturbs the output, or the disturbance grows or rings without end.
    """
    plant, step = rig.plant, rig.timing.fast_step_s
    A = np.asarray(plant.A)
    mu, V = np.linalg.eig(A)
    if np.linalg.cond(V) > _MOST_CONDITION:
        mu, V = np.linalg.eig(A * (1 - _NUDGE * np.arange(len(A))[:, None] / len(A)))
    root = np.linalg.solve(V, plant.B_w @ psd_root(plant.process_noise))
    Q = root @ root.conj().T
    seen = np.asarray(plant.C)[output] @ V
    walks = np.abs(mu - 1) < _WALK
    driven = np.abs(np.diagonal(Q)) * np.abs(seen) ** 2 > 0
    if (driven & ~walks & (np.abs(mu) >= 1)).any():
        raise IdentificationError(
            "the rig file's disturbance grows or rings without end: it has no stationary variance; give a resonance a"
            " damping"
        )
    processes: list[Covariance] = []
    held = np.flatnonzero(driven & ~walks)
    if len(held):
        P = Q[np.ix_(held, held)] / (1 - mu[held][:, None] * mu[held].conj())
        residues = seen[held] * (P @ seen[held].conj())
        size = np.maximum(np.abs(mu[held]), _LEAST)
        poles = (np.log(size) + 1j * np.angle(mu[held])) / step
        counts = np.abs(residues) > _NOTHING * abs(residues.sum())
        processes.append(_Stationary((poles[counts], residues[counts])))
    free = np.flatnonzero(driven & walks)
    if len(free):
        gained = (seen[free] @ Q[np.ix_(free, free)] @ seen[free].conj()).real
        processes.append(Process("random-walk", (float(gained) / step,)))
    if not processes:
        raise IdentificationError("by the rig file nothing disturbs this output: plant.process_noise is zero")
    return RigModel(tuple(processes))
