"""The damping of Levenberg and Marquardt's method, for all searches for a mode.

A step solves (H + damping diag H) step = gradient. The searches differ in what they linearise and in when they are
done: `modes.find_modes` follows many starts at once, with a compiled twin for line sensors, `joint_pixels.find_mode`
one start of hundreds of coefficients. Marquardt, J. SIAM 11 (1963) 431.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FIRST_DAMPING = 0.01
LARGEST_DAMPING = 1e6
"""With more than this no step makes the objective smaller: the search is over."""
FREE_DAMPING = 0.1
"""Up to this damping a short step means that a mode is near; with more it is the damping that makes it short."""


def next_damping(damping: FloatArray | float, better: NDArray[np.bool_] | bool) -> FloatArray:
    """An eighth where the step made the objective smaller; eight times as much, and no less than that, where not."""
    return np.where(better, np.divide(damping, 8), np.maximum(damping, 1e-3) * 8)
