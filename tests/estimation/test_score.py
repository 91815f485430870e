"""Scores against sums done by hand, and bounds against chi-square."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from aolink.estimation import Scorer, Status, make_estimator, run, score
from aolink.estimation.score import RunningMean
from aolink.simulation.model import simulate


@pytest.fixture(scope="module")
def scored(rig):
    exposures = simulate(rig, 12, seed=2)
    return exposures, run(rig, exposures, ["o3", "open-loop"])


def test_errors_are_root_mean_squares(scored):
    exposures, estimates = scored
    result = score(exposures, estimates["o3"], skip=2)
    pairs = list(zip(exposures, estimates["o3"], strict=True))[2:]
    start = [np.sum((e.start_state - x.truth.start_state) ** 2) for x, e in pairs]
    end = [np.sum((e.end_state - x.truth.end_state) ** 2) for x, e in pairs]
    path = [np.mean((e.path - x.truth.path) ** 2) for x, e in pairs]
    assert result.exposures == 10
    assert result.start_rmse == pytest.approx(np.sqrt(np.mean(start)))
    assert result.end_rmse == pytest.approx(np.sqrt(np.mean(end)))
    assert result.path_rmse == pytest.approx(np.sqrt(np.mean(path)))


def test_nees_and_nis_are_means_with_chi_square_bounds(scored):
    exposures, estimates = scored
    result = score(exposures, estimates["o3"])
    nees = [
        d @ np.linalg.solve(e.end_covariance[0], d)
        for x, e in zip(exposures, estimates["o3"], strict=True)
        for d in [e.end_state[0] - x.truth.end_state[0]]
    ]
    assert result.end_nees.mean == pytest.approx(np.mean(nees))
    assert result.nis.mean == pytest.approx(np.mean([e.nis[0] for e in estimates["o3"]]))
    low, high = (stats.chi2.ppf(p, 2 * 12) / 12 for p in (0.025, 0.975))
    assert (result.end_nees.low, result.end_nees.high) == pytest.approx((low, high))
    assert (result.nis.low, result.nis.high) == pytest.approx((low, high))


def test_nothing_measured_is_no_nis(scored):
    exposures, estimates = scored
    result = score(exposures, estimates["open-loop"])
    assert np.isnan(result.nis.mean)
    assert not result.nis.inside


def test_gated_exposures_are_counted_with_truth_and_without(scored):
    exposures, estimates = scored
    statuses = [Status.GATED, Status.DIVERGED, Status.REINITIALISED, Status.INPUT_INVALID, *[Status.OK] * 8]
    changed = [dataclasses.replace(e, status=s) for e, s in zip(estimates["o3"], statuses, strict=True)]
    assert score(exposures, changed).gated == 2
    assert score([dataclasses.replace(e, truth=None) for e in exposures], changed).gated == 2


def test_exposures_without_truth_do_not_count(scored):
    exposures, estimates = scored
    half_blind = [dataclasses.replace(e, truth=None) if i % 2 else e for i, e in enumerate(exposures)]
    assert score(half_blind, estimates["o3"]).exposures == 6
    blind = [dataclasses.replace(e, truth=None) for e in exposures]
    result = score(blind, estimates["o3"])
    assert result.exposures == 0
    assert np.isnan(result.path_rmse)


def test_a_frame_that_was_not_used_has_no_nis(rig, scored):
    exposures, _ = scored
    estimator = make_estimator(rig, "o1")
    dropped = dataclasses.replace(exposures[3], mask=np.zeros_like(exposures[3].mask))
    series = [*exposures[:3], dropped, *exposures[4:]]
    result = score(series, [estimator.step(e) for e in series])
    assert result.nis.low == pytest.approx(stats.chi2.ppf(0.025, 11) / 11)


def test_as_many_estimates_as_exposures(scored):
    exposures, estimates = scored
    with pytest.raises(ValueError, match="12 estimates for 11 exposures"):
        score(exposures[:-1], estimates["o3"])


def test_a_scorer_can_be_asked_at_any_time(scored):
    exposures, estimates = scored
    scorer = Scorer()
    for n, (exposure, estimate) in enumerate(zip(exposures, estimates["o3"], strict=True), 1):
        scorer.add(exposure, estimate)
        assert scorer.result() == score(exposures[:n], estimates["o3"][:n])


def test_a_long_sum_loses_nothing():
    total = RunningMean()
    for _ in range(1000):
        total.add(np.array([1e16]))
        total.add(np.array([1.0]))
        total.add(np.array([-1e16]))
    assert total.mean == 1 / 3


def test_states_of_another_rig_file_are_not_compared_with_the_truth(scored):
    exposures, estimates = scored
    others = []
    for each in exposures:
        truth = each.truth
        longer = dataclasses.replace(
            truth, start_state=np.pad(truth.start_state, ((0, 0), (0, 1))),
            end_state=np.pad(truth.end_state, ((0, 0), (0, 1))),
        )  # fmt: skip
        others.append(dataclasses.replace(each, truth=longer))
    result, own = score(others, estimates["o3"]), score(exposures, estimates["o3"])
    assert result.path_rmse == own.path_rmse
    assert np.isnan([result.end_rmse, result.end_nees.mean]).all()
