"""The fixed-interval smoother against one dense least-squares solve, and against the truth."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy import linalg

import aolink
from aolink.errors import EstimatorError
from aolink.estimation import (
    BlurFilter,
    Estimator,
    Measurement,
    PathMoments,
    Status,
    exposure_model,
    run,
    score,
    smooth,
)
from aolink.estimation.frames.moments import measure_moments, noise_integrals
from aolink.optics.camera import effective_noise_density
from aolink.plant.lifting import input_response, lift
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.kinds import must_be, truth_of

RIG = load_rig("section-vi-lively")


def batch(rig, exposures):
    """Start states of all exposures by one least-squares solve, and their covariances: o1's model, whole."""
    plant, sensor = rig.plant, rig.sensor
    n, count = plant.n_states, len(exposures)
    R = effective_noise_density(sensor) * noise_integrals(sensor, 2)[2]
    rows, values = [], []

    def add(blocks, value, root):
        row = np.zeros((len(value), n * count))
        for k, block in blocks:
            row[:, n * k : n * k + n] = block
        rows.append(linalg.solve_triangular(root, row, lower=True))
        values.append(linalg.solve_triangular(root, value, lower=True))

    add([(0, np.eye(n))], plant.initial_mean, np.linalg.cholesky(plant.initial_covariance))
    for k, e in enumerate(exposures):
        model = exposure_model(plant, e.n_steps)
        measured = must_be(Measurement, measure_moments(sensor, e.pixels, (1,)))
        y = measured.value[0] - model.response(e.inputs).mean[0]
        add([(k, model.mean_row)], y, np.array([[np.sqrt(R)]]))
        if k + 1 < count:
            u = np.concatenate([e.inputs, exposures[k + 1].lead_inputs])
            transition, noise = lift(plant, len(u))
            _, kick = input_response(plant, u[None])
            add([(k, -transition), (k + 1, np.eye(n))], kick[0], np.linalg.cholesky(noise))
    J = np.concatenate(rows)
    P = np.linalg.inv(J.T @ J)
    x = np.linalg.lstsq(J, np.concatenate(values), rcond=None)[0]
    return x.reshape(count, n), np.stack([P[n * k : n * k + n, n * k : n * k + n] for k in range(count)])


@pytest.mark.parametrize("period", [200, 260])
def test_it_is_one_least_squares_solve_where_all_is_linear(period):
    rig = dataclasses.replace(RIG, timing=dataclasses.replace(RIG.timing, frame_period_steps=period))
    exposures = simulate(rig, 12, seed=5)
    o1 = Estimator(rig, "o1", BlurFilter(rig.plant, PathMoments(rig.plant, (1,)), gate=False))
    smoothed = smooth(rig.plant, exposures, [o1.step(e) for e in exposures])
    mean, covariance = batch(rig, exposures)
    np.testing.assert_allclose([e.start_state[0] for e in smoothed], mean, atol=1e-8)
    np.testing.assert_allclose([e.start_covariance[0] for e in smoothed], covariance, rtol=1e-6, atol=1e-12)
    if period == 200:
        for before, after in itertools.pairwise(smoothed):
            np.testing.assert_allclose(before.end_state, after.start_state, atol=1e-10)


@pytest.mark.slow
def test_the_last_estimate_is_the_filters_and_the_others_know_more():
    exposures = simulate(RIG, 60, seed=6)
    for name, estimates in run(RIG, exposures, ["open-loop", "o1", "moments", "profile"]).items():
        smoothed = smooth(RIG.plant, exposures, estimates)
        assert smoothed[-1] is estimates[-1]
        before, after = score(exposures, estimates, 5), score(exposures, smoothed, 5)
        if name == "open-loop":
            np.testing.assert_allclose(smoothed[3].path, estimates[3].path, atol=1e-8)
            continue
        assert after.path_rmse < (0.95 if name == "o1" else 1.0) * before.path_rmse
        for estimate in smoothed:
            assert np.linalg.eigvalsh(estimate.coefficient_covariance[0]).min() >= -1e-12
            np.testing.assert_allclose(estimate.coefficients[:, :2], estimate.start_state)


def test_a_lag_is_so_many_later_exposures():
    exposures = simulate(RIG, 6, seed=6)
    estimates = run(RIG, exposures, ["moments"])["moments"]
    assert smooth(RIG.plant, exposures, estimates, lag=0) == estimates
    for k, each in enumerate(smooth(RIG.plant, exposures, estimates, lag=2)[:-2]):
        own = smooth(RIG.plant, exposures[k : k + 3], estimates[k : k + 3])[0]
        assert each.path.tobytes() == own.path.tobytes()
    long, whole = (smooth(RIG.plant, exposures, estimates, lag) for lag in (100, None))
    assert [e.path.tobytes() for e in long] == [e.path.tobytes() for e in whole]
    with pytest.raises(EstimatorError, match="lag"):
        smooth(RIG.plant, exposures, estimates, lag=-1)


def test_a_frame_that_is_lost_is_found_by_those_after_it():
    exposures = list(simulate(RIG, 12, seed=4))
    exposures[5] = dark = dataclasses.replace(exposures[5], mask=np.zeros_like(exposures[5].mask))
    estimates = run(RIG, exposures, ["profile"])["profile"]
    assert estimates[5].status == Status.INPUT_INVALID
    smoothed = smooth(RIG.plant, exposures, estimates)
    assert smoothed[5].path_sd.max() < 0.6 * estimates[5].path_sd.max()
    assert np.mean(np.abs(smoothed[5].path - truth_of(dark).path) < 3 * smoothed[5].path_sd) > 0.9


def test_several_axes_are_smoothed_side_by_side():
    rig = load_rig("single-lenslet")
    exposures = simulate(rig, 8, seed=2)
    estimates = run(rig, exposures, ["profile"])["profile"]
    smoothed = smooth(rig.plant, exposures, estimates)
    before, after = (score(exposures, each, 0).path_rmse for each in (estimates, smoothed))
    assert after < before


def test_in_python_it_is_one_call():
    exposures = aolink.simulate("section-vi-lively", 5)
    series = aolink.estimate(exposures, "moments")
    again = aolink.smooth(series).estimates()
    assert [e.frame_id for e in again] == [e.frame_id for e in exposures]
    assert again[0].path.tobytes() != series.estimates()[0].path.tobytes()
    with pytest.raises(EstimatorError, match=r"aolink\.smooth\(series, lag=3\)"):
        aolink.smooth(exposures, series.estimates())  # type: ignore[arg-type]


def test_estimates_of_other_exposures_are_refused():
    exposures = simulate(RIG, 4)
    estimates = run(RIG, exposures, ["o1"])["o1"]
    for some in (estimates[1:], estimates[::-1]):
        with pytest.raises(EstimatorError, match="one for each"):
            smooth(RIG.plant, exposures, some)
