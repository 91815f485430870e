"""Root mean square."""

from __future__ import annotations

import math

import numpy as np

from aolink.numerics.arrays import FloatArray


def rms(values: FloatArray) -> float:
    """Root mean square of all values, whatever their shape; NaN where there are none.

    >>> rms(np.array([[3.0, 4.0], [0.0, 0.0]]))
    2.5
    """
    return math.sqrt(np.mean(values**2)) if values.size else math.nan
