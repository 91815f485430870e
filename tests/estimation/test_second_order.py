"""o3 as a second-order extended Kalman filter: right about itself where the spot swings by several widths."""

import numpy as np
import pytest

from aolink.errors import EstimatorError
from aolink.estimation import make_estimator
from aolink.estimation.estimate import Status
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.vibrating import vibrating
from tests.kinds import truth_of


def judged(rig, sessions, **options):
    """RMS error of the path, share inside 95 % intervals, and NEES over the number of states, first four left out."""
    found = []
    for exposures in sessions:
        estimator = make_estimator(rig, "o3", **options)
        for k, exposure in enumerate(exposures):
            estimate, truth = estimator.step(exposure), truth_of(exposure)
            assert estimate.status == Status.OK
            error, away = estimate.path - truth.path, (estimate.end_state - truth.end_state)[0]
            nees = away @ np.linalg.solve(estimate.end_covariance[0], away) / len(away)
            if k > 3:
                found.append((np.mean(error**2), np.mean(np.abs(error) < 1.96 * estimate.path_sd), nees))
    squared, inside, nees = np.mean(found, axis=0)
    return np.sqrt(squared), inside, nees


def test_it_is_right_about_its_error_where_the_first_order_is_too_sure():
    rig = vibrating(1, sd=0.1, noise_density=2e-4)
    u = np.zeros((20 * rig.timing.frame_period_steps, 1))
    sessions = [list(simulate(rig, 20, seed=seed, inputs=u)) for seed in range(8)]
    first, second = judged(rig, sessions), judged(rig, sessions, second_order=True)
    assert first[2] > 2.0
    assert second[2] < 1.5
    assert second[1] > first[1] + 0.08
    assert second[0] < 0.9 * first[0]


def test_where_the_prior_is_narrow_it_is_the_first_order():
    rig = load_rig("section-vi")
    exposures = list(simulate(rig, 6, seed=1))
    first, second = (make_estimator(rig, "o3", second_order=each) for each in (False, True))
    for exposure in exposures:
        one, other = first.step(exposure), second.step(exposure)
        assert np.abs(one.path - other.path).max() < 0.05 * one.path_sd.min()


def test_what_it_is_not_for_is_said():
    with pytest.raises(EstimatorError, match="filterpy', whose filters are of first order"):
        make_estimator(load_rig("section-vi"), "o3", engine="filterpy", second_order=True)
    with pytest.raises(EstimatorError, match="second_order is for plants of one spot, sh-8x8 has 48: use moments"):
        make_estimator(load_rig("sh-8x8"), "o3", second_order=True)
