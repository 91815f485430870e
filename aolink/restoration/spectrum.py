"""Noise and weights estimated from the blurred picture itself, by Whittle's likelihood of its periodogram.

The picture is tapered, so that the jump at its border does not leak over all frequencies; the periodogram at each
frequency then has nearly an exponential distribution with the mean that the model expects, independently of the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, optimize

from aolink.errors import RestorationError
from aolink.numerics.arrays import BoolArray, FloatArray

# Share of the frequencies that are assumed to hold noise only: those where the blurred scene is weakest.
_DARK_SHARE = 0.02
# Frequencies below this many periods an image are left out, since the taper dominates them.
_LOWEST = 2.5
_FEWEST = 6
_SMALLEST_RATIO, _LARGEST_RATIO = 1e-7, 1e2


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectrum:
    """A picture's periodogram, and the spectra of blur and differences at the same frequencies."""

    power: FloatArray
    """Squared magnitude per pixel, the mean of all colours, (frequencies,)."""
    transfer: FloatArray
    """Squared magnitude of the PSF's transfer function, (frequencies,)."""
    roughness: FloatArray
    """4 sin^2 of half the frequency, summed over the differences that the model has, (frequencies,)."""


def _taper(n: int) -> FloatArray:
    taper = np.hanning(n + 2)[1:-1]
    return np.asarray(taper / math.sqrt(float((taper**2).mean())))


def _check_enough(usable: BoolArray, rows: int, columns: int, where: str) -> None:
    if not usable.any():
        raise RestorationError(
            f"{rows} x {columns} pixels are too few to find noise and weights in: expected {_FEWEST} or more {where}"
        )


def plane_spectrum(images: FloatArray, psf: FloatArray) -> Spectrum:
    """The periodogram of pictures (batch, rows, columns), for a scene whose differences along both axes are white."""
    _, rows, columns = images.shape
    taper = _taper(rows)[:, None] * _taper(columns)
    centred = images - (images * taper**2).mean(axis=(1, 2), keepdims=True)
    power = (np.abs(fft.rfft2(centred * taper)) ** 2).mean(axis=0) / (rows * columns)
    y, x = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None]
    roughness = 4 * np.sin(math.pi * y) ** 2 + 4 * np.sin(math.pi * x) ** 2
    transfer = np.abs(fft.rfft2(psf.reshape(-1, psf.shape[-1]), (rows, columns))) ** 2
    usable = np.hypot(y * rows, x * columns) > _LOWEST
    _check_enough(usable, rows, columns, "along one side")
    return Spectrum(power=power[usable], transfer=transfer[usable], roughness=roughness[usable])


def line_spectrum(images: FloatArray, psf: FloatArray) -> Spectrum:
    """The periodogram of the rows of pictures (batch, rows, columns), each a line of its own."""
    columns = images.shape[-1]
    taper = _taper(columns)
    centred = images - (images * taper**2).mean(axis=-1, keepdims=True)
    power = (np.abs(fft.rfft(centred * taper)) ** 2).mean(axis=(0, 1)) / columns
    x = fft.rfftfreq(columns)
    usable = x * columns > _LOWEST
    _check_enough(usable, images.shape[1], columns, "on a line")
    transfer = np.abs(fft.rfft(psf, columns)) ** 2
    return Spectrum(power=power[usable], transfer=transfer[usable], roughness=4 * np.sin(math.pi * x[usable]) ** 2)


def noise_variance(spectrum: Spectrum) -> float:
    """Variance of white noise, from the frequencies where least of the scene is left; it is too small only by
    chance."""
    left = spectrum.transfer / np.maximum(spectrum.roughness, 1e-12)
    count = min(max(8, math.ceil(_DARK_SHARE * left.size)), left.size)
    # All equal frequencies are included, so that a mirrored picture has the same noise.
    dark = left <= np.partition(left, count - 1)[count - 1] * (1 + 1e-9)
    return float(spectrum.power[dark].mean())


def difference_weight(spectrum: Spectrum, variance: float) -> float:
    """Maximum-likelihood lambda: one over the variance of the scene's differences.

    The expected periodogram is s^2 + |h|^2 / (lambda roughness).
    """
    signal = spectrum.transfer / np.maximum(spectrum.roughness, 1e-12)
    power = spectrum.power / variance

    def loss(log_ratio: float) -> float:
        expected = 1 + signal * math.exp(-log_ratio)
        return float((power / expected + np.log(expected)).sum())

    limits = (math.log(_SMALLEST_RATIO), math.log(_LARGEST_RATIO))
    found = optimize.minimize_scalar(loss, bounds=limits, method="bounded", options={"xatol": 0.02})
    return math.exp(found.x) / variance


def correlation_and_variance(spectrum: Spectrum, variance: float) -> tuple[float, float]:
    """Maximum-likelihood correlation of neighbours and variance of a first-order line (Shahin (11)).

    The expected periodogram is s^2 + |h|^2 q / |1 - rho e^(-jw)|^2, q = (1 - rho^2) times the line's variance.
    """
    power = spectrum.power / variance

    def expected(log_ratio: float, logit: float) -> FloatArray:
        rho = 1 / (1 + math.exp(-logit))
        # |1 - rho e^(-jw)|^2 = (1 - rho)^2 + rho 4 sin^2(w / 2)
        colour = (1 - rho) ** 2 + rho * spectrum.roughness
        return np.asarray(1 + spectrum.transfer * math.exp(log_ratio) / colour)

    def loss(p: FloatArray) -> float:
        each = expected(*np.clip(p, (-20, -1), (20, 8)))
        return float((power / each + np.log(each)).sum())

    found = optimize.minimize(loss, (3.0, 3.0), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 1e-3})
    log_ratio, logit = np.clip(found.x, (-20, -1), (20, 8))
    rho = 1 / (1 + math.exp(-logit))
    return rho, variance * math.exp(log_ratio) / (1 - rho**2)
