"""The smoother of mixtures: against all components of a linear case, and on paths that only later frames make out."""

import dataclasses

import numpy as np
import pytest
from scipy import special

from aolink.errors import EstimatorError
from aolink.estimation import (
    BlurFilter,
    Estimator,
    Needs,
    Status,
    joseph_update,
    run,
    score,
    smooth,
)
from aolink.estimation.estimate import Components
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.vibrating import vibrating
from tests.kinds import truth_of

LIVELY = load_rig("section-vi-lively")
SD = 0.05


class Centroid:
    """The mean of the path with Gaussian noise of a known sd: all is linear, the noise inside the exposure included."""

    needs = Needs(what="moments", orders=(1,))
    models_noise = True
    n_measurements = 1

    def update(self, model, response, prior, measured):
        row = model.basis.mean(axis=1)
        innovation = measured.value - prior.mean @ row.T - response.mean
        return joseph_update(prior, innovation, row[None], np.full((1, 1, 1), SD**2))


def component(rig, mean, exposures):
    """Estimates of a linear filter that starts from this mean, and the log-likelihood of all frames up to each."""
    plant = dataclasses.replace(
        rig.plant, initial_mean=np.asarray(mean), initial_covariance=rig.plant.initial_covariance / 50
    )
    estimator = Estimator(rig, "linear", BlurFilter(plant, Centroid(), gate=False))
    estimates = [estimator.step(exposure) for exposure in exposures]
    each = [-0.5 * (e.nis[0] + np.log(e.innovation_covariance[0, 0, 0])) for e in estimates]
    return estimates, np.cumsum(each)


def mixed(logs, estimates, components):
    """The estimate of a mixture of components with these log-weights."""
    w = special.softmax(logs)
    changes = {}
    for mean, covariance in (("coefficients", "coefficient_covariance"), ("end_state", "end_covariance")):
        means = np.array([getattr(e, mean)[0] for e in estimates])
        away = means - w @ means
        changes[mean] = (w @ means)[None]
        changes[covariance] = np.tensordot(w, [getattr(e, covariance)[0] for e in estimates], 1)[None]
        changes[covariance] += np.einsum("h,hi,hj->ij", w, away, away)
    n = changes["end_state"].shape[1]
    return dataclasses.replace(
        estimates[0], start_state=changes["coefficients"][:, :n],
        start_covariance=changes["coefficient_covariance"][:, :n, :n], components=components, **changes,
    )  # fmt: skip


def without_components(estimates):
    return [dataclasses.replace(each, components=None) for each in estimates]


def exact(means, seed=3, count=6):
    """Filtered estimates of a linear mixture of components, and the smoothed ones, component by component."""
    timing = dataclasses.replace(LIVELY.timing, frame_period_steps=260)
    rig = dataclasses.replace(LIVELY, timing=timing)
    exposures = simulate(rig, count, seed=seed)
    found, logs = zip(*(component(rig, mean, exposures) for mean in means), strict=True)
    size = found[0][0].coefficients.shape[1]
    wide = np.zeros((1, 2)), 1e3 * rig.plant.initial_covariance[None]
    filtered = []
    for k in range(count):
        now = [each[k] for each in found]
        part = (
            np.arange(1), special.log_softmax([each[k] for each in logs])[None],
            np.stack([e.coefficients for e in now], axis=1), np.stack([e.coefficient_covariance for e in now], axis=1),
        )  # fmt: skip
        components = Components([part], np.eye(size), np.zeros((size, size)), wide)
        filtered.append(mixed([each[k] for each in logs], now, components))
    after = [smooth(rig.plant, exposures, each) for each in found]
    last = [each[-1] for each in logs]
    return rig, exposures, filtered, [mixed(last, [each[k] for each in after], None) for k in range(count)]


def apart(one, other):
    """Largest difference of means and of sds, in sds of the first."""
    sd = np.sqrt(np.einsum("aii->ai", one.coefficient_covariance))
    own = np.sqrt(np.einsum("aii->ai", other.coefficient_covariance))
    return max(np.abs((one.coefficients - other.coefficients) / sd).max(), np.abs(own / sd - 1).max())


def test_one_gaussian_gives_what_rauch_tung_and_striebel_give():
    rig, exposures, filtered, expected = exact([(0.05, -0.2)])
    for one, other, before in zip(expected, smooth(rig.plant, exposures, filtered), filtered, strict=True):
        assert apart(one, other) < 2e-3  # a thousandth is doubt
        np.testing.assert_allclose(one.end_state, other.end_state, atol=2e-3 * np.sqrt(one.end_covariance.max()))
        if before is not filtered[-1]:
            assert apart(one, before) > 0.05


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_components_are_weighed_by_all_frames(seed):
    rig, exposures, filtered, expected = exact([(0.04, 0.0), (-0.04, 0.2), (0.0, -0.3)], seed)
    smoothed = smooth(rig.plant, exposures, filtered)
    as_one_gaussian = smooth(rig.plant, exposures, without_components(filtered))
    away = [max(map(apart, expected, each)) for each in (smoothed, as_one_gaussian, filtered)]
    assert away[0] < 0.002
    assert away[1] > 10 * away[0]
    assert away[2] > 0.5


