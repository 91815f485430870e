"""Windowed moments: every expectation against sampling, the estimator against o1 and against its own claims."""

import dataclasses

import numpy as np
import pytest
from scipy import linalg

from aolink.estimation import Status, exposure_model, run, score
from aolink.estimation.compiled.windows import Path
from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.kalman.filter import BlurFilter
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import Dynamics
from aolink.estimation.model.quadrature import equal_parts, quadrature_paths
from aolink.estimation.moments.windowed import Inflation, WindowedMoments, inflation, path_of, windows_of
from aolink.numerics.covariance import psd_root
from aolink.optics.camera import pixel_noise_sd, shot_gain
from aolink.optics.kernel import exposure_density, pixel_mass
from aolink.rig import Rig, load_rig
from aolink.simulation.model import simulate
from tests.kinds import line_of

RIG = load_rig("section-vi-lively")
SENSOR = line_of(RIG)


def rig_with(noise: float, V: float, *, resonance_hz: float | None = None) -> Rig:
    """Section VI's plant, or a resonance of sd 0.2, at other noises; the counts leave room for both."""
    plant = RIG.plant
    A, B_w = plant.A, plant.B_w
    if resonance_hz:
        w = 2 * np.pi * resonance_hz
        A, B_w = linalg.expm(np.array([[0, 1], [-w * w, -0.01 * w]]) * 1e-3), np.array([[0.0], [1.0]])
        noise = 0.04 / linalg.solve_discrete_lyapunov(A, B_w @ B_w.T)[0, 0]
    stationary = np.asarray(linalg.solve_discrete_lyapunov(A, noise * B_w @ B_w.T), dtype=float)
    plant = dataclasses.replace(plant, A=A, B_w=B_w, process_noise=np.array([[noise]]), initial_covariance=stationary)
    sensor = dataclasses.replace(SENSOR, noise_density=V, counts_per_density=1500.0)
    return dataclasses.replace(RIG, plant=plant, sensor=sensor)


def errors(exposures, estimates, skip=10):
    """Squared path error of each exposure."""
    pairs = list(zip(exposures, estimates, strict=True))[skip:]
    return np.array([np.mean((e.path - x.truth.path) ** 2) for x, e in pairs])


def upper_bound_of_ratio(ours, theirs, seed=0):
    """Upper 95 % bootstrap bound of the paired RMSE ratio, in blocks of 20 exposures, which are not independent."""
    rng, blocks = np.random.default_rng(seed), len(ours) // 20
    a, b = (e[: blocks * 20].reshape(blocks, 20).mean(axis=1) for e in (ours, theirs))
    picks = rng.integers(0, blocks, (2000, blocks))
    return np.quantile(np.sqrt(a[picks].mean(axis=1) / b[picks].mean(axis=1)), 0.95)


# What is expected, by sampling


def nodes_of(rig, steps=200):
    model = exposure_model(dataclasses.replace(rig.plant, axes=1), steps)
    return model, quadrature_paths(
        model, model.response(np.zeros((steps, model.plant.n_inputs))), equal_parts(steps, 50)
    )


def prior_of(rig, model, share=0.25, seed=0):
    """A prior of an exposure's coefficients about an offset."""
    count, n = model.n_coefficients, rig.plant.n_states
    covariance, mean = np.eye(count), np.zeros((1, count))
    covariance[:n, :n] = rig.plant.initial_covariance * share
    mean[0, :n] = psd_root(rig.plant.initial_covariance) @ np.random.default_rng(seed).normal(0, 0.5, n)
    return Gaussian(mean, covariance[None])


def dark(shape, **changes):
    return windows_of(Profile(density=np.zeros(shape), mask=np.ones(shape, bool), **changes))


