"""Lenslets and Zernike polynomials: against areas, fine grids, finite differences and HCIPy."""

import math

import numpy as np
import pytest

from aolink.optics.lenslets import Lenslets
from aolink.optics.zernike import noll_to_orders, zernike, zernike_gradient
from tests.needs import needed

SQUARE = Lenslets(grid=(5, 7), pitch_m=2e-4, focal_length_m=5e-3)
ROUND = Lenslets(grid=(10, 10), pitch_m=0.1, focal_length_m=1.0, pupil_diameter_m=0.97, obstruction=0.3)


def test_spots_are_counted_along_rows_about_the_middle():
    np.testing.assert_allclose(SQUARE.centres_m.mean(axis=0), 0, atol=1e-18)
    np.testing.assert_allclose(SQUARE.centres_m[1] - SQUARE.centres_m[0], [2e-4, 0])
    np.testing.assert_allclose(SQUARE.centres_m[7] - SQUARE.centres_m[0], [0, 2e-4], atol=1e-18)


def test_the_light_on_all_lenslets_is_the_pupils_area():
    area = math.pi * 0.97**2 / 4 * (1 - 0.3**2)
    assert ROUND.light.sum() * ROUND.pitch_m**2 == pytest.approx(area, rel=2e-3)
    light = ROUND.light.reshape(10, 10)
    np.testing.assert_array_equal(light, light[::-1])
    assert light[0, 0] == 0
    assert light[5, 8] == 1
    assert 0 < light[0, 4] < 1
    assert 0 < light[4, 6] < 1  # the obstruction's edge


def test_mean_slopes_of_planes_and_of_focus_are_exact():
    plane = SQUARE.mean_slopes(lambda r: np.broadcast_to([1e-3, -2e-3], r.shape))
    np.testing.assert_allclose(plane, np.tile([1e-3, -2e-3], (35, 1)))
    focus = SQUARE.mean_slopes(lambda r: 2 * r)  # W = r^2
    np.testing.assert_allclose(focus, 2 * SQUARE.centres_m, atol=1e-18)


def test_mean_slopes_are_differences_along_the_sides():
    # Gauss: the mean of dW/dx over a square is the difference of W's means along two sides, over the side.
    index, r = 11, 8e-4
    slopes = SQUARE.mean_slopes(lambda p: zernike_gradient(index, p / r) / r)
    along = np.linspace(-0.5, 0.5, 2001) * SQUARE.pitch_m
    centre, half = SQUARE.centres_m[9], SQUARE.pitch_m / 2
    sides = [zernike(index, (centre + np.stack([np.full(2001, s), along], 1)) / r) for s in (half, -half)]
    assert slopes[9, 0] == pytest.approx(np.trapezoid(sides[0] - sides[1], along) / SQUARE.pitch_m**2, rel=1e-6)


def test_partly_lit_lenslets_average_what_is_lit_and_dark_ones_have_no_slope():
    slopes = ROUND.mean_slopes(lambda p: 2 * p).reshape(10, 10, 2)
    assert np.isnan(slopes[0, 0]).all()
    # Light only on the inner side: nearer to the middle than the lenslet's own middle is.
    assert -2 * 0.45 < slopes[0, 4, 1] < -2 * 0.4


@pytest.mark.parametrize("change", [{"pitch_m": 0.0}, {"grid": (0, 3)}, {"obstruction": 1.0}])
def test_what_cannot_be_lenslets_is_refused(change):
    with pytest.raises(ValueError, match="not lenslets"):
        Lenslets(**{"grid": (2, 2), "pitch_m": 1.0, "focal_length_m": 1.0, **change})


def test_zernikes_are_those_of_another_library():
    hcipy = needed("hcipy")
    grid = hcipy.make_pupil_grid(41, 0.99)
    points = np.stack([grid.x, grid.y], axis=1)
    radius = np.linalg.norm(points, axis=1)
    points = points[(radius < 0.49) & (radius > 0)]  # its recursion divides by the radius
    for index in range(1, 40):
        n, m = hcipy.noll_to_zernike(index)
        assert noll_to_orders(index) == (n, m)
        there = hcipy.CartesianGrid(hcipy.UnstructuredCoords(points.T))
        expected = hcipy.zernike(n, m, 1.0, there, radial_cutoff=False)
        np.testing.assert_allclose(zernike(index, 2 * points), expected, atol=1e-9)


def test_zernike_gradients_are_finite_differences():
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (50, 2))
    points[0] = 0  # the middle is a point like others
    h = 1e-6
    for index in range(1, 37):
        for axis, step in enumerate(np.eye(2) * h):
            slope = (zernike(index, points + step) - zernike(index, points - step)) / (2 * h)
            np.testing.assert_allclose(zernike_gradient(index, points)[:, axis], slope, atol=1e-7)
