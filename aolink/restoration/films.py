"""Pictures from files without their blur, also with a motion that something else measured: a gyro, an encoder, a
strain gauge."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aolink.errors import ImportingError, RestorationError
from aolink.extensions import needs_extra
from aolink.files import writing
from aolink.films.film import Film, saturation
from aolink.films.stills import encoded
from aolink.optics.sensor import Kernel
from aolink.restoration.method import Restored
from aolink.restoration.psf import Psf, motion_psf
from aolink.restoration.restore import restore
from aolink.restoration.texts import read_log

_TIFF, _FITS = (".tif", ".tiff"), (".fits", ".fit", ".fts")
_STEPS = 1000
"""Moments of an exposure at which the log is interpolated."""
_SHARP = 0.01
"""Width of the picture's own spot, pixels: the log knows the motion alone."""
_ROUNDING_S = 1e-6


class PathClock(NamedTuple):
    """What a log does not say itself."""

    offset_s: float
    """Seconds by which its clock is behind that of the pictures."""
    exposure_s: float | None
    """Exposure time of the pictures, where their file does not have it."""


class RestoredFilm(NamedTuple):
    """The pictures of a film without their blur."""

    pictures: list[NDArray[Any]]
    """(rows, columns, any channels) each, of the film's type."""
    last: Restored
    """What is known of the last one."""
    missing: int
    """Pixels that were no numbers."""
    saturated: int
    """Pixels that were at the end of their range, and therefore left out."""


def restored_film(film: Film, psfs: Sequence[Psf | ArrayLike], method: str, noise_sd: float | None) -> RestoredFilm:
    """Restore each picture of a film with its PSF. Raises `RestorationError`."""
    pictures, missing, saturated, whole_numbers = list[NDArray[Any]](), 0, 0, film.dtype.kind in "iu"
    try:
        for whole, psf in zip(film.pictures(), psfs, strict=True):
            colours: NDArray[Any] = whole.reshape(*whole.shape[:2], -1)
            alpha = colours[..., colours.shape[2] // 2 * 2 - 1 :] if colours.shape[2] in (2, 4) else colours[..., :0]
            light = colours[..., : colours.shape[2] - alpha.shape[2]]  # transparency is not light: it stays as it is
            known = np.isfinite(light).all(axis=2)
            top = saturation([light], film.full_scale, least=1) if whole_numbers else math.inf
            clipped = (light >= top).any(axis=2)
            missing, saturated = missing + int((~known).sum()), saturated + int(clipped.sum())
            good = known & ~clipped
            picture = light[..., 0] if light.shape[2] == 1 else light
            last = restore(picture, psf, method=method, noise_sd=noise_sd, mask=good if good.any() else None)
            made = last.image.reshape(light.shape)
            if whole_numbers:
                made = np.clip(np.rint(made), None, film.full_scale).astype(film.dtype)
            pictures.append(np.concatenate([made, alpha], axis=2).reshape(whole.shape))
    except ImportingError as error:
        raise RestorationError(str(error)) from None
    return RestoredFilm(pictures, last, missing, saturated)


def path_psfs(path: Path, clock: PathClock, film: Film) -> list[Psf]:
    """A PSF for each picture of a film, from a log of time (s), x and y (pixels along columns and rows).

    Pictures without a start of their own begin at 0 of the clock that the log has with its offset, or without an offset
    at the log's first time; without an exposure time the whole log is one exposure. Displacements are from the mean of
    an exposure. Raises `RestorationError` where the log cannot be read or does not cover an exposure.
    """
    times, places = read_log(path)
    times = times + clock.offset_s
    exposure_s = clock.exposure_s or film.exposure_s
    since = np.zeros(1)
    if film.count > 1:
        if exposure_s is None or (film.times_ns is None and film.rate_hz is None):
            raise RestorationError(
                f"{film.name} does not say when its {film.count} pictures were exposed, or for how long: give"
                " --exposure, and pictures with times"
            )
        since = np.arange(film.count) / film.rate_hz if film.rate_hz else np.zeros(film.count)
        since = since if film.times_ns is None else (film.times_ns - film.times_ns[0]) / 1e9
    begin = film.start_ns / 1e9 if film.start_ns is not None else 0.0 if clock.offset_s else times[0]
    if exposure_s is None:
        exposure_s, begin = times[-1] - times[0], times[0]
    found = []
    for start in begin + since:
        if start < times[0] - _ROUNDING_S or start + exposure_s > times[-1] + _ROUNDING_S:
            raise RestorationError(
                f"{path} knows the motion from {times[0]:.6f} to {times[-1]:.6f} s, and an exposure lasts from"
                f" {start:.6f} to {start + exposure_s:.6f} s: give the right --offset or --exposure"
            )
        moments = start + (np.arange(_STEPS) + 0.5) / _STEPS * exposure_s
        along = np.array([np.interp(moments, times, each) for each in places])
        kernel = Kernel(shape="gaussian", sigma=_SHARP)
        found.append(motion_psf(along - along.mean(axis=1, keepdims=True), None, kernel, 1.0))
    return found


def write_pictures(
    path: Path, made: list[NDArray[Any]], film: Film, *, overwrite: bool = False, sources: Iterable[Path] = ()
) -> None:
    """Write what was made of the pictures of a film so that a reader of that film reads it, of its type and with its
    meaning of black and white; ``sources`` are files that it never replaces.

    Raises `RestorationError` where the file exists and ``overwrite`` is False, or it cannot be written, or its format
    cannot hold the pictures.
    """
    stack = np.asarray(made)
    if len(made) == 1 and film.count == 1:
        stack = stack[0]
    data, suffix = io.BytesIO(), path.suffix.lower()
    try:
        if suffix == ".npy":
            np.save(data, stack)
        elif suffix in _TIFF:
            with needs_extra("films", RestorationError):
                import tifffile
            dark = film.white_is_zero and stack.dtype.kind == "u"
            light = "rgb" if stack.shape[-1] in (3, 4) and made[0].ndim == 3 else "minisblack"
            most = (film.full_scale - stack).astype(stack.dtype) if dark else stack
            tifffile.imwrite(data, most, photometric="miniswhite" if dark else light)
        elif suffix in _FITS:
            with needs_extra("films", RestorationError):
                from astropy.io import fits
            fits.PrimaryHDU(stack).writeto(data)
        elif len(made) > 1:
            raise ValueError(f"it holds one picture, and there are {len(made)}; .tif and .npy hold several")
        else:
            data.write(encoded(path, made[0], film.top))
    except (ValueError, TypeError, KeyError, OSError) as error:
        raise RestorationError(
            f"{path} cannot be written ({error}): a picture of type {stack.dtype} fits in a .npy file"
        ) from error
    with writing(path, overwrite=overwrite, sources=sources, error=RestorationError) as partial:
        partial.write_bytes(data.getbuffer())
