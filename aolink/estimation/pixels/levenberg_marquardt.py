"""Levenberg and Marquardt's method, for the search of `joint_pixels`; `compiled.modes` has it for few coefficients.

A step solves (H + damping diag H) step = g, where g is minus the objective's gradient and H is its Hessian, or Fisher's
information instead. A step that makes the objective smaller is taken and the damping falls; else the damping grows.
Marquardt, J. SIAM 11 (1963) 431.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from aolink.numerics.arrays import FloatArray

FIRST_DAMPING = 0.01
LARGEST_DAMPING = 1e6
"""Largest damping: beyond it no step makes the objective smaller, and the search ends."""
FREE_DAMPING = 0.1
"""Up to this damping a short step means that a mode is near; with more damping, the damping makes it short."""


class Place(NamedTuple):
    """The objective about a point."""

    x: FloatArray
    """(n,)"""
    objective: float
    descent: FloatArray
    """Minus the gradient, (n,)."""
    hessian: FloatArray
    """Positive definite, (n, n)."""
    seen: Any = None
    """What the caller keeps with it."""


def minimise(
    at: Callable[[FloatArray], Place], start: FloatArray, passes: int, converged: float, *,
    foreseen: float = 0.0, solve: Callable[..., Any] = np.linalg.solve,
) -> Place:  # fmt: skip
    """The minimum that a start (n,) leads to, in at most so many ``passes``.

    It is reached when a step changes the objective by less than ``converged``, or when one is foreseen to change it by
    less than ``foreseen``: such a step is not tried.
    """
    here, damping = at(start), FIRST_DAMPING
    for _ in range(passes):
        step = solve(here.hessian + damping * np.diag(np.diag(here.hessian)), here.descent)
        slope, free = float(step @ here.descent), damping <= FREE_DAMPING
        if free and slope / 2 < foreseen:
            break
        there = at(here.x + step)
        gain = here.objective - there.objective
        # An eighth where the step makes the objective smaller; eight times as much, and no less than that, where not.
        here, damping = (there, damping / 8) if gain > 0 else (here, max(damping, 1e-3) * 8)
        if (free and (0 < gain < converged or slope < converged)) or damping > LARGEST_DAMPING:
            break
    return here
