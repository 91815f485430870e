"""Two-dimensional moments with cross terms: of a path, of noise, in the filter."""

import dataclasses

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from aolink.estimation.frames.plane_moments import measure_moments_2d
from aolink.estimation.kalman.filter import BlurFilter
from aolink.estimation.kalman.path_moments import PathMoments, predicted_moments
from aolink.estimation.model.exposure_model import exposure_model
from aolink.optics.plane import pixel_mass_2d
from aolink.optics.sensor import Kernel
from aolink.plant.lifting import lift
from aolink.rig import Plant

KERNEL = Kernel(shape="gaussian", sigma=0.12, matrix=((0.14, 0.04), (0.04, 0.1))).covariance
X, Y = np.linspace(-1, 1, 21), np.linspace(-1, 1, 21)
N = 40
ALONG = [(1, 0), (2, 0), (0, 1), (0, 2)]
WITH_CROSS = [*ALONG, (1, 1)]


@pytest.fixture(scope="module")
def tilt() -> Plant:
    """A mirror whose two tilts are coupled and decay at different rates."""
    return Plant(
        A=np.array([[0.99, 0.03], [-0.02, 0.97]]),
        B=np.eye(2) * 0.01,
        B_w=np.eye(2),
        C=np.array([[1.0, 0.3], [-0.2, 1.0]]),
        process_noise=np.array([[4e-5, 2e-5], [2e-5, 3e-5]]),
        initial_mean=np.array([0.2, -0.1]),
        initial_covariance=np.eye(2) * 0.01,
        axes=1,
    )


def lissajous(n=200):
    t = np.linspace(0, 2, n)
    return np.stack([0.2 + 0.25 * np.sin(3 * t), -0.1 + 0.2 * np.cos(2 * t)], axis=-1)


def density(path, noise_density=0.0, seed=0, frames=1):
    clean = pixel_mass_2d(KERNEL, X, Y, path).mean(axis=0) / 0.01
    sd = np.sqrt(noise_density / 0.01)
    return clean + sd * np.random.default_rng(seed).standard_normal((frames, *clean.shape))


def test_moments_are_those_of_the_path():
    path, orders = lissajous(), [*WITH_CROSS, (2, 1), (3, 0), (2, 2)]
    measured = measure_moments_2d(density(path), X, Y, KERNEL, 1e-6, orders)
    expected = [np.mean(path[:, 0] ** p * path[:, 1] ** q) for p, q in orders]
    np.testing.assert_allclose(measured.value[0], expected, atol=2e-4)


def test_a_coupled_kernel_left_in_would_bias_the_cross_moment():
    path = lissajous()
    plain = measure_moments_2d(density(path), X, Y, KERNEL * np.eye(2), 1e-6, [(1, 1)])
    bias = plain.value[0, 0] - np.mean(path[:, 0] * path[:, 1])
    assert bias == pytest.approx(KERNEL[0, 1], abs=2e-4)


def test_moments_scatter_as_their_covariance_says():
    measured = measure_moments_2d(density(lissajous(), 1e-3, 1, 20_000), X, Y, KERNEL, 1e-3, WITH_CROSS)
    spread, predicted = np.cov(measured.value.T), measured.covariance.mean(axis=0)
    scale = np.sqrt(np.outer(spread.diagonal(), spread.diagonal()))
    np.testing.assert_allclose(predicted / scale, spread / scale, atol=0.04)


def path_of(plant, x, u):
    path = []
    for v in u:
        path.append(plant.C @ x)
        x = plant.A @ x + plant.B @ v
    return np.array(path)


def brute(plant, x, u):
    path = path_of(plant, x, u)
    return np.array([np.mean(path[:, 0] ** p * path[:, 1] ** q) for p, q in ALONG])


def test_predicted_moments_and_jacobian_of_both_directions(tilt):
    rng = np.random.default_rng(2)
    plant = dataclasses.replace(tilt, axes=3)
    model, x, u = exposure_model(plant, N), rng.standard_normal((3, 2)), rng.standard_normal((N, 6))
    h, H = predicted_moments(model, model.response(u), x, (1, 2))
    for axis in range(3):
        own = u[:, 2 * axis : 2 * axis + 2]
        np.testing.assert_allclose(h[axis], brute(plant, x[axis], own), atol=1e-10)
        for k, e in enumerate(np.eye(2) * 1e-3):
            slope = (brute(plant, x[axis] + e, own) - brute(plant, x[axis] - e, own)) / 2e-3
            np.testing.assert_allclose(H[axis, :, k], slope, atol=1e-8)


def test_every_step_is_the_one_of_filterpy(tilt):
    rng = np.random.default_rng(3)
    model = exposure_model(tilt, N)
    ours = BlurFilter(tilt, PathMoments(tilt, (1, 2)))
    A_N, Q = lift(tilt, N)
    ekf = ExtendedKalmanFilter(dim_x=2, dim_z=4, dim_u=2)
    ekf.x, ekf.P = tilt.initial_mean[:, None].copy(), tilt.initial_covariance.copy()
    ekf.F, ekf.Q, ekf.B = A_N, Q, np.eye(2)
    truth = tilt.initial_mean + 0.1 * rng.standard_normal(2)
    for j in range(10):
        u = 0.3 * rng.standard_normal((N, 2))
        frame = density(path_of(tilt, truth, u), 1e-4, seed=j)
        measured = measure_moments_2d(frame, X, Y, KERNEL, 1e-4, ALONG)
        step = ours.step(model, model.response(u), measured)
        ekf.R = measured.covariance[0]
        jacobian = np.empty((4, 2))

        def slopes(x, v=u, out=jacobian):
            for k, e in enumerate(np.eye(2)):
                out[:, k] = (brute(tilt, x[:, 0] + e, v) - brute(tilt, x[:, 0] - e, v)) / 2
            return out

        ekf.update(measured.value[0][:, None], slopes, lambda x, v=u: brute(tilt, x[:, 0], v)[:, None])
        np.testing.assert_allclose(step.start.mean[0], ekf.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(step.start.covariance[0], ekf.P, atol=1e-9)
        kick = np.zeros(2)
        for v in u:
            kick, truth = tilt.A @ kick + tilt.B @ v, tilt.A @ truth + tilt.B @ v
        ekf.predict(u=kick[:, None])
        np.testing.assert_allclose(step.end.mean[0], ekf.x[:, 0], atol=1e-9)
    assert np.abs(step.end.mean[0] - truth).max() < 0.02
