"""Files of single pictures and PSFs."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, RestorationError
from aolink.files import writing
from aolink.limits import check_picture, load_array
from aolink.numerics.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from PIL import Image


def read_picture(path: Path) -> NDArray[Any]:
    """A picture as numbers, (rows, columns) or (rows, columns, 3 or 4), of its own type.

    ``.npy`` is taken as it is; otherwise any format of Pillow's: 8 bits grey or colour, 16 bits grey, floats. Raises
    `RestorationError` where the file cannot be read as a picture.
    """
    if path.suffix == ".npy":
        return _load(path, "picture")
    try:
        with opened_image(path, RestorationError) as image:
            return image_pixels(image)
    except RestorationError as error:
        raise RestorationError(f"{path}: {error}") from None
    except (OSError, ValueError) as error:
        raise RestorationError(
            f"{path} cannot be read as a picture ({error}): give a .png, .tif, .jpg or .npy"
        ) from error


@contextmanager
def opened_image(source: Path | IO[bytes], error: type[AolinkError]) -> Iterator[Image.Image]:
    """An image of Pillow's, whose pixels are not read yet; raises ``error`` for one with more than the limit's."""
    from PIL import Image

    with warnings.catch_warnings():  # Pillow has other limits of its own
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            image = Image.open(source)
        except Image.DecompressionBombError as problem:
            raise error(str(problem).partition(",")[0].lower()) from None
    with image:
        check_picture(image.width, image.height, error)
        yield image


def image_pixels(image: Image.Image) -> NDArray[Any]:
    """Pixels of an image of Pillow's, as `read_picture` gives them."""
    if image.mode in ("1", "LA"):
        return np.asarray(image.convert("L"))
    if image.mode not in ("L", "F", "I", "RGB", "RGBA") and not image.mode.startswith("I;16"):
        return np.asarray(image.convert("RGB"))
    return np.asarray(image)


def finite_pixels(picture: NDArray[Any]) -> BoolArray | None:
    """Mask of the pixels of a picture (rows, columns, any colours) that are finite, (rows, columns); None where all
    are."""
    if picture.dtype.kind != "f" or picture.ndim not in (2, 3):
        return None
    finite = np.isfinite(picture).reshape(*picture.shape[:2], -1).all(axis=2)
    return finite if not finite.all() and finite.any() else None


def write_picture(path: Path, picture: NDArray[Any], *, overwrite: bool = False, sources: Iterable[Path] = ()) -> None:
    """Write a picture that `read_picture` reads back; ``sources`` are files that it never replaces.

    Raises `RestorationError` where the file exists and ``overwrite`` is False, or it cannot be written, or its format
    cannot hold the picture.
    """
    from PIL import Image

    data = io.BytesIO()
    try:
        if path.suffix == ".npy":
            np.save(data, picture)
        else:
            kind = Image.registered_extensions().get(path.suffix.lower())
            if kind is None:
                raise ValueError(f"unknown file extension: {path.suffix}")
            Image.fromarray(picture).save(data, format=kind)
    except (ValueError, TypeError, KeyError, OSError) as error:
        raise RestorationError(
            f"{path} cannot be written ({error}): a picture of type {picture.dtype} fits in a .npy file"
        ) from error
    with writing(path, overwrite=overwrite, sources=sources, error=RestorationError) as partial:
        partial.write_bytes(data.getbuffer())


def read_psf(path: Path) -> FloatArray:
    """A PSF as numbers, from ``.npy`` or from text with commas or spaces; one row or column is a PSF along the rows.

    Raises `RestorationError` where the file cannot be read as a PSF.
    """
    if path.suffix == ".npy":
        values = _load(path, "PSF")
        if values.dtype.kind not in "uif":
            raise RestorationError(f"{path} holds {values.dtype}, expected the PSF's numbers")
        return values.astype(np.float64)
    try:
        rows = [line.replace(",", " ").split() for line in path.read_text(encoding="utf-8").splitlines()]
        found = np.array([[float(cell) for cell in row] for row in rows if row])
    except (OSError, ValueError) as error:
        raise RestorationError(
            f"{path} cannot be read as a PSF ({error}): give a .npy file, or rows of numbers with commas or spaces"
        ) from error
    return found.ravel() if 1 in found.shape else found


def _load(path: Path, what: str) -> NDArray[Any]:
    try:
        values = load_array(path)
    except (OSError, ValueError, EOFError) as error:
        raise RestorationError(f"{path} cannot be read as a {what} ({error})") from error
    if not values.size:
        raise RestorationError(f"{path} cannot be read as a {what}: it holds an array of shape {values.shape}")
    return values
