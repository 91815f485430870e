"""Pictures and PSFs from the files of any film, and files of the same kind for what was made of them."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, ImportingError, RestorationError
from aolink.extensions import needs_extra
from aolink.files import writing
from aolink.films.film import Film, grey
from aolink.films.formats import open_film
from aolink.films.stills import encoded
from aolink.numerics.arrays import FloatArray

_TIFF, _FITS = (".tif", ".tiff"), (".fits", ".fit", ".fts")
_EVEN = 1.2
"""A ground is even where a quarter of a PSF's values are not above it by more than this factor."""
_PEDESTAL = 0.05
"""Share of a PSF's sum in an even ground from which on it is one, and of its values that may be below that ground."""


def read_film(path: str | Path, error: type[AolinkError]) -> Film:
    """The film of a file; raises ``error`` where it cannot be read."""
    try:
        return open_film(path)
    except ImportingError as problem:
        raise error(str(problem)) from None


def read_picture(path: str | Path, error: type[AolinkError]) -> NDArray[Any]:
    """The only picture in a file, (rows, columns) or (rows, columns, 2 to 4 channels), of its own type or, where pixels
    of it are undefined, with NaN there. Raises ``error``."""
    film = read_film(path, error)
    if film.count != 1:
        raise error(f"{path} holds {film.count} pictures, expected one: take the right one out of it")
    try:
        return next(film.pictures())
    except ImportingError as problem:
        raise error(str(problem)) from None


def read_frame(path: str | Path, error: type[AolinkError]) -> FloatArray:
    """The only picture in a file in grey, (rows, columns). Raises ``error``."""
    return np.asarray(grey(read_picture(path, error), path), dtype=np.float64)


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


def read_psf(path: Path) -> tuple[FloatArray, tuple[str, ...]]:
    """A PSF as numbers, and notes on it: from text with commas or spaces, .npy, or a picture.

    One row is a PSF along the rows, (taps,), one column a PSF along the columns, (taps, 1). Raises `RestorationError`
    where the file cannot be read as a PSF.
    """
    if path.suffix.lower() in (".csv", ".txt", ".dat", ""):
        try:
            rows = [line.replace(",", " ").split() for line in path.read_text(encoding="utf-8").splitlines()]
            found = np.array([[float(cell) for cell in row] for row in rows if row])
        except (OSError, ValueError) as error:
            raise RestorationError(
                f"{path} cannot be read as a PSF ({error}): give a picture, .npy, or rows of numbers with commas or"
                " spaces"
            ) from error
        found = found[0] if len(found) == 1 else found
    elif path.suffix == ".npy":
        try:
            found = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise RestorationError(f"{path} cannot be read as a PSF ({error})") from error
        if found.dtype.kind not in "uif":
            raise RestorationError(f"{path} holds {found.dtype}, expected the PSF's numbers")
        found = found.astype(np.float64)
    else:
        found = read_frame(path, RestorationError)
    if found.size > 2 and np.isfinite(found).all() and found.sum() > 0:
        ground = float(np.quantile(found, _PEDESTAL))
        share = ground * found.size / found.sum()
        even = np.count_nonzero(found <= _EVEN * ground) > found.size / 4
        if share > _PEDESTAL and ground < found.max() / 5 and even:
            return np.maximum(found - ground, 0.0), (
                f"{share:.0%} of the PSF's sum is an even ground of {ground:.3g}, as of a camera's dark level, with"
                " which the picture would become worse: it is subtracted from the PSF",
            )
    return found, ()
