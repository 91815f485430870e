"""The covariance to expect of centroids that are measured in a rig's frames, from the rig file's noise and light."""

from __future__ import annotations

import numpy as np

from aolink.estimation.frames.moments import noise_integrals
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import effective_noise_density
from aolink.optics.sensor import BaseSensor
from aolink.rig import Rig


def centroid_covariance(rig: Rig) -> FloatArray:
    """Covariance of the centroids by read-out and shot noise, for spots where the plant's prior expects them.

    The result is blocks along the diagonal for each copy of the plant, one block a spot, (axes, blocks, size, size),
    slope units squared; for one copy, (1, blocks, size, size), where all have the same light.
    """
    sensor, plant = rig.sensor, rig.plant
    own = _of_whole_spot(sensor, plant.n_outputs)
    size = len(own)
    blocks = np.tile(own, (plant.n_outputs // size, 1, 1))
    light = sensor.spot_light
    if light is None:
        light = np.ones((1, len(blocks)))
    else:  # an axis with one slope shares its spot with the next
        light = np.repeat(light, 2 // size).reshape(plant.axes, -1)
    covariance = blocks / light[..., None, None] ** 2
    if sensor.photoelectrons:
        # y_2 / photoelectrons
        spread = np.diag(plant.C @ plant.initial_covariance @ plant.C.T) + (plant.C @ plant.initial_mean) ** 2
        shot = (spread + _kernel_variances(sensor, plant.n_outputs)) / sensor.photoelectrons
        covariance = covariance + shot.reshape(-1, size)[:, :, None] * np.eye(size) / light[..., None, None]
    return np.asarray(covariance)


def _of_whole_spot(sensor: BaseSensor, n_outputs: int) -> FloatArray:
    """Covariance of one spot's first moments by read-out noise, (1, 1), or (2, 2) for both directions."""
    line = sensor.profile
    _, first, second = noise_integrals(line, 2)
    own, other = effective_noise_density(line) * second, effective_noise_density(sensor) * first**2
    return np.array([[own]] if n_outputs == 1 else [[own, other], [other, own]])


def _kernel_variances(sensor: BaseSensor, n_outputs: int) -> FloatArray:
    """Variance of the kernel along each output of one copy, (n_outputs,)."""
    if n_outputs == 1:
        return np.array([sensor.kernel.variance])
    return np.tile(np.diag(sensor.kernel.covariance), n_outputs // 2)
