"""Frames of many spots: a profile for each slope of each spot, with its noise, and what is measured of it.

A window's counts summed over its rows are what a line sensor (`BaseSensor.profile`) would see of the slope
along x, summed over its columns of the one along y; so every estimator of line sensors works on them. A pixel
that cannot be used takes its whole column out of the one and its whole row out of the other, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.frames.frame_data import FrameData, Measurement, Needs, Profile, SpotWindows
from aolink.estimation.frames.moments import (
    measure_moments,
    significance_scale,
    spot_significance,
)
from aolink.estimation.frames.plane_moments import measure_moments_2d
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.optics.camera import effective_noise_density, is_saturated, to_density
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import SpotSensor
from aolink.rig import Plant


@dataclass(frozen=True, kw_only=True, eq=False)
class Profiles:
    """A profile for each output of the rig, as counts of `SpotSensor.profile`."""

    counts: FloatArray
    """Whole numbers, zero where the mask is, (n_outputs, pixels); contiguous in memory along the outputs."""
    mask: BoolArray
    """True where all pixels summed can be used, (n_outputs, pixels), alike."""


def profiles(sensor: SpotSensor, pixels: NDArray[np.uint16], usable: BoolArray) -> Profiles:
    """Sums of each window over its rows (x) and over its columns (y); both arguments are (rows, columns)."""
    # 256 counts of 16 bits, which a window has at most along a side, make a sum that single precision holds exactly.
    counts = _summed(sensor, pixels[None].astype(np.float32))
    if usable.all():
        return Profiles(counts=counts, mask=np.ones_like(counts, dtype=bool))
    mask = _summed(sensor, (~usable)[None].astype(np.float32)) == 0
    return Profiles(counts=np.where(mask, counts, 0.0), mask=mask)


def _summed(sensor: SpotSensor, light: NDArray[np.float32]) -> FloatArray:
    """Sums of each window of frames over its rows and over its columns, (frames * n_outputs, pixels)."""
    (rows, columns), (height, width), frames = sensor.grid, sensor.window, len(light)
    sums = np.empty((width, frames, rows, columns, 2))
    sums[..., 0] = np.add.reduce(light.reshape(frames, rows, height, columns, width), axis=2).transpose(3, 0, 1, 2)
    # As a product: NumPy takes several times as long to sum over a short last axis.
    along_rows = light.reshape(frames, -1, width) @ np.ones(width, np.float32)  # frame by frame: on one thread
    sums[..., 1] = along_rows.reshape(frames, rows, height, columns).transpose(2, 0, 1, 3)
    if sensor.light is not None:
        sums = sums.reshape(width, frames, -1, 2)[:, :, sensor.lit]
    return sums.reshape(width, -1).T


def moments_of_frames(
    sensor: SpotSensor, frames: NDArray[np.uint16], needs: Needs, least_significance: FloatArray | float
) -> tuple[Indices, Measurement | None]:
    """Which of some frames show all spots without a flaw, and the moments of these, a row for each output of each.

    Frames are (frames, rows, columns); all of their pixels arrived.
    """
    from aolink.estimation.compiled.frames import brightest_stretches, window_sums  # not before it is needed

    line, count, (rows, columns), side = sensor.profile, len(frames), sensor.grid, sensor.window[0]
    sums, ends = np.empty((side, count, rows, columns, 2)), np.empty((count, 2), dtype=np.int64)
    window_sums(np.ascontiguousarray(frames), side, sums, ends)
    each = sums.reshape(side, count, -1, 2)
    seen = (each if sensor.light is None else each[:, :, sensor.lit]).reshape(side, -1)
    counts, stretches = seen.T, np.empty(seen.shape[1])
    brightest_stretches(to_density(line, seen), stretches)
    lit = (stretches * significance_scale(line)).reshape(count, -1) >= least_significance
    good = np.flatnonzero(lit.all(axis=1) & (ends[:, 0] > 0) & (ends[:, 1] < sensor.full_scale))
    if len(good) < count:
        counts = counts.reshape(count, -1, line.pixels)[good].reshape(-1, line.pixels)
    if not len(good):
        return good, None
    light = None if sensor.spot_light is None else np.tile(np.repeat(sensor.spot_light, 2), len(good))
    return good, measure_moments(line, counts, needs.orders, light)


def measure_spots(
    sensor: SpotSensor, plant: Plant, pixels: NDArray[np.uint16], arrived: BoolArray, needs: Needs,
    least_significance: FloatArray | float,
) -> tuple[FrameData | None, str]:  # fmt: skip
    """What is measured of each axis in a frame, or None; and a remark on how many axes are not measured, and why.

    ``pixels`` is the frame, ``arrived`` which of them did, (rows, columns). ``least_significance`` says by how many
    standard deviations of noise a spot must stand out, (n_outputs,) or one for all.
    """
    saturated = is_saturated(sensor, pixels) & arrived
    light = None if sensor.spot_light is None else np.repeat(sensor.spot_light, 2)
    seen: SpotWindows | None = None
    if needs.what == "windows":
        seen = _seen(sensor, plant, pixels, arrived & ~saturated)
        shone = seen.density.reshape(sensor.spots, *sensor.window) * sensor.pixel_width
        share = np.asarray(np.repeat(seen.mask.reshape(sensor.spots, -1).mean(axis=1), 2))
        density = np.stack([shone.sum(axis=1), shone.sum(axis=2)], axis=1).reshape(2 * sensor.spots, -1)
    else:
        found = profiles(sensor, pixels, arrived & ~saturated)
        share = np.count_nonzero(found.mask, axis=1) / sensor.profile.pixels
        density = np.where(found.mask, to_density(sensor.profile, found.counts), 0.0)
    whole: BoolArray = share >= needs.least_usable
    lit = spot_significance(sensor.profile, density) >= least_significance
    good: BoolArray = np.asarray((whole & lit).reshape(plant.axes, plant.n_outputs))
    usable: BoolArray = np.asarray(good.all(axis=1))
    left_out = 0
    if seen is not None and needs.least_spots < 1:
        of_spot: BoolArray = np.asarray(good.reshape(plant.axes, -1, 2).all(axis=2))
        usable = np.asarray(of_spot.mean(axis=1) >= needs.least_spots)
        left_out = int(np.count_nonzero(~of_spot[usable]))
        kept = of_spot[:, :, None, None]
        seen = replace(seen, density=np.where(kept, seen.density, 0.0), mask=seen.mask & kept)
    reasons = [
        (_count(sensor, ~arrived), f"of {pixels.size} pixels are missing"),
        (_count(sensor, saturated), f"of {pixels.size} pixels are at an end of the scale"),
        (np.count_nonzero(whole & ~lit), f"of {len(lit)} profiles show no spot"),
    ]
    remark = ", ".join(f"{count} {what}" for count, what in reasons if count)
    if not usable.all():
        remark = f"{int((~usable).sum())} of {plant.axes} axes predicted: {remark}"
    elif left_out:
        remark = f"{left_out} of {sensor.spots} spots left out: {remark}"
    elif remark:
        remark += ": left out"
    if not usable.any():
        return None, remark
    measured: FrameData
    if seen is not None:
        measured = seen.per_light(sensor.spot_light)
    elif needs.what == "profile":
        # An axis without a measurement needs one that can be computed with.
        if light is not None:
            density = density / light[:, None]
        measured = Profile(density=density, mask=found.mask | ~usable.repeat(plant.n_outputs)[:, None], light=light)
    elif plant.n_outputs == 1:
        counts = found.counts if usable.all() else found.counts[usable]
        measured = measure_moments(sensor.profile, counts, needs.orders, None if light is None else light[usable])
    else:
        measured = _coupled_moments(sensor, plant, pixels, usable, needs)
    if not usable.all():
        measured = replace(_spread(measured, usable), usable=usable)
    return measured, remark


def _count(sensor: SpotSensor, pixels: BoolArray) -> int:
    """How many of these pixels, (rows, columns), are in windows: in most frames there are none."""
    return int(np.count_nonzero(spot_windows(sensor, pixels))) if pixels.any() else 0


def _seen(sensor: SpotSensor, plant: Plant, pixels: NDArray[np.uint16], good: BoolArray) -> SpotWindows:
    shape = (plant.axes, plant.n_outputs // 2, *sensor.window)
    density = np.where(good, to_density(sensor, pixels), 0.0)
    mask = spot_windows(sensor, good).reshape(shape)
    return SpotWindows(density=spot_windows(sensor, density).reshape(shape), mask=mask)


def _coupled_moments(
    sensor: SpotSensor, plant: Plant, pixels: NDArray[np.uint16], usable: BoolArray, needs: Needs
) -> Measurement:
    """Moments where one copy of the plant moves whole spots: a spot's two slopes share the noise of its pixels."""
    spots = plant.n_outputs // 2
    used = np.repeat(usable, spots)
    density = spot_windows(sensor, to_density(sensor, pixels))[used]
    light = None if sensor.spot_light is None else sensor.spot_light[used]
    edges = sensor.profile.edges
    along = [(p, 0) for p in needs.orders] + [(0, p) for p in needs.orders]
    noise = effective_noise_density(sensor)
    found = measure_moments_2d(
        density, edges, edges, sensor.kernel.covariance, noise, along, light, sensor.photoelectrons
    )
    copies, m = len(density) // spots, len(along)
    value = found.value.reshape(copies, spots * m)
    return Measurement(value=value, covariance=found.covariance.reshape(copies, spots, m, m))


def _spread(measured: FrameData, usable: BoolArray) -> FrameData:
    """Moments of the usable axes spread over all axes; the others get zero with unit covariance."""
    if not isinstance(measured, Measurement):
        return measured
    value = np.zeros((len(usable), measured.value.shape[1]))
    *lead, size, _ = measured.covariance.shape[1:]
    covariance = np.tile(np.eye(size), (len(usable), *lead, 1, 1))
    value[usable], covariance[usable] = measured.value, measured.covariance
    return Measurement(value=value, covariance=covariance)
