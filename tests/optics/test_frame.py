"""Whole frames, against integrals on a fine grid and against the kernel step by step."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aolink.optics.frame import frame_density, spots_density
from aolink.optics.kernel import exposure_density, pixel_mass
from aolink.optics.sensor import Kernel
from aolink.rig import load_rig
from tests.kinds import line_of

EDGES = np.linspace(-1, 1, 17)
WIDTH = 0.125
SENSOR = load_rig("sh-4x4").sensor


def wandering(spots: int, n_steps: int, seed: int = 1) -> np.ndarray:
    steps = 0.02 * np.random.default_rng(seed).standard_normal((spots, 2, n_steps))
    return np.cumsum(steps, axis=2) + np.linspace(-0.3, 0.3, spots)[:, None, None]


def test_a_window_is_the_round_kernel_integrated_over_pixels_and_steps():
    path, sigma, points = wandering(1, 7), 0.1, 40
    inside = (np.arange(points) + 0.5) / points * WIDTH
    x = (EDGES[:-1, None] + inside).ravel()
    fine = np.zeros((len(x), len(x)))  # y down, x across
    for k in range(7):
        away = (x[:, None] - path[0, 1, k]) ** 2 + (x - path[0, 0, k]) ** 2
        fine += np.exp(-away / sigma**2) / (np.pi * sigma**2) / 7
    expected = fine.reshape(16, points, 16, points).mean(axis=(1, 3))
    (window,) = spots_density(Kernel(shape="gaussian", sigma=sigma), EDGES, path)
    np.testing.assert_allclose(window, expected, atol=2e-4 * expected.max())


@given(sigma=st.floats(0.03, 0.4), seed=st.integers(0, 1000), far=st.floats(0, 3))
@settings(max_examples=25)
def test_the_table_is_as_good_as_the_error_function(sigma, seed, far):
    """Wherever the spot is, off the window too."""
    kernel = Kernel(shape="gaussian", sigma=sigma)
    path = wandering(3, 11, seed) + far
    x, y = pixel_mass(kernel, EDGES, path[:, 0]), pixel_mass(kernel, EDGES, path[:, 1])
    light = spots_density(kernel, EDGES, path) * WIDTH**2
    np.testing.assert_allclose(light, np.einsum("skr,skc->src", y, x) / 11, atol=1e-8)


def test_a_kernel_too_narrow_for_a_table_is_integrated_all_the_same():
    kernel, path = Kernel(shape="gaussian", sigma=1e-4), wandering(1, 3)
    x, y = pixel_mass(kernel, EDGES, path[0, 0]), pixel_mass(kernel, EDGES, path[0, 1])
    (window,) = spots_density(kernel, EDGES, path)
    np.testing.assert_allclose(window * WIDTH**2, y.T @ x / 3, atol=1e-12)


def test_a_spot_does_not_depend_on_the_spots_beside_it():
    kernel, path = Kernel(shape="gaussian", sigma=0.1), wandering(40, 20)
    together = spots_density(kernel, EDGES, path)
    for spot in (0, 15, 16, 39):
        assert np.array_equal(spots_density(kernel, EDGES, path[spot : spot + 1])[0], together[spot])


def test_spots_lie_along_the_rows_of_the_grid_and_x_along_the_columns():
    path = np.zeros((16, 2, 5))
    path[6] = [[0.5], [-0.25]]  # second row, third column
    frame = frame_density(SENSOR, path.reshape(32, 5))
    assert frame.shape == (96, 96)
    rows, columns = np.indices(frame.shape)
    for spot, (row, column) in enumerate(np.ndindex(4, 4)):
        window = (slice(24 * row, 24 * row + 24), slice(24 * column, 24 * column + 24))
        light = frame[window] * SENSOR.pixel_size
        assert light.sum() == pytest.approx(1, abs=1e-6)
        x, y = ((12 + 12 * path[spot, :, 0]) - 0.5) + [24 * column, 24 * row]
        assert (light * columns[window]).sum() == pytest.approx(x, abs=1e-4)
        assert (light * rows[window]).sum() == pytest.approx(y, abs=1e-4)


def test_the_sum_over_one_direction_is_the_line_sensors_profile():
    path = wandering(16, 50)
    frame = frame_density(SENSOR, path.reshape(32, 50))
    line = SENSOR.profile
    window = frame[24:48, 48:72]  # spot 6
    for direction in (0, 1):
        profile = window.sum(axis=direction) * SENSOR.pixel_width
        np.testing.assert_allclose(profile, exposure_density(line.kernel, line.edges, path[6, direction]), atol=1e-6)


def test_a_line_sensors_frame_is_its_exposure():
    sensor, path = line_of(load_rig("section-vi")), wandering(1, 30)[0, :1]
    assert np.array_equal(frame_density(sensor, path), exposure_density(sensor.kernel, sensor.edges, path))
