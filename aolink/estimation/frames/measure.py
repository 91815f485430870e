"""The measurement of exposures for an estimator: their moments, profiles or windows, each independent of earlier
exposures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aolink.errors import EstimatorError
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.flaws import has_flaws, without_flaws
from aolink.estimation.frames.frame_data import FrameData, Measurement, Needs, Profile
from aolink.estimation.frames.moments import least_significance, measure_moments, spot_significance
from aolink.estimation.frames.spots import Profiles, measure_spots, moments_of_frames, profiles
from aolink.exposure import Exposure
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.optics.camera import is_saturated, to_density
from aolink.optics.sensor import BaseSensor, RegionSensor, Sensor, SpotSensor
from aolink.rig import Rig

MeasuredFrame = tuple[FrameData | None, str]
"""The measurements of an exposure, or None; and a remark about unusable parts, or an empty text."""

_MOST_BAD = 0.1
"""Share of a region's pixels that may be filled in."""


class Measurements:
    """What an estimator needs of each of some exposures, the same bits as for each alone.

    Frames without a flaw of a line sensor, or of spots with a copy of the plant for each slope, are measured all at
    once, the others one by one on demand.
    """

    def __init__(self, rig: Rig, exposures: Sequence[Exposure], needs: Needs | None) -> None:
        self._rig, self._exposures, self._needs = rig, exposures, needs
        self.rows: list[int] = [-1] * len(exposures)
        """Row of each exposure in ``moments``, -1 where it has none."""
        self.moments: Measurement | None = None
        sensor = rig.sensor
        self._axes = rig.plant.axes
        if needs is None or needs.what != "moments" or rig.plant.n_outputs > 1:
            return
        given = [without_flaws(sensor, each, needs) for each in exposures] if has_flaws(sensor) else exposures
        shape = sensor.shape
        whole = [
            k
            for k, each in enumerate(given)
            if each.slopes is None and each.pixels.shape == shape == each.mask.shape and each.mask.all()
        ]
        if not whole:
            return
        if isinstance(sensor, SpotSensor):
            # One frame of many spots is not copied.
            pixels = [given[k].pixels for k in whole]
            frames = pixels[0][None] if len(pixels) == 1 else np.stack(pixels)
            good, moments = moments_of_frames(sensor, frames, needs, _least_significance(sensor))
        elif shape[0] == 1:
            good, moments = _moments_of_lines(sensor.profile, np.concatenate([given[k].pixels for k in whole]), needs)
        else:
            return
        if moments is not None:
            self.moments = moments
            for row, k in enumerate(good.tolist()):
                self.rows[whole[k]] = row

    def __getitem__(self, k: int) -> MeasuredFrame:
        """The measurements of exposure k, or None; and a remark."""
        row = self.rows[k]
        if self.moments is None or row < 0:
            return measure(self._rig, self._exposures[k], self._needs)
        return self.some(row, row + 1), ""

    def some(self, row: int, end: int) -> Measurement:
        """Moments in some rows, each of all axes."""
        assert self.moments is not None
        some = slice(row * self._axes, end * self._axes)
        return Measurement(value=self.moments.value[some], covariance=self.moments.covariance[some])


def profiles_of(sensor: BaseSensor, pixels: NDArray[np.uint16], usable: BoolArray) -> Profiles:
    """A profile for each output, as counts of ``sensor.profile``; the frame of a line is one."""
    if isinstance(sensor, SpotSensor):
        return profiles(sensor, pixels, usable)
    return Profiles(counts=pixels.astype(np.float64), mask=usable)


def _moments_of_lines(sensor: Sensor, pixels: NDArray[np.uint16], needs: Needs) -> tuple[Indices, Measurement | None]:
    """Which frames of a line sensor, (frames, pixels), show a spot without a flaw, and the moments of these."""
    lit = spot_significance(sensor, to_density(sensor, pixels)) >= least_significance(sensor)
    good = np.flatnonzero(lit & ~is_saturated(sensor, pixels).any(axis=1))
    return good, measure_moments(sensor, pixels[good], needs.orders) if len(good) else None


