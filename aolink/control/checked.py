"""Controllers, which may be of any package, with the checks that all callers need: what is wrong with one is a single
error that names it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from aolink.control.controller import ControllerRow, Seen
from aolink.errors import AolinkError, ControlError
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

Answer = TypeVar("Answer")


class CheckedController:
    """The `Controller` of a row on a rig.

    Raises `ControlError` where it cannot be made for this rig; `see` and `step` raise it where its own code
    fails, or gives something that is no input of this rig.
    """

    def __init__(self, row: ControllerRow, rig: Rig) -> None:
        self._name, self._shape = row.name, (rig.n_inputs,)
        refused = f"the controller {row.name} cannot work on the rig {rig.name}"
        self._controller = _asked(lambda: row.build(rig), refused)
        self._failed = f"the controller {row.name} failed"

    def see(self, seen: Seen) -> None:
        """Take the next exposure."""
        _asked(lambda: self._controller.see(seen), self._failed)

    def step(self, held: FloatArray) -> FloatArray:
        """The input wanted for the next fast step, (n_inputs,), finite."""
        u = _asked(lambda: np.asarray(self._controller.step(held), dtype=np.float64), self._failed)
        if u.shape != self._shape or not np.isfinite(u).all():
            found = "a number that is not finite" if u.shape == self._shape else f"an array of {u.shape}"
            raise ControlError(f"the controller {self._name} gives {found}, expected {self._shape} finite inputs")
        return u


def refusal(row: ControllerRow, rig: Rig) -> str | None:
    """The reason why a controller cannot work on a rig, by its own row; None where it can. Raises ControlError where
    the row's function fails."""
    return _asked(lambda: row.refusal(rig), f"the controller {row.name} cannot say whether it works on {rig.name}")


def _asked(call: Callable[[], Answer], otherwise: str) -> Answer:
    """The answer of a package's code; an error there is a ControlError that begins with ``otherwise``."""
    try:
        return call()
    except AolinkError:
        raise
    except Exception as error:  # any error of another package
        raise ControlError(f"{otherwise}: {error!r}") from error
