"""Windowed moments: every expectation against sampling, the estimator against o1 and against its own claims."""

import dataclasses

import numpy as np
import pytest
from scipy import linalg

from aolink.estimation import Status, exposure_model, run, score
from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.kalman.filter import BlurFilter
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.quadrature import equal_parts, quadrature_paths
from aolink.estimation.moments.lines import WindowedMoments
from aolink.estimation.moments.windowed import weighted_sums
from aolink.optics.camera import pixel_noise_sd, shot_gain
from aolink.optics.kernel import exposure_density, pixel_mass
from aolink.rig import Rig, load_rig
from aolink.rig.parts import UnmodelledSlopes
from aolink.simulation.model import simulate
from tests.estimation.moments.plain import PlainMoments
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


def spread_prior(axes=2):
    """A prior of the lively plant's coefficients about an offset."""
    model = exposure_model(dataclasses.replace(RIG.plant, axes=axes), 200)
    count = model.n_coefficients
    covariance = np.eye(count)
    covariance[:2, :2] = RIG.plant.initial_covariance / 4
    mean = np.zeros((axes, count))
    mean[:, 0] = np.linspace(0.2, -0.3, axes)
    return model, Gaussian(mean, np.tile(covariance, (axes, 1, 1)))


@pytest.mark.slow
def test_regression_is_that_of_samples():
    model, prior = spread_prior()
    observation = PlainMoments(SENSOR)
    nodes = quadrature_paths(
        model, model.response(np.zeros((model.n_steps, model.plant.axes))), equal_parts(model.n_steps, 100)
    )
    rows, weights = nodes.basis[0], nodes.weights
    mean = prior.mean @ rows.T
    spread = rows @ prior.covariance @ rows.T
    W = observation.window_weights(mean, np.einsum("akk->ak", spread), np.ones((2, 40), bool))
    fit = observation.regression(W, mean, spread, rows, weights)
    rng = np.random.default_rng(1)
    samples = 4000
    z = rng.standard_normal((samples, len(prior.mean[0]))) @ np.linalg.cholesky(prior.covariance[0]).T
    paths = (z + prior.mean[0]) @ rows.T
    y = np.array([weights @ pixel_mass(SENSOR.kernel, SENSOR.edges, path) for path in paths]) @ W[0].T
    slope = np.linalg.lstsq(np.column_stack([np.ones(samples), z]), y, rcond=None)[0][1:].T
    rest = y - y.mean(axis=0) - z @ slope.T
    scale = y.std(axis=0)
    np.testing.assert_allclose(fit.expected[0], y.mean(axis=0), atol=0.05 * scale.max())
    np.testing.assert_allclose(
        fit.slope[0] @ prior.covariance[0] @ fit.slope[0].T, np.cov((z @ slope.T).T), atol=0.1 * scale.max() ** 2
    )
    # Two terms of the series; what they leave out is small where the prior is no wider than this.
    np.testing.assert_allclose(fit.remainder[0], np.cov(rest.T), atol=0.12 * scale.max() ** 2)


def test_slope_is_the_derivative_of_what_is_expected():
    model, prior = spread_prior(1)
    observation = PlainMoments(SENSOR)
    nodes = quadrature_paths(
        model, model.response(np.zeros((model.n_steps, model.plant.axes))), equal_parts(model.n_steps, 100)
    )
    rows, weights = nodes.basis[0], nodes.weights
    spread = rows @ prior.covariance @ rows.T
    W = observation.window_weights(prior.mean @ rows.T, np.einsum("akk->ak", spread), np.ones((1, 40), bool))

    def at(z):
        return observation.regression(W, z @ rows.T, spread, rows, weights)

    slope = at(prior.mean).slope[0]
    for k in range(slope.shape[1]):
        h = np.zeros_like(prior.mean)
        h[0, k] = 1e-5
        difference = (at(prior.mean + h).expected - at(prior.mean - h).expected)[0] / 2e-5
        np.testing.assert_allclose(slope[:, k], difference, atol=1e-7)


