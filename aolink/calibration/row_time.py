"""The row time of a camera from a film of light that blinks at a known rate.

A row that is exposed later sees the light later in its blinking: rows are bright and dark in bands, which move from
frame to frame. With a light of f blinks a second, frame k and row r see its harmonics with the phases
2 pi h (nu k + mu r), where mu = f times the row time, and nu is f times the frame period, up to whole blinks. The two
are those of the largest peak of the rows' two-dimensional periodogram, refined by least squares. The rate of the light
says which of nu and -nu it is, and with it the sign of mu.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from aolink.errors import CalibrationError
from aolink.numerics.arrays import FloatArray, IntArray

_FEWEST_FRAMES, _FEWEST_ROWS = 8, 8
_HARMONICS = 3
"""Harmonics of the light that are fitted: a light that is switched has more than a sine."""
_FINER = 4
"""Points of the periodogram for one of the film."""
_SEEN = 5.0
"""Least share of the largest peak in what the rows vary by, over that of noise alone."""
IN_STEP = (0.0, 1 / 3, 1 / 2, 2 / 3, 1.0)
"""Cycles in a frame period with which a harmonic cannot be told from another one, or from its mirror image."""
_AMBIGUOUS = 0.03
"""Cycles by which nu must differ from these."""
_ON_RATE = 0.15
"""The most by which nu may differ from that of the light's rate, cycles: clocks of light and camera differ."""


@dataclass(frozen=True, kw_only=True)
class RowTime:
    """A measured row time."""

    row_time_s: float
    """As ``sensor.row_time_s``."""
    sd_s: float
    """Its standard deviation, s."""
    frames: int
    bands: float
    """Bands over the height of a frame: blinks of the light from the first row to the last."""


def row_time(light: FloatArray, numbers: IntArray, frame_period_s: float, blink_hz: float) -> RowTime:
    """The row time from a film of blinking light.

    Parameters
    ----------
    light:
        Mean light of each row in each frame, above black, (frames, rows).
    numbers:
        Frame periods from the first frame to each, (frames,).
    frame_period_s:
        Frame period, s.
    blink_hz:
        Blinks of the light in a second.

    Raises
    ------
    CalibrationError
        There are too few frames or rows, the light does not blink in them, or it blinks in step with the frames.
    """
    frames, rows = light.shape
    if frames < _FEWEST_FRAMES or rows < _FEWEST_ROWS:
        raise CalibrationError(
            f"a row time needs {_FEWEST_FRAMES} frames of {_FEWEST_ROWS} rows or more, the film has {frames} of {rows}"
        )
    wanted = blink_hz * frame_period_s % 1.0
    if min(abs(wanted - each) for each in IN_STEP) < _AMBIGUOUS:
        raise CalibrationError(
            f"{blink_hz:g} blinks/s are in step with {1 / frame_period_s:g} frames/s, or a half or a third of them, so"
            " that the bands do not say which row comes first: film a light of another rate, such as"
            f" {blink_hz + 0.23 / frame_period_s:.4g} blinks/s"
        )
    mean = light.mean(axis=0)
    if not (np.isfinite(light).all() and (mean > 0).all()):
        raise CalibrationError("a row of the film has no light: film even light that fills the picture")
    y = light / mean - 1
    nu, mu = _peak(y, numbers)
    # The peak at (-nu, -mu) is the same: the light's rate says which is meant.
    off, other = (abs((each - wanted + 0.5) % 1.0 - 0.5) for each in (nu, -nu))
    if min(off, other) > _ON_RATE:
        raise CalibrationError(
            f"the bands move by {nu % 1:.3f} of a band from frame to frame, a light of {blink_hz:g} blinks/s would move"
            f" them by {wanted:.3f}: check blink_hz and the frame rate, and that nothing else flickers"
        )
    sign = 1 if off <= other else -1
    found = optimize.least_squares(
        _residual, (sign * nu, sign * mu), x_scale=(0.1 / np.ptp(numbers), 0.1 / rows), args=(y, numbers)
    )
    degrees = y.size - 2 * _HARMONICS - 2
    slopes = np.asarray(found.jac, dtype=np.float64)
    covariance = np.linalg.pinv(slopes.T @ slopes) * 2 * found.cost / degrees
    mu, sd = float(found.x[1]), math.sqrt(float(covariance[1, 1]))
    return RowTime(row_time_s=mu / blink_hz, sd_s=sd / blink_hz, frames=frames, bands=abs(mu) * (rows - 1))


def _peak(y: FloatArray, numbers: IntArray) -> tuple[float, float]:
    """Cycles in a frame period and cycles in a row of the largest peak."""
    whole = np.zeros((int(numbers[-1] - numbers[0]) + 1, y.shape[1]))
    whole[numbers - numbers[0]] = y
    size = tuple(_FINER * n for n in whole.shape)
    power = np.abs(np.fft.fft2(whole, size)) ** 2
    k, r = np.unravel_index(int(power.argmax()), power.shape)
    # The power of noise alone is exponentially distributed, its mean the variance times the numbers.
    if power[k, r] < (_SEEN + math.log(y.size)) * (y**2).sum():
        raise CalibrationError(
            "the rows of the film do not blink: film a light that is switched or flickers, with exposures shorter than"
            " its period"
        )
    return float(np.fft.fftfreq(size[0])[k]), float(np.fft.fftfreq(size[1])[r])


def _residual(at: FloatArray, y: FloatArray, numbers: IntArray) -> FloatArray:
    """What the harmonics with these cycles in a frame period and in a row leave of the light."""
    phase = 2 * math.pi * (at[0] * numbers[:, None] + at[1] * np.arange(y.shape[1]))
    waves = [wave(h * phase).ravel() for h in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)]
    basis = np.stack(waves, axis=1)
    return np.asarray(y.ravel() - basis @ np.linalg.lstsq(basis, y.ravel(), rcond=None)[0])
