"""Log-likelihoods of many points and their gradients, of whichever pixels were seen: compiled for each kind where it
is called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from aolink.estimation.compiled.line import Line, gradients_of_lines, log_likelihoods_of_lines
from aolink.estimation.compiled.plane import Plane, gradients_of_spots, log_likelihoods_of_spots
from aolink.estimation.compiled.small import compiled
from aolink.numerics.arrays import FloatArray

_OF_KIND = {Line: log_likelihoods_of_lines, Plane: log_likelihoods_of_spots}


def log_likelihoods_of_row(seen: Line | Plane, row: int, t: FloatArray, begin: int, end: int, out: FloatArray) -> None:
    """Log-likelihoods (points,) of the points ``begin`` to ``end`` of t (n, points) in one row."""
    _OF_KIND[type(seen)](seen, row, t, begin, end, out)


@overload(log_likelihoods_of_row, strict=False)  # signatures differ in annotations
def _of_its_kind(seen: Any, row: Any, t: Any, begin: Any, end: Any, out: Any) -> Callable[..., None]:
    own = _OF_KIND[seen.instance_class]

    def log_likelihoods(seen: Line | Plane, row: int, t: FloatArray, begin: int, end: int, out: FloatArray) -> None:
        own(seen, row, t, begin, end, out)

    return log_likelihoods


@compiled
def log_likelihoods(seen: Line | Plane, t: FloatArray, out: FloatArray) -> None:
    """Log-likelihoods (rows, points) of points t (rows, n, points)."""
    for row in range(len(t)):
        log_likelihoods_of_row(seen, row, t[row], 0, t.shape[2], out[row])


_GRADIENTS_OF_KIND = {Line: gradients_of_lines, Plane: gradients_of_spots}


def gradients_of_row(
    seen: Line | Plane, row: int, t: FloatArray, begin: int, end: int, out: FloatArray, gradients: FloatArray
) -> None:
    """As `log_likelihoods_of_row`; their gradients are added to ``gradients``, (n, points)."""
    _GRADIENTS_OF_KIND[type(seen)](seen, row, t, begin, end, out, gradients)


@overload(gradients_of_row, strict=False)  # signatures differ in annotations
def _gradients_of_its_kind(
    seen: Any, row: Any, t: Any, begin: Any, end: Any, out: Any, gradients: Any
) -> Callable[..., None]:
    own = _GRADIENTS_OF_KIND[seen.instance_class]

    def with_gradients(
        seen: Line | Plane, row: int, t: FloatArray, begin: int, end: int, out: FloatArray, gradients: FloatArray
    ) -> None:
        own(seen, row, t, begin, end, out, gradients)

    return with_gradients


@compiled
def log_likelihoods_and_gradients(seen: Line | Plane, t: FloatArray, out: FloatArray, gradients: FloatArray) -> None:
    """As `log_likelihoods`; their gradients by t are added to ``gradients``, (rows, n, points)."""
    for row in range(len(t)):
        gradients_of_row(seen, row, t[row], 0, t.shape[2], out[row], gradients[row])
