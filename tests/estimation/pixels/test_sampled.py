"""The sampler against the Kalman filter where all is linear, against itself, and by simulation-based calibration."""

import dataclasses
from typing import cast

import numpy as np
import pytest
from scipy import stats
from threadpoolctl import threadpool_limits

from aolink.estimation import Profile, exposure_model, make_estimator
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.moments.lines import WindowedMoments
from aolink.estimation.pixels import likelihood
from aolink.estimation.pixels.gaussian_mixture import single
from aolink.estimation.pixels.sampled import TemperedUpdater
from aolink.estimation.pixels.tempering import fitted
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import PlainView
from tests.kinds import must_be, truth_of

RIG = load_rig("section-vi-lively")
MODEL = exposure_model(RIG.plant, 200)
PRIOR = Gaussian(np.array([[0.05, -0.2]]), RIG.plant.initial_covariance[None] / 20)


class LinearView:
    """A linear observation y = H t + noise in the place of pixels."""

    def __init__(self, H, y, sd, reduced):
        self.H, self.y, self.sd, self.reduced, self.axes, self.on_line = H, y, sd, reduced, np.arange(len(y)), True

    def part(self, axes):
        return LinearView(self.H, self.y[axes], self.sd, self.reduced)

    def rough(self):
        return self

    def log_likelihoods(self, t):
        return -0.5 * (((self.y[:, None] - t @ self.H.T) / self.sd) ** 2).sum(axis=-1)

    def log_likelihoods_and_gradients(self, t):
        return self.log_likelihoods(t), (self.y[:, None] - t @ self.H.T) @ self.H / self.sd**2


def test_it_is_the_kalman_filter_where_all_is_linear():
    reduced = likelihood.reduction(MODEL, RIG.sensor)
    rng = np.random.default_rng(1)
    H = rng.standard_normal((4, reduced.size)) * [20, 2, *[1] * (reduced.size - 2)]
    before = reduced.prior(PRIOR)
    truth = before.mean[0] + np.linalg.cholesky(before.covariance[0]) @ rng.standard_normal(reduced.size)
    view = LinearView(H, (H @ truth + 0.3 * rng.standard_normal(4))[None], 0.3, reduced)
    # It has all of a PixelView that is asked for.
    (t,), (evidence,) = TemperedUpdater(particles=4000).sample(cast(likelihood.PixelView, view), single(PRIOR))
    kalman = joseph_update(before, view.y - before.mean @ H.T, H[None], 0.09 * np.eye(4)[None]).posterior
    sd = np.sqrt(np.diag(kalman.covariance[0]))
    np.testing.assert_allclose((t.mean(axis=0) - kalman.mean[0]) / sd, 0, atol=0.1)
    white = np.linalg.solve(np.linalg.cholesky(kalman.covariance[0]), (t - kalman.mean[0]).T)
    np.testing.assert_allclose(np.cov(white), np.eye(reduced.size), atol=0.15)
    # The likelihood above is without its normalisation.
    expected = stats.multivariate_normal(H @ before.mean[0], H @ before.covariance[0] @ H.T + 0.09 * np.eye(4))
    assert evidence == pytest.approx(expected.logpdf(view.y[0]) + 2 * np.log(2 * np.pi * 0.09), abs=0.15)


def seen(rig, exposure):
    measured = must_be(Profile, measure(rig, exposure, WindowedMoments(rig.sensor).needs)[0])
    updates = TemperedUpdater()
    reduced = updates.reduction(MODEL, rig.sensor)
    return likelihood.PixelView(rig.sensor, MODEL, MODEL.response(exposure.inputs), measured, reduced)


def test_other_particles_and_twice_as_many_say_the_same():
    rig = dataclasses.replace(RIG, sensor=dataclasses.replace(RIG.sensor, noise_density=0.001))
    (exposure,) = simulate(rig, 1, seed=3)
    view = seen(rig, exposure)
    mean = truth_of(exposure).start_state + np.array([0.01, 0.1])
    prior = single(Gaussian(mean, RIG.plant.initial_covariance[None] / 9))
    one, other, more = (
        TemperedUpdater(count, seed).sample(view, prior).points[0] for count, seed in ((600, 0), (600, 1), (1200, 2))
    )
    sd = more.std(axis=0)
    for each in (one, other):
        assert np.sqrt(np.mean(((each.mean(axis=0) - more.mean(axis=0)) / sd) ** 2)) < 0.2
        np.testing.assert_allclose(each.std(axis=0) / sd, 1, atol=0.15)
    again = TemperedUpdater(600, 0).sample(view, prior)
    assert again.points[0].tobytes() == one.tobytes()
    update = TemperedUpdater(600, 0).update(view, prior, prior.gaussian)
    assert update.log_evidence.tobytes() == again.log_evidence.tobytes()


