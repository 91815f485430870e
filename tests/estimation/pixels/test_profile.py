"""The estimators of pixels: modes against the gradient and against sampling, claims, faults, independence of axes."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from aolink.errors import EstimatorError
from aolink.estimation import Status, exposure_model, make_estimator, run, score
from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.moments.lines import WindowedMoments
from aolink.estimation.pixels import likelihood
from aolink.estimation.pixels.filter import MixtureFilter
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, single
from aolink.estimation.pixels.importance import importance_corrected
from aolink.estimation.pixels.modes import broad, whitened
from aolink.estimation.pixels.profile import ProfileUpdater, explored
from aolink.numerics.covariance import cholesky
from aolink.optics.kernel import exposure_density
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import PlainView, settled_modes
from tests.estimation.vibrating import vibrating
from tests.kinds import line_of, must_be, truth_of

RIG = load_rig("section-vi-lively")
PROFILE = ProfileUpdater()


def quiet(rig, V):
    return dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, noise_density=V))


def seen(rig=RIG, *, width=1.0, seed=3):
    """One exposure, with a prior of its start state so many times as wide as the plant's own, about the truth."""
    (exposure,) = simulate(rig, 1, seed=seed)
    measured = must_be(Profile, measure(rig, exposure, WindowedMoments(rig.sensor).needs)[0])
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
    start = whitened(prior, broad(view, prior).mean[:, None])
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
        assert abs(slope) < 0.05
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
    update = PROFILE.update(view, single(state), state)
    assert_near(update.coefficients, mean, covariance, 0.25, 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_mixture_is_the_posterior_of_importance_sampling_where_it_is_bent(seed):
    view, state = seen(quiet(RIG, 0.01), width=0.5, seed=seed)
    mean, covariance, effective = by_importance(view, state)
    assert effective > 100
    _, proposal = explored(view, single(state))
    after, points = importance_corrected(view, single(state), proposal, 1.0, np.array([100.0]))
    assert points[0] > 40
    assert_near(after.gaussian, mean, covariance, 0.3, 0.25)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [10, 11])
def test_profile_is_the_mean_of_the_posterior_where_it_has_several_modes(seed):
    """Gaussians about the modes alone are up to 0.7 standard deviations off."""
    view, state = seen(quiet(RIG, 0.003), width=0.5, seed=seed)
    mean, covariance, effective = by_importance(view, state)
    assert effective > 200
    update = PROFILE.update(view, single(state), state)
    assert update.several[0]
    assert_near(update.coefficients, mean, covariance, 0.45, 0.35)


def test_profile_carries_as_many_gaussians_as_it_takes():
    """One of a posterior that is Gaussian; of one with two readings more, whose density is that of the points."""
    one, state = seen(quiet(load_rig("section-vi"), 0.005))
    assert PROFILE.update(one, single(state), state).end.mean.shape[1] == 1
    view, state = seen(quiet(RIG, 0.003), width=0.5, seed=10)
    end = PROFILE.update(view, single(state), state).end
    assert 1 < end.mean.shape[1] <= 3
    whole = single(end.gaussian)
    points = np.concatenate([end.mean[0], whole.mean[0]])[None]
    assert np.abs(end.log_density(points) - whole.log_density(points)).max() > 0.05


def test_evidence_of_a_mode_has_the_weight_of_its_prior():
    view, state = seen(quiet(RIG, 0.01), width=0.3)
    apart = state.mean[:, None] + np.array([[0.0, 0.0], [0.1, 3.0]])
    both = np.repeat(state.covariance[:, None], 2, axis=1) / 4
    weights = np.log([[0.5, 0.5], [0.9, 0.1]])
    each = [explored(view, GaussianMixture(log_weight[None], apart, both))[0] for log_weight in weights]
    assert len({modes.mean.shape for modes in each}) == 1
    # Whose prior led to a mode: those are told apart by what the other weight made of it.
    change = np.sort(each[1].log_evidence[0] - each[0].log_evidence[0])
    np.testing.assert_allclose(each[0].mean, each[1].mean)
    assert change[0] == pytest.approx(np.log(0.1 / 0.5), abs=1e-9)
    assert change[-1] == pytest.approx(np.log(0.9 / 0.5), abs=1e-9)
    assert np.all(np.isclose(change, change[0]) | np.isclose(change, change[-1]))


