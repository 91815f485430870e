"""The PSF's uncertainty: the noise that it makes, and what it gains to know it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import linalg

from aolink.optics.sensor import Kernel
from aolink.restoration import Psf, first_order, motion_psf, restore
from aolink.restoration.deblur import psnr
from aolink.restoration.plane import plane_variance
from aolink.restoration.psf import line_matrix
from aolink.restoration.shahin import line_variance
from tests.restoration.scenes import blocks, blurred

KERNEL = Kernel(shape="gaussian", sigma=0.3)
TIME = np.linspace(0, 1, 200)
PATH = 12 * np.exp(-1.5 * TIME) * np.sin(3 * math.pi * TIME)


def uncertain(share: float) -> Psf:
    """The PSF of a path whose range is known to ``share`` of it (one standard deviation)."""
    return motion_psf(PATH, share**2 * np.outer(PATH, PATH), KERNEL, 1.0)


def test_noise_by_the_psfs_error_on_lines() -> None:
    rng, scanner = np.random.default_rng(1), first_order(0.95, 2.0)
    modes = uncertain(0.05).modes
    taps, columns = modes.shape[1], 60
    root = np.linalg.cholesky(linalg.toeplitz(scanner.correlation(columns + taps - 2)))
    scenes = rng.standard_normal((4000, len(root))) @ root.T
    measured = sum(((scenes @ line_matrix(m, columns).T) ** 2).mean() for m in modes)
    assert line_variance(modes, scanner) == pytest.approx(measured, rel=0.05)
    assert line_variance(np.zeros((0, 5)), scanner) == 0


def test_noise_by_the_psfs_error_on_the_plane() -> None:
    """A scene drawn from its own spectrum, periodic and large."""
    rng, weight, n = np.random.default_rng(2), 50.0, 256
    modes = uncertain(0.05).modes
    one = 4 * np.sin(np.pi * np.arange(n) / n) ** 2
    rough = one[:, None] + one
    rough[0, 0] = np.inf
    found = []
    for _ in range(6):
        scene = np.fft.fft2(rng.standard_normal((n, n))) / np.sqrt(weight * rough)
        found.append(sum(float(np.mean(np.fft.ifft2(scene * np.fft.fft(m, n)).real ** 2)) for m in modes))
    assert plane_variance(modes, weight) == pytest.approx(np.mean(found), rel=0.1)


@pytest.mark.parametrize(("method", "gain"), [("smoother", 0.4), ("gauss_markov", 0.8), ("tv", 2)])
def test_to_know_that_the_range_is_off_helps(method: str, gain: float) -> None:
    """The true range is 5 % less than the one that was estimated, of which that is the standard deviation."""
    true = motion_psf(0.95 * PATH, None, KERNEL, 1.0)
    image, inside = blurred(blocks(80, 200, seed=6), true.values, true.origin)
    image = image + 0.002 * np.random.default_rng(1).standard_normal(image.shape)
    told, sure = uncertain(0.05), motion_psf(PATH, None, KERNEL, 1.0)
    believed, doubted = (psnr(restore(image, p, method=method, noise_sd=0.002).image, inside) for p in (sure, told))
    assert doubted > believed + gain