def functions(view, t):
    """Start state, first noise coefficient, and one that is not linear: the path's spread."""
    return np.stack([t[:, 0], t[:, 1], t[:, 2], PlainView.of(view).paths(t[None])[0, :, 0].std(axis=1)])


def ranks(count, particles, seed=5):
    """Ranks of the truth among thinned particles, for paths drawn from the prior: uniform if the sampler is right."""
    rng = np.random.default_rng(seed)
    rig = dataclasses.replace(RIG, sensor=dataclasses.replace(RIG.sensor, noise_density=0.003))
    reduced = likelihood.reduction(MODEL, rig.sensor, left_out=0.1)
    before = reduced.prior(PRIOR)
    root = np.linalg.cholesky(before.covariance[0])
    found = []
    for _ in range(count):
        t = (before.mean[0] + root @ rng.standard_normal(reduced.size))[None, None]
        dark = Profile(density=np.zeros((1, 40)), mask=np.ones((1, 40), bool))
        view = likelihood.PixelView(rig.sensor, MODEL, MODEL.response(np.zeros((200, 1))), dark, reduced)
        view.y = PlainView.of(view).predicted(t)[:, 0] + np.sqrt(view.read_noise) * rng.standard_normal((1, 40))
        drawn = TemperedUpdater(particles).sample(view, single(PRIOR)).points[0]

        thin = drawn[rng.permutation(particles)[:99]]
        found.append((functions(view, thin) < functions(view, t[0])).sum(axis=1))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "particles"), [(25, 200), pytest.param(120, 600, marks=pytest.mark.slow)])
def test_simulation_based_calibration(count, particles):
    """Talts et al. (2018): ranks of the truth are uniform. Ten bins would need more; five have chi-square of four."""
    r = ranks(count, particles)
    for each in r.T:
        bins = np.histogram(each, bins=5, range=(0, 100))[0]
        assert stats.chisquare(bins).pvalue > 1e-3


def test_a_mixture_is_fitted_to_points():
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.standard_normal((600, 2)) * 0.2 + [2, 0], rng.standard_normal((300, 2)) * 0.4])
    fit = fitted(points, np.eye(2), 4, 0)
    np.testing.assert_allclose(fit.gaussian.mean[0], points.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(fit.gaussian.covariance[0], np.cov(points.T), rtol=0.02, atol=0.01)
    truth = np.log(
        2 / 3 * stats.multivariate_normal([2, 0], 0.04).pdf(points)
        + 1 / 3 * stats.multivariate_normal([0, 0], 0.16).pdf(points)
    )
    assert fit.log_density(points[None])[0].mean() > truth.mean() - 0.05


def test_it_is_an_estimator_like_any_other():
    rig = dataclasses.replace(RIG, plant=dataclasses.replace(RIG.plant))
    exposures = simulate(rig, 3, seed=4)
    runs = []
    for seed in (0, 0, 1):
        sampled = make_estimator(rig, "sampled", particles=100, seed=seed)
        runs.append([sampled.step(e) for e in exposures])
    assert all(a.path.tobytes() == b.path.tobytes() for a, b in zip(runs[0], runs[1], strict=True))
    assert runs[0][-1].path.tobytes() != runs[2][-1].path.tobytes()
    for e, x in zip(runs[0], exposures, strict=True):
        assert e.status.name == "OK"
        assert np.mean(np.abs(e.path - truth_of(x).path) < 3 * e.path_sd) > 0.9


@pytest.mark.slow
def test_no_bit_depends_on_how_many_threads_there_are():
    """Of 10,000 numbers BLAS shares a scalar product among threads, of 30 coefficients a product of matrices."""
    rng = np.random.default_rng(3)
    points = rng.standard_normal((2500, 31))
    (exposure,) = simulate(RIG, 1, seed=3)
    view, prior, found = seen(RIG, exposure), single(PRIOR), []
    for threads in (1, 2):
        with threadpool_limits(threads):
            drawn = TemperedUpdater(10_001).sample(view, prior).points
            found.append([drawn.tobytes(), *(each.tobytes() for each in fitted(points, np.eye(2, 31), 8, 0))])
    assert found[0] == found[1]