def test_points_are_drawn_from_the_wide_gaussian_too():
    view, state = seen(quiet(RIG, 0.01), width=0.5)
    _, proposal = explored(view, single(state))
    prior = view.reduced.prior(state)
    wide = broad(view, prior)
    same = np.abs(proposal.mean[0] - wide.mean[0]).max(axis=1) < 1e-12
    assert np.exp(proposal.log_weight[0, same]).sum() == pytest.approx(0.3)


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
    update = PROFILE.update(view, single(state), state)
    assert update.several[0]
    modes, _ = explored(view, single(state))
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


@pytest.mark.slow
def test_intervals_are_honest_about_a_phase_that_no_pixel_tells():
    """A whole swing in each exposure: the blur tells how far the spot swings, and nothing of when.

    The spot is so bright that a path which leaves out too little to be seen would make a phase of the rest.
    """
    turn, decay, sd = 2 * np.pi / 12, np.exp(-1 / 600), 0.09
    A = decay * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    plant = dataclasses.replace(
        RIG.plant, A=A, B=np.zeros((2, 1)), B_w=np.eye(2), process_noise=sd**2 * (1 - decay**2) * np.eye(2),
        initial_covariance=sd**2 * np.eye(2),
    )  # fmt: skip
    kernel = dataclasses.replace(RIG.sensor.kernel, sigma=0.16)
    sensor = dataclasses.replace(
        RIG.sensor, noise_density=3e-4, kernel=kernel, counts_per_density=8000.0, black_level=1000.0
    )
    timing = dataclasses.replace(RIG.timing, exposure_steps=12, frame_period_steps=12)
    rig = dataclasses.replace(RIG, plant=plant, timing=timing, sensor=sensor)
    inside = []
    for seed in range(30, 54):
        exposures = simulate(rig, 12, seed=seed, inputs=np.zeros((144, 1)))
        found = list(zip(exposures, run(rig, exposures, ["profile"])["profile"], strict=True))
        inside += [np.abs(e.path - truth_of(x).path) < 1.96 * e.path_sd for x, e in found[4:]]
    assert 0.87 < np.mean(inside) < 0.99


# Trust


@pytest.mark.parametrize("axes", [1, 7])
def test_an_axis_does_not_depend_on_those_beside_it(axes):
    rng = np.random.default_rng(4)
    paths = rng.uniform(-0.3, 0.3, (2, 40, 1)) + 0.1 * np.sin(np.linspace(0, 6, 200))
    density = exposure_density(RIG.sensor.kernel, line_of(RIG).edges, paths) + 0.3 * rng.standard_normal((2, 40, 40))

    def estimates(rows):
        plant = dataclasses.replace(RIG.plant, axes=len(range(*rows.indices(40))))
        own = MixtureFilter(plant, RIG.sensor, PROFILE)
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
        own, model = MixtureFilter(plant, RIG.sensor, PROFILE), exposure_model(plant, 200)
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
    """Two exposures after a filter was made sure of the opposite; without doubt it takes four."""
    rig = load_rig("jitter")
    how, found = WindowedMoments(line_of(rig)).needs, []
    for seed in range(1, 13):
        filter_, errors = MixtureFilter(rig.plant, rig.sensor, PROFILE), []
        for k, exposure in enumerate(simulate(rig, 9, seed=seed)):
            if k == 5:
                h = filter_.prior
                filter_.prior = GaussianMixture(h.log_weight, -h.mean, 0.3 * h.covariance)
            model = exposure_model(rig.plant, exposure.n_steps)
            measured = must_be(Profile, measure(rig, exposure, how)[0])
            response = model.response(exposure.inputs)
            posterior = filter_.step(model, response, measured)
            path = model.path(posterior.coefficients.mean, response.path)
            errors.append(np.sqrt(np.mean((path[0] - truth_of(exposure).path) ** 2)))
        found.append(max(errors[7:]) < 2.5 * np.sqrt(np.mean(np.square(errors[1:5]))))
    assert sum(found) >= 9


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
    log = PlainView.of(view).log_likelihoods(t[None, :, None])[0] - 0.5 * t**2 / state.covariance[0, 0, 0]
    w = np.exp(log - log.max())
    w /= w.sum()
    mean = w @ t
    sd = np.sqrt(w @ (t - mean) ** 2)
    update = PROFILE.update(view, single(state), state)
    assert not update.poor[0]
    assert abs(update.coefficients.mean[0, 0] - mean) < 0.2 * sd
    assert np.sqrt(update.coefficients.covariance[0, 0, 0]) == pytest.approx(sd, rel=0.25)


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
    filter_ = MixtureFilter(plant, rig.sensor, PROFILE)
    # A posterior mean is trusted however unstable the plant is, and what would be without a camera is a number.
    for _ in range(150):
        last = filter_.step(model, model.response(np.zeros((200, 1))), centred)
        assert (last.status == Status.OK).all()
    assert np.isfinite(filter_.prior.mean).all()
    assert np.isfinite(filter_._unseen.covariance).all()


