"""Restoration of a two-dimensional Gauss-Markov scene, whose differences along rows and columns are white.

A solver holds (H'WH + kappa L) for one PSF: H blurs a scene that goes beyond the frame into the frame, W masks pixels
that were not measured, L = Dx'Dx + Dy'Dy, and kappa is lambda times the noise's variance. Nothing is periodic, and
nothing is assumed about the scene outside. Scenes are (batch, rows, columns), larger than the frame by the PSF's reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from aolink.numerics.arrays import BoolArray
from aolink.restoration.psf import Psf, line_matrix

FloatingArray = NDArray[np.floating[Any]]

_THREADS = 2
_MOST_STEPS = 400
_TOLERANCE = 1e-4
_SINGLE = 1e-3
# Scenes of up to this many pixels are solved by one dense factorisation, which is faster than conjugate gradients; and
# FFTs of fewer pixels than this gain nothing by a second thread.
_SMALL_SCENE, _SMALL_FFT = 1200, 40_000


def single_is_enough(kappa: float, sum_of_taps: float) -> bool:
    """Whether the error of single precision is far below the noise; this error grows with one over kappa."""
    return kappa >= _SINGLE * sum_of_taps**2


class Solver(Protocol):
    """Solves (H'WH + kappa L) x = b for the methods on the plane."""

    @property
    def frame(self) -> tuple[slice, slice]:
        """The place of the frame in the scene."""

    def project(self, images: FloatingArray) -> FloatingArray:
        """H'W applied to images, the size of the scene."""

    def solve(
        self, right: FloatingArray, start: FloatingArray | None = None, tolerance: float = _TOLERANCE
    ) -> FloatingArray:
        """The scene x with (H'WH + kappa L) x = right; ``tolerance`` is relative to the root of kappa x'L x."""

    def guess(self, images: FloatingArray) -> FloatingArray | None:
        """A scene to start from, or None if the solver needs none; ``images`` hold likely values where nothing was
        measured."""


def difference_spectrum(n: int) -> NDArray[np.float64]:
    """Eigenvalues of D'D for n pixels in a row, whose eigenvectors are the cosines of the DCT-II, (n,)."""
    return 2 - 2 * np.cos(np.pi * np.arange(n) / n)


@dataclass(frozen=True, kw_only=True, eq=False)
class LineSolver:
    """An exact solver for blur along the rows with all pixels measured: cosines down the columns, one eigenbasis along
    the rows."""

    C: FloatingArray
    """Matrix that blurs a line, (columns, columns + m)."""
    vectors: FloatingArray
    """Eigenvectors of C'C + kappa Dx'Dx, (columns + m, columns + m)."""
    inverse: FloatingArray
    """One over their eigenvalues plus kappa times those of Dy'Dy, (rows, columns + m)."""
    first: int
    """Element of a line at which the frame starts."""

    @property
    def frame(self) -> tuple[slice, slice]:
        return slice(None), slice(self.first, self.first + len(self.C))

    def project(self, images: FloatingArray) -> FloatingArray:
        return np.asarray(images.astype(self.C.dtype, copy=False) @ self.C)

    def guess(self, images: FloatingArray) -> None:
        """No scene: this solver needs none."""

    def solve(self, right: FloatingArray, start: FloatingArray | None = None, tolerance: float = 0.0) -> FloatingArray:
        # A second thread for the cosines would cost more than it saves: the thread of the products is still awake.
        z = fft.dct(right, axis=-2, norm="ortho") @ self.vectors
        z *= self.inverse
        return np.asarray(fft.idct(z @ self.vectors.T, axis=-2, norm="ortho", overwrite_x=True))


def line_solver(psf: Psf, shape: tuple[int, int], kappa: float, single: bool = False) -> LineSolver:
    """The exact solver of a PSF along the rows, which may differ from pixel to pixel.

    ``single`` allows single precision, which is used where its error is far below the noise.
    """
    taps = np.broadcast_to(psf.values, (shape[1], psf.values.shape[-1]))
    single = single and single_is_enough(kappa, float(taps.sum(axis=1).max()))
    dtype = np.float32 if single else np.float64
    C = line_matrix(taps, shape[1])
    # NumPy's function, not SciPy's: each library has threads of its own, and SciPy's would be in the way of the
    # products'.
    values, vectors = np.linalg.eigh(C.T @ C + kappa * _differences_squared(C.shape[1]))
    return LineSolver(
        C=C.astype(dtype), vectors=vectors.astype(dtype),
        inverse=(1 / (values + kappa * difference_spectrum(shape[0])[:, None])).astype(dtype),
        first=taps.shape[1] - 1 - psf.origin[0],
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class DenseSolver:
    """An exact solver for any blur on the plane and any mask of a small frame, by the Cholesky factor of the whole
    matrix."""

    H: FloatingArray
    """Matrix that blurs a scene, zero where nothing was measured, (pixels, scene's pixels)."""
    factor: FloatingArray
    """Lower Cholesky factor of (H'WH + kappa L), (scene's pixels, scene's pixels)."""
    shape: tuple[int, int]
    """Rows and columns of the scene."""
    frame: tuple[slice, slice]

    def project(self, images: FloatingArray) -> FloatingArray:
        return np.asarray(images.reshape(len(images), -1) @ self.H).reshape(-1, *self.shape)

    def guess(self, images: FloatingArray) -> None:
        """No scene: this solver needs none."""

    def solve(self, right: FloatingArray, start: FloatingArray | None = None, tolerance: float = 0.0) -> FloatingArray:
        flat = right.reshape(len(right), -1).T
        return np.asarray(linalg.cho_solve((self.factor, True), flat, check_finite=False)).T.reshape(right.shape)


def dense_solver(psf: Psf, shape: tuple[int, int], kappa: float, seen: BoolArray | None = None) -> DenseSolver:
    """The exact solver of a PSF on the plane, or along all rows alike, for a small frame."""
    taps, frame = _on_plane(psf, shape)
    (rows, columns), (high, wide) = shape, (shape[0] + taps.shape[0] - 1, shape[1] + taps.shape[1] - 1)
    H = np.zeros((rows, columns, high, wide))
    each = np.lib.stride_tricks.as_strided(
        H, (rows, columns, *taps.shape), (H.strides[0] + H.strides[2], H.strides[1] + H.strides[3], *H.strides[2:])
    )
    each[...] = taps[::-1, ::-1]
    if seen is not None:
        H *= seen[:, :, None, None]
    flat = H.reshape(rows * columns, high * wide)
    A = (flat.T @ flat).reshape(high, wide, high, wide)
    r, c = np.arange(high), np.arange(wide)
    A[r, :, r, :] += kappa * _differences_squared(wide)
    A[:, c, :, c] += kappa * _differences_squared(high)
    factor = linalg.cholesky(A.reshape(high * wide, -1), lower=True, overwrite_a=True, check_finite=False)
    return DenseSolver(H=flat, factor=factor, shape=(high, wide), frame=frame)


def _differences_squared(n: int) -> NDArray[np.float64]:
    """D'D for n pixels in a row, (n, n)."""
    D = np.diff(np.eye(n), axis=0)
    return np.asarray(D.T @ D)


def _on_plane(psf: Psf, shape: tuple[int, int]) -> tuple[NDArray[np.float64], tuple[slice, slice]]:
    """Taps on the plane, and the place of a frame in its scene."""
    taps, origin = np.atleast_2d(psf.values), (0, *psf.origin)[-2:]
    top, left = (n - 1 - o for n, o in zip(taps.shape, origin, strict=True))
    return taps, (slice(top, top + shape[0]), slice(left, left + shape[1]))


@dataclass(frozen=True, kw_only=True, eq=False)
class IterativeSolver:
    """A solver for any blur on the plane and any mask, by preconditioned conjugate gradients."""

    kappa: float
    blur: Callable[[FloatingArray], FloatingArray]
    blur_transposed: Callable[[FloatingArray], FloatingArray]
    nearly: Callable[[FloatingArray], FloatingArray]
    """Preconditioner: a symmetric positive definite operator near the inverse."""
    guess: Callable[[FloatingArray], FloatingArray]
    seen: BoolArray | None
    frame: tuple[slice, slice]
    white: bool = False
    """Whether I takes the place of L: the scene's pixels are white, not its differences."""

    def project(self, images: FloatingArray) -> FloatingArray:
        return self.blur_transposed(images if self.seen is None else np.where(self.seen, images, 0.0))

    def solve(
        self, right: FloatingArray, start: FloatingArray | None = None, tolerance: float = _TOLERANCE
    ) -> FloatingArray:
        x = self.nearly(right) if start is None else start.copy()
        prior = self.kappa * _dot(x, x if self.white else roughness(x))
        r = right - self._apply(x)
        z = self.nearly(r)
        p, rz = z, _dot(r, z)
        # The second limit is that of rounding, for a picture that is constant.
        goal = np.maximum(tolerance**2 * prior, 1e-28 * _dot(right, self.nearly(right)))
        for _ in range(_MOST_STEPS):
            if (rz <= goal).all():
                break
            q = self._apply(p)
            step = rz / np.maximum(_dot(p, q), 1e-300)
            x += step * p
            r = r - step * q
            z = self.nearly(r)
            rz, before = _dot(r, z), rz
            p = z + rz / np.maximum(before, 1e-300) * p
        return x

    def _apply(self, x: FloatingArray) -> FloatingArray:
        return self.project(self.blur(x)) + self.kappa * (x if self.white else roughness(x))


def _dot(a: FloatingArray, b: FloatingArray) -> FloatingArray:
    return np.asarray((a * b).sum(axis=(-2, -1), keepdims=True))


def roughness(x: FloatingArray) -> FloatingArray:
    """L x = (Dx'Dx + Dy'Dy) x."""
    return differences_transposed(np.diff(x, axis=-1), np.diff(x, axis=-2))


def differences_transposed(along: FloatingArray, down: FloatingArray) -> FloatingArray:
    """Dx' along + Dy' down, from differences (.., rows, columns - 1) and (.., rows - 1, columns)."""
    out = np.empty((*along.shape[:-1], down.shape[-1]), along.dtype)
    out[..., 0] = 0
    out[..., 1:] = along
    out[..., :-1] -= along
    out[..., 1:, :] += down
    out[..., :-1, :] -= down
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodicPlane:
    """A blur on a periodic plane, as large as the scene or slightly larger, with a size for which transforms are
    fast."""

    taps: NDArray[np.float64]
    frame: tuple[slice, slice]
    """The place of the frame in the scene."""
    scene: tuple[int, int]
    """Rows and columns of the scene, which begins at the plane's first pixel."""
    shape: tuple[int, int]
    """Rows and columns of the plane."""
    transfer: NDArray[np.complexfloating[Any]]
    """Transfer function of the blur, as computed by `forward`."""
    rough: FloatingArray
    """Spectrum of L."""

    @classmethod
    def of(cls, psf: Psf, shape: tuple[int, int]) -> PeriodicPlane:
        """The plane for a PSF on the plane, or along all rows alike, and a frame's rows and columns."""
        taps, frame = _on_plane(psf, shape)
        rows, columns = shape[0] + taps.shape[0] - 1, shape[1] + taps.shape[1] - 1
        plane = fft.next_fast_len(rows, real=True), fft.next_fast_len(columns, real=True)
        return cls(
            taps=taps, frame=frame, scene=(rows, columns), shape=plane,
            transfer=fft.rfft2(taps, plane), rough=_roughness_spectrum(plane),
        )  # fmt: skip

    @property
    def blurred(self) -> tuple[slice, slice]:
        """The place of the frame in the blurred plane: only there no light arrives from across the periodic border."""
        return slice(self.taps.shape[0] - 1, self.scene[0]), slice(self.taps.shape[1] - 1, self.scene[1])

    @property
    def _threads(self) -> int:
        return _THREADS if self.scene[0] * self.scene[1] > _SMALL_FFT else 1

    def forward(self, images: FloatingArray, shape: tuple[int, int] | None = None) -> NDArray[np.complexfloating[Any]]:
        """The spectrum of images from the plane's first pixel on."""
        return np.asarray(fft.rfft2(images, shape or self.shape, workers=self._threads))

    def backward(
        self, spectrum: NDArray[np.complexfloating[Any]], shape: tuple[int, int] | None = None
    ) -> FloatingArray:
        """The whole plane that has a spectrum, which is overwritten."""
        return np.asarray(fft.irfft2(spectrum, shape or self.shape, workers=self._threads, overwrite_x=True))

    def through(
        self, images: FloatingArray, factor: NDArray[np.inexact[Any]], shape: tuple[int, int] | None = None
    ) -> FloatingArray:
        """The scene's pixels after the images' spectrum is multiplied by a factor."""
        spectrum = self.forward(images, shape)
        spectrum *= factor
        return self.backward(spectrum, shape)[..., : self.scene[0], : self.scene[1]]

    def placed(self, images: FloatingArray) -> FloatingArray:
        """Images at the frame's place in the blurred plane, cut to the scene's size, with zeros around the frame."""
        padded = np.zeros((*images.shape[:-2], *self.scene))
        padded[..., *self.blurred] = images
        return padded

    def guess(self, images: FloatingArray, kappa: float, share: float = 1.0, white: bool = False) -> FloatingArray:
        """The periodic solution for images continued from their last pixel to their first beyond the frame."""
        padded, (above, left) = self.placed(images), (n - 1 for n in self.taps.shape)
        down = (np.arange(1, above + 1) / (above + 1))[:, None]
        padded[..., :above, :] = (1 - down) * padded[..., -1:, :] + down * padded[..., above, None, :]
        right = np.arange(1, left + 1) / (left + 1)
        padded[..., :left] = (1 - right) * padded[..., -1:] + right * padded[..., left, None]
        transfer = fft.rfft2(self.taps, self.scene)
        inverse = inverse_spectrum(transfer, _roughness_spectrum(self.scene), kappa, share, white)
        return self.through(padded, transfer.conj() * inverse, self.scene)


def _roughness_spectrum(shape: tuple[int, int]) -> FloatingArray:
    y, x = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None]
    return np.asarray(4 * np.sin(np.pi * y) ** 2 + 4 * np.sin(np.pi * x) ** 2)


def inverse_spectrum(
    transfer: NDArray[np.complexfloating[Any]], rough: FloatingArray, kappa: float, share: float = 1.0,
    white: bool = False,
) -> FloatingArray:  # fmt: skip
    """One over the spectrum of (H'H + kappa L), or with I instead of L; a given share of the plane's pixels is
    measured."""
    # A floor for the mean, which the differences do not determine.
    prior = 1.0 if white else np.maximum(rough, rough[rough > 0].min() / 4)
    return np.asarray(1 / (share * np.abs(transfer) ** 2 + kappa * prior))


def plane_solver(
    psf: Psf, shape: tuple[int, int], kappa: float, seen: BoolArray | None = None, white: bool = False
) -> IterativeSolver:
    """The solver of a PSF on the plane (or along all rows alike), with the periodic solver as preconditioner."""
    plane = PeriodicPlane.of(psf, shape)
    fraction = 1.0 if seen is None else float(seen.mean())
    # The frame's share of the scene.
    share = fraction * shape[0] * shape[1] / (plane.scene[0] * plane.scene[1])
    inverse = inverse_spectrum(plane.transfer, plane.rough, kappa, share, white)
    backward = plane.transfer.conj()
    return IterativeSolver(
        kappa=kappa,
        blur=lambda x: plane.through(x, plane.transfer)[..., *plane.blurred],
        blur_transposed=lambda y: plane.through(plane.placed(y), backward),
        nearly=lambda r: plane.through(r, inverse),
        guess=lambda y: plane.guess(y, kappa, share, white),
        seen=seen, white=white, frame=plane.frame,
    )  # fmt: skip


def masked_line_solver(psf: Psf, seen: BoolArray, kappa: float) -> IterativeSolver:
    """A solver for blur along the rows with pixels missing: conjugate gradients, preconditioned by the whole frame's
    exact solver."""
    exact = line_solver(psf, (seen.shape[0], seen.shape[1]), kappa)
    return IterativeSolver(
        kappa=kappa, blur=lambda x: np.asarray(x @ exact.C.T), blur_transposed=lambda y: np.asarray(y @ exact.C),
        nearly=exact.solve, guess=lambda y: exact.solve(exact.project(y)), seen=seen, frame=exact.frame,
    )  # fmt: skip


def make_solver(
    psf: Psf, shape: tuple[int, int], kappa: float, seen: BoolArray | None = None, single: bool = False
) -> Solver:
    """The solver for a PSF, a frame's shape, kappa, and a mask (rows, columns), False where nothing was measured.

    ``single`` allows single precision, which is used where its error is far below the noise.
    """
    if psf.on_line and seen is None:
        return line_solver(psf, shape, kappa, single)
    if not psf.varies:
        taps = np.atleast_2d(psf.values).shape
        if (shape[0] + taps[0] - 1) * (shape[1] + taps[1] - 1) <= _SMALL_SCENE:
            return dense_solver(psf, shape, kappa, seen)
    if psf.on_line and seen is not None:
        return masked_line_solver(psf, seen, kappa)
    return plane_solver(psf, shape, kappa, seen)
