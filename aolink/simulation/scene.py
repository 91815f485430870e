"""The simulated picture sensor: a picture that moves during the exposure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aolink.exposure import step_shares
from aolink.numerics.arrays import FloatArray
from aolink.optics.scene import framed, framed_columns, framed_rows, scene_motion
from aolink.optics.sensor import Kernel
from aolink.rig import Rig
from aolink.rig.scene_table import read_scene_picture

_FLAT = 0.5
"""Intensity of even light."""


class SceneCamera:
    """Integrates a picture along a path, blurred by the sensor's kernel, noisy and in counts.

    Shifts are exact for the picture's own, finer pixels, by its Fourier transform; light that moves out on one side
    comes in on the other, so the picture should reach beyond the frame by the scene's motion.
    """

    def __init__(self, rig: Rig, rng: np.random.Generator) -> None:
        assert rig.scene is not None
        self._sensor, self._rng = rig.scene, rng
        picture = read_scene_picture(rig.scene, rig.folder)
        self._shape = picture.shape
        self._scale = rig.scene.picture_pixels / rig.scene.pixel_scale
        self._fy, self._fx = np.fft.fftfreq(picture.shape[0])[:, None], np.fft.rfftfreq(picture.shape[1])[:, None]
        self._spectrum = np.fft.rfft2(picture) * self._kernel(rig.scene.kernel)
        self._along_x = rig.n_outputs == 1
        if self._along_x:  # nothing moves along y: only rows need transforms
            rows = framed_rows(rig.scene, np.fft.irfft2(self._spectrum, picture.shape))
            self._spectrum = np.fft.rfft(rows)

    def frame(self, path: FloatArray, weights: FloatArray, light: str) -> NDArray[np.uint16]:
        """Counts of one exposure, (rows, columns).

        Parameters
        ----------
        path:
            Positions of all spots, slope units, (n_outputs, n_steps).
        weights:
            Share of the exposure in each step, (n_steps,).
        light:
            The light, as in `aolink.rig.Light`.
        """
        sensor = self._sensor
        if light in ("dark", "flat"):
            intensity = np.full(sensor.shape, _FLAT if light == "flat" else 0.0)
        else:
            intensity = self._intensity(scene_motion(len(path)) @ path * self._scale, weights)
        return sensor.to_counts(intensity + sensor.noise_sd * self._rng.standard_normal(sensor.shape))

    def frame_by_rows(self, path: FloatArray, starts: FloatArray, n_steps: int) -> NDArray[np.uint16]:
        """Counts where each row of pixels has an exposure of its own.

        ``path`` is that of `frame` at all fast steps of the exposure; ``starts`` says when each row's ``n_steps`` steps
        start, fast steps after its first, (rows,).
        """
        sensor = self._sensor
        moved = scene_motion(len(path)) @ path * self._scale
        intensity = np.empty(sensor.shape)
        for start in np.unique(starts):
            whole = int(start)
            of_row = moved[:, whole : whole + n_steps + 1]
            shares = step_shares(n_steps, float(start - whole))
            picture = self._intensity(of_row[:, : len(shares)], shares)
            intensity[starts == start] = picture[starts == start]
        return sensor.to_counts(intensity + sensor.noise_sd * self._rng.standard_normal(sensor.shape))

    def _intensity(self, moved: FloatArray, weights: FloatArray) -> FloatArray:
        """The picture without noise along a path in the picture's pixels, (rows, columns)."""
        spectrum = self._spectrum * self._motion(moved, weights)
        if self._along_x:
            return framed_columns(self._sensor, np.fft.irfft(spectrum, self._shape[1]))
        return framed(self._sensor, np.fft.irfft2(spectrum, self._shape))

    def _kernel(self, kernel: Kernel) -> FloatArray:
        """Transform of the sensor's kernel, (rows, columns // 2 + 1)."""
        x, y = self._fx.T, self._fy
        if kernel.matrix is None:
            width = math.pi * kernel.sigma * self._scale
            return np.asarray(np.exp(-((width * y) ** 2)) * np.exp(-((width * x) ** 2)))
        (xx, xy), (_, yy) = kernel.covariance * (math.pi * self._scale) ** 2
        return np.asarray(np.exp(-2 * (xx * x * x + 2 * xy * x * y + yy * y * y)))

    def _motion(self, path: FloatArray, weights: FloatArray) -> NDArray[np.complex128]:
        """Transform of the path's histogram, (rows or 1, columns // 2 + 1); the path in the picture's pixels."""
        along_x = np.exp(-2j * math.pi * self._fx * path[0])
        if len(path) == 1:
            return np.asarray(along_x @ weights)[None]
        along_y = np.exp(-2j * math.pi * self._fy * path[1])
        return np.asarray((along_y * weights) @ along_x.T)