@pytest.mark.slow
def test_regression_is_that_of_samples():
    model, nodes = nodes_of(RIG)
    prior, observation = prior_of(RIG, model), WindowedMoments(SENSOR, 1)
    fit = observation.regression(dark((1, 40)), path_of(nodes), prior)
    rng, samples = np.random.default_rng(1), 4000
    z = rng.standard_normal((samples, model.n_coefficients)) @ np.linalg.cholesky(prior.covariance[0]).T
    paths = (z + prior.mean[0]) @ nodes.basis[0].T
    frames = np.array([nodes.weights @ pixel_mass(SENSOR.kernel, SENSOR.edges, path) for path in paths])
    # The window is that of the prior, whatever the frame, so the sums of frames are values of the same observation.
    windows = windows_of(Profile(density=frames / SENSOR.pixel_width, mask=np.ones(frames.shape, bool)))
    many = Gaussian(np.tile(prior.mean, (samples, 1)), np.tile(prior.covariance, (samples, 1, 1)))
    path = path_of(nodes)._replace(inputs=np.zeros((samples, 1, len(nodes.weights))))
    y = observation.regression(windows, path, many).value
    slope = np.linalg.lstsq(np.column_stack([np.ones(samples), z]), y, rcond=None)[0][1:].T
    rest = y - y.mean(axis=0) - z @ slope.T
    scale = y.std(axis=0)
    np.testing.assert_allclose(fit.expected[0], y.mean(axis=0), atol=0.05 * scale.max())
    np.testing.assert_allclose(
        fit.slope[0] @ prior.covariance[0] @ fit.slope[0].T, np.cov((z @ slope.T).T), atol=0.1 * scale.max() ** 2
    )
    # Two terms of the series; what they leave out is small where the prior is no wider than this.
    np.testing.assert_allclose(fit.remainder[0], np.cov(rest.T), atol=0.12 * scale.max() ** 2)


@pytest.mark.parametrize("photoelectrons", [0.0, 400.0])
def test_noise_of_the_sums_is_that_of_many_frames(photoelectrons):
    clean = exposure_density(SENSOR.kernel, SENSOR.edges, np.linspace(0.1, 0.4, 200))
    sensor = dataclasses.replace(SENSOR, photoelectrons=photoelectrons)
    sd = np.sqrt(pixel_noise_sd(sensor) ** 2 + shot_gain(sensor) * clean)
    model, nodes = nodes_of(RIG)
    count, observation, path = 20_000, WindowedMoments(sensor, 1), path_of(nodes)
    frames = np.concatenate([clean[None], clean + sd * np.random.default_rng(3).standard_normal((count, 40))])
    prior = prior_of(RIG, model, share=1e-3)
    many = Gaussian(np.tile(prior.mean, (count + 1, 1)), np.tile(prior.covariance, (count + 1, 1, 1)))
    found = observation.regression(
        windows_of(Profile(density=frames, mask=np.ones(frames.shape, bool))),
        path._replace(inputs=np.zeros((count + 1, 1, len(nodes.weights)))), many,
    )  # fmt: skip
    spread = np.cov(found.value[1:], rowvar=False)
    np.testing.assert_allclose(found.noise[0], spread, atol=0.03 * spread.max())


def test_expected_sums_are_those_of_a_noiseless_frame():
    """Window, mask, kernel and pixels are all in the expectation: there is no bias to remove."""
    path = 0.2 + 0.15 * np.sin(np.linspace(0, 4, 200))
    density = exposure_density(SENSOR.kernel, SENSOR.edges, path)[None]
    mask = np.ones((1, 40), bool)
    mask[0, 24] = False
    still = Path(basis=np.zeros((1, 3, 200)), inputs=path[None, None], weights=np.full(200, 1 / 200))
    nothing = Gaussian(np.zeros((1, 3)), np.zeros((1, 3, 3)))
    windows = windows_of(Profile(density=np.where(mask, density, 0.0), mask=mask))
    fit = WindowedMoments(SENSOR, 1).regression(windows, still, nothing)
    np.testing.assert_allclose(fit.value, fit.expected, atol=1e-11)
    whole = windows_of(Profile(density=density, mask=np.ones((1, 40), bool)))
    assert abs(WindowedMoments(SENSOR, 1).regression(whole, still, nothing).value - fit.value).max() > 1e-3


