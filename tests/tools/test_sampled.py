"""The sampler against the Kalman filter where all is linear, on a ring, against itself, and by calibration."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from aolink.estimation.moments.lines import WindowedMoments
from scipy import stats

from aolink.estimation import Profile, exposure_model, make_estimator
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.pixels import likelihood
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, single
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import PlainView, with_noise
from tests.kinds import must_be, truth_of

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from judging.sampled import (
    Hamiltonian,
    TemperedUpdater,
    estimator,
    fitted,
    log_likelihoods_and_gradients,
    tempered,
    with_noise_and_gradient,
)

RIG = load_rig("section-vi-lively")
MODEL = exposure_model(RIG.plant, 200)
PRIOR = Gaussian(np.array([[0.05, -0.2]]), RIG.plant.initial_covariance[None] / 20)
COUNT, SIZE, RADIUS, WIDTH = 4000, 20, 2.0, 0.1
STANDARD = GaussianMixture(np.zeros((1, 1)), np.zeros((1, 1, 2)), np.eye(2)[None, None])


def test_it_is_the_kalman_filter_where_all_is_linear():
    """Mean, covariance and evidence of y = H t + noise, which are known exactly."""
    rng, size = np.random.default_rng(1), 8
    H = rng.standard_normal((4, size)) * [20, 2, *[1] * (size - 2)]
    before = PRIOR.with_noise(size)
    root = np.linalg.cholesky(before.covariance[0])
    y = H @ (before.mean[0] + root @ rng.standard_normal(size)) + 0.3 * rng.standard_normal(4)

    def look(t):
        away = (y - t @ H.T) / 0.3
        return -0.5 * (away**2).sum(axis=1), away @ H / 0.3

    start = before.mean[0] + rng.standard_normal((4000, size)) @ root.T
    t, evidence = tempered(Hamiltonian(look, single(PRIOR), start, rng, 16), rng)
    kalman = joseph_update(before, (y - before.mean[0] @ H.T)[None], H[None], 0.09 * np.eye(4)[None]).posterior
    sd = np.sqrt(np.diag(kalman.covariance[0]))
    np.testing.assert_allclose((t.mean(axis=0) - kalman.mean[0]) / sd, 0, atol=0.1)
    white = np.linalg.solve(np.linalg.cholesky(kalman.covariance[0]), (t - kalman.mean[0]).T)
    np.testing.assert_allclose(np.cov(white), np.eye(size), atol=0.15)
    # The likelihood above is without its normalisation.
    expected = stats.multivariate_normal(H @ before.mean[0], H @ before.covariance[0] @ H.T + 0.09 * np.eye(4))
    assert evidence == pytest.approx(expected.logpdf(y) + 2 * np.log(2 * np.pi * 0.09), abs=0.15)


def seen(rig, exposure, model=MODEL):
    measured = must_be(Profile, measure(rig, exposure, WindowedMoments(rig.sensor).needs)[0])
    reduced = TemperedUpdater().reduction(model, rig.sensor)
    return likelihood.PixelView(rig.sensor, model, model.response(exposure.inputs), measured, reduced)


def test_gradients_are_slopes():
    (exposure,) = simulate(RIG, 1, seed=3)
    view = seen(RIG, exposure)
    rng, n = np.random.default_rng(2), view.reduced.size
    root = rng.standard_normal((1, 3, 2, 2))
    weights = np.log([[0.3, 0.7, 1e-300]])
    prior = GaussianMixture(weights, rng.standard_normal((1, 3, 2)), root @ root.swapaxes(-1, -2) + 0.1 * np.eye(2))
    t = 0.2 * rng.standard_normal((5, n))
    plain = PlainView.of(view)
    for found, value in (
        (with_noise_and_gradient(prior, t), lambda t: with_noise(prior, t[None])[0]),
        (log_likelihoods_and_gradients(view, t), lambda t: plain.log_likelihoods(t[None])[0]),
    ):
        np.testing.assert_allclose(found[0], value(t), rtol=1e-5)
        slopes = np.array([(value(t + step) - value(t - step)) / 2e-5 for step in 1e-5 * np.eye(n)]).T
        np.testing.assert_allclose(found[1], slopes, rtol=1e-3, atol=1e-4 * np.abs(slopes).max())


@pytest.mark.slow
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
    assert TemperedUpdater(600, 0).update(view, prior, prior.gaussian).log_evidence == again.log_evidence


@pytest.mark.slow
def test_simulation_based_calibration():
    """Talts et al. (2018): the truth's ranks among thinned particles are uniform, of paths drawn from the prior.

    Of the start state, the first noise coefficient, and the path's spread, which is not linear. Ten bins would need
    more; five have chi-square of four.
    """
    rng, count = np.random.default_rng(5), 200
    rig = dataclasses.replace(RIG, sensor=dataclasses.replace(RIG.sensor, noise_density=0.003))
    reduced = likelihood.reduction(MODEL, rig.sensor, left_out=0.1)
    before = reduced.prior(PRIOR)
    root, ranks = np.linalg.cholesky(before.covariance[0]), []

    def functions(t):
        return np.stack([t[:, 0], t[:, 1], t[:, 2], plain.paths(t[None])[0, :, 0].std(axis=1)])

    for _ in range(25):
        truth = (before.mean[0] + root @ rng.standard_normal(reduced.size))[None]
        dark = Profile(density=np.zeros((1, 40)), mask=np.ones((1, 40), bool))
        view = likelihood.PixelView(rig.sensor, MODEL, MODEL.response(np.zeros((200, 1))), dark, reduced)
        plain = PlainView.of(view)
        view.y = plain.predicted(truth[None])[:, 0] + np.sqrt(view.read_noise) * rng.standard_normal((1, 40))
        drawn = TemperedUpdater(count).sample(view, single(PRIOR)).points[0][rng.permutation(count)[:99]]
        ranks.append((functions(drawn) < functions(truth)).sum(axis=1))
    for each in np.array(ranks).T:
        assert stats.chisquare(np.histogram(each, bins=5, range=(0, 100))[0]).pvalue > 1e-3


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["section-vi-lively", "single-lenslet"])
def test_it_is_near_profile_and_the_same_seed_gives_the_same_bits(name):
    rig, runs = load_rig(name), []
    exposures, profile = simulate(rig, 3, seed=4), make_estimator(rig, "profile")
    for seed in (0, 0, 1):
        sampled = estimator(rig, "sampled", particles=100, seed=seed)
        runs.append([sampled.step(e) for e in exposures])
    assert all(a.path.tobytes() == b.path.tobytes() for a, b in zip(runs[0], runs[1], strict=True))
    assert runs[0][-1].path.tobytes() != runs[2][-1].path.tobytes()
    for e, x in zip(runs[0], exposures, strict=True):
        other = profile.step(x)
        assert e.status.name == "OK"
        assert np.sqrt(np.mean((e.path - other.path) ** 2 / other.path_sd**2)) < 0.7


def ring(t, end=np.inf):
    """Log-likelihoods of points whose first two coefficients lie on a ring, and their gradients; beyond a radius there
    are no numbers."""
    radius = np.hypot(t[:, 0], t[:, 1])
    away = np.where(radius > end, np.nan, (radius - RADIUS) / WIDTH)
    gradient = np.zeros_like(t)
    gradient[:, :2] = -(away / WIDTH / radius)[:, None] * t[:, :2]
    return -0.5 * away**2, gradient


def on_the_ring(power):
    """Points of the tempered posterior, of density radius * exp(-radius^2 / 2 - power (radius - RADIUS)^2 / 2 w^2)."""
    rng, grid = np.random.default_rng(1), np.linspace(0.0, 8.0, 40001)
    density = grid * np.exp(-0.5 * grid**2 - 0.5 * power * ((grid - RADIUS) / WIDTH) ** 2)
    inside = np.cumsum(density) / density.sum()
    radius = np.interp(rng.random(COUNT), inside, grid)
    angle = rng.uniform(0, 2 * np.pi, COUNT)
    t = rng.standard_normal((COUNT, SIZE))
    t[:, 0], t[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    return t, lambda r: np.interp(r, grid, inside)


def moved(look, t, power, times):
    moves = Hamiltonian(look, STANDARD, t.copy(), np.random.default_rng(5), 16)
    for _ in range(times):
        moves.move(power)
    return moves.points


@pytest.mark.slow
@pytest.mark.parametrize("power", [0.01, 1.0])
def test_moves_leave_the_distribution_as_it_is(power):
    t, inside = on_the_ring(power)
    after = moved(ring, t, power, 8)
    assert stats.kstest(np.hypot(after[:, 0], after[:, 1]), inside).pvalue > 1e-3
    angle = np.arctan2(after[:, 1], after[:, 0])
    assert stats.kstest((angle + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-3
    for each in after[:, 2:].T:
        assert stats.kstest(each, "norm").pvalue > 1e-3


def test_moves_lead_along_the_ring():
    t, _ = on_the_ring(1.0)
    # All start in a quarter of it; the mean of cos(angle) falls from there towards zero.
    t = t[np.abs(np.arctan2(t[:, 1], t[:, 0])) < np.pi / 4]
    start = np.cos(np.arctan2(t[:, 1], t[:, 0])).mean()
    after = moved(ring, t, 1.0, 20)
    assert np.cos(np.arctan2(after[:, 1], after[:, 0])).mean() < 0.3 * start


def test_a_trajectory_that_leaves_all_numbers_is_not_taken():
    t, _ = on_the_ring(1e-3)
    end = 1.001 * np.hypot(t[:, 0], t[:, 1]).max()
    after = moved(lambda t: ring(t, end), t, 1e-3, 4)
    assert np.isfinite(after).all()
    assert np.hypot(after[:, 0], after[:, 1]).max() <= end
    assert (after != t).any(axis=1).mean() > 0.5
