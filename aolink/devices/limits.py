"""The limits of the inputs that a mirror is sent."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from aolink.errors import DeviceError
from aolink.rig import Rig

_ROUNDING = 1e-9
_REMEMBERED_INPUTS = 64
"""Number of blocks that are remembered, so that a later block, sent anew, can continue from one of them."""


class CommandLimits:
    """The limits of a mirror's inputs and of their change from step to step; inputs beyond them are not sent.

    The change is measured from the input that the mirror holds in the step before, as far as that is known here: the
    input that it was sent for that step, or its safe input where it was sent none or was parked since.
    """

    def __init__(self, rig: Rig) -> None:
        self._min, self._max, self._slew = rig.mirror.input_min, rig.mirror.input_max, rig.mirror.slew_max_per_s
        self._most_change = self._slew * rig.timing.fast_step_s * (1 + _ROUNDING)
        self._sent: deque[tuple[int, NDArray[np.float64]]] = deque(maxlen=_REMEMBERED_INPUTS)
        """First fast steps and inputs of the newest blocks that were sent."""
        self._park = rig.mirror.park
        self._joined = -math.inf
        """The first fast step in which the mirror holds the wanted input again, after steps were left out or it was
        parked."""

    def check(self, first_step: int, u: NDArray[np.float64]) -> None:
        """Check inputs (n_steps, n_inputs) for the fast steps from ``first_step``, then take them as sent.

        Raises DeviceError for inputs beyond the limits.
        """
        if u.ndim != 2 or u.shape[1] != len(self._min):
            raise DeviceError(
                f"a command of shape {u.shape} for a mirror of {len(self._min)} inputs: give (steps, inputs)"
            )
        inside = (u >= self._min) & (u <= self._max)
        if not inside.all():  # NaN fails as well
            step, channel = np.argwhere(~inside)[0]
            raise DeviceError(
                f"input {channel} at fast step {first_step + step} is {u[step, channel]:g}, beyond the mirror's limits"
                f" {self._min[channel]:g} .. {self._max[channel]:g}: it was not sent"
            )
        if self._slew:
            change = np.abs(np.diff(u, axis=0, prepend=self.held(first_step - 1)[None]))
            if (change > self._most_change).any():
                step, channel = np.argwhere(change > self._most_change)[0]
                raise DeviceError(
                    f"input {channel} changes by {change[step, channel]:g} to fast step {first_step + step}, more than"
                    f" mirror.slew_max_per_s = {self._slew:g} allows in a fast step ({self._most_change:g}): it was"
                    " not sent"
                )
        self._sent.append((first_step, u))

    def take(self, first_step: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Check inputs and take them as sent, as `check` does; gives the inputs to send.

        These are ``u``; or, after `parked` and `go_on_from`, inputs as near to ``u`` as the limit of the change allows.
        """
        wanted = u
        if self._slew and first_step <= self._joined:
            u = self._approached(first_step, wanted)
            on_the_way = np.flatnonzero((u != wanted).any(axis=1))
            last = on_the_way[-1] + 1 if len(on_the_way) else 0
            self._joined = first_step + last if last < len(u) else math.inf
        self.check(first_step, u)
        return u

    def parked(self) -> None:
        """Forget the inputs that were sent: the mirror holds its safe input, and goes from there to the next input."""
        self._sent.clear()
        self._joined = math.inf

    def go_on_from(self, first_step: int, step: int) -> NDArray[np.float64]:
        """Steps from ``first_step`` to the one before ``step`` are left out: nothing more is sent for them.

        The mirror goes from the input that it holds by then to the next input. Gives the inputs that it holds in the
        steps that are left out, (step - first_step, n_inputs).
        """
        self._joined = max(self._joined, step)
        return np.array([self.held(each) for each in range(first_step, step)]).reshape(-1, len(self._park))

    def held(self, step: int) -> NDArray[np.float64]:
        """The input that the mirror holds in a fast step by the commands that it was sent, (n_inputs,)."""
        for first, u in reversed(self._sent):
            if first <= step < first + len(u):
                return np.asarray(u[step - first])
        return self._park

    def _approached(self, first_step: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
        near, before, most = np.array(u), self.held(first_step - 1), self._most_change / (1 + _ROUNDING)
        for row in near:
            row[:] = before + np.clip(row - before, -most, most)
            before = row
        return near
