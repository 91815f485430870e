"""Mixtures of Gaussians against their own moments and samples."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special

from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, log_sum


def mixture(seed, axes=3, components=5, n=3):
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((axes, components, n, n))
    logs = rng.standard_normal((axes, components)) * 2
    return GaussianMixture(
        logs - special.logsumexp(logs, axis=1, keepdims=True),
        rng.standard_normal((axes, components, n)) * 2,
        roots @ roots.swapaxes(-1, -2) + 0.01 * np.eye(n),
    )


def test_moments_are_those_of_samples():
    m = mixture(3, axes=1)
    rng = np.random.default_rng(4)
    chosen = rng.choice(5, 200_000, p=np.exp(m.log_weight[0]))
    drawn = m.mean[0, chosen] + np.einsum(
        "kij,kj->ki", np.linalg.cholesky(m.covariance[0])[chosen], rng.standard_normal((len(chosen), 3))
    )
    np.testing.assert_allclose(m.gaussian.mean[0], drawn.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(m.gaussian.covariance[0], np.cov(drawn.T), rtol=0.05, atol=0.1)
    rows, rest = rng.standard_normal((2, 3)), np.diag([0.5, 2.0])
    seen = m.mapped(rows, rest).gaussian
    np.testing.assert_allclose(seen.mean[0], rows @ m.gaussian.mean[0])
    np.testing.assert_allclose(seen.covariance[0], rows @ m.gaussian.covariance[0] @ rows.T + rest)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), most=st.integers(1, 5), gone=st.booleans())
def test_merging_keeps_weight_mean_and_covariance(seed, most, gone):
    m = mixture(seed)
    if gone:
        m.log_weight[:, 2] = -np.inf
        m = GaussianMixture(m.log_weight - log_sum(m.log_weight, axis=1)[:, None], m.mean, m.covariance)
    less = m.reduced(most)
    assert less.mean.shape == (3, min(most, 5 - gone), 3)
    np.testing.assert_allclose(np.exp(less.log_weight).sum(axis=1), 1.0)
    np.testing.assert_allclose(less.gaussian.mean, m.gaussian.mean, atol=1e-9)
    np.testing.assert_allclose(less.gaussian.covariance, m.gaussian.covariance, atol=1e-8)
    assert np.linalg.eigvalsh(less.covariance).min() > 0


def test_twins_are_merged_first():
    m = mixture(5, axes=1, components=3)
    weight, again = np.exp(m.log_weight) * [1, 2, 1], [0, 1, 2, 1]
    twins = GaussianMixture(m.log_weight[:, again], m.mean[:, again].copy(), m.covariance[:, again])
    twins.mean[:, 3] += 1e-6
    less, order = twins.reduced(3), np.argsort(-weight[0])  # the heaviest comes first
    np.testing.assert_allclose(less.mean[0], m.mean[0, order], atol=1e-5)
    np.testing.assert_allclose(np.exp(less.log_weight[0]), weight[0, order])


def test_an_axis_does_not_depend_on_those_beside_it():
    m = mixture(6, axes=7)
    assert m.part(slice(3, 4)).reduced(2).mean[0].tobytes() == m.reduced(2).mean[3].tobytes()


def test_what_is_not_there_does_not_change_a_bit_of_a_sum():
    rng = np.random.default_rng(4)
    values = rng.standard_normal((200, 6))
    for more in (1, 3, 10):
        padded = np.concatenate([values, np.full((200, more), -np.inf)], axis=1)
        assert log_sum(padded, axis=1).tobytes() == log_sum(values, axis=1).tobytes()


def test_components_of_hardly_any_weight_are_dropped_however_far_away_they_are():
    weight = np.array([[0.4, 0.6 - 2e-13, 2e-13]])
    mean = np.array([[[0.0], [5.0], [1e9]]])
    kept = GaussianMixture(np.log(weight), mean, np.ones((1, 3, 1, 1))).reduced(3)
    assert sorted(kept.mean[0, :, 0]) == [0.0, 5.0]
