"""`restore`: a blurred picture and its PSF to the picture without the blur."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from aolink.errors import RestorationError
from aolink.restoration import spectrum
from aolink.restoration.inverse import Direction
from aolink.restoration.lines import LINE_METHODS, LineRequest, restore_lines
from aolink.restoration.markov import make_solver, plane_solver
from aolink.restoration.plug_and_play import Denoiser, non_local_means, plug_and_play
from aolink.restoration.psf import STRAIGHT_PX, Line, Psf, along_line, as_psf
from aolink.restoration.rotation import to_lines
from aolink.restoration.scanner import Scanner, first_order
from aolink.restoration.tv import total_variation
from aolink.restoration.uncertainty import line_variance, plane_variance

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

Method = Literal["inverse", "predictor", "filter", "lag", "smoother", "gauss_markov", "tv", "pnp"]
METHODS: tuple[Method, ...] = get_args(Method)
_COLOURS = (3, 4)
# Noise below this share of the scene's differences (variances) is taken for as much where conjugate gradients solve:
# their steps grow with one over its root, and the picture is no sharper for it.
_SMALLEST_RATIO = 3e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class Restored:
    """A picture without its blur, and what it was restored with."""

    image: NDArray[Any]
    """Aligned with the scene at no displacement; shape and dtype of the blurred picture."""
    method: Method
    noise_sd: float
    """Standard deviation of the picture's white noise, as given or as found; NaN for the inverse."""
    psf_noise_sd: float
    """What the PSF's uncertainty adds to it, root of the added variance."""
    difference_weight: float
    """lambda of gauss_markov, tv and pnp, one over the picture's unit squared; NaN for the methods on lines."""
    scanner: Scanner | None
    """What the methods on lines took the scene for."""
    direction: Direction
    """In which the lines were scanned."""


def restore(
    image: ArrayLike,
    psf: Psf | ArrayLike,
    *,
    method: Method = "tv",
    noise_sd: float | None = None,
    boundary: float | ArrayLike | None = None,
    mask: ArrayLike | None = None,
    scanner: Scanner | None = None,
    direction: Direction | None = None,
    denoise: Denoiser = non_local_means,
) -> Restored:
    """Take the blur out of a picture.

    Parameters
    ----------
    image:
        (rows, columns), or (rows, columns, 3 or 4 colours), integers or floats. Integers are rounded and cut at
        the ends of their type.
    psf:
        A `Psf`; or plain numbers, which are divided by their sum and centred on tap ``n // 2``.
    method:
        On lines (a motion along a straight line, at any angle), no line knows of its neighbours: ``inverse`` (exact,
        for pictures without noise), the Kalman ``predictor``, ``filter``, ``lag`` (by the PSF's length), ``smoother``.
        On the plane: ``gauss_markov``, ``tv`` (keeps edges), ``pnp`` (plug and play with ``denoise``; slow).
    noise_sd:
        Of the picture's white noise, in its own unit; None finds it in the picture.
    boundary:
        What the scene is before the first pixel of each line: a value, or (rows, taps - 1) pixels in their order on
        the line. The inverse takes it for the taps - 1 pixels before the one that c_0 meets. None: unknown,
        estimated. For methods on lines only; the others need nothing.
    mask:
        True where a pixel is good, (rows, columns); dead and saturated pixels are False and are filled in.
    scanner:
        Model of the scene for the Kalman methods, see `first_order`, `from_correlation`; None fits a first-order one.
    direction:
        In which lines are scanned. None: the stable one for the inverse, forwards for the others.
    denoise:
        For ``pnp``.

    Raises
    ------
    RestorationError
        A picture or PSF that is empty, of the wrong shape or not finite; a PSF that is negative or wider than the
        picture; an inverse that is unstable; a path that is not straight, with a method on lines.

    Examples
    --------
    >>> scene = np.tile(np.repeat([0.0, 1.0, 0.0], 20), (8, 1))
    >>> blurred = np.array([np.convolve(row, np.full(5, 0.2), mode="same") for row in scene])
    >>> sharp = restore(blurred, np.full(5, 0.2), method="tv", noise_sd=0.001)
    >>> bool(abs(sharp.image - scene).max() < 0.05)
    True

    References
    ----------
    Shahin, (4)-(13); see the modules of `aolink.restoration` for the rest.
    """
    picture = np.asarray(image)
    psf = as_psf(psf)
    good = _checked_mask(picture, mask)
    checked_method(method)
    planes = _planes(picture, good)
    if not psf.on_line and 1 in psf.values.shape:
        # A motion along one axis is exact on lines.
        if psf.values.shape[0] > 1:
            turned = None if mask is None else np.asarray(mask).T
            upright = Psf(values=psf.values.T, origin=psf.origin[::-1], modes=psf.modes.swapaxes(1, 2))
            done = restore(
                picture.swapaxes(0, 1), upright, method=method, noise_sd=noise_sd, boundary=boundary, mask=turned,
                scanner=scanner, direction=direction, denoise=denoise,
            )  # fmt: skip
            return replace(done, image=done.image.swapaxes(0, 1))
        psf = Psf(values=psf.values[0], origin=psf.origin[1:], modes=psf.modes[:, 0])
    _check_fit(planes, psf)
    if noise_sd is not None and not (math.isfinite(noise_sd) and noise_sd > 0):
        raise RestorationError(f"noise_sd is {noise_sd}: expected above zero, or method='inverse' where there is none")
    if direction not in (None, *get_args(Direction)):
        raise RestorationError(f"direction is {direction!r}, expected one of {', '.join(get_args(Direction))}")
    if method in LINE_METHODS:
        done = _on_lines(planes, psf, method, noise_sd, boundary, good, scanner, direction)
    else:
        for name, given in (("boundary", boundary), ("scanner", scanner), ("direction", direction)):
            if given is not None:
                raise RestorationError(
                    f"{name} belongs to the methods on lines ({', '.join(LINE_METHODS)}): leave it out"
                )
        done = _on_plane(planes, psf, method, noise_sd, good, denoise)
    return replace(done, image=_as_given(done.image, picture))


