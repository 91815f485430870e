"""Input and result of a restoration method, and its row in the registry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.restoration import spectrum
from aolink.restoration.psf import ProjectedPsf, Psf, along_line
from aolink.restoration.scanner import Scanner

Direction = Literal["forward", "backward"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Blurred:
    """A blurred picture and its PSF, the input of a method."""

    planes: FloatArray
    """The colours one after the other, zero where nothing was measured, (colours, rows, columns)."""
    psf: Psf
    seen: BoolArray | None
    """True where a pixel was measured, (rows, columns); None where all were."""
    given_noise_sd: float | None
    """Standard deviation of the picture's white noise; None where it is to be estimated from the picture."""

    @cached_property
    def whole(self) -> FloatArray:
        """The planes with each missing pixel replaced by its nearest neighbour, which is accurate enough to find
        weights."""
        if self.seen is None:
            return self.planes
        nearest = ndimage.distance_transform_edt(~self.seen, return_distances=False, return_indices=True)
        return self.planes[:, nearest[0], nearest[1]]

    @cached_property
    def power_spectrum(self) -> spectrum.Spectrum:
        """Periodogram of `whole`, for a scene whose differences are white."""
        return spectrum.plane_spectrum(self.whole, self.psf.mean)

    @cached_property
    def noise_variance(self) -> float:
        """Variance of the noise, given or estimated from the picture; at least that of rounding."""
        if self.given_noise_sd is not None:
            return self.given_noise_sd**2
        planes = self.whole
        floor = 1e-6 * max(float(np.ptp(planes)), 1e-6 * float(np.abs(planes).max()), 1e-100)
        return max(spectrum.noise_variance(self.power_spectrum), floor**2)

    @cached_property
    def line(self) -> ProjectedPsf:
        """The straight line that is nearest to a PSF on the plane."""
        return along_line(self.psf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Restored:
    """A picture without its blur, and the values with which it was restored."""

    image: NDArray[Any]
    """The picture, aligned with the scene at zero displacement, with shape and dtype of the blurred picture. A method
    gives it as (colours, rows, columns)."""
    method: str = ""
    noise_sd: float = math.nan
    """Standard deviation of the picture's white noise, as given or as estimated; NaN for a method that needs none."""
    psf_noise_sd: float = math.nan
    """Root of the variance that the PSF's uncertainty adds to the noise; NaN for a method that ignores it."""
    expected_gain_db: float = math.nan
    """By how much the method's own model expects it to lower the error of the blurred picture; below zero it adds to
    it. NaN for methods whose model never expects that."""
    difference_weight: float = math.nan
    """lambda of gauss_markov, tv and pnp, one over the picture's unit squared; NaN for the other methods."""
    scanner: Scanner | None = None
    """Model of the scene that a method on lines used."""
    direction: Direction = "forward"
    """Direction in which the lines were scanned."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """One row of the registry: a restoration method."""

    name: str
    restore: Callable[..., Restored]
    """The function: it takes a `Blurred`, and by name those of `parameters` that the caller gives."""
    why_not: Callable[[Blurred], str | None] = lambda blurred: None
    """A function that gives the reason why it cannot restore this picture with this PSF, and what to use instead; None
    where it can."""
    parameters: tuple[str, ...] = ()
    """Further keyword arguments of `aolink.restoration.restore` that it takes; it has a default for each."""
