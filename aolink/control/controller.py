"""The interface of a controller: it sees each exposure, and gives the inputs of the mirror step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """The data about an exposure that a controller gets."""

    slopes: FloatArray
    """Centroids of the frame: the mean of each slope over the exposure, slope units, (n_outputs,). NaN where a spot was
    not seen."""
    state: FloatArray | None
    """The estimator's state of the plant one fast step after the exposure's last, which is the end of the exposure,
    (axes, n_states). None where no estimator serves the controller."""
    pending: FloatArray
    """Inputs that the mirror holds in the fast steps from the end of the exposure to the one before the controller's
    next, (k, n_inputs) with k at least 1; k is the delay. These inputs can no longer be changed."""


class Controller(Protocol):
    """A control law, without limits, time or files: the loop that runs it has those."""

    def see(self, seen: Seen) -> None:
        """Take the next exposure. The inputs that `step` gives from now on follow the steps of ``seen.pending``."""

    def step(self, held: FloatArray) -> FloatArray:
        """The input wanted for the next fast step, (n_inputs,).

        ``held`` is the input that the mirror holds in the step before it, (n_inputs,): the wanted input after limits,
        slew limit and converter.
        """


@dataclass(frozen=True, kw_only=True)
class ControllerRow:
    """All that aolink needs to know about a controller."""

    name: str
    summary: str
    build: Callable[[Rig], Controller]
    """A function that makes the controller for a rig, whose table ``[control]`` has its parameters."""
    needs_state: bool = True
    """Whether it needs an estimator's state, or the centroids alone."""
    refusal: Callable[[Rig], str | None] = lambda rig: None
    """A function that gives the reason why it cannot work on a rig, and what to do; None where it can."""
    believes_a_model: bool = False
    """Whether it relies on the rig file's model of the disturbance: another controller then takes over where that model
    is wrong (``control.fall_back``)."""
