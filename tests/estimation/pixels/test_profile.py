"""The estimators of pixels: modes against the gradient and against sampling, claims, faults, independence of axes."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from aolink.estimation import Status, exposure_model, run, score
from aolink.estimation.frames.frame_data import Needs, Profile
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.pixels import likelihood
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, single
from aolink.estimation.pixels.profile import ProfileFilter
from aolink.numerics.covariance import cholesky
from aolink.optics.kernel import exposure_density
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import PlainView, by_moments, settled_modes, whitened
from tests.kinds import line_of, must_be, truth_of

RIG = load_rig("section-vi-lively")
FILTER = ProfileFilter(RIG.plant, RIG.sensor)
PIXELS = Needs(what="profile")


def quiet(rig, V):
    return dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, noise_density=V))


def seen(rig=RIG, *, width=1.0, seed=3):
    """One exposure, with a prior of its start state so many times as wide as the plant's own, about the truth."""
    (exposure,) = simulate(rig, 1, seed=seed)
    measured = must_be(Profile, measure(rig, exposure, PIXELS)[0])
    model = exposure_model(rig.plant, exposure.n_steps)
    reduced = likelihood.reduction(model, rig.sensor)
    view = likelihood.PixelView(rig.sensor, model, model.response(exposure.inputs), measured, reduced)
    P = rig.plant.initial_covariance * width**2
    offset = np.linalg.cholesky(P) @ np.random.default_rng(seed).standard_normal(len(P))
    return view, Gaussian(truth_of(exposure).start_state + offset, P[None])


def by_importance(view, state, count=60_000, seed=1):
    """Mean and covariance of the posterior of t by plain importance sampling from the prior; and how many count."""
    prior = view.reduced.prior(state)
    e = np.random.default_rng(seed).standard_normal((count, view.reduced.size))
    t = prior.mean + e @ cholesky(prior.covariance)[0].T
    plain = PlainView.of(view)
    logs = np.concatenate([plain.log_likelihood(plain.predicted(part[None]))[0] for part in np.split(t, 20)])
    w = np.exp(logs - logs.max())
    w /= w.sum()
    mean = w @ t
    return mean, (w[:, None] * (t - mean)).T @ (t - mean), 1 / (w @ w)


# Modes


def assert_near(ours, mean, covariance, means, sds):
    """Means within so many standard deviations, and those within such a part of themselves."""
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(ours.mean[0] / sd, mean / sd, atol=means)
    np.testing.assert_allclose(np.sqrt(np.diag(ours.covariance[0])) / sd, 1.0, atol=sds)


def test_the_gradient_is_zero_at_a_mode():
    view, state = seen(quiet(RIG, 0.001), width=0.3)
    prior = view.reduced.prior(state)
    start = whitened(prior, by_moments(view, prior).mean[:, None])
    view = PlainView.of(view)  # its error function is exact; what is compiled has a test of its own
    modes = settled_modes(view, prior, start)
    inverse = np.linalg.inv(prior.covariance[0])

    def objective(t):
        away = t - prior.mean[0]
        return 0.5 * away @ inverse @ away - view.log_likelihood(view.predicted(t[None, None]))[0, 0]

    t, root = modes.mean[0, 0], np.linalg.cholesky(modes.covariance[0, 0])
    assert objective(t) == pytest.approx(modes.objective[0, 0], abs=1e-6)
    for direction in root.T:  # one standard deviation each
        slope = (objective(t + 1e-4 * direction) - objective(t - 1e-4 * direction)) / 2e-4
        assert abs(slope) < 0.1  # a search ends at steps that change the objective by 0.03
    assert objective(t) < min(objective(t + s * d) for d in root.T for s in (-0.5, 0.5))