def test_few_points_are_reported_but_not_where_the_frame_cannot_be_believed():
    rig = vibrating(1)
    view, state = seen(rig, seed=1)
    lie = view.part(slice(None))
    lie.y = np.roll(np.abs(lie.y), 15, axis=1) + 3.0
    of_a_lie = PROFILE.update(lie, single(state), state)
    assert not of_a_lie.innovation.within_gate[0]
    assert not of_a_lie.poor[0]
    assert PROFILE.update(view, single(state), state).poor[0]
    (exposure,) = simulate(rig, 1, seed=1, inputs=np.zeros((rig.timing.exposure_steps, 1)))
    reason = make_estimator(rig, "profile").step(exposure).reason
    assert reason.endswith("too few of the paths tried fit the blur: the estimate is wider for it")


def test_a_part_of_the_exposures_gets_the_random_numbers_of_the_whole():
    """A filter that is given the state of another goes on as that one does, however many exposures came before."""
    exposures = simulate(RIG, 4, seed=2)
    whole, part = (make_estimator(RIG, "profile") for _ in range(2))
    whole.step(exposures[0])
    ours, theirs = (must_be(MixtureFilter, each.filter) for each in (part, whole))
    ours.prior, ours._unseen = theirs.prior, theirs._unseen
    for exposure in exposures[1:3]:
        assert whole.step(exposure).path.tobytes() == part.step(exposure).path.tobytes()


def log_evidence(estimator):
    return float(must_be(np.ndarray, estimator.posterior.log_evidence).sum())


def test_few_draws_find_the_same_motion_and_nearly_the_same_evidence():
    rig = load_rig("jitter")
    usual, few = make_estimator(rig, "profile"), make_estimator(rig, "profile:draws=5")
    apart, evidence = [], []
    for exposure in list(simulate(rig, 8, seed=4))[2:]:
        one, other = usual.step(exposure), few.step(exposure)
        apart.append(np.sqrt(np.mean((one.path - other.path) ** 2) / np.mean(one.path_sd**2)))
        evidence.append([log_evidence(each) for each in (usual, few)])
    assert 0 < np.median(apart) < 0.5
    assert np.abs(np.diff(np.sum(evidence, axis=0))) < 10


@pytest.mark.parametrize("draws", [0, 401])
def test_a_share_of_the_draws_that_makes_no_sense_is_refused(draws):
    with pytest.raises(EstimatorError, match=f"draws = {draws}: use 1 to 400 per cent of the usual points"):
        make_estimator(RIG, "profile", draws=draws)
