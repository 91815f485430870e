"""Few nodes in the place of all fast steps: exact where they are to be, and as right as the camera asks for."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.estimation import exposure_model, nodes, pixels
from aolink.optics.camera import effective_noise_density
from aolink.optics.kernel import exposure_density
from aolink.rig import load_rig

LIVELY, SHAKEN = load_rig("section-vi-lively"), load_rig("jitter")


@given(st.integers(2, 400), st.integers(1, 30))
def test_gauss_is_exact_for_polynomials(n_steps: int, count: int) -> None:
    if count >= n_steps:
        return
    q = nodes.gauss(n_steps, count)
    time = (np.arange(n_steps) - (n_steps - 1) / 2) / n_steps
    places = q.at(time)
    np.testing.assert_allclose(places, -places[::-1], atol=1e-12)
    np.testing.assert_allclose(q.weights, q.weights[::-1], atol=1e-12)
    assert q.weights.min() > 0
    for degree in range(min(2 * count, 20)):
        assert q.weights @ places**degree == pytest.approx(np.mean(time**degree), abs=1e-10)


@given(st.integers(1, 300), st.integers(1, 300))
def test_blocks_keep_the_mean(n_steps: int, most: int) -> None:
    q = nodes.blocks(n_steps, most)
    path = np.random.default_rng(n_steps).standard_normal(n_steps)
    assert len(q.weights) <= max(most, 1)
    assert q.at(path) @ q.weights == pytest.approx(path.mean(), abs=1e-12)
    if most >= n_steps:
        np.testing.assert_array_equal(q.at(path), path)


def wrong(rig, seed=5, count=200):
    """Rms error of the light of paths at the nodes, in standard deviations of the pixels' noise; and their number."""
    model = exposure_model(rig.plant, rig.timing.exposure_steps)
    reduced = pixels.reduction(model, rig.sensor)
    q = reduced.resolution.quadrature
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
    assert count <= 12


def test_a_quiet_camera_needs_more_of_them():
    counts = [
        wrong(dataclasses.replace(LIVELY, sensor=dataclasses.replace(LIVELY.sensor, noise_density=V)), count=2)[1]
        for V in (1.0, 0.01, 1e-5)
    ]
    assert counts[0] < counts[1] < counts[2]


def test_a_spot_that_goes_back_and_forth_needs_many():
    error, count = wrong(SHAKEN)
    assert error < 0.15
    assert 12 < count <= SHAKEN.timing.exposure_steps


def test_as_fine_as_the_inputs_ask_for():
    model = exposure_model(LIVELY.plant, 200)
    found = pixels.reduction(model, LIVELY.sensor).resolution
    time = np.linspace(0, 1, 200)
    smooth, jump = 0.05 * time**2, np.where(time > 0.37, 0.4, 0.0)
    assert found.with_inputs(np.zeros((3, 1, 200))) is found.quadrature
    assert found.with_inputs((smooth + 3.0)[None, None]) is found.quadrature
    q = found.with_inputs(np.stack([smooth, jump])[:, None])
    assert len(q.weights) > len(found.quadrature.weights)
    assert abs(q.at(jump) @ q.weights - jump.mean()) <= found.mean
    assert abs(q.at(jump) ** 2 @ q.weights - (jump**2).mean()) <= found.square


def test_a_mean_or_a_spread_as_wrong_as_allowed_is_hardly_seen():
    sensor = LIVELY.sensor
    found = pixels.reduction(exposure_model(LIVELY.plant, 200), sensor).resolution
    noise = effective_noise_density(sensor) / sensor.pixel_size

    def seen(path):
        away = exposure_density(sensor.kernel, sensor.edges, path) - exposure_density(
            sensor.kernel, sensor.edges, np.zeros(2)
        )
        return np.sqrt((away**2).sum() / noise)

    assert seen(np.full(2, found.mean)) == pytest.approx(0.03, rel=0.1)
    assert seen(np.sqrt(found.square) * np.array([-1.0, 1.0])) == pytest.approx(0.03, rel=0.2)
