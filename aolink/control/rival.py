"""A controller that does not act, computed beside the one that does: what it would have left of the slopes.

The inputs of the mirror are known, and so is the effect of other inputs in their place: the slopes would have differed
by the response of the plant's mirror to the difference of the two inputs. This needs no model of the disturbance.
"""

from __future__ import annotations

import math

import numpy as np

from aolink.control.controller import ControllerRow, Seen
from aolink.control.modes import reached
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig


class Rival:
    """A controller on centroids that does not act, computed beside the one that does.

    It begins from an input that the mirror holds, (n_inputs,), and the centroids of an exposure, (n_outputs,).
    """

    def __init__(self, rig: Rig, row: ControllerRow, delay_steps: int, held: FloatArray, slopes: FloatArray) -> None:
        self._rig, self._controller = rig, row.build(rig)
        self._most_change = rig.mirror.slew_max_per_s * rig.timing.fast_step_s or math.inf
        states, _ = reached(rig.plant)
        self._A, self._B = rig.plant.A[np.ix_(states, states)].T.copy(), rig.plant.B[states].T.copy()
        self._C = rig.plant.C[:, states].T.copy()
        self._state = np.zeros((rig.plant.axes, len(states)))
        """The states that inputs reach with the rival's inputs less the real ones."""
        self._sent, self._ahead = held, np.tile(held, (delay_steps, 1))
        """The input sent last, and those from the exposure's end on until the answer to it takes effect."""
        self._controller.see(Seen(slopes=slopes, state=None, pending=self._ahead))

    def see(self, held: FloatArray, slopes: FloatArray) -> FloatArray:
        """Take the next exposure: inputs that the mirror held since the end of the one before, (k, n_inputs), and
        centroids. Gives the difference that the rival's inputs would have made to the slopes at each of the exposure's
        fast steps, (n_outputs, N)."""
        mirror, k = self._rig.mirror, len(held)
        wanted = np.clip(self._controller.step(self._sent), mirror.input_min, mirror.input_max)
        most = self._most_change * np.arange(1, k + 1)[:, None]
        rows = self._sent + np.clip(wanted - self._sent, -most, most)
        inputs, self._sent = np.concatenate([self._ahead, mirror.quantise(rows)]), rows[-1]
        self._ahead = inputs[k:]
        path = np.empty((k, *self._state.shape))
        for step, push in enumerate((inputs[:k] - held).reshape(k, len(self._state), -1) @ self._B):
            path[step] = self._state
            self._state = self._state @ self._A + push
        moved = (path[-self._rig.timing.exposure_steps :] @ self._C).reshape(-1, len(slopes)).T
        self._controller.see(Seen(slopes=slopes + moved.mean(axis=1), state=None, pending=self._ahead))
        return moved
