"""The function `restore`: it gives the picture without the blur from a blurred picture and its PSF."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aolink.errors import RestorationError
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.restoration.method import Blurred, Restored
from aolink.restoration.psf import Psf, as_psf
from aolink.restoration.registry import DEFAULT_METHOD, check_parameters, find_method

_COLOURS = (3, 4)


def restore(
    image: ArrayLike, psf: Psf | ArrayLike, *, method: str = DEFAULT_METHOD, noise_sd: float | None = None,
    mask: ArrayLike | None = None, **parameters: Any,
) -> Restored:  # fmt: skip
    """Take the blur out of a picture.

    Parameters
    ----------
    image:
        (rows, columns), or (rows, columns, 3 or 4 colours), integers or floats. Integers are rounded and cut at
        the ends of their type.
    psf:
        A `Psf`; or plain numbers, which are divided by their sum and centred on tap ``n // 2``.
    method:
        A name of `METHODS`. On lines (for a motion along a straight line, at any angle; each line by itself):
        ``inverse`` (exact, for pictures without noise), the Kalman ``predictor``, ``filter``, ``lag`` (fixed-lag
        smoother, by the PSF's length), ``smoother``. On the plane: ``gauss_markov``, ``tv`` (keeps edges), ``pnp``
        (plug and play; slow). Installed packages may add others.
    noise_sd:
        Standard deviation of the picture's white noise, in the picture's unit; estimated from the picture where None.
    mask:
        True where a pixel is good, (rows, columns); dead and saturated pixels are False and are filled in.
    **parameters:
        Further parameters of the method (`Method.parameters`); None means not given. The methods on lines take

        ``boundary``: the scene before the first pixel of each line: a value, or (rows, taps - 1) pixels in their order
        on the line. For the inverse these are the taps - 1 pixels before the first that tap c_0 brings into the frame.
        None: unknown, estimated.

        ``scanner``: model of the scene, see `first_order`, `from_correlation`; None fits a first-order one.

        ``direction``: the direction in which lines are scanned. None: the stable one for the inverse, forwards for the
        others.

        ``pnp`` takes ``denoise``: a function of a picture (rows, columns) and its noise's standard deviation.

    Raises
    ------
    RestorationError
        The picture or PSF is empty, of the wrong shape or not finite; the PSF is negative or wider than the picture;
        the method does not exist, cannot restore this picture, or does not take a parameter.

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
    row = find_method(method)
    given = {name: value for name, value in parameters.items() if value is not None}
    check_parameters(row, given)
    planes = _planes(picture, good)
    if not psf.on_line and 1 in psf.values.shape:
        # A motion along one axis is exact on lines.
        if psf.values.shape[0] > 1:
            turned = None if mask is None else np.asarray(mask).T
            upright = Psf(values=psf.values.T, origin=psf.origin[::-1], modes=psf.modes.swapaxes(1, 2))
            done = restore(picture.swapaxes(0, 1), upright, method=method, noise_sd=noise_sd, mask=turned, **parameters)
            return replace(done, image=done.image.swapaxes(0, 1))
        psf = Psf(values=psf.values[0], origin=psf.origin[1:], modes=psf.modes[:, 0])
    _check_fit(planes, psf)
    if noise_sd is not None and not (math.isfinite(noise_sd) and noise_sd > 0):
        raise RestorationError(f"noise_sd is {noise_sd}: expected above zero, or method='inverse' where there is none")
    blurred = Blurred(planes=planes, psf=psf, seen=good, given_noise_sd=noise_sd)
    if reason := row.why_not(blurred):
        raise RestorationError(reason)
    done = row.restore(blurred, **given)
    return replace(done, method=row.name, image=_as_given(done.image, picture))


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
