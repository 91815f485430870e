"""Moments of many spots in windows: against the path, the spread of many frames, and the moments of the plane."""

import dataclasses

import numpy as np
import pytest

from aolink.estimation.moments2d import measure_moments_2d
from aolink.estimation.windows import Window, measure_windows
from aolink.optics.plane import kernel_covariance, pixel_mass_2d

WINDOW = Window(
    shape=(18, 16), x_field=(-0.8, 0.8), y_field=(-0.7, 1.1), kernel=kernel_covariance(np.diag([0.16, 0.14])),
    noise_density=1e-4, black_level=1000.0, counts_per_density=2000.0,
)  # fmt: skip
X, Y = np.linspace(-0.8, 0.8, 17), np.linspace(-0.7, 1.1, 19)
AREA = 0.1 * 0.1


def frames(window, paths, seed=None, photoelectrons=0.0):
    """Counts of spots along paths, (spots, steps, 2)."""
    density = np.stack([pixel_mass_2d(window.kernel, X, Y, path).mean(axis=0) for path in paths]) / AREA
    if seed is not None:
        rng = np.random.default_rng(seed)
        if photoelectrons:
            density = rng.poisson(density * AREA * photoelectrons) / (AREA * photoelectrons)
        density = density + np.sqrt(window.noise_density / AREA) * rng.standard_normal(density.shape)
    return np.rint(window.black_level + window.counts_per_density * density).astype(np.uint16)


def paths(spots):
    t, rng = np.linspace(0, 6, 60), np.random.default_rng(2)
    start = rng.uniform(-0.15, 0.25, (spots, 1, 2))
    return start + 0.15 * np.stack([np.sin(t), np.cos(2 * t)], axis=-1)


@pytest.mark.parametrize("flux", ["known", "measured"])
def test_moments_are_those_of_the_paths_x_and_y_in_turn(flux):
    fine = dataclasses.replace(WINDOW, noise_density=1e-9)
    given = paths(3)
    measured = measure_windows(fine, frames(fine, given), (1, 2, 3), flux)
    expected = [[np.mean(path[:, axis] ** p) for p in (1, 2, 3)] for path in given for axis in (0, 1)]
    np.testing.assert_allclose(measured.value, expected, atol=5e-4)


@pytest.mark.parametrize("flux", ["known", "measured"])
def test_they_are_those_of_the_plane_without_its_cross_terms(flux):
    counts = frames(WINDOW, paths(4), seed=1)
    density = (counts - WINDOW.black_level) / WINDOW.counts_per_density
    ours = measure_windows(WINDOW, counts, flux=flux)
    orders = [(1, 0), (2, 0), (0, 1), (0, 2)]
    theirs = measure_moments_2d(density, X, Y, WINDOW.kernel, WINDOW.noise_density, orders, flux)
    np.testing.assert_allclose(ours.value.reshape(4, 4), theirs.value, atol=1e-12)
    np.testing.assert_allclose(ours.covariance[::2], theirs.covariance[:, :2, :2], rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(ours.covariance[1::2], theirs.covariance[:, 2:, 2:], rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("flux", ["known", "measured"])
@pytest.mark.parametrize("photoelectrons", [0.0, 1000.0])
def test_they_scatter_as_their_covariance_says(flux, photoelectrons):
    window = dataclasses.replace(WINDOW, noise_density=1e-4, counts_per_density=400.0, photoelectrons=photoelectrons)
    one = paths(1)
    counts = frames(window, np.repeat(one, 6000, axis=0), seed=3, photoelectrons=photoelectrons)
    measured = measure_windows(window, counts, flux=flux)
    for axis in (0, 1):
        spread, predicted = np.cov(measured.value[axis::2].T), measured.covariance[axis::2].mean(axis=0)
        scale = np.sqrt(np.outer(spread.diagonal(), spread.diagonal()))
        np.testing.assert_allclose(predicted / scale, spread / scale, atol=0.08)


@pytest.mark.parametrize("photoelectrons", [0.0, 300.0])
@pytest.mark.parametrize("flux", ["known", "measured"])
def test_a_spot_does_not_depend_on_those_beside_it(flux, photoelectrons):
    window = dataclasses.replace(WINDOW, photoelectrons=photoelectrons)
    counts = frames(window, paths(40), seed=5)
    many, few = measure_windows(window, counts, flux=flux), measure_windows(window, counts[:3], flux=flux)
    np.testing.assert_array_equal(few.value, many.value[:6])
    np.testing.assert_array_equal(few.covariance, many.covariance[:6])


def test_windows_of_another_size_are_refused():
    with pytest.raises(ValueError, match="windows have"):
        measure_windows(WINDOW, np.zeros((2, 16, 18), np.uint16))


def test_light_lost_in_noise_is_not_divided_by():
    dim = dataclasses.replace(WINDOW, noise_density=0.1)
    assert "flux" in measure_windows(dim, frames(WINDOW, paths(1)), flux="measured")
