"""Linear-quadratic control at the fast rate, from the state that an estimator finds in the blurred frames."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from aolink.control.controller import Seen
from aolink.control.modes import MirrorModes, reached, response_at_rest
from aolink.errors import ControlError
from aolink.numerics.arrays import FloatArray
from aolink.rig import Plant, Rig

_DOUBLINGS = 60
_SMALL = 1e-14
_SETTLES = 1e-9


class LQG:
    """The controller u(k) = -K x(k): x is the estimate at the end of the exposure, predicted over the delay and on,
    step by step.

    The state has mirror and disturbance (`[[disturbance.model]]`, drifts), so -K x is the input that cancels the
    prediction of both. Between exposures the prediction runs on with the inputs that the mirror really holds, so it
    does not wind up at the limits; until a late estimate comes, the loop runs on its prediction.
    """

    def __init__(self, rig: Rig) -> None:
        plant = rig.plant
        self._A, self._B = plant.A.T.copy(), plant.B.T.copy()
        self._K = lqr_gain(plant, rig.control.effort, rig.timing.exposure_steps).T.copy()
        self._x = np.tile(plant.initial_mean, (plant.axes, 1))

    def see(self, seen: Seen) -> None:
        assert seen.state is not None
        self._x = seen.state
        for u in seen.pending[:-1]:
            self._predict(u)

    def step(self, held: FloatArray) -> FloatArray:
        self._predict(held)
        return -(self._x @ self._K).ravel()

    def _predict(self, u: FloatArray) -> None:
        self._x = self._x @ self._A + u.reshape(len(self._x), -1) @ self._B


def lqr_gain(plant: Plant, effort: float, n_steps: int) -> FloatArray:
    """K of u = -K x for one copy of a plant, (n_inputs, n_states).

    It minimises the mean over fast steps of |C x|^2 + rho |u|^2, with rho = ``effort`` times the mean square gain of
    the `MirrorModes`. With x_1 the states that the inputs reach and x_2 the others, A = [A_1 A_12; 0 A_2] and
    C = [C_1 C_2]: P solves the Riccati equation of (A_1, B_1, C_1' C_1, rho), and S, which weighs x_1 against x_2,

        S = C_1' C_2 + (A_1 - B_1 K_1)' (P A_12 + S A_2),

    a sum that converges even where x_2 never dies out, such as a random walk. Then
    K = (rho I + B_1' P B_1)^-1 B_1' [P A_1,  P A_12 + S A_2].

    Raises `ControlError` where the Riccati equation has no stabilising solution.
    """
    one, two = reached(plant)
    A1, A12, A2 = (plant.A[np.ix_(*pair)] for pair in ((one, one), (one, two), (two, two)))
    B, C1, C2 = plant.B[one], plant.C[:, one], plant.C[:, two]
    gains = MirrorModes.of(response_at_rest(plant, n_steps)).gains
    R = effort * float(np.mean(gains**2)) * np.eye(plant.n_inputs)
    try:
        P = linalg.solve_discrete_are(A1, B, C1.T @ C1, R)
        weight = linalg.cho_factor(R + B.T @ P @ B)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ControlError(f"lqg has no gain for this plant: {error}") from None
    K1 = linalg.cho_solve(weight, B.T @ P @ A1)
    closed = (A1 - B @ K1).T
    if float(np.abs(np.linalg.eigvals(closed)).max(initial=0.0)) > 1 - _SETTLES:
        raise ControlError(
            "lqg has no gain for this plant: the slopes must show every state that its inputs move and that does not"
            " die out"
        )
    S, left, right = C1.T @ C2 + closed @ P @ A12, closed, A2
    for _ in range(_DOUBLINGS):
        more = left @ S @ right
        S = S + more
        if not more.size or np.abs(more).max() <= _SMALL * np.abs(S).max():
            break
        left, right = left @ left, right @ right
    K = np.zeros((plant.n_inputs, plant.n_states))
    K[:, one], K[:, two] = K1, linalg.cho_solve(weight, B.T @ (P @ A12 + S @ A2))
    return K
