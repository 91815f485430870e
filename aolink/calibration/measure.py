"""Calibration of a camera from its own frames: black level, noise, gain, scale, image kernel, standard deviations.

It takes counts and gives a `Calibration`. Dark frames give the black level and the read noise. The photon transfer
curve (a pixel's variance against its mean, EMVA 1288) of flats and of the resting spot gives the counts that one
photo-electron makes. The mean profile of the resting spot gives the counts of a density of one and the kernel's width.
Values for which the camera was not shown the light stay unknown, and `Calibration.notes` says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from aolink.calibration.spot import Spot, check_at_rest, fit_spots
from aolink.errors import CalibrationError
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.sensor import Sensor
from aolink.rig import Rig

Kind = Literal["dark", "flat", "still"]
KINDS: tuple[Kind, ...] = ("dark", "flat", "still")

LEAST_FRAMES = 10
"""Fewer frames give variances that are too uncertain for the checks."""
_SURE = 1e-6
"""Probability by chance below which a deviation is reported, or refused."""
_HOT = 6.0
"""Standard deviations from the others at which a dark pixel counts as hot."""
_MOST_CLIPPED = 0.01
"""Share of a pixel's frames that may be at an end of the scale."""
_UNEVEN = 0.3
"""Scatter over the mean from which on a frame does not count as flat."""
_ROUNDING = 1 / 12
"""Variance of rounding to whole counts."""
_VAGUE = 0.3
"""Largest standard deviation of the kernel's width, as a share of the width."""
_SEEN = 3.0
"""Standard deviations from which on shot noise counts as measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """Frames of one recording, all with the same light."""

    kind: Kind
    counts: NDArray[np.uint16]
    """(frames, pixels)"""
    source: str
    """The name of the recording in errors and notes."""


@dataclass(frozen=True)
class Measured:
    """A value and its standard deviation (NaN where it has none)."""

    value: float
    sd: float


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """The measured values; None where these frames do not determine one."""

    black_level: Measured
    """Black level, counts."""
    read_noise: Measured
    """Standard deviation of a pixel, counts, rounding to whole counts included."""
    noise_density: Measured
    """V, the variance of the noise density, without the rounding to whole counts."""
    gain: Measured | None
    """Counts that one photo-electron makes."""
    photoelectrons: Measured | None
    """Photo-electrons of the whole spot in one exposure; zero where there are too many to be counted."""
    counts_per_density: Measured | None
    kernel_sigma: Measured | None
    """Kernel width, slope units, in the rig file's convention: variance sigma^2/2."""
    spot: Spot | None
    """The fit of the resting spot."""
    frames: dict[Kind, int]
    """Number of frames of each kind that were used."""
    hot_pixels: tuple[int, ...]
    """Pixels that were left out: far too bright, too dark or too noisy in the dark."""
    notes: tuple[str, ...]
    """Notes about values that the frames do not determine, and about oddities in the frames."""

    @property
    def values(self) -> dict[str, Measured]:
        """The measured values, by the rig file's key."""
        names = ("black_level", "noise_density", "counts_per_density", "photoelectrons")
        found = {f"sensor.{name}": getattr(self, name) for name in names} | {"sensor.kernel.sigma": self.kernel_sigma}
        return {key: value for key, value in found.items() if value is not None}


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelStatistics:
    """Mean and variance over time of each pixel."""

    frames: int
    mean: FloatArray
    """Counts, (pixels,)."""
    variance: FloatArray
    """Variance from differences of successive frames, which neither a fixed pattern nor a slow drift affects,
    (pixels,)."""
    spread: float
    """Variance of ``variance`` over its square, for Gaussian noise."""


def pixel_statistics(series: Sequence[NDArray[np.uint16]], *, steady: bool = True) -> PixelStatistics:
    """Statistics over several series of frames, (frames, pixels) each.

    With ``steady`` False the light may flicker: the common factor of all pixels of a frame is removed first.
    """
    counts = [each.astype(np.float64) for each in series]
    frames = sum(map(len, counts))
    mean = np.sum([each.sum(axis=0) for each in counts], axis=0) / frames
    pixels = len(mean)
    share = 1.0 if steady else (pixels - 1) / pixels
    if not steady:
        counts = [each - each.mean(axis=1, keepdims=True) for each in counts]
    differences = frames - len(counts)
    squares = np.sum([(np.diff(each, axis=0) ** 2).sum(axis=0) for each in counts], axis=0)
    spread = sum(3 * len(each) - 4 for each in counts) / differences**2 / share
    return PixelStatistics(frames=frames, mean=mean, variance=squares / (2 * differences * share), spread=spread)


