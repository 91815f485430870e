"""Controllers to compare with ours: the predictors of pyRTC, and one that is given the disturbance's true state."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from pyrtc.predictive import ModalPredictor, make_predictor
from scipy import linalg

from aolink.control import ControllerRow, Seen
from aolink.control.lqg import LQG
from aolink.control.modes import reached, response_at_rest
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig
from bench_rows.disturbances import DisturbanceRun

PREDICTORS = ("ar_kalman", "least_squares")


class _MirrorFollowed:
    """Computes the mirror's motion by its model and the inputs that it held, all of which it gets."""

    def __init__(self, rig: Rig) -> None:
        moved, _ = reached(rig.plant)
        self._A, self._B, self._C = rig.plant.A[np.ix_(moved, moved)], rig.plant.B[moved], rig.plant.C[:, moved]
        self._mirror = np.zeros(len(moved))
        self._steps = rig.timing.exposure_steps
        self._held = [rig.mirror.park] * (self._steps + 1)
        """Inputs from the step before the newest exposure on."""

    def exposed(self, seen: Seen) -> FloatArray:
        """The mirror's mean share of the slopes in the exposure that is seen, (n_outputs,); it then is at its end."""
        total = np.zeros(len(self._C))
        for u in self._held[1 : self._steps + 1]:
            total += self._C @ self._mirror
            self._mirror = self._A @ self._mirror + self._B @ u
        self._held = [self._held[self._steps], *seen.pending[:-1]]
        return total / self._steps

    def follow(self, held: FloatArray) -> None:
        """The input of one more step."""
        self._held.append(held)


class Predicted(_MirrorFollowed):
    """A predictor of pyRTC on the pseudo-open-loop centroids: the mirror cancels its prediction for a frame."""

    def __init__(self, rig: Rig, predictor: ModalPredictor) -> None:
        super().__init__(rig)
        self.predictor = copy.deepcopy(predictor)
        self._from_slopes = np.linalg.inv(response_at_rest(rig.plant, self._steps))
        self._u = rig.mirror.park

    def see(self, seen: Seen) -> None:
        self.predictor.update(seen.slopes - self.exposed(seen))
        self._u = -self._from_slopes @ self.predictor.predict()

    def step(self, held: FloatArray) -> FloatArray:
        self.follow(held)
        return self._u


class TrueState(_MirrorFollowed):
    """`lqg` with the disturbance's true state at the end of each exposure in the place of an estimate."""

    def __init__(self, rig: Rig, known: DisturbanceRun) -> None:
        super().__init__(rig)
        n = len(known.A)
        plant = replace(
            rig.plant, A=linalg.block_diag(self._A, known.A), B=np.vstack([self._B, np.zeros((n, 1))]),
            C=np.hstack([self._C, known.C]), initial_mean=np.zeros(len(self._A) + n),
        )  # fmt: skip
        self._lqg, self._states, self._end = LQG(replace(rig, plant=plant)), known.states, 0

    def see(self, seen: Seen) -> None:
        self.exposed(seen)
        self._end += self._steps
        state = np.concatenate([self._mirror, self._states[self._end]])
        self._lqg.see(replace(seen, state=state[None]))

    def step(self, held: FloatArray) -> FloatArray:
        self.follow(held)
        return self._lqg.step(held)


def predicted(name: str, centroids: FloatArray) -> ControllerRow:
    """A predictor of pyRTC fitted to the centroids of past exposures with the mirror at rest, (exposures, 1).

    The correction acts from the next exposure on: one frame ahead. Everything else is as in pyRTC.
    """
    predictor = make_predictor({"type": name, "horizon": 1}, centroids.shape[1]).fit(centroids)
    for each in centroids:
        predictor.update(each)
    return ControllerRow(
        name=name, summary="pyRTC", build=lambda rig: Predicted(rig, predictor), needs_state=False
    )  # fmt: skip


def with_true_state(known: DisturbanceRun) -> ControllerRow:
    """The row of the controller for a loop whose first fast step has the first row of ``known``."""
    return ControllerRow(
        name="true-state", summary="the limit", build=lambda rig: TrueState(rig, known), needs_state=False
    )  # fmt: skip