def measure(rig: Rig, exposure: Exposure, needs: Needs | None) -> MeasuredFrame:
    """The measurements that an estimator needs of an exposure, or None; and a remark about unusable parts."""
    if needs is None:
        return None, ""
    if exposure.slopes is not None:
        return _measured_slopes(rig, exposure.frame_id, exposure.slopes, needs)
    sensor = rig.sensor
    if exposure.pixels.shape != sensor.shape:
        return None, f"the frame has {exposure.pixels.shape} pixels, the rig's sensor {sensor.shape}"
    if isinstance(sensor, RegionSensor):
        return _of_region(sensor, exposure, needs)
    if has_flaws(sensor):
        exposure = without_flaws(sensor, exposure, needs)
    pixels = exposure.pixels
    if isinstance(sensor, SpotSensor):
        return measure_spots(sensor, rig.plant, pixels, exposure.mask, needs, _least_significance(sensor))
    sensor = sensor.profile
    saturated = is_saturated(sensor, pixels) & exposure.mask
    usable = exposure.mask & ~saturated
    remark = ""
    if not usable.all():
        remark = f"{int((~exposure.mask).sum())} of {pixels.size} pixels are missing"
        if saturated.any():
            remark = f"{int(saturated.sum())} of {pixels.size} pixels are at an end of the scale"
        if usable.sum() < needs.least_usable * pixels.size:
            return None, remark
        remark += ": left out"
    density = np.where(usable, to_density(sensor, pixels), 0.0)
    significance = spot_significance(sensor, density)[0]
    if significance < least_significance(sensor):
        return None, f"no spot: the brightest stretch is {significance:.1f} standard deviations of noise"
    rows = (rig.plant.axes, -1)
    if needs.what != "moments":
        return Profile(density=density.reshape(rows), mask=usable.reshape(rows)), remark
    return measure_moments(sensor, pixels.reshape(rows), needs.orders), ""


def _of_region(sensor: RegionSensor, exposure: Exposure, needs: Needs) -> MeasuredFrame:
    """Mean and covariance of a region's path along the axes of its texture, as far as it shows them."""
    from scipy import ndimage  # loads long

    density, remark = to_density(sensor, exposure.pixels), ""
    bad = ~exposure.mask | (exposure.pixels >= sensor.full_scale)
    if sensor.defect_mask is not None:
        bad |= sensor.defect_mask
    if bad.any():
        remark = f"{int(bad.sum())} of {bad.size} pixels cannot be used"
        if bad.mean() > _MOST_BAD:
            return None, remark
        near = ndimage.distance_transform_edt(bad, return_distances=False, return_indices=True)
        density, remark = density[tuple(near)], f"{remark}: filled in from those beside them"
    seen = sensor.texture.seen(density)
    if seen is None:
        return None, "the reference is not seen, or went out of its margin"
    means, spreads = sensor.texture.known_means, sensor.texture.known_spreads
    value = [seen.mean[: len(means)]]
    variance = [seen.mean_variance[: len(means)]]
    if 2 in needs.orders:
        value.append(seen.spread[: len(spreads)] + spreads @ np.array(sensor.blur))
        variance.append(seen.spread_variance[: len(spreads)])
    return Measurement(value=np.concatenate(value)[None], covariance=np.diag(np.concatenate(variance))[None]), remark


def _measured_slopes(rig: Rig, frame_id: int, slopes: FloatArray, needs: Needs) -> MeasuredFrame:
    """Slopes that came without pixels, with the noise that the rig's sensor has in a centroid.

    Raises EstimatorError for an estimator that needs more of a frame than its centroids.
    """
    if needs.what != "moments" or needs.orders != (1,):
        raise EstimatorError(
            f"exposure {frame_id} holds slopes only, no pixels: o1 and open-loop can use it, no other estimator"
        )
    value = slopes.reshape(rig.plant.axes, -1) if slopes.size == rig.n_outputs else None
    if value is None:
        return None, f"there are {slopes.size} slopes, the rig has {rig.n_outputs}"
    usable: BoolArray = np.asarray(np.isfinite(value).all(axis=1))
    if not usable.any():
        return None, "no slope was measured"
    noise = centroid_covariance(rig)
    return Measurement(
        value=np.where(usable[:, None], value, 0.0),
        covariance=np.broadcast_to(noise, (len(value), *noise.shape[1:])),
        usable=None if usable.all() else usable,
    ), ("" if usable.all() else f"slopes of {int((~usable).sum())} of {len(usable)} axes are missing")


def _least_significance(sensor: SpotSensor) -> FloatArray:
    """`least_significance` of each profile, (n_outputs,), or of all."""
    light = 1.0 if sensor.spot_light is None else np.repeat(sensor.spot_light, 2)
    return least_significance(sensor.profile, light)
