"""Centroids: against known places, aotools and SciPy."""

import aotools
import numpy as np
import pytest
from scipy import ndimage

from aolink.optics.centroid import centre_of_gravity, weighted_centroid
from aolink.optics.kernel import pixel_mass
from aolink.optics.sensor import Kernel

PLACES = np.random.default_rng(1).uniform(5.5, 10.5, (40, 2))


def spots(places, side=17, sd=1.4, light=1000.0):
    """Gaussian spots integrated over pixels, (n, side, side)."""
    edges, kernel = np.arange(side + 1) - 0.5, Kernel(shape="gaussian", sigma=sd * np.sqrt(2))
    return (
        light * pixel_mass(kernel, edges, places[:, 1])[:, :, None] * pixel_mass(kernel, edges, places[:, 0])[:, None]
    )


def test_the_centre_of_gravity_is_that_of_two_other_libraries():
    windows = spots(PLACES) + np.random.default_rng(2).uniform(0, 5, (40, 17, 17))
    found = centre_of_gravity(windows)
    np.testing.assert_allclose(found[:, ::-1], [ndimage.center_of_mass(w) for w in windows], rtol=1e-12)
    np.testing.assert_allclose(found.T, aotools.image_processing.centre_of_gravity(windows), rtol=1e-12)


def test_the_threshold_is_that_of_another_library():
    windows = spots(PLACES) + np.random.default_rng(2).uniform(0, 5, (40, 17, 17))
    found = centre_of_gravity(windows, 0.1 * windows.max(axis=(1, 2)))
    expected = [aotools.image_processing.centre_of_gravity(w.copy(), threshold=0.1) for w in windows]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(
    "method",
    [
        centre_of_gravity,
        lambda w: centre_of_gravity(w, 0.05 * w.max(axis=(1, 2))),
        lambda w: weighted_centroid(w, 2.0),
    ],
    ids=["plain", "thresholded", "weighted"],
)
def test_spots_are_where_they_are(method):
    assert np.abs(method(spots(PLACES)) - PLACES).max() < 0.01


def test_weights_stand_noise_that_the_plain_one_does_not():
    rng = np.random.default_rng(3)
    places = np.repeat(PLACES, 10, axis=0)
    windows = spots(places) + rng.normal(0, 4.0, (400, 17, 17))
    errors = {
        "plain": centre_of_gravity(windows) - places,
        "weighted": weighted_centroid(windows, 2.0) - places,
    }
    rms = {name: float(np.sqrt((error**2).mean())) for name, error in errors.items()}
    # Cramer-Rao for a Gaussian spot under white noise: sd = 2 sqrt(2 pi) sd^2... per axis, s^2 = 8 pi n^2 sd^4 / F^2.
    bound = np.sqrt(8 * np.pi) * 4.0 * (1.4**2 + 1 / 12) / 1000
    assert bound < rms["weighted"] < rms["plain"] / 3


def test_a_window_without_light_has_no_centroid():
    dark = np.zeros((1, 9, 9))
    for found in (
        centre_of_gravity(dark),
        centre_of_gravity(spots(PLACES[:1]), 1e9),
        weighted_centroid(dark, 2.0),
    ):
        assert np.isnan(found).all()
