"""Counts and densities of an integer camera."""

import dataclasses

import numpy as np
import pytest

from aolink.optics.camera import effective_noise_density, is_saturated, pixel_noise_sd, to_counts, to_density
from aolink.rig import load_rig

SENSOR = load_rig("section-vi").sensor


def test_density_survives_the_counts_to_half_a_count():
    density = np.linspace(-9, 22, 40)
    back = to_density(SENSOR, to_counts(SENSOR, density))
    assert np.abs(back - density).max() <= 0.5 / SENSOR.counts_per_density + 1e-12


def test_nothing_is_the_black_level_and_less_than_nothing_is_below_it():
    np.testing.assert_array_equal(to_counts(SENSOR, np.array([0.0, -1.0])), [20000, 18000])


def test_both_ends_of_the_scale_are_cut_and_reported():
    counts = to_counts(SENSOR, np.array([-1e6, 0.0, 1e6]))
    np.testing.assert_array_equal(counts, [0, 20000, 65535])
    np.testing.assert_array_equal(is_saturated(SENSOR, counts), [True, False, True])


def test_full_scale_follows_the_bit_depth():
    sensor = dataclasses.replace(SENSOR, bit_depth=12, black_level=100.0)
    assert to_counts(sensor, np.array([1e6]))[0] == 4095


def test_pixel_noise_is_the_square_root_of_v_over_d():
    assert pixel_noise_sd(SENSOR) == pytest.approx(np.sqrt(0.1 / 0.05))


def test_rounding_adds_a_twelfth_of_a_count():
    silent = dataclasses.replace(SENSOR, noise_density=0.0, counts_per_density=10.0)
    density = np.random.default_rng(1).uniform(0, 20, 200_000)
    error = to_density(silent, to_counts(silent, density)) - density
    assert error.var() * silent.pixel_width == pytest.approx(effective_noise_density(silent), rel=0.02)
