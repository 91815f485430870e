"""Observability and detectability of the plant by the camera (remarks 1 and 2 of Mishra & Wen)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import FloatArray, Indices
from aolink.numerics.block_diagonal import blockwise, components, eigenvalues, null_space
from aolink.rig import Plant

# An eigenmode that decays to this share over one exposure is gone before the next, observed or not.
_FORGOTTEN = 1e-3


# Eigenvalues closer than this count as equal; and v counts as an eigenvector if A v differs by less from a multiple of
# v.
_SAME = 1e-7


# An eigenvector whose outputs are smaller than this, relative to the outputs' size, is not observable.
_UNSEEN = 1e-9


@dataclass(frozen=True, kw_only=True)
class Eigenmode:
    """An eigenmode of the plant: an eigenvalue of A (of a complex pair, the one above the real axis)."""

    eigenvalue: complex
    frequency_hz: float
    time_constant_s: float
    """Time in which it decays to 1/e; infinite where it does not decay."""
    seen: bool
    """Whether it is observable from the outputs at the fast rate, (A, C)."""
    seen_by_centroid: bool
    """Whether it is observable from the mean over each exposure, (A^N, C-bar)."""

    def __str__(self) -> str:
        lasts = "undamped" if math.isinf(self.time_constant_s) else f"time constant {self.time_constant_s:.3g} s"
        return f"the eigenmode at {self.frequency_hz:.4g} Hz ({lasts})"


@dataclass(frozen=True, kw_only=True)
class ObservabilityReport:
    """The eigenmodes of the plant that are observable, and from which measurements (remarks 1 and 2 of Mishra &
    Wen)."""

    n_states: int
    rank: int
    """Dimension of the observable subspace of (A, C), at the fast rate."""
    centroid_rank: int
    """The same for (A^N, C-bar), the means over exposures; remark 1 holds where it equals ``rank``, and it need not."""
    modes: tuple[Eigenmode, ...]

    @property
    def unseen(self) -> tuple[Eigenmode, ...]:
        """Eigenmodes that are not observable at the fast rate."""
        return tuple(m for m in self.modes if not m.seen)

    @property
    def lost_by_centroid(self) -> tuple[Eigenmode, ...]:
        """Eigenmodes that are observable at the fast rate but not from the means over exposures."""
        return tuple(m for m in self.modes if m.seen and not m.seen_by_centroid)


def observability(plant: Plant, n_steps: int, fast_step_s: float) -> ObservabilityReport:
    """Observability of a plant, eigenmode by eigenmode (Popov-Belevitch-Hautus test), for exposures of ``n_steps`` fast
    steps."""
    A, parts = plant.A, components(plant.A)
    transition, mean, square = blockwise(partial(_powers, n_steps), (A,), parts)
    values = _distinct(eigenvalues(A, parts))
    blind = [_unobservable(A, plant.C / np.linalg.norm(plant.C), value, parts) for value in values]
    # The outputs' mean over an exposure, in units of their rms over its steps.
    centroid = plant.C @ mean / math.sqrt(float(((plant.C @ square) * plant.C).sum()))
    lifted = values**n_steps
    distinct = _distinct(lifted)
    lost = [_unobservable(transition, centroid, value, parts) for value in distinct]
    modes = []
    for value, value_n, unseen in zip(values, lifted, blind, strict=True):
        if value.imag < 0:
            continue
        radius = abs(value)
        modes.append(
            Eigenmode(
                eigenvalue=complex(value),
                frequency_hz=float(abs(np.angle(value))) / (2 * math.pi * fast_step_s),
                time_constant_s=math.inf if radius >= 1 - 1e-12 else -fast_step_s / math.log(max(radius, 1e-300)),
                seen=not unseen.shape[1],
                seen_by_centroid=abs(value_n) < _FORGOTTEN
                or not any(
                    _has_part_in(A, value, space, parts)
                    for other, space in zip(distinct, lost, strict=True)
                    if abs(other - value_n) < _SAME
                ),
            )
        )
    n = plant.n_states
    # Eigenvectors of different eigenvalues are independent.
    rank, centroid_rank = (n - sum(space.shape[1] for space in spaces) for spaces in (blind, lost))
    return ObservabilityReport(
        n_states=n,
        rank=rank,
        centroid_rank=centroid_rank,
        modes=tuple(modes),
    )


def _powers(n_steps: int, A: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A^N, and the means of A^i and of A^i A^i' for i from 0 to N - 1."""
    power, total, squares = np.eye(len(A)), np.zeros_like(A), np.zeros_like(A)
    for _ in range(n_steps):
        total += power
        squares += power @ power.T
        power = power @ A
    return power, total / n_steps, squares / n_steps


def _distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Distinct values: a mirror's actuators are alike, and have the same eigenvalues."""
    keep: list[complex] = []
    for value in values:
        if all(abs(value - other) > _SAME for other in keep):
            keep.append(value)
    return np.array(keep)


def _unobservable(A: FloatArray, C: FloatArray, value: complex, parts: list[Indices]) -> NDArray[Any]:
    """Orthonormal basis of the eigenvectors of A for a value that C maps to zero, (n_states, dimension)."""
    vectors = null_space(A, value, parts, _SAME)
    seen = C @ vectors
    if not vectors.shape[1]:
        return vectors
    if len(seen) > vectors.shape[1]:
        seen = np.linalg.qr(seen)[1]
    _, sizes, rows = np.linalg.svd(seen)
    hidden = np.concatenate([sizes, np.zeros(len(rows) - len(sizes))]) < _UNSEEN
    return np.asarray(vectors @ rows[hidden].conj().T)


def _has_part_in(A: FloatArray, value: complex, space: NDArray[Any], parts: list[Indices]) -> bool:
    """Whether the invariant subspace of an eigenvalue of A has a component in ``space``."""
    if not space.shape[1]:
        return False
    # The eigenvalue's left invariant space: a vector that it does not annihilate has a component in the eigenmode.
    left = null_space(A, value, parts, _SAME, left=True, power=len(A))
    return bool(np.linalg.norm(left.conj().T @ space) > 1e-6)