@pytest.mark.parametrize("photoelectrons", [0.0, 500.0])
def test_posterior_is_that_of_importance_sampling(photoelectrons):
    """Where the spot moves by less than the kernel's width, the posterior is a Gaussian."""
    rig = load_rig("section-vi")
    rig = dataclasses.replace(
        rig, sensor=dataclasses.replace(rig.sensor, noise_density=0.005, photoelectrons=photoelectrons)
    )
    view, state = seen(rig)
    mean, covariance, effective = by_importance(view, state)
    assert effective > 300
    assert_near(
        ProfileFilter(rig.plant, rig.sensor).found(view, single(state)).posterior.gaussian, mean, covariance, 0.25, 0.15
    )


def test_evidence_of_a_mode_has_the_weight_of_its_prior():
    view, state = seen(quiet(RIG, 0.01), width=0.3)
    apart = state.mean[:, None] + np.array([[0.0, 0.0], [0.1, 3.0]])
    both = np.repeat(state.covariance[:, None], 2, axis=1) / 4
    weights, wide = np.log([[0.5, 0.5], [0.9, 0.1]]), by_moments(view, view.reduced.prior(state))
    each = [FILTER._modes(view, GaussianMixture(log_weight[None], apart, both), wide) for log_weight in weights]
    assert len({modes.mean.shape for modes in each}) == 1
    # Whose prior led to a mode: those are told apart by what the other weight made of it.
    change = np.sort(each[1].log_evidence[0] - each[0].log_evidence[0])
    np.testing.assert_allclose(each[0].mean, each[1].mean)
    assert change[0] == pytest.approx(np.log(0.1 / 0.5), abs=1e-9)
    assert change[-1] == pytest.approx(np.log(0.9 / 0.5), abs=1e-9)
    assert np.all(np.isclose(change, change[0]) | np.isclose(change, change[-1]))


def test_a_path_and_its_reversal_are_two_readings():
    """From a start state at rest, with no preference, a fast sweep may have gone either way."""
    rig = quiet(RIG, 0.001)
    model = exposure_model(rig.plant, 200)
    reduced = likelihood.reduction(model, rig.sensor)
    path = np.linspace(-0.2, 0.2, 200)
    rng = np.random.default_rng(1)
    density = exposure_density(rig.sensor.kernel, rig.sensor.edges, path) + 0.14 * rng.standard_normal(40)
    measured = Profile(density=density[None], mask=np.ones((1, 40), bool))
    view = likelihood.PixelView(rig.sensor, model, model.response(np.zeros((200, 1))), measured, reduced)
    P = np.diag([0.04, 25.0])
    state = Gaussian(np.zeros((1, 2)), P[None])
    assert FILTER.found(view, single(state)).is_multimodal[0]
    modes = FILTER._modes(view, single(state), by_moments(view, view.reduced.prior(state)))
    there = np.isfinite(modes.log_evidence[0])
    ends = PlainView.of(view).paths(modes.mean)[0, there][:, 0, [0, -1]]
    evidence = modes.log_evidence[0, there]
    forth, back = evidence[ends[:, 1] > ends[:, 0]].max(), evidence[ends[:, 1] < ends[:, 0]].max()
    assert abs(forth - back) < 3.0
    np.testing.assert_allclose(np.sort(ends[np.argmax(evidence)]), [-0.2, 0.2], atol=0.06)


# What they are good for


def squared(exposures, estimates, skip=5):
    return np.array([np.mean((e.path - x.truth.path) ** 2) for x, e in zip(exposures, estimates, strict=True)])[skip:]


@pytest.mark.slow
@pytest.mark.parametrize("V", [0.1, 0.01, 0.001])
def test_better_than_o1_and_right_about_it(V):
    rig = quiet(RIG, V)
    exposures = simulate(rig, 45, seed=8, inputs=np.zeros((9_000, 1)))
    found = run(rig, exposures, ["o1", "moments", "profile"])
    o1, moments = (squared(exposures, found[name]).mean() for name in ("o1", "moments"))
    ours = squared(exposures, found["profile"]).mean()
    assert ours < 0.5 * o1
    assert ours < 1.1 * moments
    result = score(exposures, found["profile"], 5)
    assert 1.0 < result.start_nees.mean < 3.2
    assert 1.0 < result.end_nees.mean < 3.2
    each = zip(exposures, found["profile"], strict=True)
    inside = [np.abs(e.path - truth_of(x).path) < 1.96 * e.path_sd for x, e in each]
    assert 0.9 < np.mean(inside[5:]) < 0.995
    assert {e.status for e in found["profile"]} == {Status.OK}


