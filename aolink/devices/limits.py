"""The limits of what a mirror is sent."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from aolink.errors import DeviceError
from aolink.rig import Rig

_REMEMBERED_INPUTS = 64
"""Blocks among which the one is found that a later block, sent anew, goes on from."""


class CommandLimits:
    """The limits of a mirror's inputs and of their change from step to step; what is beyond them is not sent."""

    def __init__(self, rig: Rig) -> None:
        self._min, self._max, self._slew = rig.mirror.input_min, rig.mirror.input_max, rig.mirror.slew_max_per_s
        self._most_change = self._slew * rig.timing.fast_step_s * (1 + 1e-9)
        self._sent: deque[tuple[int, NDArray[np.float64]]] = deque(maxlen=_REMEMBERED_INPUTS)
        """First fast steps and inputs of the newest blocks that were sent."""
        self._park = rig.mirror.park

    def check(self, first_step: int, u: NDArray[np.float64]) -> None:
        """Check inputs (n_steps, n_inputs) for the fast steps from ``first_step``, then take them as sent.

        The change to their first step counts from the input that was sent last for a step before it, at first from the
        safe input. Raises DeviceError.
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
            change = np.abs(np.diff(u, axis=0, prepend=self._sent_before(first_step)[None]))
            if (change > self._most_change).any():
                step, channel = np.argwhere(change > self._most_change)[0]
                raise DeviceError(
                    f"input {channel} changes by {change[step, channel]:g} to fast step {first_step + step}, more than"
                    f" mirror.slew_max_per_s = {self._slew:g} allows in a fast step ({self._most_change:g}): it was"
                    " not sent"
                )
        self._sent.append((first_step, u))

    def begin_anew(self) -> None:
        """What was sent is forgotten, and the mirror holds its safe input."""
        self._sent.clear()

    def approach(self, first_step: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inputs (n_steps, n_inputs), or what comes as near to them as the limit of their change allows."""
        if not self._slew:
            return u
        near, before, most = np.array(u), self._sent_before(first_step), self._most_change / (1 + 1e-9)
        for row in near:
            row[:] = before + np.clip(row - before, -most, most)
            before = row
        return near

    def _sent_before(self, step: int) -> NDArray[np.float64]:
        """The input that was sent last for the newest step before this one."""
        best, row = -1, self._park
        for first, u in reversed(self._sent):
            newest = min(step, first + len(u)) - 1
            if newest > best and first <= newest:
                best, row = newest, u[newest - first]
            if best == step - 1:
                break
        return row
