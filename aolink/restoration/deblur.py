"""Pictures of an exposure without its blur, restored with the PSF of the estimated path.

Neither the truth nor the true scene is used; `psnr` compares with the true scene afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

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

_SKEW_OF_BAND = 0.05
"""Most of an exposure by which the rows that share a PSF are exposed apart."""
_MARGIN = 16
"""Rows about a band, beside those that its PSF reaches, with which it is restored."""


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
    delays, n_steps = estimate.model.delays, estimate.model.exposed_steps
    shares = step_shares(n_steps, 0.0 if delays else offset)
    for mix in mixes:
        path, root = motion(estimate, mix, roots, after=0 if delays else int(offset > 0))
        if delays:  # one plant moves all spots, and each is seen in its own interval
            first = delays[int(np.flatnonzero(mix.any(axis=0))[0]) % len(delays)]
            path, root = _interval(path, root, first, n_steps)
        yield motion_psf_by_root(path, root, kernel, pixel_scale, shares)


def _interval(path: FloatArray, root: FloatArray, first: int, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """Some steps of a path, (k, n_steps), and of its covariance's root."""
    some = slice(first, first + n_steps)
    return path[:, some], root.reshape(*path.shape, -1)[:, some].reshape(len(path) * n_steps, -1)


def scene_psf(rig: Rig, exposure: Exposure, estimate: Estimate) -> Psf:
    """The PSF of a rig's picture sensor by an estimate, with its uncertainty; that of the middle row, where its rows
    are exposed one after the other."""
    assert rig.scene is not None
    if rig.readout_steps:
        starts = rig.scene.row_starts_s
        return _PsfOfRow(rig, exposure, estimate).at(float(starts[len(starts) // 2]))
    mix = scene_motion(rig.n_outputs)
    return next(estimated_psfs(exposure, estimate, [mix], rig.scene.kernel, rig.scene.pixel_scale))


class _PsfOfRow:
    """The PSFs of the scene's rows, from the mean motion of the spots from the first row's exposure to the last one's.

    At each step it is the mean of the spots whose own intervals have that step; where none has, the model's prediction
    from the end of the exposure, or what was first seen.
    """

    def __init__(self, rig: Rig, exposure: Exposure, estimate: Estimate) -> None:
        assert rig.scene is not None
        self._rig, self._scene, self._offset = rig, rig.scene, exposure.start_offset
        self._n_steps = n_steps = estimate.model.exposed_steps
        total = n_steps + rig.readout_steps + 1
        mix, roots, delays = scene_motion(rig.n_outputs), psd_root(estimate.coefficient_covariance), rig.axis_delays
        of_output = np.repeat(delays, rig.plant.n_outputs)
        groups = np.unique(delays)
        steps = np.arange(total)
        seen = np.array([(steps >= late) & (steps < late + estimate.n_steps) for late in groups])
        seen[:, ~seen.any(axis=0)] = True
        parts = np.array([np.mean(of_output == late) for late in groups])
        weights = seen / (parts @ seen)
        self._path, each = np.zeros((len(mix), total)), []
        after = max(total - int(groups[0]) - estimate.n_steps, 0)
        for late, weight in zip(groups, weights, strict=True):
            path, root = motion(estimate, mix * (of_output == late), roots, after=after)
            at = np.clip(steps - late, 0, path.shape[1] - 1)
            self._path += weight * path[:, at]
            each.append(weight[:, None] * root.reshape(*path.shape, -1)[:, at])
        self._root = np.concatenate(each, axis=2).reshape(len(mix) * total, -1)

    def at(self, start_s: float) -> Psf:
        """The PSF of a row that starts so long after the exposure, s."""
        start = start_s / self._rig.timing.fast_step_s + self._offset
        shares = step_shares(self._n_steps, start % 1)
        path, root = _interval(self._path, self._root, int(start), len(shares))
        return motion_psf_by_root(path, root, self._scene.kernel, self._scene.pixel_scale, shares)


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
    if rig.readout_steps:
        return _restored_by_rows(rig, exposure, estimate, method, rig.scene.to_intensity(counts), good)
    return restore(rig.scene.to_intensity(counts), scene_psf(rig, exposure, estimate), method=method, mask=good)


def _restored_by_rows(
    rig: Rig, exposure: Exposure, estimate: Estimate, method: str, intensity: FloatArray, good: BoolArray
) -> Restored:
    """The scene restored band by band of its rows, each with the PSF of its middle row."""
    assert rig.scene is not None
    psfs, starts = _PsfOfRow(rig, exposure, estimate), rig.scene.row_starts_s
    most = _SKEW_OF_BAND * rig.timing.exposure_steps * rig.timing.fast_step_s
    count = min(max(1, math.ceil(float(np.ptp(starts)) / most)), len(starts))
    done = []
    image = np.empty_like(intensity)
    for rows in np.array_split(np.arange(len(starts)), count):
        psf = psfs.at(float(starts[rows].mean()))
        margin = 2 * (1 if psf.on_line else psf.values.shape[0]) + _MARGIN
        top, end = max(int(rows[0]) - margin, 0), int(rows[-1]) + 1 + margin
        found = restore(intensity[top:end], psf, method=method, mask=good[top:end])
        image[rows] = found.image[rows - top]
        done.append(found)
    noise, added, gain = np.mean([(each.noise_sd, each.psf_noise_sd, each.expected_gain_db) for each in done], axis=0)
    return replace(
        done[0], image=image, noise_sd=float(noise), psf_noise_sd=float(added), expected_gain_db=float(gain)
    )  # fmt: skip


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
