"""Films from TIFF files, with the times that ImageJ and OME-TIFF write."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.film import Film, FilmFrame, Stored
from aolink.films.stills import COMPRESSED
from aolink.limits import check_picture

_LOSSY = (6, 7)  # JPEG
_SECONDS = {
    **dict.fromkeys(("s", "sec", "seconds"), 1.0), **dict.fromkeys(("ms", "msec"), 1e-3), "min": 60.0,
    **dict.fromkeys(("us", "usec", "\N{MICRO SIGN}s", "\N{GREEK SMALL LETTER MU}s", r"\u00B5s"), 1e-6), "ns": 1e-9,
}  # fmt: skip
"""Units of time in the headers of TIFF files."""


def tiff_film(path: Path) -> Film:
    """The stack of a TIFF file, or of the several files of an OME-TIFF, or pictures that were appended one by one."""
    with needs_extra("films", ImportingError):
        import tifffile
    with _complaints(path), tifffile.TiffFile(path) as file:
        named = re.findall(r"FileName *= *[\"']([^\"']*)", file.ome_metadata or "")
        if far := next((each for each in named if Path(each).name != each), None):
            raise ImportingError(f"{path} names the file {far}: files of a stack are read from its own folder alone")
        kinds = [(each.shape, each.axes, np.dtype(each.dtype)) for each in file.series]
        first: Any = file.series[0]
        page: Any = file.pages.first
        imagej, ome = file.imagej_metadata or {}, file.ome_metadata
        names = {Path(each.parent.filehandle.path).name for each in first.pages if each is not None}
        lossy, bits = int(page.compression) in _LOSSY, page.bitspersample
        _, top, dtype = _light(path, page)
        place, order = first.dataoffset, file.byteorder
        white_is_zero = str(page.photometric.name) == "MINISWHITE"
    (shape, axes, stored), *others = kinds
    size = tuple(n for n, axis in zip(shape, axes, strict=True) if axis != "S")
    one_by_one = len(size) == 2 and bool(others)  # pictures that were appended
    if one_by_one and (other := next((kind for kind in others if kind != kinds[0]), None)):
        raise ImportingError(
            f"{path} holds pictures of {stored} of shape {shape} and of {other[2]} of shape {other[0]}: a film has"
            " frames of one size and type"
        )
    size = (len(kinds), *size) if len(size) == 2 else size
    if len(size) != 3 or dtype.kind not in "biuf":
        raise ImportingError(f"{path} holds {stored} of shape {shape}, expected (frames, rows, columns)")

    def pictures() -> Iterator[FilmFrame]:
        with _complaints(path), tifffile.TiffFile(path) as file:
            pages: Any = [page for each in file.series for page in each.pages] if one_by_one else file.series[0].pages
            if len(pages) != size[0]:  # ImageJ keeps a large stack as one page
                whole = Stored(path, stored.newbyteorder(order), (size[0], *shape[1:]), place)
                yield from (whole[k] for k in range(size[0]))
                return
            for page in pages:
                if page is None or math.prod(page.chunked) > len(page.dataoffsets):  # it would count them all
                    raise ImportingError(f"{path} is damaged: a page lacks some of its pixels")
                check_picture(page.keyframe.tilewidth, page.keyframe.tilelength, ImportingError)
                handle = page.parent.filehandle
                handle.open()  # of another file of the stack, it is closed
                yield _light(path, page.aspage(), read=True)[0]
                if handle is not file.filehandle:
                    handle.close()

    notes = [f"{path.name} holds {len(kinds)} stacks: the first is taken"] if others and not one_by_one else []
    if axes[0] in "CZ" and size[0] > 1 and not one_by_one:
        notes.append(f"its axis {axes[0]}, {'channels' if axes[0] == 'C' else 'depths'}, is taken for frames")
    known = _ome_times(tifffile.xml2dict(ome), size[0], notes) if ome else _imagej_times(imagej)
    return Film(
        name=path.name, shape=(size[1], size[2]), dtype=dtype, count=size[0], pictures=pictures,
        top=top if top is not None or dtype.kind not in "iu" or bits in (8, 16, 32, 64) else float((1 << bits) - 1),
        nonlinear=COMPRESSED if lossy else "", notes=tuple(notes), white_is_zero=white_is_zero, **known,
        files=frozenset(names),
    )  # fmt: skip


def _light(path: Path, page: Any, read: bool = False) -> tuple[NDArray[Any], float | None, np.dtype[Any]]:
    """Light of a page, (rows, columns) or (rows, columns, channels); its largest value where that is not its type's;
    and its type."""
    dtype, bits = np.dtype(page.dtype), page.bitspersample
    kind = str(page.photometric.name)
    top = float((1 << bits) - 1) if dtype.kind == "u" and bits != 8 * dtype.itemsize else None
    if kind in ("SEPARATED", "CIELAB", "YCBCR") and int(page.compression) not in _LOSSY:
        raise ImportingError(f"{path} has colours as {kind}, which are no light: convert them to RGB or grey")
    palette = page.colormap if kind == "PALETTE" else None
    if palette is not None:
        coarse = bool(((palette % 257 == 0) | (palette % 256 == 0)).all())  # 8 bits, written as 16
        palette, top = (palette >> 8).astype(np.uint8) if coarse else palette, None
        dtype = palette.dtype
    if not read:
        return np.empty(0, dtype), top, dtype
    values = page.asarray().squeeze() if page.axes not in ("YX", "YXS") else page.asarray()
    if values.ndim == 3 and page.axes.endswith("YX"):
        values = np.moveaxis(values, 0, 2)
    if palette is not None:
        values = np.moveaxis(palette[:, values], 0, 2)
    elif kind == "MINISWHITE" and values.dtype.kind in "bu":
        values = ~values if values.dtype.kind == "b" else (top or np.iinfo(values.dtype).max) - values
    return np.ascontiguousarray(values.astype(dtype)), top, dtype


def _seconds(value: object, unit: object) -> float | None:
    try:
        number = float(str(value)) * _SECONDS[str(unit)]
    except (ValueError, KeyError):
        return None
    return number if 0 <= number < math.inf else None


def _imagej_times(header: dict[str, Any]) -> dict[str, Any]:
    interval = _seconds(header.get("finterval"), header.get("tunit", "sec"))
    return {"rate_hz": 1 / interval} if interval else {}


def _ome_times(document: dict[str, Any], count: int, notes: list[str]) -> dict[str, Any]:
    """Rate, exposure time, start and the times of the planes by OME's header; what cannot be used is noted."""
    image = document.get("OME", {}).get("Image", {})
    image = image[0] if isinstance(image, list) else image
    pixels = image.get("Pixels", {})
    planes = pixels.get("Plane", [])
    planes = sorted(planes if isinstance(planes, list) else [planes], key=lambda each: int(each.get("TheT", 0)))
    known: dict[str, Any] = {}
    if interval := _seconds(pixels.get("TimeIncrement"), pixels.get("TimeIncrementUnit", "s")):
        known["rate_hz"] = 1 / interval
    exposures = {_seconds(each.get("ExposureTime"), each.get("ExposureTimeUnit", "s")) for each in planes}
    if exposure := next(iter(exposures), None):
        known["exposure_s"] = exposure
        if len(exposures) > 1:
            notes.append("exposure times differ from frame to frame: that of one of them is taken")
    times = [_seconds(each.get("DeltaT"), each.get("DeltaTUnit", "s")) for each in planes]
    stated = [each for each in times if each is not None]
    if len(stated) == count:
        known["times_ns"] = np.rint(np.array(stated) * 1e9).astype(np.int64)
        known.pop("rate_hz", None)  # the planes' own times are measured, and this is planned
    elif stated:
        notes.append(f"{len(stated)} of {count} frames have a time of their own (DeltaT): not used")
    try:
        moment = datetime.fromisoformat(str(image["AcquisitionDate"]))
        utc = moment.astimezone(UTC).replace(tzinfo=None) if moment.tzinfo else moment
        start = np.datetime64(utc, "ns")
        known["start_ns"] = int(start.astype(np.int64)) + int(known["times_ns"][0] if "times_ns" in known else 0)
    except (KeyError, ValueError):
        pass
    return known


@contextmanager
def _complaints(path: Path) -> Iterator[None]:
    """Raise an error for a stack that is cut off, which tifffile only logs; damage to a tag does not harm the
    pictures."""
    said: list[str] = []
    listener = logging.Handler(logging.ERROR)
    listener.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("tifffile")
    log.addHandler(logging.NullHandler())  # later, too, nothing goes to the terminal
    log.addHandler(listener)
    try:
        yield
    finally:
        log.removeHandler(listener)
    damage = [each for each in said if "TiffTag" not in each]
    if damage:
        raise ImportingError(f"{path} is damaged: {damage[0].splitlines()[0]}")
