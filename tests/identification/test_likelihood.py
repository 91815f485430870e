"""The likelihood against what it approximates: dense Gaussians, and drawn paths."""

import numpy as np
import pytest
from scipy import stats

import aolink
from aolink.identification import Process, ProcessSum, readings
from aolink.identification.likelihood import Likelihood
from aolink.identification.simulate import simulated

MODEL = ProcessSum((Process("resonance", (12.0, 0.02, 0.2)), Process("ornstein-uhlenbeck", (0.5, 0.02))))


@pytest.fixture(scope="module")
def seen():
    exposures = aolink.simulate("jitter", 32, seed=5)
    return readings(exposures.rig, list(exposures))


@pytest.mark.rare
def test_with_squares_that_say_nothing_it_is_the_gaussian_of_the_means(seen):
    """The oracle has every fast step of every exposure in one covariance matrix."""
    from dataclasses import replace

    N, step = seen.n_steps, seen.step_s
    blind = replace(seen, square_noise=np.full_like(seen.square, 1e12))
    times = np.arange(seen.slots * N) * step
    mean = np.kron(np.eye(seen.slots), np.full((1, N), 1 / N))

    def oracle(model):
        lags = np.abs(times[:, None] - times)
        path = sum(process.covariance(lags) for process in model.processes)
        sigma = mean @ path @ mean.T + seen.mean_noise.mean() * np.eye(seen.slots)
        y = (seen.mean + seen.centre)[0]
        one = np.linalg.solve(sigma, np.ones(len(y)))
        return stats.multivariate_normal(np.full(len(y), one @ y / one.sum()), sigma).logpdf(y)

    other = ProcessSum((Process("resonance", (13.0, 0.01, 0.15)),))
    ours = Likelihood(blind, 8)
    assert ours(MODEL) - ours(other) == pytest.approx(oracle(MODEL) - oracle(other), abs=0.02)


def test_the_truth_is_likelier_than_what_is_far_from_it(seen):
    truth = ProcessSum((Process("resonance", (12.0, 0.005, 0.2)),))
    ours = Likelihood(seen, 8)
    for values in ((9.0, 0.005, 0.2), (12.0, 0.1, 0.2), (12.0, 0.005, 0.05)):
        assert ours(truth) > ours(ProcessSum((Process("resonance", values),))) + 5


def test_no_other_model_is_likelier_on_average_than_the_one_that_drew_the_readings(seen):
    """E log p(truth) is the largest; of a likelihood, E exp(log p(other) - log p(truth)) is one at most."""
    truth = ProcessSum((Process("resonance", (12.0, 0.02, 0.2)),))
    drawn = Likelihood(simulated(seen, truth, 60, seed=1), 8)
    for values in ((13.0, 0.02, 0.2), (12.0, 0.03, 0.2), (12.0, 0.02, 0.23)):
        gain = drawn.of_outputs(truth) - drawn.of_outputs(ProcessSum((Process("resonance", values),)))
        assert gain.mean() > -0.3
        assert np.exp(np.minimum(-gain, 20)).mean() < 3


def test_an_exposure_that_is_missing_says_nothing(seen):
    from dataclasses import replace

    usable = seen.usable.copy()
    usable[0, 9] = False
    spoilt = np.where(usable, seen.mean, 99.0)
    here = replace(seen, usable=usable)
    assert Likelihood(replace(here, mean=spoilt), 8)(MODEL) == Likelihood(here, 8)(MODEL)


def test_whitened_means_are_innovations_of_unit_variance(seen):
    """Where the model drew the readings they are white; a model of too little motion leaves more than that."""
    truth = ProcessSum((Process("resonance", (12.0, 0.02, 0.2)),))
    drawn = Likelihood(simulated(seen, truth, 60, seed=1), 8)
    white = np.concatenate(drawn.whitened_means(truth))
    assert white.var() == pytest.approx(1.0, abs=5 * np.sqrt(2 / len(white)) + 1 / drawn.seen.slots)
    one_after = np.concatenate([each[1:] * each[:-1] for each in drawn.whitened_means(truth)])
    assert abs(one_after.mean()) < 5 / np.sqrt(len(one_after))
    quiet = ProcessSum((Process("resonance", (12.0, 0.02, 0.1)),))
    assert np.concatenate(drawn.whitened_means(quiet)).var() > 2
