"""The kernel on pixels, against integrals on a fine grid."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.optics.kernel import exposure_density, kernel_moments, pixel_mass, pixel_masses
from aolink.optics.sensor import Kernel

EDGES = np.linspace(-1, 1, 41)
WIDTH = 0.05
positions = st.floats(-0.6, 0.6)
widths = st.floats(0.04, 0.15)


def density(w: np.ndarray, sigma: float) -> np.ndarray:
    """The kernel with the constant that gives it unit mass."""
    return np.asarray(np.exp(-(w**2) / sigma**2) / (sigma * np.sqrt(np.pi)))


def shifted(place: float, w: np.ndarray) -> np.ndarray:
    """A kernel that stands there."""
    return density(w - place, 0.05)


def fine_pixels(function: Callable[[np.ndarray], np.ndarray], points: int = 4000) -> np.ndarray:
    """Integral of a function over each pixel by the midpoint rule."""
    inside = (np.arange(points) + 0.5) / points * WIDTH
    return np.array([function(edge + inside).mean() * WIDTH for edge in EDGES[:-1]])


@given(position=positions, sigma=widths)
def test_pixel_mass_is_the_kernel_integrated_over_each_pixel(position, sigma):
    mass = pixel_mass(Kernel(shape="gaussian", sigma=sigma), EDGES, np.array(position))
    np.testing.assert_allclose(mass, fine_pixels(lambda w: density(w - position, sigma), 1000), atol=1e-6)


@given(position=positions, sigma=widths)
def test_all_light_of_a_spot_on_the_sensor_is_found(position, sigma):
    mass = pixel_mass(Kernel(shape="gaussian", sigma=sigma), EDGES, np.array(position))
    assert mass.sum() == pytest.approx(1, abs=1e-4)
    assert (mass >= 0).all()


def test_the_printed_constant_would_not_give_unit_mass():
    sigma = 0.05
    printed = fine_pixels(lambda w: np.exp(-(w**2) / sigma**2) / np.sqrt(2 * np.pi * sigma))
    ours = pixel_mass(Kernel(shape="gaussian", sigma=sigma), EDGES, np.array(0.0))
    assert ours.sum() == pytest.approx(1, abs=1e-12)
    assert printed.sum() == pytest.approx(np.sqrt(sigma / 2), abs=1e-9)  # 0.158: off by a factor of six


def test_slope_is_the_derivative_of_the_mass():
    kernel, at, h = Kernel(shape="gaussian", sigma=0.05), np.linspace(-0.9, 0.9, 7), 1e-6
    difference = (pixel_mass(kernel, EDGES, at + h) - pixel_mass(kernel, EDGES, at - h)) / (2 * h)
    np.testing.assert_allclose(pixel_masses(kernel.variance, EDGES, at, 1)[1], difference, atol=1e-7)


def test_exposure_density_is_the_mean_over_the_path():
    kernel, path = Kernel(shape="gaussian", sigma=0.05), np.sin(np.linspace(0, 5, 200)) * 0.4
    expected = np.mean([fine_pixels(partial(shifted, p), 400) for p in path], axis=0) / WIDTH
    np.testing.assert_allclose(exposure_density(kernel, EDGES, path), expected, atol=1e-4)


def test_moments_of_a_resting_spot_are_those_of_kernel_and_pixel():
    kernel, highest = Kernel(shape="gaussian", sigma=0.1), 6
    centres = (EDGES[:-1] + EDGES[1:]) / 2
    # Averaged over where in a pixel the spot rests, which takes the aliasing out.
    rests = (np.arange(50) / 50 - 0.5) * WIDTH
    mass = pixel_mass(kernel, EDGES, rests)
    found = [np.mean(mass @ centres**0)] + [
        np.mean((mass * (centres - rests[:, None]) ** p).sum(axis=1)) for p in range(1, highest + 1)
    ]
    np.testing.assert_allclose(kernel_moments(kernel, WIDTH, highest), found, rtol=1e-9, atol=1e-12)
    assert kernel_moments(kernel, WIDTH, 2)[2] == pytest.approx(kernel.variance + WIDTH**2 / 12)
