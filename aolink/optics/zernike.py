"""Zernike polynomials in Noll's order, of unit rms over the full unit disc, with gradients that are exact.

Noll, J. Opt. Soc. Am. 66, 207 (1976). They are kept as polynomials in z = x + iy and its conjugate, so that they
and their gradients are as smooth at the middle as anywhere.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import FloatArray


def noll_to_orders(index: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m of Noll's index, from 1; m below zero is a sine."""
    if index < 1:
        raise ValueError(f"Noll's index begins with 1, found {index}")
    n = int((math.isqrt(8 * index - 7) - 1) // 2)
    within = index - n * (n + 1) // 2 - 1
    m = 2 * ((within + (n + 1) % 2) // 2) + n % 2
    return n, (m if index % 2 == 0 else -m)


@lru_cache(maxsize=1024)
def _terms(index: int) -> tuple[tuple[int, float], ...]:
    """Terms (k, coefficient) of r^(2k) in the radial polynomial over r^|m|, normalised."""
    n, m = noll_to_orders(index)
    a, scale = abs(m), math.sqrt((n + 1) * (2 if m else 1))
    f = math.factorial
    return tuple(
        ((n - 2 * s - a) // 2, scale * (-1) ** s * f(n - s) / (f(s) * f((n + a) // 2 - s) * f((n - a) // 2 - s)))
        for s in range((n - a) // 2 + 1)
    )


def zernike(index: int, points: FloatArray) -> FloatArray:
    """Values at points (..., 2) on the unit disc, (...)."""
    z, m = _complex(points), noll_to_orders(index)[1]
    radial = sum(c * np.abs(z) ** (2 * k) for k, c in _terms(index))
    return np.asarray(_part(radial * z ** abs(m), m))


def zernike_gradient(index: int, points: FloatArray) -> FloatArray:
    """Gradients at points (..., 2) on the unit disc, per unit of the disc's radius, (..., 2)."""
    z, m = _complex(points), noll_to_orders(index)[1]
    square, a = np.abs(z) ** 2, abs(m)
    radial = sum(c * square**k for k, c in _terms(index))
    by_square = sum((k * c * square ** (k - 1) for k, c in _terms(index) if k), np.zeros(z.shape))
    power = a * z ** (a - 1) if a else np.zeros_like(z)
    along_x = 2 * z.real * by_square * z**a + radial * power
    along_y = 2 * z.imag * by_square * z**a + radial * power * 1j
    return np.stack([_part(along_x, m), _part(along_y, m)], axis=-1)


def _complex(points: FloatArray) -> NDArray[np.complex128]:
    return np.asarray(points[..., 0] + 1j * points[..., 1])


def _part(value: NDArray[np.complex128], m: int) -> FloatArray:
    return value.imag if m < 0 else value.real