# Trust


@pytest.mark.parametrize("axes", [1, 7])
def test_an_axis_does_not_depend_on_those_beside_it(axes):
    rng = np.random.default_rng(4)
    paths = rng.uniform(-0.3, 0.3, (2, 40, 1)) + 0.1 * np.sin(np.linspace(0, 6, 200))
    density = exposure_density(RIG.sensor.kernel, line_of(RIG).edges, paths) + 0.3 * rng.standard_normal((2, 40, 40))

    def estimates(rows):
        plant = dataclasses.replace(RIG.plant, axes=len(range(*rows.indices(40))))
        own = ProfileFilter(plant, RIG.sensor)
        model = exposure_model(plant, 200)
        response = model.response(np.zeros((200, plant.axes)))
        return [own.step(model, response, Profile(density=d[rows], mask=np.ones(d[rows].shape, bool))) for d in density]

    some = slice(3, 3 + axes)
    for alone, together in zip(estimates(some), estimates(slice(0, 40)), strict=True):
        assert alone.coefficients.mean.tobytes() == together.coefficients.mean[some].tobytes()
        assert alone.coefficients.covariance.tobytes() == together.coefficients.covariance[some].tobytes()
        assert alone.nis.tobytes() == together.nis[some].tobytes()


@pytest.mark.slow
def test_the_quadrature_of_an_axis_does_not_depend_on_those_beside_it():
    """One axis of three is commanded; the others are looked at as coarsely as alone."""
    density = np.random.default_rng(3).standard_normal((3, 40)) * 0.3 + exposure_density(
        RIG.sensor.kernel, line_of(RIG).edges, np.zeros(2)
    )
    jump = np.zeros((200, 3))
    jump[60:, 1] = 2.0

    def estimates(rows):
        plant = dataclasses.replace(RIG.plant, axes=len(range(*rows.indices(3))))
        own, model = ProfileFilter(plant, RIG.sensor), exposure_model(plant, 200)
        measured = Profile(density=density[rows], mask=np.ones(density[rows].shape, bool))
        return own.step(model, model.response(jump[:, rows]), measured)

    level = likelihood.reduction(exposure_model(RIG.plant, 200), RIG.sensor).resolution.of(
        exposure_model(dataclasses.replace(RIG.plant, axes=3), 200).response(jump).path
    )
    assert level[1] > level[0] == level[2] == 0
    together = estimates(slice(0, 3))
    for k in range(3):
        alone = estimates(slice(k, k + 1))
        assert alone.coefficients.mean.tobytes() == together.coefficients.mean[k : k + 1].tobytes()
        assert alone.end.covariance.tobytes() == together.end.covariance[k : k + 1].tobytes()


def test_what_commands_left_in_the_state_is_foreseen():
    """A quiet mirror that was kicked rings on by many widths of the kernel, with no input any more."""
    w = 2 * np.pi * 3.0
    A = expm(np.array([[0.0, 1.0], [-(w**2), -0.01 * w]]) * 1e-3)
    noise, kick = np.array([[1e-4]]), np.array([[0.0], [1.0]])
    rig = quiet(load_rig("section-vi"), 0.01)
    plant = dataclasses.replace(
        rig.plant, A=A, B=kick, B_w=kick, process_noise=noise,
        initial_covariance=solve_discrete_lyapunov(A, kick @ noise @ kick.T),
    )  # fmt: skip
    rig, inputs = dataclasses.replace(rig, plant=plant), np.zeros((12 * 200, 1))
    inputs[450] = 5.0
    exposures = simulate(rig, 12, seed=3, inputs=inputs)
    assert np.mean([np.ptp(truth_of(e).path) for e in exposures[3:]]) > 6 * np.sqrt(rig.sensor.kernel.variance)
    error = np.sqrt(squared(exposures, run(rig, exposures, ["profile"])["profile"], 3).mean())
    assert error < 0.01


