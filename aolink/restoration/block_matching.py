"""A denoiser: similar patches are grouped, and the spectrum of each group is shrunk.

References
----------
Dabov, Foi, Katkovnik & Egiazarian, Image denoising by sparse 3-D transform-domain collaborative filtering, IEEE Trans.
Image Process. 16 (2007): both passes, with their window and weights; a picture's edges and groups are handled simply.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, sparse

from aolink.numerics.arrays import FloatArray

Singles = NDArray[np.float32]

_SIDE = 8
_STEP = 3
"""Distance between the patches for which groups are made, pixels."""
_REACH = 8
"""Pixels along rows and columns within which similar patches are searched for."""
_GROUP = 16
"""Patches in a group, at most."""
_THRESHOLD = 2.7
"""Threshold of the first pass, in standard deviations of the noise."""
_KAISER = 2.0
_BAND = 32
"""Rows of groups that are made at once: it bounds the memory."""


def block_matching(image: FloatArray, noise_sd: float) -> FloatArray:
    """A picture (rows, columns) without its white noise of this standard deviation, above zero.

    In the first pass the small coefficients of each group are left out. Its result shows in the second pass which
    patches are similar, and how large each coefficient is without noise (Wiener's filter).
    """
    level = image.mean()
    noisy = (image - level).astype(np.float32)
    patches = _Patches.of(noisy.shape[0], noisy.shape[1])
    basic = patches.filtered(noisy, None, noise_sd)
    return np.asarray(level + patches.filtered(noisy, basic.astype(np.float32), noise_sd))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Patches:
    """The patches of pictures of one size."""

    sides: tuple[int, int]
    """Rows and columns of a patch."""
    places: tuple[int, int]
    """Rows and columns of pixels at which a patch can begin."""
    group: int
    """Patches in a group, a power of two."""
    transform: Singles
    """Orthonormal cosine transform of a patch, (pixels, pixels)."""
    across: Singles
    """Orthonormal Walsh-Hadamard transform of a group, (group, group)."""
    window: Singles
    """Weight of a patch's pixels, (rows, columns)."""

    @classmethod
    def of(cls, rows: int, columns: int) -> _Patches:
        sides = min(_SIDE, rows), min(_SIDE, columns)
        places = rows - sides[0] + 1, columns - sides[1] + 1
        # The number of patches that the patch in a corner finds.
        group = 2 ** int(math.log2(min(_GROUP, math.prod(min(n, _REACH + 1) for n in places))))
        each = [fft.dct(np.eye(n), axis=0, norm="ortho") for n in sides]
        return cls(
            sides=sides, places=places, group=group, transform=np.kron(*each).astype(np.float32),
            across=(linalg.hadamard(group) / math.sqrt(group)).astype(np.float32),
            window=np.outer(*(np.kaiser(n, _KAISER) for n in sides)).astype(np.float32),
        )  # fmt: skip

    def filtered(self, noisy: Singles, guide: Singles | None, noise_sd: float) -> FloatArray:
        """One pass: by a guide picture, or without one by a threshold."""
        total, weight = np.zeros(noisy.shape), np.zeros(noisy.shape)
        starts = _every(self.places[0])
        for first in range(0, len(starts), _BAND):
            some = starts[first : first + _BAND]
            top = max(some[0] - _REACH, 0)
            part = slice(top, some[-1] + _REACH + self.sides[0])
            self._add(
                noisy[part], None if guide is None else guide[part], noise_sd, some - top, total[part], weight[part]
            )
        return total / weight

    def _add(
        self, noisy: Singles, guide: Singles | None, noise_sd: float, starts: NDArray[np.intp], total: FloatArray,
        weight: FloatArray,
    ) -> None:  # fmt: skip
        """Add the groups of the patches that begin in some rows of a part of a picture."""
        members = self._alike(noisy if guide is None else guide, starts)
        groups = self.across @ self._spectra(noisy)[members]
        if guide is None:
            keep = np.abs(groups) > _THRESHOLD * noise_sd
            keep[:, 0, 0] = True
            groups *= keep
            trust = 1 / keep.sum(axis=(1, 2))
        else:
            share = np.square(self.across @ self._spectra(guide)[members])
            share /= share + np.float32(noise_sd**2)
            groups *= share
            trust = 1 / np.maximum(np.square(share).sum(axis=(1, 2)), 1e-6)
        places = total.shape[0] - self.sides[0] + 1, self.places[1]
        count = members.size
        gather = sparse.csr_matrix(
            (np.repeat(trust, self.group).astype(np.float32), (members.ravel(), np.arange(count))),
            shape=(math.prod(places), count),
        )
        spectra = gather @ (self.across.T @ groups).reshape(count, -1)
        pixels = (spectra @ self.transform).reshape(*places, *self.sides)
        weights = np.asarray(gather.sum(axis=1)).reshape(places)
        for y, x in np.ndindex(*self.sides):
            here = slice(y, y + places[0]), slice(x, x + places[1])
            total[here] += self.window[y, x] * pixels[:, :, y, x]
            weight[here] += self.window[y, x] * weights

    def _spectra(self, image: Singles) -> Singles:
        """Spectra of the patches at all places, (places, pixels of a patch)."""
        windows = np.lib.stride_tricks.sliding_window_view(image, self.sides)
        return np.asarray(windows.reshape(-1, math.prod(self.sides)) @ self.transform.T)

    def _alike(self, image: Singles, starts: NDArray[np.intp]) -> NDArray[np.intp]:
        """Places of the patches that are most similar to those of some rows, each patch itself first, (groups,
        group)."""
        rows, columns = image.shape
        high, wide = rows - self.sides[0] + 1, self.places[1]
        across = _every(wide)
        side = 2 * _REACH + 1
        distances = np.full((side, side, len(starts), len(across)), np.inf, np.float32)
        distances[_REACH, _REACH] = -1
        for dy, dx in np.ndindex(_REACH + 1, side):
            dx -= _REACH
            if (dy, dx) <= (0, 0) or dy >= high or abs(dx) >= wide:
                continue
            left, right = max(0, -dx), columns - max(0, dx)
            difference = image[: rows - dy, left:right] - image[dy:, left + dx : right + dx]
            sums = _box_sums(np.square(difference), self.sides)
            # A patch and the one beyond it, and the other way round.
            for sign, y, x in ((1, starts, across - left), (-1, starts - dy, across - dx - left)):
                inside = [(each >= 0) & (each < n) for each, n in zip((y, x), sums.shape, strict=True)]
                there = distances[_REACH + sign * dy, _REACH + sign * dx]
                there[np.ix_(*inside)] = sums[np.ix_(y[inside[0]], x[inside[1]])]
        flat = distances.reshape(side**2, -1)
        nearest = np.argpartition(flat, self.group - 1, axis=0)[: self.group]
        order = np.take_along_axis(flat, nearest, axis=0).argsort(axis=0)
        nearest = np.take_along_axis(nearest, order, axis=0)
        down, along = np.divmod(nearest, side)
        own = (starts[:, None] * wide + across).ravel()
        return np.asarray((own + (down - _REACH) * wide + along - _REACH).T)


def _every(places: int) -> NDArray[np.intp]:
    """Every third place, and the last."""
    return np.unique(np.append(np.arange(0, places, _STEP), places - 1))


def _box_sums(values: Singles, sides: tuple[int, int]) -> FloatArray:
    """Sums over each patch."""
    sums = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(values, axis=0, out=sums[1:, 1:])
    np.cumsum(sums[1:, 1:], axis=1, out=sums[1:, 1:])
    high, wide = sides
    return sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]
