"""Processes and plants: their covariances against their own state space, and their steps against the rig's plant."""

import numpy as np
import pytest

from aolink.errors import IdentificationError
from aolink.identification import IdentifiedPlant, Process, ProcessSum, kinds_of
from aolink.plant.lifting import input_response
from aolink.rig import load_rig

STEP = 1e-3
STATIONARY = [
    Process("ornstein-uhlenbeck", (0.03, 2.0)),
    Process("second-order", (0.05, 0.008, 0.3)),
    Process("second-order", (0.02, 0.02, 0.3)),
    Process("resonance", (12.0, 0.005, 0.2)),
]


@pytest.mark.parametrize("process", STATIONARY, ids=lambda each: each.kind)
def test_covariance_is_that_of_the_sampled_system(process):
    space = ProcessSum((process,)).state_space(STEP)
    lags = np.array([0, 1, 7, 40, 200])
    powers = [np.linalg.matrix_power(space.A, k) for k in lags]
    expected = [(space.C @ power @ space.initial_covariance @ space.C.T)[0, 0] for power in powers]
    np.testing.assert_allclose(process.covariance(lags * STEP), expected, rtol=2e-3, atol=1e-6 * process.variance)
    balance = space.A @ space.initial_covariance @ space.A.T + space.B_w @ space.W @ space.B_w.T
    np.testing.assert_allclose(balance, space.initial_covariance, rtol=1e-6, atol=1e-9 * space.initial_covariance.max())


@pytest.mark.parametrize("process", STATIONARY, ids=lambda each: each.kind)
def test_covariances_across_exposures_are_those_of_their_lags(process):
    at, apart, weights = np.array([0.0, 0.004, 0.01]), np.array([0.02, 0.06]), np.array([0.2, 0.5, 0.3])
    expected = process.covariance(apart[:, None, None] + at[:, None] - at)
    np.testing.assert_allclose(process.covariance_across(apart, at), expected, rtol=1e-9, atol=1e-12)
    means = process.covariance_of_means(apart, at, weights)
    np.testing.assert_allclose(means, expected @ weights @ weights, rtol=1e-9, atol=1e-12)


def test_a_walk_takes_steps_of_its_intensity():
    space = ProcessSum((Process("random-walk", (4.0,)),)).state_space(STEP, start_variance=0.5)
    assert space.W[0, 0] == pytest.approx(4.0 * STEP)
    assert space.initial_covariance[0, 0] == 0.5


@pytest.mark.parametrize(("wrong", "says"), [("wobble", "resonance"), ("resonance+", "resonance")])
def test_an_unknown_kind_is_refused(wrong, says):
    with pytest.raises(IdentificationError, match=says):
        kinds_of(wrong)


def test_values_that_are_none_are_refused():
    with pytest.raises(IdentificationError, match="frequency_hz, damping, sd"):
        Process("resonance", (12.0, -0.1, 0.2))


def test_a_plant_of_second_order_answers_as_the_rigs_own():
    plant = load_rig("jitter").plant
    ours = IdentifiedPlant("second-order", (1.0, 12.0, 0.005, 0.2))
    u = np.random.default_rng(1).standard_normal((1, 300))
    expected, _ = input_response(plant, u[:, :, None])
    np.testing.assert_allclose(ours.response(u, STEP)[0, :300], expected[0, 0], atol=1e-3 * np.abs(expected).max())