@pytest.mark.parametrize("kind", ["line", "plane"])
def test_slope_is_the_derivative_of_what_is_expected(kind):
    """The window is where the spread is wide, so a small move of the mean leaves it as it is."""
    rig = RIG if kind == "line" else load_rig("tip-tilt")
    model, nodes = nodes_of(rig, rig.timing.exposure_steps)
    prior, outputs = prior_of(rig, model), rig.plant.n_outputs
    size = rig.sensor.profile.pixels
    shape = (1, size) if kind == "line" else (1, outputs // 2, size, size)
    observation = WindowedMoments(rig.sensor, outputs)
    # All pixels are in the window whichever way the mean moves.
    wide = Gaussian(prior.mean, prior.covariance * 60)

    def at(mean):
        return observation.regression(dark(shape), path_of(nodes), Gaussian(mean, wide.covariance))

    slope = at(prior.mean).slope[0]
    for k in range(min(slope.shape[1], 6)):
        h = np.zeros_like(prior.mean)
        h[0, k] = 1e-5
        difference = (at(prior.mean + h).expected - at(prior.mean - h).expected)[0] / 2e-5
        np.testing.assert_allclose(slope[:, k], difference, atol=2e-3 * np.abs(slope).max())


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.999999, 1.5])
def test_errors_that_return_count_as_often_as_they_do(rho):
    """The variance of a mean of many errors with this correlation, over that of independent ones."""
    factor = float(inflation(np.array(rho)))
    if rho < 0.9:
        count = 4000
        each = rho ** np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
        assert factor == pytest.approx(each.sum() / count, rel=2e-3)
    else:
        assert factor == 1e3


def test_a_state_that_stays_but_is_known_does_not_count():
    """A constant beside a vibration changes nothing of how long the vibration's errors last."""
    turn, decay = 1.3, 0.8
    A = decay * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    both = linalg.block_diag(A, np.eye(1))
    known = np.diag([0.04, 0.04, 1e-8])[None]
    alone = Inflation(Dynamics(A, A, np.eye(2)), Gaussian(np.zeros((1, 2)), known[:, :2, :2]))
    beside = Inflation(Dynamics(both, both, np.eye(3)), Gaussian(np.zeros((1, 3)), known))
    assert beside.by_plant[0] == pytest.approx(alone.by_plant[0], rel=1e-6)
    assert alone.by_plant[0] == pytest.approx((1 + decay) / (1 - decay), rel=1e-9)


# What it is good for


# Noise, V, and the RMSE that a windowed centroid with a noise-aware filter has on this plant.
TABLE = [(0.1, 0.1, 0.0066), (0.1, 0.001, 0.0027), (10, 0.1, 0.0240)]


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "V", "windowed_centroid"), TABLE)
def test_as_good_as_a_windowed_centroid_and_never_worse_than_o1(noise, V, windowed_centroid):
    rig = rig_with(noise, V)
    exposures = simulate(rig, 410, seed=8, inputs=np.zeros((82_000, 1)))
    estimates = run(rig, exposures, ["o1", "moments"])
    o1, ours = (errors(exposures, estimates[name]) for name in ("o1", "moments"))
    assert np.sqrt(ours.mean()) < 1.1 * windowed_centroid
    assert upper_bound_of_ratio(ours, o1) <= 1.02
    result = score(exposures, estimates["moments"], 10)
    for consistency in (result.start_nees, result.end_nees):
        assert consistency.mean == pytest.approx(2.0, abs=0.35)
    assert {e.status for e in estimates["moments"]} == {Status.OK}


@pytest.mark.parametrize("resonance_hz", [5.0, 12.0])
def test_a_blur_that_has_several_readings_is_not_believed_in_one(resonance_hz):
    """At 5 Hz an exposure is one whole period: the blur shows the amplitude and nothing of the phase."""
    rig = rig_with(0, 0.001, resonance_hz=resonance_hz)
    exposures = simulate(rig, 210, seed=2, inputs=np.zeros((42_000, 1)))
    estimates = run(rig, exposures, ["o1", "moments"])
    o1, ours = (errors(exposures, estimates[name]) for name in ("o1", "moments"))
    assert upper_bound_of_ratio(ours, o1) <= (1.02 if resonance_hz == 5 else 0.7)
    assert score(exposures, estimates["moments"], 10).end_nees.mean < 2.6


# Trust


