"""Log-likelihoods, gradients and Fisher information of whichever pixels were seen: compiled for each kind where it is
called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from aolink.estimation.compiled.line import (
    Line,
    gradients_of_lines,
    information_of_line,
    log_likelihoods_of_lines,
)
from aolink.estimation.compiled.plane import (
    Plane,
    gradients_of_spots,
    information_of_spots,
    log_likelihoods_of_spots,
)
from aolink.estimation.compiled.small import compiled
from aolink.numerics.arrays import FloatArray


def _of_its_kind(of_line: Any, of_spots: Any) -> Any:
    """The function of a `Line`, or that of a `Plane`, by what its first argument is."""
    by_kind = {Line: of_line, Plane: of_spots}

    def function(seen: Line | Plane, *arguments: Any) -> Any:
        return by_kind[type(seen)](seen, *arguments)

    @overload(function, strict=False)  # signatures differ in annotations
    def _(seen: Any, *arguments: Any) -> Callable[..., Any]:
        own = by_kind[seen.instance_class]
        return lambda seen, *arguments: own(seen, *arguments)

    return function


log_likelihoods_of_row = _of_its_kind(log_likelihoods_of_lines, log_likelihoods_of_spots)
gradients_of_row = _of_its_kind(gradients_of_lines, gradients_of_spots)
information_of_row = _of_its_kind(information_of_line, information_of_spots)


@compiled
def log_likelihoods_and_gradients(seen: Line | Plane, t: FloatArray, out: FloatArray, gradients: FloatArray) -> None:
    """Log-likelihoods (rows, points) of points t (rows, n, points); their gradients by t are added to ``gradients``,
    (rows, n, points)."""
    for row in range(len(t)):
        gradients_of_row(seen, row, t[row], 0, t.shape[2], out[row], gradients[row])