def checked_method(name: str) -> Method:
    """The method of a name. Raises RestorationError where there is none."""
    for method in METHODS:
        if name == method:
            return method
    raise RestorationError(f"method is {name!r}, expected one of {', '.join(METHODS)}")


def _checked_mask(picture: NDArray[Any], mask: ArrayLike | None) -> BoolArray | None:
    colour = picture.ndim == 3 and picture.shape[2] in _COLOURS
    if not (picture.ndim == 2 or colour) or not picture.size or picture.dtype.kind not in "uif":
        raise RestorationError(
            f"the picture has shape {picture.shape} and type {picture.dtype}, expected numbers, (rows, columns) or"
            " (rows, columns, 3 or 4 colours)"
        )
    good = None
    if mask is not None:
        good = np.asarray(mask)
        if good.shape != picture.shape[:2] or good.dtype != np.bool_ or not good.any():
            raise RestorationError(
                f"the mask has shape {good.shape} and type {good.dtype}, expected bool {picture.shape[:2]}, True"
                " where a pixel is good, at least one"
            )
        good = None if good.all() else good
    bad = ~np.isfinite(picture).reshape(*picture.shape[:2], -1).all(axis=2)
    if good is not None:
        bad &= good
    if bad.any():
        raise RestorationError(
            f"{int(bad.sum())} of the picture's {bad.size} pixels are not finite: leave them out with"
            " mask=np.isfinite(image)"
        )
    return good


def _planes(picture: NDArray[Any], good: BoolArray | None) -> FloatArray:
    """Colours first, zeros where nothing was measured, (colours, rows, columns)."""
    planes = np.moveaxis(picture.reshape(*picture.shape[:2], -1), 2, 0).astype(np.float64)
    return planes if good is None else np.where(good, planes, 0.0)


def _as_given(planes: FloatArray, picture: NDArray[Any]) -> NDArray[Any]:
    out = np.moveaxis(planes, 0, 2).reshape(picture.shape)
    if picture.dtype.kind in "ui":
        limits = np.iinfo(picture.dtype)
        out = np.clip(np.rint(out), limits.min, limits.max)
    return out.astype(picture.dtype)


def _check_fit(planes: FloatArray, psf: Psf) -> None:
    rows, columns = planes.shape[1:]
    wide = psf.values.shape[-1] > columns
    if wide or (not psf.on_line and psf.values.shape[0] > rows):
        raise RestorationError(
            f"the PSF has {' x '.join(map(str, psf.values.shape))} taps, the picture {rows} x {columns} pixels: it"
            " must be at least as wide as its blur"
        )
    if psf.varies and len(psf.values) != columns:
        raise RestorationError(f"there are PSFs for {len(psf.values)} pixels of a line, the picture has {columns}")