@pytest.fixture(scope="module")
def swinging():
    """Runs of a spot that swings 2.6 times in an exposure, where a path and its reversal give the same blur."""
    rig = vibrating(1, (13.0,), damping=0.005, sd=0.05, noise_density=0.01)
    rig = dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, bit_depth=16, black_level=20_000.0))
    still = np.zeros((12 * rig.timing.exposure_steps, 1))
    runs = [simulate(rig, 12, seed=seed, inputs=still) for seed in range(5, 11)]
    return rig, [(exposures, run(rig, exposures, ["profile"])["profile"]) for exposures in runs]


@pytest.mark.slow
def test_later_frames_tell_which_way_a_path_ran(swinging):
    rig, runs = swinging
    errors, inside = np.zeros(2), []
    for exposures, estimates in runs:
        after = smooth(rig.plant, exposures, estimates)
        errors += [score(exposures, each, 0).path_rmse ** 2 for each in (estimates, after)]
        for e, x in zip(after, exposures, strict=True):
            inside.append(np.mean(np.abs(e.path - truth_of(x).path) < 1.96 * e.path_sd))
            assert np.linalg.eigvalsh(e.coefficient_covariance[0]).min() > -1e-12
        assert after[-1] is estimates[-1]
    filtered, smoothed = np.sqrt(errors)
    assert smoothed < 0.85 * filtered
    assert 0.92 < np.mean(inside) < 0.98


def test_a_lag_is_so_many_later_exposures(swinging):
    rig, ((exposures, estimates), *_) = swinging
    assert smooth(rig.plant, exposures, estimates, lag=0) == estimates
    for k, each in enumerate(smooth(rig.plant, exposures, estimates, lag=2)[:-2]):
        own = smooth(rig.plant, exposures[k : k + 3], estimates[k : k + 3])[0]
        assert each.path.tobytes() == own.path.tobytes()
    long, whole = (smooth(rig.plant, exposures, estimates, lag) for lag in (100, None))
    assert [e.path.tobytes() for e in long] == [e.path.tobytes() for e in whole]
    with pytest.raises(EstimatorError, match="lag = -1: give the number of later exposures, 0 or more"):
        smooth(rig.plant, exposures, estimates, lag=-1)


def test_a_frame_that_is_lost_is_found_by_those_after_it():
    exposures = simulate(LIVELY, 12, seed=4)
    dark = dataclasses.replace(exposures[5], mask=np.zeros_like(exposures[5].mask))
    exposures = [*exposures[:5], dark, *exposures[6:]]
    estimates = run(LIVELY, exposures, ["profile"])["profile"]
    assert estimates[5].status == Status.INPUT_INVALID
    smoothed = smooth(LIVELY.plant, exposures, estimates)
    assert smoothed[5].path_sd.max() < 0.6 * estimates[5].path_sd.max()
    assert np.mean(np.abs(smoothed[5].path - truth_of(dark).path) < 3 * smoothed[5].path_sd) > 0.9


def test_where_the_state_was_lost_the_past_stays():
    """After five exposures the spot is where another run of the plant has brought it, which no filter could know."""
    one, other = (simulate(LIVELY, 12, seed=seed) for seed in (1, 2))
    exposures = [*one[:5], *(dataclasses.replace(o, inputs=x.inputs) for o, x in zip(other[5:], one[5:], strict=True))]
    rig, estimates = LIVELY, run(LIVELY, exposures, ["profile"])["profile"]
    together, apart_ = smooth(rig.plant, exposures, estimates), smooth(rig.plant, exposures[:5], estimates[:5])
    for a, b in zip(together[:5], apart_, strict=True):
        assert np.abs((a.path - b.path) / b.path_sd).max() < 1


def test_several_axes_are_smoothed_side_by_side():
    rig = load_rig("single-lenslet")
    exposures = simulate(rig, 8, seed=2)
    estimates = run(rig, exposures, ["profile"])["profile"]
    smoothed = smooth(rig.plant, exposures, estimates)
    before, after = (score(exposures, each, 0).path_rmse for each in (estimates, smoothed))
    assert after < before
    assert [e.path.shape for e in smoothed] == [e.path.shape for e in estimates]
