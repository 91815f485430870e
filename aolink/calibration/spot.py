"""The resting spot of a calibration: its position, width and light, and whether it is at rest at all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from aolink.errors import CalibrationError
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.kernel import pixel_mass, pixel_masses
from aolink.optics.sensor import Kernel, Sensor

_UNSTEADY = 1e-5
"""Probability by chance below which a spot counts as moving or flickering."""
_NOT_GAUSSIAN = 1e-4
"""Probability of the fit's chi-square by chance below which the kernel does not count as Gaussian."""
_FAINT = 10.0
"""Least light of a spot, in its standard deviations."""
_BACKGROUND = 0.05
"""Largest accepted light away from the spot, as a share of the spot's own."""
_LEAST_MASS = 0.99
"""Share of the spot's light that must fall on the sensor."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Spot:
    """Least-squares fit of the Gaussian kernel, integrated over the pixels, to the mean profile of resting spots."""

    positions: tuple[float, ...]
    """Positions, slope units, one for each recording."""
    position_sds: tuple[float, ...]
    sigma: float
    """Kernel width, slope units."""
    sigma_sd: float
    counts_per_density: float
    """Scale from the fit's amplitude where the kernel is Gaussian, from the spot's total light where it is not."""
    counts_per_density_sd: float
    chi_square: float
    freedom: int
    """Degrees of freedom."""
    largest_residual: float
    """Largest residual as a share of the profile's peak."""
    noise: tuple[float, float]
    """Variance of a dark pixel in one frame, counts squared, and counts per electron."""

    @property
    def gaussian(self) -> bool:
        """Whether the profile is that of a Gaussian within the noise."""
        return bool(stats.chi2.sf(self.chi_square, self.freedom) >= _NOT_GAUSSIAN)

    @property
    def complaint(self) -> str:
        """The note about a kernel that is not Gaussian."""
        return (
            f"the spot is not a Gaussian: chi-square {self.chi_square:.0f} for {self.freedom} degrees of freedom,"
            f" largest residual {self.largest_residual:.1%} of the peak; kernel.sigma is that of the nearest Gaussian,"
            " counts_per_density comes from the total"
        )


def fit_spots(
    sensor: Sensor, signals: Sequence[tuple[str, int, FloatArray]], good: BoolArray, noise: tuple[float, float],
    dark_frames: int,
) -> Spot:  # fmt: skip
    """Fit one width and one scale to the spots of several recordings, each at its own position.

    Raises `CalibrationError` where there is no spot, only a part of it, or light everywhere.

    Parameters
    ----------
    signals:
        Name, number of frames, and mean counts above the dark level, (pixels,), of each recording.
    good:
        Pixels to use, (pixels,).
    noise:
        Variance of a dark pixel in one frame, counts squared, and counts per electron.
    """
    means = np.array([mean[good] for _, _, mean in signals])
    dark_variance = noise[0] / dark_frames
    start = [
        _first_guess(sensor, source, mean, good, noise[0] / frames + dark_variance) for source, frames, mean in signals
    ]
    scale, sigma = float(np.mean([s[0] for s in start])), float(np.median([s[2] for s in start]))
    p = np.array([scale, math.log(sigma), *[s[1] for s in start]])
    unit = np.array([scale, 1.0, *[sigma] * len(signals)])
    model = partial(_mean_counts, sensor, good)
    frames = np.array([[n] for _, n, _ in signals])
    expected = np.maximum(means, 0.0)
    for _ in range(3):  # the noise depends on the profile
        # All recordings share the dark frames' error: it is treated as one of each recording, but that many times
        # larger.
        variance = (noise[0] + noise[1] * expected) / frames + dark_variance * len(signals)
        p, covariance, residuals = _weighted_fit(model, means, variance, p, unit)
        expected = model(p)
    sigma, positions = _width(p), p[2:]
    inside = pixel_mass(Kernel(shape="gaussian", sigma=sigma), sensor.edges, positions)
    _check_inside(sensor, [source for source, _, _ in signals], positions, inside.sum(axis=1))
    chi_square, freedom = float((residuals**2 / variance).sum()), means.size - len(p)
    sds = np.sqrt(np.diag(covariance))
    amplitude, amplitude_sd = p[0], sds[0]
    if stats.chi2.sf(chi_square, freedom) < _NOT_GAUSSIAN:
        # The model is wrong, rather than the noise large: the total light needs no model, and the other values are
        # uncertain by the misfit.
        sds = sds * math.sqrt(chi_square / freedom)
        total = inside[:, good].sum() / sensor.pixel_width
        amplitude, amplitude_sd = means.sum() / total, math.sqrt(variance.sum()) / total
    return Spot(
        positions=tuple(map(float, positions)), position_sds=tuple(map(float, sds[2:])), sigma=sigma,
        sigma_sd=float(sigma * sds[1]), counts_per_density=float(amplitude), counts_per_density_sd=float(amplitude_sd),
        chi_square=chi_square, freedom=freedom, largest_residual=float(np.abs(residuals).max() / means.max()),
        noise=noise,
    )  # fmt: skip


def _check_inside(sensor: Sensor, sources: Sequence[str], positions: FloatArray, shares: FloatArray) -> None:
    for source, position, share in zip(sources, positions, shares, strict=True):
        # In the outermost pixel it could also be the edge of a spot that is not on the sensor at all.
        if share < _LEAST_MASS or min(position - sensor.field[0], sensor.field[1] - position) < sensor.pixel_width:
            raise CalibrationError(
                f"{source}: the spot is at the edge of the sensor or beyond (at {position:.3g}): move it inward, and"
                " record it again"
            )


