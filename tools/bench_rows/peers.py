"""Restoration by others: padded by reflection, and tuned with the scene in hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from skimage import restoration

from bench_rows.pictures import Case, psnr

FloatArray = NDArray[np.float64]

_PAD = 40


def _padded(image: FloatArray) -> FloatArray:
    return np.pad(image, _PAD, mode="reflect")


def _cut(image: FloatArray) -> FloatArray:
    return image[_PAD:-_PAD, _PAD:-_PAD]


def _best(case: Case, made: list[FloatArray]) -> FloatArray:
    return max(made, key=lambda image: psnr(image, case.scene))


def wiener(case: Case) -> FloatArray:
    """The best of many balances."""
    wide, taps = _padded(case.image), case.psf.values[None]
    return _best(case, [_cut(restoration.wiener(wide, taps, b, clip=False)) for b in np.geomspace(1e-4, 3, 19)])


def unsupervised_wiener(case: Case) -> FloatArray:
    """As it comes, with a fixed seed."""
    found, _ = restoration.unsupervised_wiener(_padded(case.image), case.psf.values[None], clip=False, rng=1)
    return _cut(found)


def richardson_lucy(case: Case) -> FloatArray:
    """The best of several numbers of iterations."""
    wide, taps = np.maximum(_padded(case.image), 1e-6), case.psf.values[None]
    counts = (3, 6, 12, 25, 50, 100)
    return _best(case, [_cut(restoration.richardson_lucy(wide, taps, n, clip=False)) for n in counts])


PADDED: dict[str, Callable[[Case], FloatArray]] = {
    "Wiener": wiener,
    "unsupervised Wiener": unsupervised_wiener,
    "Richardson-Lucy": richardson_lucy,
}
