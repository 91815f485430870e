"""Kernels on a plane, against fine grids."""

import numpy as np
import pytest

from aolink.optics.kernel import pixel_mass
from aolink.optics.plane import kernel_moments_2d, pixel_mass_2d
from aolink.optics.sensor import Kernel

SIGMA = np.array([[0.12, 0.03], [0.03, 0.08]])
X, Y = np.linspace(-1, 1, 21), np.linspace(-0.8, 0.8, 17)


def test_pixels_hold_the_integral_of_the_kernel():
    at, inside = np.array([0.13, -0.07]), (np.arange(80) + 0.5) / 80 * 0.1
    x, y = (X[:-1, None] + inside).ravel(), (Y[:-1, None] + inside).ravel()
    w = np.stack(np.meshgrid(x, y), axis=-1) - at
    inverse = np.linalg.inv(SIGMA @ SIGMA)
    psi = np.exp(-np.einsum("...i,ij,...j", w, inverse, w)) / (np.pi * np.linalg.det(SIGMA))
    expected = psi.reshape(16, 80, 20, 80).sum(axis=(1, 3)) * 0.00125**2
    mass = pixel_mass_2d(SIGMA @ SIGMA / 2, X, Y, at)
    assert mass.shape == (16, 20)
    np.testing.assert_allclose(mass, expected, atol=2e-5)
    assert mass.sum() == pytest.approx(1, abs=1e-9)


def test_the_printed_constant_would_not_give_unit_mass():
    """(4) has 1/sqrt(2 pi |Sigma|) where the mass needs 1/(pi |Sigma|)."""
    determinant = np.linalg.det(SIGMA)
    assert np.pi * determinant / np.sqrt(2 * np.pi * determinant) == pytest.approx(np.sqrt(np.pi * determinant / 2))
    assert np.sqrt(np.pi * determinant / 2) < 0.15


def test_a_separable_kernel_is_the_product_of_two():
    kernel = Kernel(shape="gaussian", sigma=0.1)
    mass = pixel_mass_2d(np.eye(2) * kernel.variance, X, Y, np.array([[0.2, 0.1], [-0.3, 0.0]]))
    for k, (x, y) in enumerate([(0.2, 0.1), (-0.3, 0.0)]):
        expected = np.outer(pixel_mass(kernel, Y, np.array(y)), pixel_mass(kernel, X, np.array(x)))
        np.testing.assert_allclose(mass[k], expected, atol=1e-9)


def test_moments_of_a_resting_spot_are_those_of_kernel_and_pixel():
    covariance = SIGMA @ SIGMA / 2
    x, y = (X[:-1] + X[1:]) / 2, (Y[:-1] + Y[1:]) / 2
    # Averaged over where in a pixel the spot rests, which takes the aliasing out.
    steps = (np.arange(10) / 10 - 0.45) * 0.1
    rests = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    mass = pixel_mass_2d(covariance, X, Y, rests)
    found = kernel_moments_2d(covariance, (0.1, 0.1), 4)
    for p in range(5):
        for q in range(5 - p):
            powers = (y[:, None] - rests[:, 1, None, None]) ** q * (x - rests[:, 0, None, None]) ** p
            assert found[p, q] == pytest.approx((mass * powers).sum(axis=(1, 2)).mean(), abs=1e-8), (p, q)
    assert found[1, 1] == pytest.approx(covariance[0, 1])
