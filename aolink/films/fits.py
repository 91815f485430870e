"""Films from FITS files."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.facts import Said, facts, meaning
from aolink.films.film import Film, FilmFrame
from aolink.limits import check_picture, unpacked

_IN_COMMENT: Any = re.compile(r"[^\[]*\[([^\]]*)\]")
"""A unit in the comment of a key."""
_MOSAICS = ("RGGB", "BGGR", "GRBG", "GBRG")


def fits_film(path: Path, topic: str | None) -> Film:
    """The cube or picture of a FITS file, the first of several, compressed or not; AO telemetry where it is that."""
    with _opened(path) as (file, size):
        header = file[0].header
        if "AOT-VERS" in header:
            from aolink.films.telemetry import aot_film

            return aot_film(path, topic)
        if topic is not None:
            raise ImportingError(no_topic(path, topic))
        arrays: list[tuple[int, Any]] = []
        damaged = ""
        try:
            for k, each in enumerate(file):
                shape = each.shape if each.is_image else ()
                if min(shape, default=0) < 0:
                    raise ImportingError(f"it is damaged: it announces an array of shape {shape}")
                if len(shape) < 2 or not math.prod(shape):
                    continue
                place = each.fileinfo()
                if place and place["datLoc"] + math.prod(shape) * abs(each.header["BITPIX"]) // 8 > size:
                    raise ImportingError(f"it is cut off: {' x '.join(map(str, shape))} pixels are announced")
                arrays.append((k, each))
        except Exception as error:
            if not arrays or arrays[0][1].shape[:-2] in ((), (1,)):
                raise
            damaged = f"{path.name}: what follows the first cube cannot be read ({error})"
        if not arrays:
            raise ImportingError(f"{path} has no array of pixels, neither a primary one nor in an image extension")
        number, chosen = arrays[0]
        shape, own = chosen.shape, {**header, **chosen.header}
        cubes = len(shape) > 2
        more = [each for _, each in arrays[1:] if (len(each.shape) > 2 if cubes else each.shape == shape)]
        if more and not cubes:
            raise ImportingError(f"{path} holds {len(more) + 1} arrays of shape {shape}: stack the frames in one array")
        # As cameras with several windows write it, there may be axes of length one.
        if math.prod(shape[:-2]) != max(shape[:-2], default=1):
            raise ImportingError(f"{path} holds an array of shape {shape}, expected (frames, rows, columns)")
        rows, columns = getattr(chosen, "tile_shape", (1, 1))[-2:]
        check_picture(columns, rows, ImportingError)
        count = math.prod(shape[:-2])
        cards = [card for each in {id(file[0]): file[0], id(chosen): chosen}.values() for card in each.header.cards]
        said = [Said(card.keyword, card.value, _IN_COMMENT.match(f"{card.comment} []")[1]) for card in cards]
        said = [each for each in said if meaning(each.name)[0] in ("rate", "period", "exposure")]
        said = [each if (meaning(*each[::2])[2] or 0) > 0 else each._replace(unit="") for each in said]
        for each in file[1:] if not damaged else []:
            if not each.is_image and hasattr(each, "columns") and each.header["NAXIS2"] == count:
                columns = [column for column in each.columns if meaning(column.name)[0]]
                said += [Said(column.name, np.array(each.data[column.name]), column.unit or "") for column in columns]
        along = next((k for k, n in enumerate(shape[:-2]) if n > 1), None)
        at = [tuple(k if axis == along else 0 for axis in range(len(shape) - 2)) for k in range(count)]
    bits = int(own["BITPIX"])
    scale, zero = (_number(own.get(key)) or 0.0 for key in ("BSCALE", "BZERO"))
    scale = scale if "BSCALE" in own else 1.0
    kind = f"{'f' if bits < 0 else 'u' if bits == 8 else 'i'}{abs(bits) // 8}"
    if bits > 0 and scale == 1 and zero == (-128 if bits == 8 else 2.0 ** (bits - 1)):
        kind = "i1" if bits == 8 else f"u{bits // 8}"  # the usual way to keep these
    elif (scale, zero) != (1, 0):
        kind = "f4" if abs(bits) <= 16 or bits == -32 else "f8"
    dtype = np.dtype(kind)

    def pictures() -> Iterator[FilmFrame]:
        with _opened(path) as (file, _):
            for each in at:
                raw = np.asarray(file[number].section[(*each, slice(None), slice(None))])
                unknown = raw == own["BLANK"] if "BLANK" in own and bits > 0 else np.zeros(1, np.bool_)
                if dtype.kind == "f":
                    frame = (raw * dtype.type(scale) + dtype.type(zero)).astype(dtype)
                else:
                    frame = raw.astype(dtype) + np.array(int(zero) % 2**64, np.uint64).astype(dtype)
                yield np.where(unknown, np.nan, frame) if unknown.any() else frame

    known, notes = facts(said, count, longest_s=math.inf)
    several = f"{path.name} holds {len(more) + 1} cubes: the first is taken" if more else ""
    start_ns, unknown = start_of(own)
    known |= {"start_ns": start_ns} if start_ns is not None else {}
    mosaic = str(own.get("BAYERPAT", own.get("COLORTYP", ""))).strip()
    if mosaic in _MOSAICS:
        cells = np.array(list(mosaic)).reshape(2, 2)
        down = shape[-2] % 2 == 0 and str(own.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP"
        right, below = (int(_number(own.get(key)) or 0) for key in ("XBAYROFF", "YBAYROFF"))
        mosaic = "".join(np.roll(cells, (down - below, -right), (0, 1)).flat)
    return Film(
        name=path.name, shape=(shape[-2], shape[-1]), dtype=dtype, count=count, pictures=pictures,
        mosaic=mosaic if mosaic in _MOSAICS else "", **known,
        notes=tuple(filter(None, (several, damaged, unknown, *notes))),
    )  # fmt: skip


def no_topic(path: Path, topic: str) -> str:
    """The error for a topic of a source that has one film only."""
    return (
        f"{path} has no topics: --film topic={topic} says which channel of an MCAP file or a bag, which dataset of an"
        " HDF5 file, or which wavefront sensor of AO telemetry, is imported; leave it out"
    )


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, int]]:
    """The open file, and its size in bytes without compression by gzip."""
    with needs_extra("films", ImportingError):
        from astropy.io import fits
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about headers that are not as the standard says
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        source: Any = io.BytesIO(unpacked(file, ImportingError)) if packed else file
        size = source.seek(0, io.SEEK_END)
        source.seek(0)
        with fits.open(source, lazy_load_hdus=True, memmap=False, do_not_scale_image_data=True) as opened:
            yield opened, size


def _number(value: Any) -> float | None:
    try:
        number = float(str(value).strip().upper().replace("D", "E"))
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def start_of(header: dict[str, Any]) -> tuple[int | None, str]:
    """Start of the exposure by DATE-OBS, which may have its time of day in TIME-OBS, ns since 1970, and a note where it
    is not known. What is called UTC goes before them: they may be local."""
    text, beside = (
        str(next((header[key] for key in keys if key in header), "")).strip()
        for keys in (("DATE-UTC", "DATE-OBS"), ("TIME-UTC", "UTC-OBS", "UT-OBS", "TIME-OBS"))
    )
    text = text.removesuffix("Z")
    if not text:
        return None, ""
    if "T" not in text and beside:
        text = f"{text}T{beside}"
    scale = str(header.get("TIMESYS", "UTC")).strip().lower()
    try:
        if "T" not in text:
            raise ValueError("it has no time of day")
        if scale not in ("utc", "gmt"):
            from astropy.time import Time

            text = str(Time(text, scale=scale, precision=9).utc.isot)
        return int(np.datetime64(text, "ns").astype(np.int64)), ""
    except ValueError as error:
        return None, f"its start is not known: DATE-OBS is {text!r} ({error})"