def _noise_variance(planes: FloatArray, found: spectrum.Spectrum, noise_sd: float | None) -> float:
    """As given, or found; above what rounding of the numbers makes."""
    if noise_sd is not None:
        return noise_sd**2
    floor = 1e-6 * max(float(np.ptp(planes)), 1e-6 * float(np.abs(planes).max()), 1e-100)
    return max(spectrum.noise_variance(found), floor**2)


def _mean_psf(psf: Psf) -> FloatArray:
    return psf.values.mean(axis=0) if psf.varies else psf.values


def _filled(planes: FloatArray, good: BoolArray | None) -> FloatArray:
    """Missing pixels as their nearest neighbours: good enough to find weights with."""
    if good is None:
        return planes
    nearest = ndimage.distance_transform_edt(~good, return_distances=False, return_indices=True)
    return planes[:, nearest[0], nearest[1]]


def _on_plane(
    planes: FloatArray, psf: Psf, method: Method, noise_sd: float | None, good: BoolArray | None, denoise: Denoiser
) -> Restored:
    shape = (planes.shape[1], planes.shape[2])
    whole = _filled(planes, good)
    light = spectrum.plane_spectrum(whole, _mean_psf(psf))
    variance = _noise_variance(whole, light, noise_sd)
    weight = spectrum.difference_weight(light, variance)
    modes = psf.modes.mean(axis=1) if psf.varies else psf.modes
    unexplained = plane_variance(modes, weight)
    total = variance + unexplained
    if not psf.on_line or good is not None:
        total = max(total, _SMALLEST_RATIO / weight)
    if method == "gauss_markov":
        solver = make_solver(psf, shape, weight * total, good)
        scene = solver.solve(solver.project(whole), solver.guess(whole))
    else:
        # Total variation does not need the last digits; half of them take half of the time.
        level = whole.mean()
        scene, solver = total_variation(
            lambda kappa: make_solver(psf, shape, kappa, good, single=True), whole - level, total, weight
        )
        scene = scene.astype(np.float64) + level
    if method == "pnp":
        if psf.varies:
            raise RestorationError("pnp needs one PSF for the whole picture: use tv")
        scene = plug_and_play(
            lambda kappa: plane_solver(psf, shape, kappa, good, white=True), whole, total, scene, denoise
        )
    return Restored(
        image=scene[(slice(None), *solver.frame)], method=method, noise_sd=math.sqrt(variance),
        psf_noise_sd=math.sqrt(unexplained), difference_weight=weight, scanner=None, direction="forward",
    )  # fmt: skip


def _on_lines(
    planes: FloatArray, psf: Psf, method: Method, noise_sd: float | None, boundary: float | ArrayLike | None,
    good: BoolArray | None, scanner: Scanner | None, direction: Direction | None,
) -> Restored:  # fmt: skip
    lines, seen, back = planes, good, None
    if not psf.on_line:
        if method == "inverse":
            raise RestorationError("the exact inverse needs a motion along the picture's rows or columns: use smoother")
        line = _straight(psf, method)
        psf = line.psf
        lines, seen, back = to_lines(planes, good, line.angle_rad)
    if method == "inverse" and seen is not None:
        raise RestorationError("the exact inverse cannot do without a pixel: use the method smoother for masked ones")
    variance = unexplained = math.nan
    if method != "inverse":
        whole = _filled(lines, seen)
        variance = _noise_variance(whole, spectrum.plane_spectrum(whole, _mean_psf(psf)), noise_sd)
        if scanner is None:
            correlation, power = spectrum.correlation_and_variance(
                spectrum.line_spectrum(whole, _mean_psf(psf)), variance
            )
            scanner = first_order(correlation, power)
        unexplained = line_variance(psf.modes, scanner)
    request = LineRequest(
        method=method, psf=psf, noise_variance=variance + unexplained, scanner=scanner, boundary=boundary,
        direction=direction, seen=seen,
    )  # fmt: skip
    scene, scanned = restore_lines(lines, request)
    return Restored(
        image=scene if back is None else back(scene), method=method, noise_sd=math.sqrt(variance),
        psf_noise_sd=math.sqrt(unexplained), difference_weight=math.nan, scanner=scanner, direction=scanned,
    )  # fmt: skip


def _straight(psf: Psf, method: Method) -> Line:
    line = along_line(psf)
    if line.deviation_px > STRAIGHT_PX:
        raise RestorationError(
            f"the motion is not along a straight line: its light strays from one by {line.deviation_px:.2g} pixels rms,"
            f" and {method} bears {STRAIGHT_PX:g}; use gauss_markov, tv or pnp"
        )
    return line