@pytest.mark.slow
def test_shot_noise_by_the_rig_file_is_allowed_for():
    """With 300 photo-electrons there is more noise than the camera's own; without allowing for it, NEES shows it."""
    sensor = dataclasses.replace(SENSOR, noise_density=1e-4, photoelectrons=300.0)
    plant = dataclasses.replace(
        RIG.plant, process_noise=np.array([[0.5]]), initial_covariance=RIG.plant.initial_covariance / 20
    )
    rig = dataclasses.replace(RIG, plant=plant, sensor=sensor)
    exposures = simulate(rig, 210, seed=9)
    without_shot = dataclasses.replace(rig, sensor=dataclasses.replace(sensor, photoelectrons=0.0))
    aware, unaware = (
        score(exposures, run(each, exposures, ["moments"])["moments"], 10) for each in (rig, without_shot)
    )
    assert aware.nis.mean == pytest.approx(4.0, abs=0.6)
    assert unaware.nis.mean > 1.3 * aware.nis.mean


@pytest.mark.parametrize("axes", [1, 7])
def test_an_axis_does_not_depend_on_those_beside_it(axes):
    rng = np.random.default_rng(4)
    paths = rng.uniform(-0.3, 0.3, (5, 64, 1)) + 0.1 * np.sin(np.linspace(0, 6, 200))
    density = exposure_density(SENSOR.kernel, SENSOR.edges, paths) + 0.3 * rng.standard_normal((5, 64, 40))
    mask = rng.random((5, 64, 40)) > 0.02

    def steps(n):
        plant = dataclasses.replace(RIG.plant, axes=n)
        filter_ = BlurFilter(plant, WindowedMoments(SENSOR, 1))
        model = exposure_model(plant, 200)
        for frame, usable in zip(density, mask, strict=True):
            response = model.response(np.full((200, n), 0.001))
            yield filter_.step(model, response, Profile(density=frame[:n], mask=usable[:n]))

    for few, many in zip(steps(axes), steps(64), strict=True):
        np.testing.assert_array_equal(few.coefficients.mean, many.coefficients.mean[:axes])
        np.testing.assert_array_equal(few.coefficients.covariance, many.coefficients.covariance[:axes])
        np.testing.assert_array_equal(few.end.covariance, many.end.covariance[:axes])
        np.testing.assert_array_equal(few.nis, many.nis[:axes])
        np.testing.assert_array_equal(few.status, many.status[:axes])


def test_lost_frames_and_dead_time_are_bridged():
    timing = dataclasses.replace(RIG.timing, frame_period_steps=230)
    rig = dataclasses.replace(RIG, timing=timing)
    exposures = simulate(rig, 120, seed=7)
    lost = exposures[40]
    lead = np.concatenate([lost.lead_inputs, lost.inputs, exposures[41].lead_inputs])
    series = [*exposures[:40], dataclasses.replace(exposures[41], lead_inputs=lead), *exposures[42:]]
    estimates = run(rig, series, ["moments", "o1"])
    assert {(e.status, e.reason) for e in estimates["moments"]} == {(Status.OK, "")}
    ours, o1 = (score(series, estimates[name], 10) for name in ("moments", "o1"))
    assert ours.path_rmse < 0.5 * o1.path_rmse
    assert ours.end_nees.mean == pytest.approx(2.0, abs=0.5)


def test_numbers_beyond_all_bounds_are_gated_and_stop_nothing():
    """Densities near the largest number."""
    plant = dataclasses.replace(RIG.plant, axes=2)
    model = exposure_model(plant, 200)
    for density in (1e200, -1e200):
        filter_ = BlurFilter(plant, WindowedMoments(SENSOR, 1))
        profile = Profile(density=np.full((2, 40), density), mask=np.ones((2, 40), bool))
        profile.density[1] = exposure_density(SENSOR.kernel, SENSOR.edges, np.zeros(200))
        with np.errstate(all="ignore"):
            done = filter_.step(model, model.response(np.zeros((200, 2))), profile)
        assert list(done.status) == [Status.GATED, Status.OK]
        assert np.isfinite(done.coefficients.mean).all()
        assert np.isfinite(done.nis).all()
