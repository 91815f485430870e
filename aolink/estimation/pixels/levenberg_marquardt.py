"""Levenberg and Marquardt's method, for all searches for a mode except the compiled one (`compiled.modes`, its twin).

A step solves (H + damping diag H) step = g, where g is minus the objective's gradient and H is its Hessian, or Fisher's
information instead. A step that makes the objective smaller is taken and the damping falls; else the damping grows.
Marquardt, J. SIAM 11 (1963) 431.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray, Indices

FIRST_DAMPING = 0.01
LARGEST_DAMPING = 1e6
"""Largest damping: beyond it no step makes the objective smaller, and the search ends."""
FREE_DAMPING = 0.1
"""Up to this damping a short step means that a mode is near; with more damping, the damping makes it short."""


@dataclass(frozen=True, eq=False)
class Points:
    """The objective about some points."""

    objective: FloatArray
    """(points,)"""
    descent: FloatArray
    """Minus the gradient, (points, n)."""
    hessian: FloatArray
    """Positive definite, (points, n, n)."""
    linearised: NDArray[Any] | None = None
    """Data that the caller keeps for each point, (points,)."""


def minimise(
    at: Callable[[FloatArray, Indices], Points], starts: FloatArray, passes: int, converged: float, *,
    foreseen: float = 0.0, solve: Callable[[FloatArray, FloatArray], FloatArray] = batched.solve,
) -> tuple[FloatArray, Points]:  # fmt: skip
    """The minimum that each of many starts leads to; the search from one start does not depend on the others.

    Parameters
    ----------
    at:
        The objective about points, one a row, and which of the starts each row comes from.
    starts:
        (starts, n)
    passes:
        Steps that are tried at most.
    converged:
        A start is done when a step changes the objective by less than this.
    foreseen:
        Or when a step is foreseen to change it by less than this: such a step is not tried.
    solve:
        For systems with positive definite matrices, (points, n, n) and (points, n).

    Returns
    -------
    The points (starts, n), and what is known about them.
    """
    x, active = starts.copy(), np.arange(len(starts))
    here = at(x, active)
    damping = np.full(len(x), FIRST_DAMPING)
    for _ in range(passes):
        H, g = here.hessian[active], here.descent[active]
        diagonal = np.einsum("rii->ri", H)
        before = damping[active]
        diagonal += before[:, None] * diagonal
        step = solve(H, g)
        slope = np.einsum("kn,kn->k", step, g)
        free = before <= FREE_DAMPING
        going_on = ~(free & (slope / 2 < foreseen))
        active, step, slope, free, before = (each[going_on] for each in (active, step, slope, free, before))
        if not len(active):
            break
        there = at(x[active] + step, active)
        gain = here.objective[active] - there.objective
        better = gain > 0
        took = active[better]
        x[took] += step[better]
        for each in fields(Points):
            if (old := getattr(here, each.name)) is not None:
                old[took] = getattr(there, each.name)[better]
        # An eighth where the step made the objective smaller; eight times as much, and no less than that, where not.
        damping[active] = np.where(better, before / 8, np.maximum(before, 1e-3) * 8)
        settled = free & ((better & (gain < converged)) | (slope < converged))
        active = active[~(settled | (damping[active] > LARGEST_DAMPING))]
        if not len(active):
            break
    return x, here
