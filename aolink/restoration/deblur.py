"""Pictures of an exposure without its blur, restored with the PSF of the estimated path.

Neither the truth nor the true scene is used; `psnr` compares with the true scene afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RestorationError
from aolink.estimation import Estimate
from aolink.estimation.estimate import motion
from aolink.exposure import Exposure, step_shares
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.numerics.covariance import psd_root
from aolink.numerics.single_thread import by_one_thread
from aolink.optics.camera import is_saturated, to_density
from aolink.optics.scene import SceneSensor, scene_motion
from aolink.optics.sensor import Kernel
from aolink.restoration.method import Restored
from aolink.restoration.psf import Psf, motion_psf_by_root
from aolink.restoration.registry import DEFAULT_METHOD
from aolink.restoration.restore import restore
from aolink.rig import Rig


@dataclass(frozen=True, kw_only=True, eq=False)
class RestoredPictures:
    """An exposure's pictures without their blur."""

    frame_id: int
    estimator: str
    """The estimator whose path they were restored with."""
    method: str
    scene_noise_sd: float
    """Standard deviation of the scene's noise, estimated from the scene; NaN where there is no scene."""
    path_noise_sd: float
    """Standard deviation of the additional noise from the path's uncertainty."""
    expected_gain_db: float = math.nan
    """`Restored.expected_gain_db` of the scene; without one, the mean of the spots."""
    reason: str
    """The reason why pictures are missing; empty where none is."""
    scene: NDArray[np.float32] | None
    """Intensity, (rows, columns)."""
    spots: NDArray[np.float32] | None
    """Share of a spot's light, (rows, columns) of the camera's frame."""


def estimated_psfs(
    exposure: Exposure, estimate: Estimate, mixes: Iterable[FloatArray], kernel: Kernel, pixel_scale: float
) -> Iterator[Psf]:
    """The PSF, with its uncertainty, for each weighted sum of outputs (weights as in `motion`)."""
    roots, offset = psd_root(estimate.coefficient_covariance), exposure.start_offset
    shares = step_shares(exposure.n_steps, offset)
    for mix in mixes:
        path, root = motion(estimate, mix, roots, after=offset > 0)
        yield motion_psf_by_root(path, root, kernel, pixel_scale, shares)


def scene_psf(rig: Rig, exposure: Exposure, estimate: Estimate) -> Psf:
    """The PSF of a rig's picture sensor by an estimate, with its uncertainty."""
    assert rig.scene is not None
    mix = scene_motion(rig.n_outputs)
    return next(estimated_psfs(exposure, estimate, [mix], rig.scene.kernel, rig.scene.pixel_scale))


@by_one_thread  # for matrices of some 100 rows the threads of BLAS take several times as long, if cores are busy
def deblur(rig: Rig, exposure: Exposure, estimate: Estimate, method: str = DEFAULT_METHOD) -> RestoredPictures:
    """Restore the pictures of an exposure with the path of its estimate; intensities are cut at 0 and 1.

    A picture that cannot be restored is None, and ``reason`` says why; ``method`` is a name of
    `aolink.restoration.METHODS`.
    """
    scene = spots = None
    noise, added, gain, reasons = math.nan, math.nan, math.nan, list[str]()
    if rig.scene is not None:
        try:
            done = _restored_scene(rig, exposure, estimate, method)
            scene, noise, added, gain = _unit(done.image), done.noise_sd, done.psf_noise_sd, done.expected_gain_db
        except RestorationError as error:
            reasons.append(f"scene: {error}")
    try:
        image, gains = _restored_spots(rig, exposure, estimate, method)
        spots, gain = _unit(image), float(np.mean(gains)) if rig.scene is None else gain
    except RestorationError as error:
        reasons.append(f"spot: {error}")
    return RestoredPictures(
        frame_id=exposure.frame_id, estimator=estimate.estimator, method=method, scene_noise_sd=noise,
        path_noise_sd=added, reason="; ".join(reasons), scene=scene, spots=spots,
        expected_gain_db=gain,
    )  # fmt: skip


def _restored_scene(rig: Rig, exposure: Exposure, estimate: Estimate, method: str) -> Restored:
    assert rig.scene is not None
    if exposure.scene is None:
        raise RestorationError("the picture never came")
    counts = exposure.scene.pixels
    good = exposure.scene.mask & ~rig.scene.is_saturated(counts)
    return restore(rig.scene.to_intensity(counts), scene_psf(rig, exposure, estimate), method=method, mask=good)


def _restored_spots(rig: Rig, exposure: Exposure, estimate: Estimate, method: str) -> tuple[FloatArray, list[float]]:
    sensor = rig.sensor
    share = to_density(sensor, exposure.pixels) * sensor.pixel_size
    good = exposure.mask & ~is_saturated(sensor, exposure.pixels)
    if sensor.defect_mask is not None:
        good &= ~sensor.defect_mask
    mixes = np.eye(rig.n_outputs).reshape(-1, sensor.directions, rig.n_outputs)
    psfs = estimated_psfs(exposure, estimate, mixes, sensor.kernel, sensor.pixel_width)
    out, gains = np.zeros_like(share), list[float]()
    for spot, psf in zip(range(sensor.spots), psfs, strict=False):
        window = sensor.window_of(spot)
        done = restore(share[window], psf, method=method, mask=good[window])
        out[window] = done.image
        gains.append(done.expected_gain_db)
    return out, gains


def _unit(image: FloatArray) -> NDArray[np.float32]:
    return np.clip(image, 0.0, 1.0).astype(np.float32)


def psnr(picture: FloatArray, scene: FloatArray, mask: BoolArray | None = None) -> float:
    """Peak signal-to-noise ratio, dB, for a peak of one; with a mask, of the pixels in it.

    >>> round(psnr(np.array([0.6, 0.0]), np.array([0.5, 1.0]), np.array([True, False])), 9)
    20.0
    """
    error = (picture - scene)[... if mask is None else mask]
    return float(-10 * np.log10(np.mean(error**2))) if error.size else math.nan


def blurred_psnr(sensor: SceneSensor, exposure: Exposure, shift_px: Indices, scene: FloatArray) -> float:
    """`psnr` of the scene before restoration, against the true scene moved by the mean displacement.

    ``shift_px`` is the mean displacement along x, or x and y, whole pixels.
    """
    assert exposure.scene is not None
    x, y = int(shift_px[0]), int(shift_px[1]) if len(shift_px) > 1 else 0
    rows, columns = sensor.shape
    kept = np.zeros(sensor.shape, dtype=bool)
    kept[max(y, 0) : rows + min(y, 0), max(x, 0) : columns + min(x, 0)] = True
    moved = np.roll(scene, (y, x), axis=(0, 1))
    return psnr(sensor.to_intensity(exposure.scene.pixels), moved, kept & exposure.scene.mask)
