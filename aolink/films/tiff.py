"""Films from TIFF files, with the times that ImageJ and OME-TIFF write."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.facts import Said, facts, meaning
from aolink.films.film import Film, FilmFrame, Stored
from aolink.films.stills import COMPRESSED
from aolink.limits import check_picture

_LOSSY = (6, 7)  # JPEG
_TAG_OF_MICRO_MANAGER = 51123
_SIGNED = -32768.0
"""Where the calibration of ImageJ begins that makes numbers of 16 bits signed."""


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
        names = {Path(each.parent.filehandle.path).name for each in first.pages if each is not None}
        lossy, bits = int(page.compression) in _LOSSY, page.bitspersample
        _, top, dtype = _light(path, page)
        white_is_zero = str(page.photometric.name) == "MINISWHITE"
        place, order = first.dataoffset, file.byteorder
        said, notes = _said(file, page, first), list[str]()
    (shape, axes, stored), *others = kinds
    size = tuple(n for n, axis in zip(shape, axes, strict=True) if axis != "S")
    one_by_one = len(size) == 2 and bool(others)  # pictures that were appended
    if one_by_one and (other := next((kind for kind in others if kind != kinds[0]), None)):
        each = f"{stored} of shape {shape} and of {other[2]} of shape {other[0]}"
        raise ImportingError(f"{path} holds pictures of {each}: a film has frames of one size and type")
    size = (len(kinds), *size) if len(size) == 2 else size
    planes = np.arange(math.prod(size[:-2])).reshape(size[:-2])
    colours = axes[: planes.ndim].find("C") if planes.ndim == 2 else -1
    planes = planes.reshape(-1, 1) if colours < 0 else np.moveaxis(planes, colours, -1)
    if planes.shape[1] not in (1, 3) or len(planes) != max(size[:-2]) or dtype.kind not in "biuf":
        raise ImportingError(f"{path} holds {stored} of shape {shape}, expected (frames, rows, columns)")

    def pictures() -> Iterator[FilmFrame]:
        with _complaints(path), tifffile.TiffFile(path) as file:
            pages: Any = [page for each in file.series for page in each.pages] if one_by_one else file.series[0].pages
            whole = None
            if len(pages) != planes.size:  # ImageJ keeps a large stack as one page
                whole = Stored(
                    path, stored.newbyteorder(order), (planes.size, *shape[planes.ndim - (colours < 0) :]), place
                )
            for numbers in planes.tolist():
                shown = [whole[k] if whole else _page(path, file, pages[k]) for k in numbers]
                picture = shown[0] if len(shown) == 1 else np.stack(shown, axis=-1)
                yield (picture.astype(np.int32) + int(_SIGNED)).astype(np.int16) if signed else picture

    if others and not one_by_one:
        notes.append(f"{path.name} holds {len(kinds)} stacks: the first is taken")
    if axes[0] in "CZ" and size[0] > 1 and not one_by_one and colours < 0:
        notes.append(f"its axis {axes[0]}, {'channels' if axes[0] == 'C' else 'depths'}, is taken for frames")
    signed = dtype == np.uint16 and any(each.name == "c0" and each.value == _SIGNED for each in said)
    known, found = facts(said, len(planes), longest_s=math.inf)
    if "times_ns" in known:
        known.pop("rate_hz", None)  # times are measured, and a rate is planned
    return Film(
        name=path.name, shape=(size[-2], size[-1]), dtype=np.dtype(np.int16) if signed else dtype, count=len(planes),
        top=top if top is not None or dtype.kind not in "iu" or bits in (8, 16, 32, 64) else float((1 << bits) - 1),
        nonlinear=COMPRESSED if lossy else "", notes=(*notes, *found), white_is_zero=white_is_zero, **known,
        files=frozenset(names), pictures=pictures,
    )  # fmt: skip


def _page(path: Path, file: Any, page: Any) -> NDArray[Any]:
    if page is None or math.prod(page.chunked) > len(page.dataoffsets):  # it would count them all
        raise ImportingError(f"{path} is damaged: a page lacks some of its pixels")
    check_picture(page.keyframe.tilewidth, page.keyframe.tilelength, ImportingError)
    handle = page.parent.filehandle
    handle.open()  # of another file of the stack, it is closed
    light = _light(path, page.aspage(), read=True)[0]
    if handle is not file.filehandle:
        handle.close()
    return light


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


def _said(file: Any, page: Any, series: Any) -> list[Said]:
    """What the headers say that OME, ImageJ, Micro-Manager and cameras' programs write, and the tags of EXIF."""
    said = _of_ome(file.ome_metadata) if file.ome_metadata else []
    for kind in sorted(file.flags - {"ome"}):
        found = getattr(file, f"{kind}_metadata", None) or {}
        for each in found if isinstance(found, list | tuple) else [found]:
            for part in (each, each.get("Summary", {})) if isinstance(each, dict) else ():
                interval = str(part.get("tunit", "sec")) if kind == "imagej" else ""
                said += [Said(str(key), value, interval if key == "finterval" else "") for key, value in part.items()]
                lines = re.findall(r"^\s*([\w .-]+?)\s*[:=]\s*(.+?)\s*$", str(part.get("Info", "")), re.M)
                said += [Said(key, value) for key, value in lines]
    if _TAG_OF_MICRO_MANAGER in page.tags:
        each_page = [each.aspage().tags.get(_TAG_OF_MICRO_MANAGER) for each in series.pages if each is not None]
        values = [each.value if each and isinstance(each.value, dict) else {} for each in each_page]
        names = [name for name in values[0] if all(name in each for each in values)]
        said += [
            Said(name, [each[name] for each in values]) for name in names if meaning(name)[0] in ("times", "exposure")
        ]
    tags = {tag.name: tag.value for tag in page.tags}
    exif = tags.get("ExifTag")
    said += [Said(name, each) for name, each in {**tags, **(exif if isinstance(exif, dict) else {})}.items()]
    return [each for each in said if str(each.value) not in ("0", "0.0")]  # which stands for nothing


def _of_ome(text: str) -> list[Said]:
    import tifffile

    image = tifffile.xml2dict(text).get("OME", {}).get("Image", {})
    image = image[0] if isinstance(image, list) else image
    pixels = image.get("Pixels", {})
    planes = pixels.get("Plane", [])
    planes = sorted(planes if isinstance(planes, list) else [planes], key=lambda each: int(each.get("TheT", 0)))
    planes = [each for each in planes if int(each.get("TheC", 0)) == int(each.get("TheZ", 0)) == 0]
    said = []
    for name in ("DeltaT", "ExposureTime"):
        if values := [float(each[name]) for each in planes if name in each]:
            said.append(Said(name, values, str(planes[0].get(f"{name}Unit", "s"))))
    said.append(Said("TimeIncrement", pixels.get("TimeIncrement"), str(pixels.get("TimeIncrementUnit", "s"))))
    date = str(image.get("AcquisitionDate", ""))
    zone = "" if re.search(r"Z$|[+-]\d\d:?\d\d$", date) else "Z"
    return [each for each in (*said, Said("AcquisitionDate", date and date + zone)) if each.value]


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
