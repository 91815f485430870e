"""Single pictures as their formats keep them: PNG, JPEG, BMP, PGM and others."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Rational
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, ImportingError
from aolink.extensions import needs_extra
from aolink.films.facts import Said, facts
from aolink.films.film import Film
from aolink.limits import check_picture

if TYPE_CHECKING:
    from PIL import Image

COMPRESSED = "JPEG and video hold light after a gamma curve and lossy compression"
LOSSY = (".jpg", ".jpeg", ".webp")
_LOSSLESS = ("PNG", "BMP", "TIFF", "PPM", "JPEG2000")
_FORMATS = (*_LOSSLESS, "JPEG", "WEBP", "GIF")
"""What is decoded, whatever a file's name says: others may run programs."""
_NETPBM = (b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"P7")


def picture_film(path: Path) -> Film:
    """A film of one picture."""
    pixels, top, lossy = decoded(path.read_bytes())
    known, notes = said(path)
    return Film(
        name=path.name, shape=pixels.shape[:2], dtype=pixels.dtype, count=1, top=top,
        pictures=lambda: iter([pixels]), nonlinear=COMPRESSED if lossy else "", notes=notes, **known,
    )  # fmt: skip


def said(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """What the file of a picture says beside it, by EXIF or in texts, and a note on that."""
    with path.open("rb") as file:
        if file.read(2) in _NETPBM:
            return {}, ()
    with opened_image(path, ImportingError) as image:
        from PIL import ExifTags

        tags: dict[Any, Any] = {}
        if image.format != "PNG" or "exif" in image.info:  # it would decode it
            exif = image.getexif()
            tags.update({**exif, **exif.get_ifd(ExifTags.IFD.Exif)})
        named = {ExifTags.TAGS.get(key, str(key)): value for key, value in tags.items()}
        parts = (named.get("DateTimeOriginal"), named.get("SubsecTimeOriginal"), named.get("OffsetTimeOriginal"))
        found = [Said(str(key), float(each) if isinstance(each, Rational) else each) for key, each in
                 [*named.items(), *image.info.items()] if isinstance(each, str | Rational | float)]  # fmt: skip
    found = [each for each in found if each.name != "DateTimeOriginal"]
    if parts[0]:  # 2026:11:22 09:30:00, with decimals and a zone beside it
        date = f"{str(parts[0])[:10].replace(':', '-')}T{str(parts[0])[11:]}"
        found.append(Said("DateTimeOriginal", f"{date}.{parts[1] or 0}{parts[2] or ''}"))
    return facts(found, 1, longest_s=math.inf)


def decoded(data: bytes) -> tuple[NDArray[Any], float | None, bool]:
    """Pixels of a picture in any format, (rows, columns) or (rows, columns, 2 to 4 channels); their largest value where
    it is not that of the type; and whether the compression loses some of them.

    Raises `ImportingError`; OSError where the format is not known.
    """
    if data[:2] in _NETPBM:
        with needs_extra("films", ImportingError):
            import netpbmfile
        with netpbmfile.NetpbmFile(io.BytesIO(data)) as file:
            rows, columns = (file.shape[file.axes.index(axis)] for axis in "YX")
            check_picture(columns, rows, ImportingError)
            pixels = file.asarray()
            if data[:2] in (b"P1", b"P4"):
                return pixels.astype(np.bool_), None, False
            pixels = pixels.astype(pixels.dtype.newbyteorder("="))
            full = np.iinfo(pixels.dtype).max if pixels.dtype.kind in "iu" else None
            return pixels, None if full in (None, file.maxval) else float(file.maxval), False
    with opened_image(io.BytesIO(data), ImportingError) as image:
        lossy = image.format not in _LOSSLESS
        if image.format in ("JPEG2000", "TIFF") or (image.format == "PNG" and data[24] > 8 and image.mode != "I;16"):
            with needs_extra("films", ImportingError):
                import imagecodecs
            decode = {"PNG": imagecodecs.png_decode, "TIFF": imagecodecs.tiff_decode}
            return decode.get(image.format, imagecodecs.jpeg2k_decode)(data), None, lossy
        return image_pixels(image), None, lossy


@contextmanager
def opened_image(source: Path | IO[bytes], error: type[AolinkError]) -> Iterator[Image.Image]:
    """An image of Pillow's, whose pixels are not read yet; raises ``error`` for one with more than the limit's."""
    with needs_extra("films", ImportingError):
        from PIL import Image

    with warnings.catch_warnings():  # Pillow has other limits of its own
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            image = Image.open(source, formats=_FORMATS)
        except Image.DecompressionBombError as problem:
            raise error(str(problem).partition(",")[0].lower()) from None
    with image:
        check_picture(image.width, image.height, error)
        yield image


def image_pixels(image: Image.Image) -> NDArray[Any]:
    """Pixels of an image of Pillow's: those of a palette as its colours."""
    if image.mode == "1":
        return np.asarray(image.convert("L"))
    if image.mode not in ("L", "LA", "F", "I", "RGB", "RGBA") and not image.mode.startswith("I;16"):
        return np.asarray(image.convert("RGB"))
    return np.asarray(image)


def encoded(path: Path, picture: NDArray[Any], top: float | None) -> bytes:
    """A picture in the format that the suffix of ``path`` names. Raises ValueError where it cannot hold the picture."""
    data, suffix = io.BytesIO(), path.suffix.lower()
    if suffix in (".pgm", ".ppm", ".pnm"):
        with needs_extra("films", ImportingError):
            import netpbmfile
        netpbmfile.imwrite(data, picture, maxval=None if top is None else int(top))
        return data.getvalue()
    if suffix == ".png" and picture.dtype == np.uint16 and picture.ndim == 3:
        with needs_extra("films", ImportingError):
            import imagecodecs
        return bytes(imagecodecs.png_encode(np.ascontiguousarray(picture)))
    from PIL import Image

    kind = Image.registered_extensions().get(suffix)
    if kind is None:
        raise ValueError(f"unknown file extension: {path.suffix}")
    Image.fromarray(picture).save(data, format=kind)
    return data.getvalue()
