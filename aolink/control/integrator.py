"""The integrator on centroids, the controller of most loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aolink.control.controller import ControllerRow, Seen
from aolink.control.modes import MirrorModes, response_at_rest
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig


class Integrator:
    """The controller u = u_0 + (1 - leak) (u_held - u_0) - gain R y, once an exposure. y are the centroids, R the
    pseudo-inverse of the plant's response at rest (modal: weak mirror modes are left out), u_0 the safe input.

    It starts from the input that the mirror really holds, so that it does not wind up at the limits.
    """

    def __init__(self, rig: Rig) -> None:
        self._gain, self._leak, self._rest = rig.control.gain, rig.control.leak, rig.mirror.park
        self._axes = rig.plant.axes
        modes = MirrorModes.of(response_at_rest(rig.plant, rig.timing.exposure_steps))
        self._reconstructor = modes.reconstructor(rig.control.least_singular_value)
        self._u = rig.mirror.park

    def see(self, seen: Seen) -> None:
        slopes = np.nan_to_num(seen.slopes).reshape(self._axes, -1)
        correction = (slopes @ self._reconstructor.T).ravel()
        self._u = self._rest + (1 - self._leak) * (seen.pending[-1] - self._rest) - self._gain * correction

    def step(self, held: FloatArray) -> FloatArray:
        return self._u


INTEGRATOR = ControllerRow(
    name="integrator", summary="leaky integrator on the centroids, modal", build=Integrator, needs_state=False
)
STILL = ControllerRow(
    name="still", summary="holds the safe input", needs_state=False,
    build=lambda rig: Integrator(replace(rig, control=replace(rig.control, gain=0.0, leak=1.0))),
)  # fmt: skip
