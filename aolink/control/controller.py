"""What a controller is: it is shown each exposure, and gives the inputs of the mirror step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What a controller is shown of an exposure."""

    slopes: FloatArray
    """Centroids of the frame: the mean of each slope over the exposure, slope units, (n_outputs,). NaN where a spot was
    not seen."""
    state: FloatArray | None
    """State of the plant one fast step after the exposure's last, as the estimator has it, (axes, n_states): the end of
    the exposure. None where no estimator serves the controller."""
    pending: FloatArray
    """Inputs that the mirror holds in the fast steps from the end of the exposure to the one before the controller's
    next, (k, n_inputs) with k at least 1: the delay. They can be changed no more."""


class Controller(Protocol):
    """A law of control, without limits, time or files: those are of the loop that runs it."""

    def see(self, seen: Seen) -> None:
        """Take the next exposure. What `step` gives from now on follows the steps of ``seen.pending``."""

    def step(self, held: FloatArray) -> FloatArray:
        """The input wanted for the next fast step, (n_inputs,).

        ``held`` is the input that the mirror holds in the step before it, (n_inputs,): what was wanted, as limits, slew
        and converter have changed it.
        """


@dataclass(frozen=True, kw_only=True)
class ControllerRow:
    """All that aolink knows of a controller."""

    name: str
    summary: str
    build: Callable[[Rig], Controller]
    """Makes the controller for a rig, whose table ``[control]`` has its numbers."""
    needs_state: bool = True
    """Whether it needs an estimator's state, or the centroids alone."""
    refusal: Callable[[Rig], str | None] = lambda rig: None
    """Why it cannot work on a rig, and what to do; None where it can."""
    believes_a_model: bool = False
    """Whether it is as good as the rig file's model of the disturbance: it is then left where that does not pay
    (``control.fall_back``)."""
