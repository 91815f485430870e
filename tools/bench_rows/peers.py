"""Restoration by others: padded by reflection, and tuned with the scene in hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from skimage import restoration

from aolink.restoration import restore
from aolink.restoration.markov import masked_line_solver
from bench_rows.pictures import NOISE_SD, Case, psnr

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


def _bm3d_deblurring(image: FloatArray, taps: FloatArray) -> FloatArray:
    """bm3d's own, with two repairs: `np.trapz` has gone, and its second stage wants the first one's result in 3-D."""
    import bm3d

    if not hasattr(np, "trapz"):
        setattr(np, "trapz", np.trapezoid)  # noqa: B010 - so that no tool takes it for ours
    plain = bm3d.bm3d

    def repaired(z: FloatArray, psd: FloatArray, profile: object, stage_arg: object) -> FloatArray:
        stage = np.atleast_3d(stage_arg) if isinstance(stage_arg, np.ndarray) else stage_arg
        return np.asarray(plain(z, psd, profile, stage_arg=stage))

    inside = bm3d.bm3d_deblurring.__globals__
    inside["bm3d"] = repaired
    try:
        return np.asarray(np.squeeze(bm3d.bm3d_deblurring(image, NOISE_SD, taps)))
    finally:
        inside["bm3d"] = plain


def bm3d_padded(case: Case) -> FloatArray:
    """Padded by reflection."""
    return _cut(_bm3d_deblurring(_padded(case.image), case.psf.values[None]))


def bm3d_filled(case: Case) -> FloatArray:
    """What lies beyond the frame as the Gauss-Markov scene has it, blurred once more; faded to close the circle."""
    weight = restore(case.image, case.psf, method="gauss_markov").difference_weight
    wide = np.pad(case.image, ((0, 0), (_PAD, _PAD)))
    seen = np.zeros(wide.shape, bool)
    seen[:, _PAD:-_PAD] = True
    solver = masked_line_solver(case.psf, seen, weight * NOISE_SD**2)
    filled = np.where(seen, wide, solver.blur(solver.solve(solver.project(wide[None])))[0])
    # What is beyond the frame meets itself on the other side.
    fade = np.linspace(0, 1, _PAD)
    filled[:, :_PAD] = fade * filled[:, :_PAD] + (1 - fade) * filled.mean(axis=1, keepdims=True)
    filled[:, -_PAD:] = fade[::-1] * filled[:, -_PAD:] + (1 - fade[::-1]) * filled.mean(axis=1, keepdims=True)
    noise = NOISE_SD * np.random.default_rng(1).standard_normal(filled.shape)
    return _bm3d_deblurring(np.where(seen, filled, filled + noise), case.psf.values[None])[:, _PAD:-_PAD]