def test_expected_sums_are_those_of_a_noiseless_frame():
    """Window, mask, kernel and pixels are all in the expectation: there is no bias to remove."""
    path = 0.2 + 0.15 * np.sin(np.linspace(0, 4, 200))
    density = exposure_density(SENSOR.kernel, SENSOR.edges, path)[None]
    mask = np.ones((1, 40), bool)
    mask[0, 24] = False
    observation = PlainMoments(SENSOR)
    W = observation.window_weights(path[None], np.zeros((1, 200)), mask)
    fit = observation.regression(W, path[None], np.zeros((1, 200, 200)), np.zeros((200, 3)), np.full(200, 1 / 200))
    y, _ = weighted_sums(observation.sensor, W, density)
    np.testing.assert_allclose(y, fit.expected, atol=1e-12)
    assert W[0, 0, 24] == 0


@pytest.mark.parametrize("photoelectrons", [0.0, 400.0])
def test_noise_of_the_sums_is_that_of_many_frames(photoelectrons):
    path = np.linspace(0.1, 0.4, 200)
    clean = exposure_density(SENSOR.kernel, SENSOR.edges, path)
    rng = np.random.default_rng(3)
    sensor = dataclasses.replace(SENSOR, photoelectrons=photoelectrons)
    sd = np.sqrt(pixel_noise_sd(sensor) ** 2 + shot_gain(sensor) * clean)
    observation = PlainMoments(sensor)
    W = observation.window_weights(path[None], np.full((1, 200), 0.001), np.ones((1, 40), bool))
    _, noise = weighted_sums(observation.sensor, W, clean[None])
    spread = np.cov((clean + sd * rng.standard_normal((20_000, 40))) @ W[0].T * SENSOR.pixel_width, rowvar=False)
    np.testing.assert_allclose(noise[0], spread, atol=0.03 * spread.max())


def test_equal_parts_of_the_steps_keep_the_mean_of_the_path():
    model = exposure_model(RIG.plant, 1037)
    nodes = quadrature_paths(
        model, model.response(np.zeros((model.n_steps, model.plant.axes))), equal_parts(model.n_steps, 100)
    )
    rows, weights = nodes.basis[0], nodes.weights
    assert len(weights) <= 100
    np.testing.assert_allclose(weights @ rows, model.basis[0].mean(axis=0), atol=1e-14)


# In compiled code


@pytest.mark.parametrize("photoelectrons", [0.0, 400.0])
@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_the_update_is_that_of_the_twin(photoelectrons, offset):
    rng, axes = np.random.default_rng(4), 5
    sensor = dataclasses.replace(SENSOR, photoelectrons=photoelectrons)
    unmodelled = UnmodelledSlopes(sd=0.04, correlation_steps=30.0) if offset else None
    plant = dataclasses.replace(RIG.plant, axes=axes, unmodelled=unmodelled)
    model = exposure_model(plant, 150, offset)
    prior = Gaussian(rng.normal(0, 0.1, (axes, 2)), np.tile(plant.initial_covariance / 3, (axes, 1, 1)))
    paths = rng.uniform(-0.3, 0.3, (axes, 1)) + 0.1 * np.sin(np.linspace(0, 6, 150))
    mask = rng.random((axes, 40)) > 0.02
    density = exposure_density(SENSOR.kernel, SENSOR.edges, paths) + 0.1 * rng.standard_normal((axes, 40))
    light = rng.uniform(0.5, 1.5, axes) if photoelectrons else None
    given = (
        model, model.response(rng.normal(0, 0.01, (150, axes))), prior.with_noise(model.n_coefficients),
        Profile(density=np.where(mask, density, 0.0), mask=mask, light=light),
    )  # fmt: skip
    ours, twin = WindowedMoments(sensor).update(*given), PlainMoments(sensor).update(*given)
    for found, expected in (
        (ours.posterior.mean, twin.posterior.mean), (ours.posterior.covariance, twin.posterior.covariance),
        (ours.innovation, twin.innovation), (ours.innovation_covariance, twin.innovation_covariance),
        (ours.nis, twin.nis),
    ):  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())


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
        filter_ = BlurFilter(plant, WindowedMoments(SENSOR))
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
        filter_ = BlurFilter(plant, WindowedMoments(SENSOR))
        profile = Profile(density=np.full((2, 40), density), mask=np.ones((2, 40), bool))
        profile.density[1] = exposure_density(SENSOR.kernel, SENSOR.edges, np.zeros(200))
        with np.errstate(all="ignore"):
            done = filter_.step(model, model.response(np.zeros((200, 2))), profile)
        assert list(done.status) == [Status.GATED, Status.OK]
        assert np.isfinite(done.coefficients.mean).all()
        assert np.isfinite(done.nis).all()
