"""Few nodes in the place of all fast steps: exact where they are to be, and as right as the camera asks for."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.estimation import exposure_model
from aolink.estimation.model import quadrature
from aolink.estimation.pixels import likelihood
from aolink.optics.camera import effective_noise_density
from aolink.optics.kernel import exposure_density
from aolink.rig import load_rig
from tests.kinds import line_of

LIVELY, SHAKEN = load_rig("section-vi-lively"), load_rig("jitter")


@given(st.integers(2, 400), st.integers(1, 30))
def test_gauss_is_exact_for_polynomials(n_steps: int, count: int) -> None:
    if count >= n_steps:
        return
    q = quadrature.gauss(n_steps, count)
    time = (np.arange(n_steps) - (n_steps - 1) / 2) / n_steps
    places = q.at(time)
    np.testing.assert_allclose(places, -places[::-1], atol=1e-12)
    np.testing.assert_allclose(q.weights, q.weights[::-1], atol=1e-12)
    assert q.weights.min() > 0
    for degree in range(min(2 * count, 20)):
        assert q.weights @ places**degree == pytest.approx(np.mean(time**degree), abs=1e-10)


@given(st.integers(1, 300), st.integers(1, 300))
def test_equal_parts_of_the_steps_keep_the_mean_of_a_path(n_steps: int, most: int) -> None:
    q = quadrature.equal_parts(n_steps, most)
    path = np.random.default_rng(n_steps).standard_normal(n_steps)
    assert len(q.weights) <= max(most, 1)
    assert q.at(path) @ q.weights == pytest.approx(path.mean(), abs=1e-12)
    if most >= n_steps:
        np.testing.assert_array_equal(q.at(path), path)


def wrong(rig, seed=5, count=200):
    """Rms error of the light of paths at the nodes, in standard deviations of the pixels' noise; and their number."""
    model = exposure_model(rig.plant, rig.timing.exposure_steps)
    reduced = likelihood.reduction(model, rig.sensor)
    q = reduced.resolution.levels[0]
    rng, n = np.random.default_rng(seed), rig.plant.n_states
    t = rng.standard_normal((count, reduced.size))
    t[:, :n] = t[:, :n] @ np.linalg.cholesky(rig.plant.initial_covariance + 1e-15 * np.eye(n)).T
    paths = t @ (model.basis @ reduced.expand)[0].T
    kernel, edges = rig.sensor.kernel, rig.sensor.edges
    noise = effective_noise_density(rig.sensor) / rig.sensor.pixel_size
    light = np.stack([exposure_density(kernel, edges, path) for path in paths])
    at_nodes = sum(
        w * np.stack([exposure_density(kernel, edges, place[None]) for place in places])
        for w, places in zip(q.weights, q.at(paths).T, strict=True)
    )
    return np.sqrt(((light - at_nodes) ** 2).sum(axis=1).mean() / noise), len(q.weights)


@pytest.mark.parametrize("V", [0.1, 0.001])
def test_a_slow_spot_needs_few_nodes(V):
    error, count = wrong(dataclasses.replace(LIVELY, sensor=dataclasses.replace(LIVELY.sensor, noise_density=V)))
    assert error < 0.15
    assert count <= 14


def test_a_quiet_camera_needs_more_of_them():
    counts = [
        wrong(dataclasses.replace(LIVELY, sensor=dataclasses.replace(LIVELY.sensor, noise_density=V)), count=2)[1]
        for V in (1.0, 0.01, 1e-5)
    ]
    assert counts[0] < counts[1] < counts[2]


@pytest.mark.slow
def test_a_spot_that_goes_back_and_forth_needs_many():
    error, count = wrong(SHAKEN)
    assert error < 0.15
    assert 12 < count <= SHAKEN.timing.exposure_steps


def light_of(sensor, paths, weights):
    return sum(
        w * np.stack([exposure_density(sensor.kernel, sensor.edges, place[None]) for place in places])
        for w, places in zip(weights, paths.T, strict=True)
    )


@pytest.mark.parametrize("rig", [LIVELY, load_rig("section-vi")])
def test_a_foreseen_path_is_looked_at_as_finely_as_it_asks_for(rig):
    """Ramps, swings and jumps of up to the whole sensor; old commands may be behind them as well as new ones."""
    sensor, found = rig.sensor, likelihood.reduction(exposure_model(rig.plant, 200), rig.sensor).resolution
    time = np.linspace(0, 1, 200)
    shapes = np.stack([time - 0.5, np.sin(9 * time), np.where(time > 0.37, 0.5, -0.5), np.abs(time - 0.4)])
    noise = effective_noise_density(sensor) / sensor.pixel_size
    levels = []
    for size in (0.0, 0.01, 0.1, 0.3, 1.0):
        paths = size * shapes
        level = found.of(paths[:, None])
        for path, k in zip(paths, level, strict=True):
            q = found.levels[k]
            away = light_of(sensor, q.at(path)[None], q.weights) - exposure_density(sensor.kernel, sensor.edges, path)
            assert np.sqrt((away**2).sum() / noise) < 0.3
        levels.append(level)
    assert np.all(levels[0] == 0)
    assert np.all(np.diff(levels, axis=0) >= 0)
    assert np.all(levels[-1] > 0)
    # An axis does not depend on those beside it.
    assert np.array_equal(found.of(shapes[:, None]), [found.of(each[None, None])[0] for each in shapes])
    assert len(found.levels[-1].weights) == 200


def test_wherever_a_step_begins_it_is_the_same():
    late = exposure_model(LIVELY.plant, 200, 0.3)
    assert (
        likelihood.reduction(late, LIVELY.sensor).resolution
        is likelihood.reduction(exposure_model(LIVELY.plant, 200), LIVELY.sensor).resolution
    )


def test_paths_without_light_say_nothing():
    wild = dataclasses.replace(SHAKEN.plant, initial_covariance=1e8 * SHAKEN.plant.initial_covariance)
    found = likelihood.reduction(exposure_model(wild, SHAKEN.timing.exposure_steps), SHAKEN.sensor).resolution
    assert len(found.levels[0].weights) > 50


def test_wide_pixels_and_a_narrow_kernel_have_a_resolution():
    narrow = dataclasses.replace(LIVELY.sensor.kernel, sigma=0.01)
    sensor = dataclasses.replace(line_of(LIVELY), pixels=3, kernel=narrow)
    assert likelihood.reduction(exposure_model(LIVELY.plant, 200), sensor).resolution.stride > 0


@pytest.mark.parametrize("n_steps", [1, 2, 3, 4, 7])
def test_weights_of_short_exposures_add_up_to_one(n_steps):
    found = likelihood.reduction(exposure_model(LIVELY.plant, n_steps), LIVELY.sensor).resolution
    for q in found.levels:
        assert q.weights.sum() == pytest.approx(1.0)
    assert found.of(np.zeros((2, 1, n_steps))).tolist() == [0, 0]
