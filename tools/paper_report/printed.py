"""A second, small implementation of the paper's o3, independent of aolink's, as printed and as corrected, to measure
the effect of each misprint.

Equations are numbered as in Mishra & Wen. There is no gate: a filter may diverge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aolink.estimation.frames.moments import measure_moments
from aolink.estimation.model.base import ExposureModel
from aolink.estimation.model.exposure_model import exposure_model
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig


@dataclass(frozen=True, kw_only=True)
class Form:
    """The choice of the equations that are used as printed."""

    innovation: bool = False
    """(20): H x instead of h(x) as the predicted moments."""
    no_inputs_inside: bool = False
    """(12) to (15): the path inside the exposure without the inputs."""
    late_inputs: bool = False
    """The predictor's inputs, u(jN - i), one step late."""
    no_delay: bool = False
    """(18) to (20): the exposure's moments as if they were those of the state at its end."""
    little_noise: bool = False
    """(17): B_w W B_w' as the noise of a whole exposure."""


FORMS: dict[str, Form] = {
    "all corrected": Form(),
    "innovation H x̂, (20)": Form(innovation=True),
    "no input inside the exposure, (12)–(15)": Form(no_inputs_inside=True),
    "predictor's inputs one step late": Form(late_inputs=True),
    "delay dropped, (18)–(20)": Form(no_delay=True, no_inputs_inside=True),
    "B_w W B_wᵀ once per exposure, (17)": Form(little_noise=True),
    "all as printed": Form(innovation=True, no_inputs_inside=True, late_inputs=True, no_delay=True, little_noise=True),
}


def _moments(model: ExposureModel, x: FloatArray, c: FloatArray, printed: bool) -> tuple[FloatArray, FloatArray]:
    """Predicted y_1, y_2, (runs, 2), and their Jacobian, (runs, 2, n); ``c`` (n_steps,) is the response of the path to
    the inputs."""
    rows = model.state_rows[0]
    path = x @ rows.T + c
    H = np.stack([np.tile(model.mean_row[0], (len(x), 1)), 2 * path @ rows / len(rows)], axis=1)
    if printed:
        return np.einsum("rmn,rn->rm", H, x), H
    return np.stack([path.mean(axis=1), (path**2).mean(axis=1)], axis=1), H


def end_states(rig: Rig, exposures: Sequence[Exposure], form: Form) -> FloatArray:
    """Estimates of the state at the end of each exposure, (exposures, runs, n_states)."""
    plant, runs = rig.plant, rig.plant.axes
    model = exposure_model(plant, rig.timing.exposure_steps)
    Q = plant.B_w @ plant.process_noise @ plant.B_w.T if form.little_noise else model.process_noise
    x, P = np.tile(plant.initial_mean, (runs, 1)), np.tile(plant.initial_covariance, (runs, 1, 1))
    ends = []
    for j, exposure in enumerate(exposures):
        c, d = _input_response(model, exposures, j, form)
        measured = measure_moments(rig.sensor.profile, exposure.pixels, (1, 2))
        assert not isinstance(measured, str)
        if form.no_delay:
            x, P = _predict(x, P, model.transition, Q, d)
        h, H = _moments(model, x, c, form.innovation)
        PH = P @ H.swapaxes(1, 2)
        K = PH @ np.linalg.inv(H @ PH + measured.covariance)
        x = x + np.einsum("rnm,rm->rn", K, measured.value - h)
        P = P - K @ H @ P
        if not form.no_delay:
            x, P = _predict(x, P, model.transition, Q, d)
        ends.append(x)
    return np.array(ends)


def _predict(
    x: FloatArray, P: FloatArray, A: FloatArray, Q: FloatArray, d: FloatArray
) -> tuple[FloatArray, FloatArray]:
    return x @ A.T + d, A @ P @ A.T + Q


def _input_response(
    model: ExposureModel, exposures: Sequence[Exposure], j: int, form: Form
) -> tuple[FloatArray, FloatArray]:
    """Path (n_steps,) and end state (n_states,) of the inputs of exposure j; they are the same for all runs."""
    inputs = exposures[j].inputs
    response = model.response(inputs)
    c, d = response.path[0, 0], response.end[0]
    if form.no_inputs_inside:
        c = np.zeros_like(c)
    if form.late_inputs:
        following = exposures[j + 1].inputs[:1] if j + 1 < len(exposures) else inputs[-1:]
        d = model.response(np.concatenate([inputs[1:], following])).end[0]
    return c, d


def output_errors(rig: Rig, exposures: Sequence[Exposure], form: Form, skip: int) -> FloatArray:
    """Squared errors of theta at the end of each exposure, (runs, exposures)."""
    found = end_states(rig, exposures, form)
    truth = np.array([e.truth.end_state for e in exposures if e.truth is not None])
    return np.asarray((((found - truth) @ rig.plant.C[0]) ** 2)[skip:].T)