def _mean_counts(sensor: Sensor, good: BoolArray, p: FloatArray) -> FloatArray:
    """Counts above the dark level of scale, log sigma and positions in ``p``, (positions, good pixels)."""
    kernel = Kernel(shape="gaussian", sigma=_width(p))
    return np.asarray(p[0] / sensor.pixel_width * pixel_mass(kernel, sensor.edges, p[2:])[:, good])


def _width(p: FloatArray) -> float:
    return math.exp(min(max(float(p[1]), -30.0), 30.0))


def _weighted_fit(
    model: Callable[[FloatArray], FloatArray], target: FloatArray, variance: FloatArray, p: FloatArray, unit: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least squares from ``p`` on, in steps of the order of ``unit``: parameters, covariance, residuals."""
    sd = np.sqrt(variance)

    def normed(q: FloatArray) -> FloatArray:
        return np.asarray((target - model(q * unit)) / sd).ravel()

    fit = optimize.least_squares(normed, p / unit, jac="3-point")
    jacobian: FloatArray = np.asarray(fit.jac)
    # Parameters that the data do not determine get a huge variance, not zero.
    covariance = np.linalg.inv(jacobian.T @ jacobian + 1e-12 * np.eye(len(p))) * np.outer(unit, unit)
    p = np.asarray(fit.x * unit)
    return p, covariance, target - model(p)


def _first_guess(
    sensor: Sensor, source: str, mean: FloatArray, good: BoolArray, variance: float
) -> tuple[float, float, float]:
    """Scale, position and width of the Gaussian on a grid that fits best. Raises CalibrationError without a spot."""
    best = (0.0, 0.0, 0.0, 0.0)
    sigma = sensor.pixel_width / 4
    while sigma < (sensor.field[1] - sensor.field[0]) / 3:
        profiles = pixel_mass(Kernel(shape="gaussian", sigma=sigma), sensor.edges, sensor.centres)[:, good]
        power = (profiles**2).sum(axis=1)
        amplitude = profiles @ mean[good] / power
        gained = np.where(amplitude > 0, amplitude**2 * power, 0.0)
        k = int(gained.argmax())
        best = max(best, (float(gained[k]), float(amplitude[k]), float(sensor.centres[k]), sigma))
        sigma *= 1.5
    gained_most, amplitude_best, position, sigma = best
    if gained_most < _FAINT**2 * variance:
        raise CalibrationError(
            f"{source} is said to show a resting spot, but there is none: is the light on, and does it meet the sensor?"
            " Record it again"
        )
    away = good & (np.abs(sensor.centres - position) > 2.5 * sigma + 1.5 * sensor.pixel_width)
    beside, pixels = float(mean[away].sum()), int(away.sum())
    everywhere = np.median(mean[good]) > 0.2 * mean[good].max()
    if everywhere or abs(beside) > max(_BACKGROUND * amplitude_best, 6 * math.sqrt(variance * pixels)):
        what = "light everywhere" if everywhere or beside > 0 else "less than the dark level away from the spot"
        raise CalibrationError(
            f"{source} is said to show a resting spot, but there is {what}: shield the sensor from other light, let the"
            " camera warm up, and record this and the dark frames again"
        )
    return amplitude_best * sensor.pixel_width, position, sigma


def check_at_rest(
    sensor: Sensor, source: str, counts: NDArray[np.uint16], alone: tuple[FloatArray, float], good: BoolArray,
    spot: Spot, number: int,
) -> list[str]:  # fmt: skip
    """Check that position and light of a spot stay the same from frame to frame; gives notes.

    Raises `CalibrationError` where the spot moves.

    Parameters
    ----------
    counts:
        Counts of the good pixels, (frames, good pixels).
    alone:
        Variance of each good pixel by itself, (good pixels,), and the variance of that over its square.
    number:
        Number of the spot in the fit.
    """
    kernel = Kernel(shape="gaussian", sigma=spot.sigma)
    position = np.array([spot.positions[number]])
    scale = spot.counts_per_density / sensor.pixel_width
    profile, slope = (scale * each[0, good] for each in pixel_masses(kernel.variance, sensor.edges, position, 1))
    read, gain = spot.noise
    weight = 1 / (read + gain * profile)
    # Independent pixels scatter by their own variances; a motion moves both flanks together, against each other.
    notes = []
    variance, spread = alone
    for pattern, moves in ((slope * sensor.pixel_width, True), (profile, False)):
        power = float((pattern**2 * weight).sum())
        if power < 1e-6 * float((profile**2 * weight).sum()):  # within one pixel a motion cannot be seen
            continue
        gains = pattern * weight / power
        shares = gains**2 * variance
        scatter, expected = float((counts @ gains).var(ddof=1)), float(shares.sum())
        freedom = 2 * expected**2 / max(spread * float((shares**2).sum()), 1e-9 * expected**2)
        if stats.f.sf(scatter / expected, len(counts) - 1, freedom) > _UNSTEADY:
            continue
        # Where the pixels' own variances were measured, the motion is in them as well.
        own = float(((gains * pattern) ** 2).sum()) if spread else 0.0
        excess = math.sqrt((scatter - expected) / max(1 - own, 1e-3))
        if moves:
            raise CalibrationError(
                f"{source} is said to show a resting spot, but the spot moves by {excess * sensor.pixel_width:.2g}"
                " (standard deviation, slope units) from frame to frame: park the mirror, keep the bench still, and"
                " record it again"
            )
        notes.append(
            f"{source}: the light of the spot flickers by {excess:.1%} from frame to frame: without flats,"
            " photoelectrons comes out too low"
        )
    return notes
