"""Measured moments: against fine integrals, against the spread of many noisy frames."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.estimation.frames.moments import (
    least_significance,
    measure_moments,
    noise_integrals,
    raw_moments,
    spot_significance,
    without_kernel,
)
from aolink.optics.camera import effective_noise_density, to_counts, to_density
from aolink.optics.kernel import exposure_density
from aolink.optics.sensor import Sensor
from aolink.rig import load_rig
from tests.kinds import line_of

SENSOR = line_of(load_rig("section-vi"))
# As many counts as can be, so that rounding does not show.
FINE = dataclasses.replace(SENSOR, noise_density=1e-4, counts_per_density=5000.0, black_level=1000.0)


def frames(sensor: Sensor, paths: np.ndarray, seed: int | None = None) -> np.ndarray:
    density = exposure_density(sensor.kernel, sensor.edges, paths)
    if seed is not None:
        sd = np.sqrt(sensor.noise_density / sensor.pixel_width)
        density = density + sd * np.random.default_rng(seed).standard_normal(density.shape)
    return to_counts(sensor, density)


def values(sensor: Sensor, counts: np.ndarray, orders: Sequence[int] = (1, 2)) -> np.ndarray:
    return measure_moments(sensor, counts, orders).value


@given(centre=st.floats(-0.4, 0.4), swing=st.floats(0, 0.3), turns=st.floats(0.1, 3))
def test_moments_are_those_of_the_path(centre, swing, turns):
    """The moments of a finely sampled path, by a kernel that pixels resolve, with the kernel taken out."""
    path = centre + swing * np.sin(2 * np.pi * turns * np.linspace(0, 1, 200))
    sensor = dataclasses.replace(FINE, kernel=dataclasses.replace(FINE.kernel, sigma=0.09))
    expected = [np.mean(path**p) for p in (1, 2, 3, 4)]
    np.testing.assert_allclose(values(sensor, frames(sensor, path[None]), (1, 2, 3, 4))[0], expected, atol=3e-4)


def test_the_kernel_left_in_would_bias_the_second_moment():
    """Mishra & Wen (13) takes the kernel for a point."""
    counts = frames(FINE, np.full((1, 200), 0.2))
    biased = raw_moments(FINE, counts, 2)[0, 2]
    kernel_and_pixel = FINE.kernel.variance + FINE.pixel_width**2 / 12
    assert biased == pytest.approx(0.04 + kernel_and_pixel, abs=2e-4)
    assert values(FINE, counts)[0, 1] == pytest.approx(0.04, abs=2e-4)


def test_raw_moments_are_sums_over_pixels_on_any_field():
    sensor = dataclasses.replace(SENSOR, field=(-0.5, 1.7))
    counts = np.random.default_rng(3).integers(0, 65536, (5, 40)).astype(np.uint16)
    density = (counts - sensor.black_level) / sensor.counts_per_density
    expected = [(sensor.centres**p * density).sum(axis=1) * sensor.pixel_width for p in range(4)]
    np.testing.assert_allclose(raw_moments(sensor, counts, 3), np.transpose(expected), rtol=1e-12)


def test_noise_covariance_is_the_papers():
    R = measure_moments(SENSOR, frames(SENSOR, np.zeros((1, 200)), seed=1), (1, 2)).covariance[0]
    V = effective_noise_density(SENSOR)
    np.testing.assert_allclose(R, [[2 / 3 * V, 0], [0, 2 / 5 * V]], atol=1e-12 * V)


def test_noise_integrals_are_integrals():
    sensor = dataclasses.replace(SENSOR, field=(-0.5, 1.7))
    w = -0.5 + 2.2 * (np.arange(100_000) + 0.5) / 100_000
    np.testing.assert_allclose(noise_integrals(sensor, 6), [2.2 * np.mean(w**n) for n in range(7)], rtol=1e-8)


@pytest.mark.parametrize("field", [(-1.0, 1.0), (-0.6, 1.4)])
@pytest.mark.parametrize("orders", [(1, 2), (1, 2, 3)])
def test_moments_scatter_as_their_covariance_says(field, orders):
    sensor = dataclasses.replace(SENSOR, field=field)
    counts = frames(sensor, np.full((20_000, 1), 0.3), seed=1)
    measured = measure_moments(sensor, counts, orders)
    spread = np.cov(measured.value.T)
    scale = np.sqrt(np.outer(spread.diagonal(), spread.diagonal()))
    np.testing.assert_allclose(measured.covariance[0] / scale, spread / scale, atol=0.04)


def test_shot_noise_is_in_the_covariance():
    """Mishra & Wen have read-out noise only; Poisson light adds y_(p+q) / photoelectrons."""
    sensor = dataclasses.replace(SENSOR, noise_density=1e-4, photoelectrons=1000.0)
    rng, light = np.random.default_rng(4), sensor.photoelectrons * sensor.pixel_width
    clean = exposure_density(sensor.kernel, sensor.edges, np.linspace(0.1, 0.5, 50))
    density = rng.poisson(clean * light, (10_000, 40)) / light + np.sqrt(1e-4 / 0.05) * rng.standard_normal(
        (10_000, 40)
    )
    counts = to_counts(sensor, density)
    measured = measure_moments(sensor, counts, (1, 2))
    spread = np.cov(measured.value.T)
    scale = np.sqrt(np.outer(spread.diagonal(), spread.diagonal()))
    np.testing.assert_allclose(measured.covariance.mean(axis=0) / scale, spread / scale, atol=0.05)
    without = measure_moments(dataclasses.replace(sensor, photoelectrons=0.0), counts, (1, 2))
    assert (without.covariance.mean(axis=0).diagonal() < 0.9 * spread.diagonal()).all()
    np.testing.assert_array_equal(measure_moments(sensor, counts[:3], (1, 2)).covariance, measured.covariance[:3])


def test_a_covariance_with_shot_noise_is_one_whatever_noise_does():
    sensor = dataclasses.replace(SENSOR, noise_density=1e-6, photoelectrons=3.0)
    rng = np.random.default_rng(5)
    counts = to_counts(sensor, 0.5 * rng.standard_normal((500, 40)))
    covariance = measure_moments(sensor, counts, (1, 2)).covariance
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_taking_the_kernel_out_undoes_the_binomial():
    kernel = np.array([1.0, 0.0, 0.02, 0.0, 0.001])
    rng = np.random.default_rng(5)
    path, blur = rng.uniform(-1, 1, 7), np.array([-np.sqrt(0.05), 0.0, np.sqrt(0.05)])
    weights = np.array([0.2, 0.6, 0.2])  # a kernel of three points with those moments
    assert (weights @ blur**2, weights @ blur**4) == pytest.approx((0.02, 0.001))
    both = [np.mean([weights @ (t + blur) ** p for t in path]) for p in range(5)]
    np.testing.assert_allclose(without_kernel(kernel) @ both, [np.mean(path**p) for p in range(5)], atol=1e-12)


def test_a_spot_stands_out_and_its_absence_does_not():
    lit, dark = frames(SENSOR, np.zeros((200, 200)), seed=3), frames(SENSOR, np.full((200, 1), 9.0), seed=3)
    assert spot_significance(SENSOR, to_density(SENSOR, lit)).min() > 4
    assert np.mean(spot_significance(SENSOR, to_density(SENSOR, dark)) > 4) < 0.05


@pytest.mark.parametrize("half_width", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("V", [0.1, 0.05, 0.03, 0.01])
def test_a_widely_smeared_spot_is_not_missed(half_width, V):
    sensor = dataclasses.replace(SENSOR, noise_density=V)
    clean = exposure_density(sensor.kernel, sensor.edges, half_width * np.sin(np.linspace(0, 20, 200)))
    noise = np.sqrt(V / sensor.pixel_width) * np.random.default_rng(6).standard_normal((1000, 40))
    assert np.mean(spot_significance(sensor, clean + noise) < least_significance(sensor)) < 0.08


@pytest.mark.parametrize(("V", "most"), [(0.03, 0.15), (0.01, 0.01), (0.001, 0.01)])
def test_a_blank_frame_is_seldom_taken_for_a_spot_where_light_can_be_told_from_noise(V, most):
    sensor = dataclasses.replace(SENSOR, noise_density=V)
    noise = np.sqrt(V / sensor.pixel_width) * np.random.default_rng(7).standard_normal((2000, 40))
    assert np.mean(spot_significance(sensor, noise) >= least_significance(sensor)) < most


@pytest.mark.parametrize("axes", [1, 7])
def test_moments_do_not_depend_on_the_axes_beside_them(axes):
    sensor = dataclasses.replace(SENSOR, field=(-0.6, 1.4), noise_density=1e-3)
    counts = frames(sensor, np.random.default_rng(1).uniform(0, 0.5, (64, 50)), seed=4)
    many, few = measure_moments(sensor, counts, (1, 2)), measure_moments(sensor, counts[:axes], (1, 2))
    np.testing.assert_array_equal(few.value, many.value[:axes])
    np.testing.assert_array_equal(few.covariance, many.covariance[:axes])
