"""The prediction of a Kalman filter: x -> A x + d, P -> A P A' + Q, in the form that suits its size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from aolink.estimation.kalman.gaussian import Gaussian
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.numerics.single_thread import congruence_one_thread
from aolink.plant.alike import MANY_STATES

Predict = Callable[[Gaussian, FloatArray, FloatArray, FloatArray], Gaussian]


def predict(state: Gaussian, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> Gaussian:
    """x -> A x + d, P -> A P A' + Q: Mishra & Wen (16) and (17), with the inputs.

    A (``transition``) and Q (``noise``) are (n_states, n_states); d (``kick``), the state's response to the inputs, is
    (axes, n_states).
    """
    mean = predicted_mean(state.mean, transition, kick)
    if max(transition.shape) > MANY_STATES:
        each = [congruence_one_thread(transition, P) for P in state.covariance]
        return Gaussian(mean, batched.symmetric(np.stack(each) + noise))
    return Gaussian(mean, batched.symmetric(batched.congruence(transition, state.covariance) + noise))


def predicted_mean(mean: FloatArray, transition: FloatArray, kick: FloatArray) -> FloatArray:
    """x -> A x + d"""
    return batched.matvec(transition, mean) + kick
