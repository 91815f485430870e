"""Pictures turned so that a straight motion runs along their rows, and back."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import ndimage

from aolink.numerics.arrays import BoolArray, FloatArray


def to_lines(
    planes: FloatArray, good: BoolArray | None, angle_rad: float
) -> tuple[FloatArray, BoolArray, Callable[[FloatArray], FloatArray]]:
    """Turn pictures so that rows run along ``angle_rad``, by cubic splines.

    Parameters
    ----------
    planes:
        Pictures with a likely value in each pixel that was not measured, (batch, rows, columns).
    good:
        True where a pixel was measured, (rows, columns).
    angle_rad:
        Angle from growing columns towards growing rows.

    Returns
    -------
    The turned pictures, in a frame that holds all of them; the mask of the measured pixels; and a function that turns
    back.
    """
    rows, columns = planes.shape[1:]
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    # (row, column) in the picture from (row, column) in the turned one, about the centres.
    turn = np.array([[c, s], [-s, c]])
    size = np.ceil(np.abs(turn) @ (rows - 1, columns - 1)).astype(int) + 1
    shape = (int(size[0]), int(size[1]))
    here, there = (np.array([rows, columns]) - 1) / 2, (np.array(shape) - 1) / 2
    offset = here - turn @ there
    turned = np.stack([ndimage.affine_transform(p, turn, offset, shape, order=3, mode="nearest") for p in planes])
    weight = np.ones((rows, columns)) if good is None else good.astype(np.float64)
    seen = ndimage.affine_transform(weight, turn, offset, shape, order=1, mode="constant") > 0.999

    def back(scene: FloatArray) -> FloatArray:
        return np.stack([
            ndimage.affine_transform(p, turn.T, there - turn.T @ here, (rows, columns), order=3, mode="nearest")
            for p in scene
        ])  # fmt: skip

    return turned, seen, back
