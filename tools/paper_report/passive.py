"""The passive output of Mishra & Wen, section V: a combination of both moments that robust feedback can use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.kalman.path_moments import predicted_moments
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics.arrays import FloatArray

_FREQUENCIES = 512
# The part of the weights without effect for a constant input is at most this many times the part with effect.
_MOST_DIFFERENCE = 10.0
_PRICE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class PassiveOutput:
    """y_P = alpha (y_1 - h_1) + beta (y_2 - h_2) about an operating point."""

    weights: FloatArray
    """alpha and beta, (2,); a constant input moves y_P by as much as itself."""
    index: float
    """Smallest real part of the transfer from a held input to y_P over all frequencies, one at none: the output is
    passive where it is not negative; otherwise it lacks this much feedthrough."""
    expected: FloatArray
    """h_1 and h_2 at the operating point, (2,)."""

    def value(self, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """y_P and its standard deviation for moments of orders 1 and 2, both (axes,)."""
        y = (measurement.value - self.expected) @ self.weights
        variance = np.einsum("i,aij,j->a", self.weights, measurement.covariance, self.weights)
        return np.asarray(y), np.sqrt(variance)


def lifted_transfer(
    model: ExposureModel, step: InputResponse, H: FloatArray, feedthrough: FloatArray, z: FloatArray
) -> FloatArray:
    """Transfer from an input held over each exposure to outputs H x + feedthrough u, (len(z), outputs)."""
    pencil = z[:, None, None] * np.eye(len(model.transition)) - model.transition
    return np.linalg.solve(pencil, step.end[0][None, :, None])[..., 0] @ H.T + feedthrough


def passive_output(model: ExposureModel, inputs: FloatArray, state: FloatArray, column: int = 0) -> PassiveOutput:
    """The most passive combination of centroid and second moment about an operating point, of unit gain.

    The lifted plant with one input held over each exposure is linearised there,

        x_(j+1) = A^N x_j + B u_j,    y_p = H_p x_j + D_p u_j,

    and the weights are those whose transfer has the largest smallest real part on the unit circle. The
    input acts within the exposure that sees it, so D_p is not zero; with (12) to (15) as printed it would be,
    and no output of a lifted plant passive. Where both moments carry the same information (a spot that rests off
    centre), there is little to combine.

    Parameters
    ----------
    model:
        Model of a plant with one axis and one output.
    inputs:
        Inputs at the operating point, (n_steps, n_inputs).
    state:
        State at the operating point, (n_states,).
    column:
        Number of the input that is fed back.
    """
    response = model.response(inputs)
    h, H = predicted_moments(model, response, state[None], (1, 2))
    pulse = np.zeros_like(inputs)
    pulse[:, column] = 1.0
    step = model.response(pulse)
    # d/du of mean(theta) and of mean(theta^2) for a held input, theta being the path at the operating point.
    path = model.path(state[None], response.path)[0, 0]
    feedthrough = np.array([step.mean[0, 0], 2 * np.mean(path * step.path[0, 0])])
    z = np.exp(1j * np.linspace(0, np.pi, _FREQUENCIES))
    gain = lifted_transfer(model, step, H[0], feedthrough, z).real
    constant = gain[0] / (gain[0] @ gain[0])
    across = np.array([-constant[1], constant[0]])
    # Largest r with constant + (p - q) across at least r everywhere: a linear program in (p, q, r). The small cost
    # of p and q leaves them at zero where they change nothing.
    program = optimize.linprog(
        [_PRICE, _PRICE, -1.0],
        A_ub=np.column_stack([-gain @ across, gain @ across, np.ones(len(gain))]),
        b_ub=gain @ constant,
        bounds=[(0, _MOST_DIFFERENCE), (0, _MOST_DIFFERENCE), (None, None)],
    )
    plus, minus, index = np.asarray(program.x)
    return PassiveOutput(weights=constant + (plus - minus) * across, index=float(index), expected=h[0])
