"""Frames from a file: a FITS image or a cube of them, compressed or not, or NumPy's .npy."""

from __future__ import annotations

import math
import os
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, FrameError
from aolink.limits import load_array, unpacked
from aolink.numerics.arrays import FloatArray

_BLOCK, _CARD = 2880, 80
_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}


def read_frame(path: str | Path) -> FloatArray:
    """The picture in a .fits, .fits.gz or .npy file, (rows, columns).

    Raises `FrameError` where the file cannot be read or holds no two-dimensional picture.
    """
    path = Path(path)
    try:
        if path.suffix == ".npy":
            picture = load_array(path)
        else:
            picture = parse_fits(read_fits(path, FrameError))
    except OSError as error:
        raise FrameError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except (EOFError, ValueError, zlib.error) as error:
        raise FrameError(f"{path} is damaged or no picture: {error}") from None
    except FrameError as error:
        raise FrameError(f"{path}: {error}") from None
    if picture.ndim != 2 or picture.dtype.kind not in "biuf":
        raise FrameError(f"{path} holds {picture.dtype} of shape {picture.shape}, expected numbers in rows and columns")
    return np.asarray(picture, dtype=np.float64)


def read_fits(path: Path, error: type[AolinkError]) -> bytes:
    """The bytes of a FITS file without its compression; raises ``error`` for a path that is not a plain file, and for a
    very large file."""
    with path.open("rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise error(f"{path} is a pipe or a device: copy what it gives into a file")
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        return unpacked(file, error) if packed else file.read()


def parse_fits(data: bytes) -> FloatArray:
    """The primary image of a FITS file with two axes. Raises `FrameError` where the data are not such a file."""
    _, stored, scale, zero = next(fits_arrays(data))
    if stored.ndim != 2:
        raise FrameError(
            f"its primary image has the shape {stored.shape}, expected two axes: take the picture out of it"
        )
    return np.asarray(stored * scale + zero)


def fits_arrays(data: bytes) -> Iterator[tuple[dict[str, str], NDArray[Any], float, float]]:
    """The arrays of a FITS file, primary or in image extensions, one after the other; at least one. Pence et al.,
    Astron. Astrophys. 524, A42 (2010).

    Raises `FrameError` where the data are not a FITS file, have no array, or are damaged.

    Yields
    ------
    The values of the primary header and of the array's own as text, by their keys; the array as it is stored, its axes
    in NumPy's order; and BSCALE and BZERO, so that the values are ``array * BSCALE + BZERO``.
    """
    if not data[:9] == b"SIMPLE  =":
        raise FrameError("it is not a FITS file: it does not begin with SIMPLE")
    values, start, compressed, count = dict[str, str](), 0, False, 0
    while start < len(data):
        own, start = _header(data, start)
        values = values | own
        try:
            kind = np.dtype(_TYPES[int(own["BITPIX"])])
            shape = tuple(int(own[f"NAXIS{axis}"]) for axis in range(int(own["NAXIS"]), 0, -1))
            scale, zero = (float(own.get(key, default)) for key, default in (("BSCALE", "1"), ("BZERO", "0")))
            groups, heap = int(own.get("GCOUNT", "1")), int(own.get("PCOUNT", "0"))
        except (KeyError, ValueError) as error:
            raise FrameError(f"its header has no usable {error}") from None
        pixels = math.prod(shape) if shape else 0
        if pixels > 0 and own.get("XTENSION", "IMAGE") == "IMAGE":
            if len(data) - start < pixels * kind.itemsize:
                raise FrameError(f"it is cut off: {' x '.join(map(str, shape))} pixels are announced")
            count += 1
            yield values, np.frombuffer(data, kind, pixels, start).reshape(shape), scale, zero
        compressed |= "ZIMAGE" in own
        size = kind.itemsize * groups * (heap + max(pixels, 0))
        start += -(-max(size, 0) // _BLOCK) * _BLOCK
    if compressed and not count:
        raise FrameError("its picture is compressed in tiles: unpack it first, with funpack for instance")
    if not count:
        raise FrameError("it has no array of pixels, neither a primary one nor in an image extension")


def _header(data: bytes, start: int) -> tuple[dict[str, str], int]:
    """A header's values as text by their keys, and where what comes after it begins."""
    values = {}
    while (card := bytes(data[start : start + _CARD]))[:8].rstrip() != b"END":
        if len(card) < _CARD:
            raise FrameError("its header has no END: the file is cut off")
        if card[8:10] == b"= ":
            values[card[:8].decode("latin-1").rstrip()] = _value(card[10:].decode("latin-1"))
        start += _CARD
    return values, (start // _BLOCK + 1) * _BLOCK


def _value(text: str) -> str:
    """A header's value without its comment and its quotes."""
    text = text.strip()
    if text.startswith("'"):
        return text[1:].split("'")[0].strip()
    return text.split("/")[0].strip()
