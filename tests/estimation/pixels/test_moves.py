"""Moves leave the distribution as it is and lead through it: on a bright ring, whose likelihood is known."""

import dataclasses
from copy import copy
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import stats

from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, with_noise_and_gradient
from aolink.estimation.pixels.likelihood import PixelView
from aolink.estimation.pixels.moves import Hamiltonian, affordable
from tests.estimation.compiled.test_pixels import looked_at, looked_at_plane
from tests.estimation.pixels.plain import with_noise

COUNT, SIZE, RADIUS, WIDTH = 4000, 20, 2.0, 0.1
STANDARD = GaussianMixture(np.zeros((1, 1)), np.zeros((1, 1, 2)), np.eye(2)[None, None])


class Ring:
    """Coefficients whose first two lie on a ring, in the place of pixels; nothing is known of the others."""

    on_line = True

    def __init__(self, end=np.inf):
        self.end = end
        """The radius beyond which there are no numbers."""

    def log_likelihoods(self, t):
        return self.log_likelihoods_and_gradients(t)[0]

    def log_likelihoods_and_gradients(self, t):
        radius = np.hypot(t[..., 0], t[..., 1])
        away = np.where(radius > self.end, np.nan, (radius - RADIUS) / WIDTH)
        gradient = np.zeros_like(t)
        gradient[..., :2] = -(away / WIDTH / radius)[..., None] * t[..., :2]
        return -0.5 * away**2, gradient


def on_the_ring(rng, power):
    """Points of the tempered posterior, of density radius * exp(-radius^2 / 2 - power (radius - RADIUS)^2 / 2 w^2)."""
    grid = np.linspace(0.0, 8.0, 40001)
    density = grid * np.exp(-0.5 * grid**2 - 0.5 * power * ((grid - RADIUS) / WIDTH) ** 2)
    inside = np.cumsum(density) / density.sum()
    radius = np.interp(rng.random(COUNT), inside, grid)
    angle = rng.uniform(0, 2 * np.pi, COUNT)
    t = rng.standard_normal((COUNT, SIZE))
    t[:, 0], t[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    return t, lambda r: np.interp(r, grid, inside)


def moved(view, t, power, times):
    moves = Hamiltonian(cast(PixelView, view), STANDARD, t.copy(), np.random.default_rng(5))
    for _ in range(times):
        moves.move(power)
    return moves.points


@pytest.mark.slow
@pytest.mark.parametrize("power", [0.01, 1.0])
def test_the_distribution_stays(power):
    t, inside = on_the_ring(np.random.default_rng(1), power)
    after = moved(Ring(), t, power, 8)
    assert stats.kstest(np.hypot(after[:, 0], after[:, 1]), inside).pvalue > 1e-3
    angle = np.arctan2(after[:, 1], after[:, 0])
    assert stats.kstest((angle + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-3
    for each in after[:, 2:].T:
        assert stats.kstest(each, "norm").pvalue > 1e-3
    kept = moved(Ring(), t, power, 8)
    assert after.tobytes() == kept.tobytes()  # the same random numbers, the same points


def test_trajectories_lead_along_the_ring():
    t, _ = on_the_ring(np.random.default_rng(1), 1.0)
    before = np.arctan2(t[:, 1], t[:, 0])
    # All start in a quarter of it; the mean of cos(angle) falls from there towards zero.
    t = t[np.abs(before) < np.pi / 4]
    start = np.cos(np.arctan2(t[:, 1], t[:, 0])).mean()
    after = moved(Ring(), t, 1.0, 20)
    assert np.cos(np.arctan2(after[:, 1], after[:, 0])).mean() < 0.3 * start


def test_a_trajectory_that_leaves_all_numbers_is_not_taken():
    t, _ = on_the_ring(np.random.default_rng(1), 1e-3)
    end = 1.001 * np.hypot(t[:, 0], t[:, 1]).max()
    after = moved(Ring(end), t, 1e-3, 4)
    assert np.isfinite(after).all()
    assert np.hypot(after[:, 0], after[:, 1]).max() <= end
    assert (after != t).any(axis=1).mean() > 0.5


def test_the_gradient_of_the_prior_is_its_slope():
    rng = np.random.default_rng(2)
    root = rng.standard_normal((2, 3, 2, 2))
    log_weight = np.log(rng.dirichlet(np.ones(3), 2))
    log_weight[1, 2] = -np.inf  # a component that is not there
    prior = GaussianMixture(log_weight, rng.standard_normal((2, 3, 2)), root @ root.swapaxes(-1, -2) + 0.1 * np.eye(2))
    t = rng.standard_normal((2, 7, 5))
    density, gradient = with_noise_and_gradient(prior, t)
    np.testing.assert_allclose(density, with_noise(prior, t), rtol=1e-12)
    for i in range(5):
        step = 1e-5 * np.eye(5)[i]
        slope = (with_noise(prior, t + step) - with_noise(prior, t - step)) / 2e-5
        np.testing.assert_allclose(gradient[..., i], slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("on_line", [True, False])
def test_the_more_work_a_point_is_the_fewer_there_are(on_line):
    counts = [affordable(cast(PixelView, SimpleNamespace(on_line=on_line, work=work))) for work in (10, 3000, 10**6)]
    assert 1500 < counts[0] <= 2000
    assert counts[0] > counts[1] > counts[2]
    assert counts[2] == 500


@pytest.mark.parametrize(("kind", "view"), [("lively", looked_at), ("round", looked_at_plane)])
def test_the_work_of_a_point_grows_with_its_nodes_and_the_pixels_that_it_lights(kind, view):
    exact = view(kind, 0)[0] if view is looked_at_plane else view(kind)[0]
    assert 0 < exact.rough().work <= exact.work
    more = copy(exact)
    more.nodes = dataclasses.replace(exact.nodes, weights=np.repeat(exact.nodes.weights, 2) / 2)
    assert more.work == 2 * exact.work
