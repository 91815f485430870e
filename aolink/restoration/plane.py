"""The methods on the plane: Gauss-Markov, total variation, plug and play."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from aolink.numerics.arrays import FloatArray
from aolink.restoration import spectrum
from aolink.restoration.block_matching import block_matching
from aolink.restoration.markov import PeriodicPlane, make_solver, plane_solver
from aolink.restoration.method import Blurred, Restored
from aolink.restoration.plug_and_play import Denoiser, plug_and_play
from aolink.restoration.tv import plane_total_variation, total_variation

# Least ratio of the variances of the noise and of the scene's differences for conjugate gradients: below it they need
# more steps, in proportion to one over the ratio's root, and the picture gets no sharper.
_SMALLEST_RATIO = 3e-4
# Frequencies along each side over which the effect of a PSF's error is averaged.
_GRID = 256


@dataclass(frozen=True, kw_only=True)
class _Weights:
    """Variances of a picture's noise, and the weight of its scene's differences."""

    noise: float
    """Variance of the picture's noise."""
    unexplained: float
    """Variance that the PSF's uncertainty adds to it."""
    total: float
    """Variance that the methods use: the sum of both."""
    difference: float
    """lambda, one over the variance of the scene's differences."""

    @classmethod
    def of(cls, picture: Blurred) -> _Weights:
        psf, noise = picture.psf, picture.noise_variance
        difference = spectrum.difference_weight(picture.power_spectrum, noise)
        modes = psf.modes.mean(axis=1) if psf.varies else psf.modes
        unexplained = plane_variance(modes, difference)
        total = noise + unexplained
        if not psf.on_line or picture.seen is not None:
            total = max(total, _SMALLEST_RATIO / difference)
        return cls(noise=noise, unexplained=unexplained, total=total, difference=difference)

    def restored(self, scene: NDArray[Any], frame: tuple[slice, slice]) -> Restored:
        return Restored(
            image=scene[(slice(None), *frame)], noise_sd=math.sqrt(self.noise),
            psf_noise_sd=math.sqrt(self.unexplained), difference_weight=self.difference,
        )  # fmt: skip


def gauss_markov(picture: Blurred) -> Restored:
    """Posterior mean of a scene whose differences are Gaussian and white."""
    weights = _Weights.of(picture)
    solver = make_solver(picture.psf, _shape(picture), weights.difference * weights.total, picture.seen)
    whole = picture.whole
    return weights.restored(solver.solve(solver.project(whole), solver.guess(whole)), solver.frame)


def tv(picture: Blurred) -> Restored:
    """Total variation: the posterior mode of a scene whose differences are Laplacian."""
    weights = _Weights.of(picture)
    return weights.restored(*_with_edges(picture, weights))


def pnp(picture: Blurred, *, denoise: Denoiser = block_matching) -> Restored:
    """Plug and play: a denoiser takes the place of the scene's prior."""
    weights = _Weights.of(picture)
    start, frame = _with_edges(picture, weights)
    scene = plug_and_play(
        lambda kappa: plane_solver(picture.psf, _shape(picture), kappa, picture.seen, white=True),
        picture.whole, weights.total, start, denoise,
    )  # fmt: skip
    return weights.restored(scene, frame)


def why_not_pnp(picture: Blurred) -> str | None:
    return "pnp needs one PSF for the whole picture: use tv" if picture.psf.varies else None


def plane_variance(modes: FloatArray, difference_weight: float) -> float:
    """Added variance for a scene of white differences; PSF modes (modes, taps) or (modes, rows, columns), each of zero
    sum.

    It is the mean over all frequencies of |m|^2 / (lambda roughness).
    """
    if not len(modes):
        return 0.0
    plane = modes.reshape(len(modes), -1, modes.shape[-1])
    power = (np.abs(fft.fft2(plane, (_GRID, _GRID))) ** 2).sum(axis=0)
    one = 4 * np.sin(np.pi * np.arange(_GRID) / _GRID) ** 2
    rough = one[:, None] + one
    return float((power[rough > 0] / rough[rough > 0]).sum() / _GRID**2 / difference_weight)


def _with_edges(picture: Blurred, weights: _Weights) -> tuple[FloatArray, tuple[slice, slice]]:
    """The scene by total variation, beyond the frame as well, and the frame's place in it."""
    psf, shape = picture.psf, _shape(picture)
    level = picture.whole.mean()
    images = picture.whole - level
    if psf.varies or (psf.on_line and picture.seen is None):
        # Total variation does not need the last digits: single precision takes half of the time.
        scene, solver = total_variation(
            lambda kappa: make_solver(psf, shape, kappa, picture.seen, single=True),
            images, weights.total, weights.difference,
        )  # fmt: skip
        return scene.astype(np.float64) + level, solver.frame
    plane = PeriodicPlane.of(psf, shape)
    return plane_total_variation(plane, images, weights.total, weights.difference, picture.seen) + level, plane.frame


def _shape(picture: Blurred) -> tuple[int, int]:
    _, rows, columns = picture.planes.shape
    return rows, columns