def line_sensor(rig: Rig) -> Sensor:
    """The rig's sensor. Raises CalibrationError where it is not a line: nothing else can be calibrated."""
    if not isinstance(rig.sensor, Sensor):
        raise CalibrationError(
            f"{rig.name} has no line sensor, and only that can be calibrated: put the known values of this one into"
            " the rig file by hand"
        )
    return rig.sensor


def calibrate(rig: Rig, recordings: Sequence[Frames]) -> Calibration:
    """Calibrate a line sensor from frames under known light.

    Parameters
    ----------
    rig:
        The rig; its pixels and field are taken as they are, and its other values are starting points of the search.
    recordings:
        At least one of kind "dark"; flats at any levels, resting spots at any positions.

    Raises
    ------
    CalibrationError
        There are no dark frames or too few frames, they are saturated, or not of the kind that they are marked with.
    """
    sensor = line_sensor(rig)
    for each in recordings:
        if len(each.counts) < LEAST_FRAMES:
            raise CalibrationError(
                f"{each.source} holds {len(each.counts)} whole frames, at least {LEAST_FRAMES} are needed (better 100):"
                " record more"
            )
    darks, flats, stills = ([each for each in recordings if each.kind == kind] for kind in KINDS)
    if not darks:
        raise CalibrationError(
            "there are no dark frames, and without the black level nothing else can be measured: cover the camera and"
            " record some with --calibration dark"
        )
    notes: list[str] = []
    dark = pixel_statistics([each.counts for each in darks])
    good = _good_pixels(dark, " and ".join(each.source for each in darks))
    for each in recordings:
        _check_clipping(rig, each, good)
    read = _mean_variance(dark.variance[good], dark.spread)
    black = _black_level(dark, darks, good, read, notes)
    flat_signals = [_signal(pixel_statistics([each.counts], steady=False), dark) for each in flats]
    still_signals = [_signal(pixel_statistics([each.counts]), dark) for each in stills]
    for each, signal in zip(flats, flat_signals, strict=True):
        _check_flat(each, signal, good)
    # A slight trembling of the spot is like shot noise, so flats are preferred.
    curves = flat_signals or still_signals
    gain = _photon_transfer(curves, dark, good, read, notes) if curves else None
    if gain and not flats and gain.value > _SEEN * gain.sd:
        notes.append(
            "photoelectrons comes from the still spot's own pixels: a tremble or a flicker too small to be seen makes"
            " it too low (several times, at a tenth of a pixel); flats would be sure"
        )
    spot = None
    if stills:
        noise = (read.value, max(gain.value, 0.0) if gain else 0.0)
        lit = list(zip(stills, still_signals, strict=True))
        spot = fit_spots(sensor, [(each.source, s.frames, s.mean) for each, s in lit], good, noise, dark.frames)
        for k, (each, signal) in enumerate(lit):
            alone, spread = signal.variance, signal.spread
            if flats and gain:  # then the pixels' own noise is known independently of this spot
                alone = read.value + max(gain.value + 2 * gain.sd, 0.0) * np.maximum(signal.mean, 0.0)
                spread = 0.0
            notes += check_at_rest(sensor, each.source, each.counts[:, good], (alone[good], spread), good, spot, k)
        if not spot.gaussian:
            notes.append(spot.complaint)
    return _result(rig, recordings, black, read, gain, spot, good, notes)


def _signal(lit: PixelStatistics, dark: PixelStatistics) -> PixelStatistics:
    """The statistics above each pixel's own dark level."""
    return replace(lit, mean=lit.mean - dark.mean)


def _mean_variance(variances: FloatArray, spread: float) -> Measured:
    """Mean variance of pixels, which need not be alike."""
    # E[s^4] = sigma^4 (1 + spread)
    mean, sd = float(variances.mean()), math.sqrt(spread / (1 + spread) * float((variances**2).sum())) / len(variances)
    # Noise under half a count depends on where the level lies between two counts.
    return Measured(mean, sd) if mean > 0.25 else Measured(max(mean, _ROUNDING), _ROUNDING)


