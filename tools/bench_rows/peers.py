"""Restoration by others: padded by reflection, and tuned with the scene in hand."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from skimage import restoration

from aolink.numerics.arrays import FloatArray
from aolink.restoration import restore
from aolink.restoration.deblur import psnr
from aolink.restoration.markov import line_solver
from bench_rows.pictures import NOISE_SD, Case

_PAD = 40


def _padded(image: FloatArray) -> FloatArray:
    return np.pad(image, _PAD, mode="reflect")


def _cut(image: FloatArray) -> FloatArray:
    return image[_PAD:-_PAD, _PAD:-_PAD]


def _best(case: Case, made: list[FloatArray]) -> FloatArray:
    return max(made, key=lambda image: psnr(image, case.scene))


def wiener(case: Case) -> FloatArray:
    """Wiener's filter with the best of many balances."""
    wide, taps = _padded(case.image), case.psf.values[None]
    return _best(case, [_cut(restoration.wiener(wide, taps, b, clip=False)) for b in np.geomspace(1e-4, 3, 19)])


def unsupervised_wiener(case: Case) -> FloatArray:
    """The unsupervised Wiener filter with its defaults and a fixed seed."""
    found, _ = restoration.unsupervised_wiener(_padded(case.image), case.psf.values[None], clip=False, rng=1)
    return _cut(found)


def richardson_lucy(case: Case) -> FloatArray:
    """Richardson-Lucy with the best of several numbers of iterations."""
    wide, taps = np.maximum(_padded(case.image), 1e-6), case.psf.values[None]
    counts = (3, 6, 12, 25, 50, 100)
    return _best(case, [_cut(restoration.richardson_lucy(wide, taps, n, clip=False)) for n in counts])


def _bm3d(image: FloatArray, case: Case) -> FloatArray:
    """BM3D's deblurring with the noise that the picture has."""
    # It asks for a function that NumPy has renamed, takes one sd for that of as many channels as there are rows, and
    # gives its second stage a picture of two dimensions where it needs three: all that is put right here.
    if not hasattr(np, "trapz"):
        np.trapz = np.trapezoid  # type: ignore[attr-defined]  # noqa: NPY201
    import bm3d

    taps, (origin,) = case.psf.values, case.psf.origin
    reach = max(origin, len(taps) - 1 - origin)
    centred = np.zeros((1, 2 * reach + 1))
    centred[0, reach - origin : reach - origin + len(taps)] = taps
    denoise = bm3d.bm3d

    def whole(z: FloatArray, psd: FloatArray, profile: Any, stage_arg: Any) -> FloatArray:
        pilot = np.atleast_3d(stage_arg) if isinstance(stage_arg, np.ndarray) else stage_arg
        return np.asarray(denoise(z, psd, profile, stage_arg=pilot))

    bm3d.bm3d = whole
    try:
        psd = np.full((*image.shape, 1), NOISE_SD**2 * image.size)
        return np.asarray(bm3d.bm3d_deblurring(image, psd, centred))
    finally:
        bm3d.bm3d = denoise


def bm3d_padded(case: Case) -> FloatArray:
    """BM3D with the frame's mirror image beyond the frame, so far that the ends, which its transforms join, fit."""
    half = case.image.shape[0] // 2
    return _bm3d(np.pad(case.image, half, mode="symmetric"), case)[half:-half, half:-half]


def bm3d_filled(case: Case) -> FloatArray:
    """BM3D with the blur of the scene of gauss_markov, which continues there, beyond the frame."""
    found = restore(case.image, case.psf, method="gauss_markov")
    solver = line_solver(case.psf, case.image.shape, found.difference_weight * found.noise_sd**2)
    scene = solver.solve(solver.project(case.image[None]))[0]
    frame = solver.frame[1]
    sides = (_PAD - frame.start, _PAD - (scene.shape[1] - frame.stop))
    scene = np.pad(scene, ((_PAD, _PAD), sides), mode="reflect")
    taps, (origin,) = case.psf.values, case.psf.origin
    kernel = np.zeros(scene.shape[1])
    kernel[: len(taps)] = taps
    spectrum = np.fft.rfft(np.roll(kernel, -origin))
    wide = np.fft.irfft(np.fft.rfft(scene, axis=1) * spectrum, n=scene.shape[1], axis=1)
    wide[_PAD:-_PAD, _PAD:-_PAD] = case.image
    return _cut(_bm3d(wide, case))


PADDED: dict[str, Callable[[Case], FloatArray]] = {
    "Wiener, padded, oracle": wiener,
    "unsupervised Wiener, padded": unsupervised_wiener,
    "Richardson-Lucy, padded, oracle": richardson_lucy,
}
FILLED: dict[str, Callable[[Case], FloatArray]] = {}
# Licensed for use that is not commercial, so nothing installs it but who runs: pip install bm3d
if importlib.util.find_spec("bm3d"):
    PADDED["BM3D, padded"] = bm3d_padded
    FILLED["BM3D, border filled by our gauss_markov"] = bm3d_filled
else:
    print("BM3D is left out: pip install bm3d, if its licence (not commercial) suits you", file=sys.stderr)
