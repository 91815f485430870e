"""A controller of another package: two integrators in a row, for disturbances that one alone follows too late."""

import numpy as np

from aolink.control import ControllerRow, MirrorModes, response_at_rest

SHARE = 0.15  # of the gain, for the second integrator
FORGETS = 0.98  # of itself that the second one keeps: it must not wind up while the spot is lost


class DoubleIntegrator:
    """u = u_held - c - d with c = gain R y, and d the sum of SHARE c over the exposures so far."""

    def __init__(self, rig):
        self._gain, self._axes = rig.control.gain, rig.plant.axes
        response = response_at_rest(rig.plant, rig.timing.exposure_steps)
        self._reconstructor = MirrorModes.of(response).reconstructor(rig.control.least_singular_value)
        self._sum, self._u = np.zeros(rig.n_inputs), rig.mirror.park

    def see(self, seen):
        slopes = np.nan_to_num(seen.slopes).reshape(self._axes, -1)
        correction = self._gain * (slopes @ self._reconstructor.T).ravel()
        self._sum = FORGETS * self._sum + SHARE * correction
        self._u = seen.pending[-1] - correction - self._sum

    def step(self, held):
        return self._u


def refusal(rig):
    slow = f"double follows drifts over many exposures: control.gain = {rig.control.gain:g} is too much for it, use 0.5"
    return slow if rig.control.gain > 0.6 else None


ROW = ControllerRow(
    name="double", summary="two integrators in a row", build=DoubleIntegrator, needs_state=False, refusal=refusal
)
