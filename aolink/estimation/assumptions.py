"""The assumptions of the estimators about a rig: the ranges of the family of scenes that they are judged on.

`tools/judge` draws its scenes from these ranges. A rig outside may work as well, but how well has not been measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.optics.sensor import RegionSensor
from aolink.rig import Rig

MOST_MODES = 3
MOST_SWINGS = 8.0
"""Most swings of an eigenmode in one exposure."""
STEPS_IN_SWING = 8
"""Fewest fast steps in one swing of an eigenmode."""
MOST_PATH_WIDTHS = 8.0
"""Largest standard deviation of the spot's motion, in standard deviations of the kernel."""
LEAST_KERNEL_PIXELS = 0.8
"""Least sigma of the kernel, pixels."""
LEAST_PEAK_SNR, MOST_PEAK_SNR = 1.0, 300.0
"""Least and largest signal to noise in the brightest pixel of a resting spot."""

# An eigenmode that makes less than this share of the motion's variance does not count.
_LEAST_SHARE = 0.01
# Plants whose eigenvectors are closer to each other than this have no separate eigenmodes.
_MOST_CONDITION = 1e8
_MOST_OUTPUTS = 2
_ROUNDING = 1e-9


def peak_snr(rig: Rig) -> float:
    """Signal to noise in the brightest pixel of a resting spot, shot noise and rounding included."""
    sensor = rig.sensor
    noise = effective_noise_density(sensor) / sensor.pixel_size + shot_gain(sensor) * sensor.peak_density
    return sensor.peak_density / math.sqrt(noise)


def broken_assumptions(rig: Rig) -> Iterator[tuple[str, str]]:
    """The rig file's key and a sentence for each assumption that a rig does not meet.

    The spot's motion is judged for plants that move one spot each, along one axis or both.
    """
    plant, timing = rig.plant, rig.timing
    if not isinstance(rig.sensor, RegionSensor):
        yield from _of_spots(rig)
    if plant.n_outputs > _MOST_OUTPUTS:
        return
    count, swings = _modes(rig)
    fastest = float(swings.max(initial=0.0))
    if count > MOST_MODES:
        yield (
            "plant.A",
            f"{count} eigenmodes of the plant move the spot along one axis, estimators were judged with up to"
            f" {MOST_MODES}: with more, intervals of profile may be too narrow; compare them with those of moments",
        )
    if fastest > MOST_SWINGS + _ROUNDING:
        yield (
            "timing.exposure_steps",
            f"the plant's fastest eigenmode swings {fastest:.3g} times in an exposure, estimators were judged up to"
            f" {MOST_SWINGS:g}: beyond, the blur shows its amplitude and not its phase; shorten the exposure",
        )
    if fastest * STEPS_IN_SWING > timing.exposure_steps * (1 + _ROUNDING):
        yield (
            "timing.fast_step_s",
            f"the plant's fastest eigenmode has {timing.exposure_steps / fastest:.2g} fast steps in one swing,"
            f" estimators were judged from {STEPS_IN_SWING} on: the model has no motion inside a step; make it shorter",
        )


def _of_spots(rig: Rig) -> Iterator[tuple[str, str]]:
    sensor, plant = rig.sensor, rig.plant
    kernel = math.sqrt(2 * float(np.linalg.eigvalsh(sensor.kernel.covariance)[0])) / sensor.pixel_width
    if kernel < LEAST_KERNEL_PIXELS - _ROUNDING:
        yield (
            "sensor.kernel.sigma",
            f"the kernel's sigma is {kernel:.2g} pixels, estimators were judged from {LEAST_KERNEL_PIXELS:g} on: below,"
            " what they see depends on where in a pixel the spot rests; defocus, or take smaller pixels",
        )
    if (snr := peak_snr(rig)) < LEAST_PEAK_SNR:
        yield (
            "sensor.noise_density",
            f"signal to noise is {snr:.2g} in the brightest pixel of a resting spot, estimators were judged from"
            f" {LEAST_PEAK_SNR:g} on: below, frames add little to the plant's model",
        )
    if snr > MOST_PEAK_SNR * (1 + _ROUNDING):
        yield (
            "sensor.noise_density",
            f"signal to noise is {snr:.3g} in the brightest pixel of a resting spot, estimators were judged up to"
            f" {MOST_PEAK_SNR:g}: beyond, small errors of the kernel and of the plant's model count as motion",
        )
    if plant.n_outputs > _MOST_OUTPUTS:
        return
    spread = math.sqrt(max(0.0, float(np.diag(plant.C @ plant.initial_covariance @ plant.C.T).max())))
    widths = spread / math.sqrt(sensor.kernel.variance)
    if widths > MOST_PATH_WIDTHS + _ROUNDING:
        yield (
            "plant.process_noise",
            f"the plant moves the spot by {widths:.3g} sds of the kernel (sd), estimators were judged up to"
            f" {MOST_PATH_WIDTHS:g}: beyond, a blur is thin and long, and more paths explain it than they follow",
        )


def _modes(rig: Rig) -> tuple[int, FloatArray]:
    """The number of eigenmodes that move the spot along one axis, an oscillation counting as one; and the swings of
    each in an exposure. Where they cannot be told apart, all count."""
    plant = rig.plant
    values, vectors = np.linalg.eig(plant.A)
    share = np.ones((plant.n_outputs, len(values)))
    if np.linalg.cond(vectors) < _MOST_CONDITION:
        back = np.linalg.inv(vectors)
        own = np.einsum("is,st,it->i", back, plant.initial_covariance, back.conj()).real
        # Both of a pair: together they make up to four times what one does.
        motion = np.abs(plant.C @ vectors) ** 2 * own * np.where(values.imag == 0, 1, 4)
        variance = np.diag(plant.C @ plant.initial_covariance @ plant.C.T)
        share = motion / np.maximum(variance, 1e-300)[:, None]
    seen = (values.imag >= 0) & (share > _LEAST_SHARE)
    swings = np.angle(values[seen.any(axis=0)]) / (2 * math.pi) * rig.timing.exposure_steps
    return int(seen.sum(axis=1).max()), swings