@pytest.mark.slow
def test_a_lost_mode_is_found_again():
    """Four exposures after a filter was made sure of the opposite."""
    rig = load_rig("jitter")
    found = []
    for seed in range(1, 13):
        filter_, errors = ProfileFilter(rig.plant, rig.sensor), []
        for k, exposure in enumerate(simulate(rig, 11, seed=seed)):
            if k == 5:
                h = filter_.prior
                filter_.prior = GaussianMixture(h.log_weight, -h.mean, 0.3 * h.covariance)
            model = exposure_model(rig.plant, exposure.n_steps)
            measured = must_be(Profile, measure(rig, exposure, PIXELS)[0])
            response = model.response(exposure.inputs)
            posterior = filter_.step(model, response, measured)
            path = model.path(posterior.coefficients.mean, response.path)
            errors.append(np.sqrt(np.mean((path[0] - truth_of(exposure).path) ** 2)))
        found.append(max(errors[9:]) < 2.5 * np.sqrt(np.mean(np.square(errors[1:5]))))
    assert all(found)


def test_the_posterior_of_a_single_coefficient_is_an_integral_over_a_line():
    """For one state without process noise, the posterior is an integral over a line."""
    noise = 0.0 * RIG.plant.process_noise
    one = np.ones((1, 1))
    plant = dataclasses.replace(
        RIG.plant, A=0.999 * one, B=one, B_w=one, C=one, process_noise=noise, initial_mean=np.zeros(1),
        initial_covariance=0.25 * one,
    )  # fmt: skip
    view, state = seen(dataclasses.replace(RIG, plant=plant), width=0.5)
    assert view.reduced.size == 1
    t = np.linspace(-3, 3, 60_001)
    plain = PlainView.of(view)
    log = plain.log_likelihood(plain.predicted(t[None, :, None]))[0] - 0.5 * t**2 / state.covariance[0, 0, 0]
    w = np.exp(log - log.max())
    w /= w.sum()
    mean = w @ t
    sd = np.sqrt(w @ (t - mean) ** 2)
    posterior = ProfileFilter(plant, RIG.sensor).found(view, single(state)).posterior.gaussian
    assert abs(posterior.mean[0, 0] - mean) < 0.2 * sd
    assert np.sqrt(posterior.covariance[0, 0, 0]) == pytest.approx(sd, rel=0.25)


@pytest.mark.slow
def test_an_unstable_plant_does_not_end_in_infinity():
    """What it would be without a camera grows without end; what the camera says of it does not."""
    plant = dataclasses.replace(
        RIG.plant, A=np.array([[1.02, 0.001], [0.0, 0.99]]), process_noise=np.array([[0.1]]),
        initial_covariance=np.diag([1e-4, 1e-2]),
    )  # fmt: skip
    rig = dataclasses.replace(RIG, plant=plant)
    model = exposure_model(plant, 200)
    density = exposure_density(rig.sensor.kernel, line_of(rig).edges, np.zeros((1, 200)))
    centred = Profile(density=density, mask=np.ones_like(density, dtype=bool))
    filter_ = ProfileFilter(plant, rig.sensor)
    # A posterior mean is trusted however unstable the plant is, and what would be without a camera is a number.
    for _ in range(150):
        last = filter_.step(model, model.response(np.zeros((200, 1))), centred)
        assert (last.status == Status.OK).all()
    assert np.isfinite(filter_.prior.mean).all()
    assert np.isfinite(filter_._from_model_only.covariance).all()