def _good_pixels(dark: PixelStatistics, source: str) -> BoolArray:
    """Pixels that are neither hot nor noisy. Raises CalibrationError if light falls on the dark frames."""
    typical = max(float(np.median(dark.variance)), _ROUNDING)
    level = float(np.median(dark.mean))
    scatter = max(1.4826 * float(np.median(np.abs(dark.mean - level))), math.sqrt(typical / dark.frames))
    hot = np.abs(dark.mean - level) > _HOT * scatter
    freedom = 2 / dark.spread
    noisy = stats.chi2.sf(dark.variance / typical * freedom, freedom) < 1e-9
    bright = dark.mean > level + _HOT * scatter
    # Hot pixels stand alone; a spot covers neighbouring pixels, a moving spot even more of them.
    alone = bright & ~np.append(bright[1:], False) & ~np.insert(bright[:-1], 0, False)
    light = np.concatenate([[0.0], np.cumsum(np.where(alone, 0.0, dark.mean - level))])
    for length in (2**k for k in range(1, (len(hot) // 2).bit_length())):
        sums = light[length:] - light[:-length]
        sd = scatter * math.sqrt(length + length**2 * math.pi / 2 / len(hot))
        if sums.max() > 8 * sd:
            first = int(sums.argmax())
            raise CalibrationError(
                f"{source} is said to be dark, but there is light on pixels {first} to {first + length - 1}:"
                " cover the camera or switch the light off, and record it again"
            )
    good: BoolArray = ~(hot | noisy)
    if good.mean() < 0.9:
        raise CalibrationError(
            f"{source}: {int((~good).sum())} of {len(good)} pixels are far from the others in the dark:"
            " is the camera covered, and is its black level steady?"
        )
    return good


def _check_clipping(rig: Rig, frames: Frames, good: BoolArray) -> None:
    top = rig.sensor.full_scale
    for clipped, where, advice in (
        (frames.counts >= top, f"full scale ({top})", "lower the light or shorten the exposure"),
        (frames.counts == 0, "zero", "raise the camera's black level (its offset)"),
    ):
        share = clipped.mean(axis=0)[good]
        if (share > _MOST_CLIPPED).any():
            raise CalibrationError(
                f"{frames.source} is saturated: {int((share > _MOST_CLIPPED).sum())} pixels are at {where}"
                f" in up to {share.max():.0%} of the frames; {advice}, and record it again"
            )


def _black_level(
    dark: PixelStatistics, darks: Sequence[Frames], good: BoolArray, read: Measured, notes: list[str]
) -> Measured:
    pixels = int(good.sum())
    sd = math.sqrt(read.value / (pixels * dark.frames))
    levels = np.concatenate([each.counts[:, good].mean(axis=1) for each in darks])
    wander, expected = float(levels.var(ddof=1)), read.value / pixels
    if stats.chi2.sf((dark.frames - 1) * wander / expected, dark.frames - 1) < _SURE:
        notes.append(
            f"the black level wanders by {math.sqrt(wander):.2g} counts from frame to frame, more than its noise"
        )
        sd = math.sqrt(wander / dark.frames)
    # A fixed pattern is an error of every single density, so a note mentions it.
    pattern = float(dark.mean[good].var(ddof=1)) - read.value / dark.frames
    if stats.chi2.sf((pixels - 1) * (pattern / (read.value / dark.frames) + 1), pixels - 1) < _SURE:
        notes.append(f"the pixels' black levels differ by {math.sqrt(pattern):.2g} counts (a fixed pattern)")
    return Measured(float(dark.mean[good].mean()), sd)


def _check_flat(frames: Frames, signal: PixelStatistics, good: BoolArray) -> None:
    mean = signal.mean[good]
    noise = signal.variance[good] / signal.frames
    if mean.mean() < 5 * math.sqrt(2 * noise.mean() / len(mean)):
        raise CalibrationError(
            f"{frames.source} is said to be flat, but is no brighter than the dark frames: is the light on?"
            " Record both again"
        )
    uneven = math.sqrt(max(0.0, float(mean.var() - 2 * noise.mean()))) / float(mean.mean())
    if uneven > _UNEVEN:
        raise CalibrationError(
            f"{frames.source} is said to be flat, but its pixels differ by {uneven:.0%}: take the spot away, light the"
            " sensor evenly, and record it again"
        )


def _photon_transfer(
    curves: Sequence[PixelStatistics], dark: PixelStatistics, good: BoolArray, read: Measured, notes: list[str]
) -> Measured:
    """Counts per electron K of variance = read variance + K (mean - black), over all lit pixels."""
    x = np.concatenate([curve.mean[good] for curve in curves])
    y = np.concatenate([curve.variance[good] for curve in curves])
    ones = np.ones(int(good.sum()))
    spread = np.concatenate([curve.spread * ones for curve in curves])
    over_frames = np.concatenate([(1 / curve.frames + 1 / dark.frames) * ones for curve in curves])
    design = np.stack([np.append(np.ones(len(x)), 1.0), np.append(x, 0.0)], axis=1)
    target = np.append(y, read.value)
    intercept, slope = read.value, 0.0
    for _ in range(50):
        # Weights follow the model, not the measured variances: otherwise variances that are low by chance would count
        # too much.
        model = intercept + max(slope, 0.0) * np.maximum(x, 0.0)
        # The mean is uncertain as well; with Poisson noise the remaining terms cancel against those of the variance.
        weight = 1 / np.append(spread * model**2 + slope**2 * intercept * over_frames, read.sd**2)
        covariance = np.linalg.inv((design.T * weight) @ design)
        before, (intercept, slope) = slope, covariance @ (design.T @ (weight * target))
        intercept = max(intercept, 0.5 * read.value)
        if abs(slope - before) < 1e-9 * abs(slope):
            break
    misfit = float((weight * (target - design @ [intercept, slope]) ** 2).sum())
    if stats.chi2.sf(misfit, len(x) - 1) < _SURE:
        notes.append(
            f"variance does not grow linearly with the mean (chi-square {misfit:.0f} for {len(x) - 1}): the light"
            " flickers, the spot trembles or the camera is not linear, and photoelectrons is doubtful"
        )
    return Measured(float(slope), math.sqrt(covariance[1, 1]))


def _result(
    rig: Rig, recordings: Sequence[Frames], black: Measured, read: Measured, gain: Measured | None, spot: Spot | None,
    good: BoolArray, notes: list[str],
) -> Calibration:  # fmt: skip
    sensor, scale = rig.sensor, None
    if spot is not None:
        scale = Measured(spot.counts_per_density, spot.counts_per_density_sd)
    else:
        notes.append(
            "without a still spot, counts_per_density and kernel.sigma stay as the file has them, and noise_density"
            " and photoelectrons rest on that counts_per_density"
        )
    known = (rig.calibration and rig.calibration.counts_per_density_sd) or 0.0
    used = scale or Measured(sensor.counts_per_density, known)
    density_per_variance = sensor.pixel_width / used.value**2
    density = density_per_variance * max(0.0, read.value - _ROUNDING)
    density_sd = math.hypot(density_per_variance * read.sd, 2 * density * used.sd / used.value)
    if read.value <= 0.25:
        notes.append("the read noise is under half a count: rounding hides it, noise_density is uncertain")
    sigma = Measured(spot.sigma, spot.sigma_sd) if spot else None
    if sigma and sigma.sd > _VAGUE * sigma.value:
        notes.append(
            "the spot is too narrow for the pixels to show its width, kernel.sigma stays as the file has it:"
            " record still spots elsewhere, on the border of two pixels"
        )
        sigma = None
    return Calibration(
        black_level=black, read_noise=Measured(math.sqrt(read.value), read.sd / (2 * math.sqrt(read.value))),
        noise_density=Measured(density, density_sd), gain=gain,
        photoelectrons=_photoelectrons(rig, gain, used, notes), counts_per_density=scale, kernel_sigma=sigma, spot=spot,
        frames={kind: sum(len(each.counts) for each in recordings if each.kind == kind) for kind in KINDS},
        hot_pixels=tuple(map(int, np.flatnonzero(~good))), notes=tuple(notes),
    )  # fmt: skip


def _photoelectrons(rig: Rig, gain: Measured | None, scale: Measured, notes: list[str]) -> Measured | None:
    """Electrons of the whole spot: a density of one over the slope unit is ``scale`` counts in D of it."""
    width = rig.sensor.pixel_width
    if gain is None:
        notes.append("without flat or still frames, photoelectrons stays as the file has it")
        return None
    if gain.value > _SEEN * gain.sd:
        electrons = scale.value / (gain.value * width)
        return Measured(electrons, electrons * math.hypot(gain.sd / gain.value, scale.sd / scale.value))
    least = scale.value / ((max(gain.value, 0.0) + _SEEN * gain.sd) * width)
    stated = rig.sensor.photoelectrons
    contradicted = 0 < stated < least
    notes.append(
        f"no shot noise is measurable, so there are more than {least:.3g} photo-electrons; photoelectrons"
        + (" becomes 0 (shot noise negligible)" if contradicted else " stays as the file has it")
        + "; brighter flats would show how many"
    )
    return Measured(0.0, math.nan) if contradicted else None
