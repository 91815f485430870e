"""Frozen-flow turbulence, which the wind blows past the pupil, with von Karman's spectrum and several layers, at any
time.

A layer is a sum of plane waves of random direction, phase and size, one for each stretch of a logarithmic ladder
of wave numbers: Charnotskii, "Sparse spectrum model for a turbulent phase", J. Opt. Soc. Am. A 30, 479 (2013). Its
structure function, in the mean over seeds, is the analytic one at every distance up to the ladder's ends; it
does not repeat; the wind moves it by any distance; and its mean slope over a square is known in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from aolink.keys import Positive, pair
from aolink.numerics.arrays import FloatArray
from aolink.optics.lenslets import Lenslets

# The longest wave over the outer scale: longer ones add nothing to the structure function within it.
_LONGEST = 20.0
_WAVES = 600
# Points along the side of a lenslet that the pupil cuts; the shortest wave is half a lenslet long.
_POINTS = 32


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One layer of turbulence."""

    r0_m: Positive
    """Fried's parameter at ``wavelength_m``, m."""
    wind_m_s: Annotated[tuple[float, float], pair]
    """Wind along x and y, m/s."""
    outer_scale_m: Positive = 25.0
    wavelength_m: Positive = 500e-9


class FrozenFlow:
    """One layer's wavefront as a sum of plane waves: a wavefront in metres of path for any point and time.

    Waves shorter than ``shortest_m`` are left out.
    """

    def __init__(self, layer: Layer, rng: np.random.Generator, shortest_m: float, waves: int = _WAVES) -> None:
        self.layer = layer
        low, high = 2 * math.pi / (layer.outer_scale_m * _LONGEST), 2 * math.pi / shortest_m
        rungs = np.geomspace(low, high, waves + 1)
        # Within its rung the density of wave numbers is proportional to k, as in the plane.
        k = np.sqrt(rungs[:-1] ** 2 + (rungs[1:] ** 2 - rungs[:-1] ** 2) * rng.random(waves))
        turn = rng.uniform(0, 2 * math.pi, waves)
        self.wave_numbers = k[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        """Wave vectors, radians per metre, (waves, 2)."""
        power = _spectrum(layer, k) * math.pi * (rungs[1:] ** 2 - rungs[:-1] ** 2)  # variance of each wave, rad^2
        scatter = rng.standard_normal((2, waves))
        self.amplitudes = np.sqrt(power) * (scatter[0] + 1j * scatter[1]) * layer.wavelength_m / (2 * math.pi)
        """Complex amplitudes, metres, (waves,): W(r) = Re sum_k a_k exp(i k r)."""

    def slope_waves(self, lenslets: Lenslets) -> NDArray[np.complex128]:
        """Mean slopes of each wave over the lit part of each lenslet in radians, (spots, 2, waves); NaN in the dark.

        The mean of exp(ikr) over a square of side d is its value at the middle times two sincs.
        """
        k = self.wave_numbers
        over_square = np.prod(np.sinc(k * lenslets.pitch_m / (2 * math.pi)), axis=1)
        middle = np.exp(1j * lenslets.centres_m @ k.T)
        mean = middle * over_square
        offsets = lenslets.offsets_m(_POINTS)
        along, across = (np.exp(1j * offsets[:, None] * each) for each in k.T)
        for spot in map(int, np.flatnonzero(lenslets.light < 1)):
            lit = lenslets.lit_part(spot, _POINTS)
            part = (across * (lit @ along)).sum(axis=0)
            mean[spot] = middle[spot] * part / lit.sum() if lit.any() else np.nan
        return np.asarray(mean[:, None] * (1j * k.T * self.amplitudes))

    def blown(self, times_s: FloatArray) -> NDArray[np.complex128]:
        """Factor exp(-i k v t) of each wave at each time, (waves, times)."""
        return np.asarray(np.exp(-1j * (self.wave_numbers @ np.asarray(self.layer.wind_m_s))[:, None] * times_s))


def _spectrum(layer: Layer, k: FloatArray) -> FloatArray:
    """von Karman's phase spectrum over the plane of wave numbers, rad^2 m^2; it integrates to the variance.

    It is 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6) over cycles per metre, and (2 pi)^-2 of that over radians per metre.
    """
    gamma = scipy.special.gamma
    exact = gamma(11 / 6) ** 2 / (2 * math.pi ** (11 / 3)) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)  # 0.0229
    cycles = k / (2 * math.pi)
    return np.asarray(
        exact * layer.r0_m ** (-5 / 3) * (cycles**2 + layer.outer_scale_m**-2) ** (-11 / 6) / (2 * math.pi) ** 2
    )
