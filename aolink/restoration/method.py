"""What a restoration method is given, what it gives, and what the registry knows about it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aolink.restoration import spectrum
from aolink.restoration.inverse import Direction
from aolink.restoration.psf import Line, Psf, along_line
from aolink.restoration.scanner import Scanner

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Blurred:
    """A blurred picture as a method is given it."""

    planes: FloatArray
    """The colours one after the other, zero where nothing was measured, (colours, rows, columns)."""
    psf: Psf
    seen: BoolArray | None
    """True where a pixel was measured, (rows, columns); None where all were."""
    given_noise_sd: float | None
    """Standard deviation of the picture's white noise; None where it is to be found in the picture."""

    @cached_property
    def whole(self) -> FloatArray:
        """The planes with each missing pixel as its nearest neighbour: good enough to find weights with."""
        if self.seen is None:
            return self.planes
        nearest = ndimage.distance_transform_edt(~self.seen, return_distances=False, return_indices=True)
        return self.planes[:, nearest[0], nearest[1]]

    @cached_property
    def power_spectrum(self) -> spectrum.Spectrum:
        """Of the whole planes, for a scene whose differences are white."""
        return spectrum.plane_spectrum(self.whole, self.psf.mean)

    @cached_property
    def noise_variance(self) -> float:
        """As given, or as found in the picture; above what rounding of the numbers makes."""
        if self.given_noise_sd is not None:
            return self.given_noise_sd**2
        planes = self.whole
        floor = 1e-6 * max(float(np.ptp(planes)), 1e-6 * float(np.abs(planes).max()), 1e-100)
        return max(spectrum.noise_variance(self.power_spectrum), floor**2)

    @cached_property
    def line(self) -> Line:
        """The straight line that a PSF on the plane is nearest to."""
        return along_line(self.psf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Restored:
    """A picture without its blur, and what it was restored with."""

    image: NDArray[Any]
    """Aligned with the scene at no displacement; shape and dtype of the blurred picture. A method gives it as
    (colours, rows, columns)."""
    method: str = ""
    noise_sd: float = math.nan
    """Standard deviation of the picture's white noise, as given or as found; NaN for a method that needs none."""
    psf_noise_sd: float = math.nan
    """What the PSF's uncertainty adds to it, root of the added variance; NaN for a method that does without."""
    difference_weight: float = math.nan
    """lambda of gauss_markov, tv and pnp, one over the picture's unit squared; NaN for the other methods."""
    scanner: Scanner | None = None
    """What the methods on lines took the scene for."""
    direction: Direction = "forward"
    """In which the lines were scanned."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """One row of the registry: a restoration method."""

    name: str
    summary: str
    """What is special about it, in some words."""
    restore: Callable[..., Restored]
    """Takes a `Blurred`, and those of `parameters` that the caller gives, by name."""
    why_not: Callable[[Blurred], str | None] = lambda blurred: None
    """Why it cannot restore this picture with this PSF, and what to use instead; None where it can."""
    parameters: tuple[str, ...] = ()
    """Further keyword arguments of `aolink.restoration.restore` that it takes; it has a default for each."""
