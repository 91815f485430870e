"""Films from files: arrays, TIFF stacks, folders of pictures, FITS cubes, videos, MCAP and ROS bags, AO telemetry.

Each reader gives a `Film` whose frames are read one after the other. What a file says about rate, exposure time and
start is taken from it; nothing is guessed.
"""

from __future__ import annotations

import logging
import math
import mmap
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, FrameError, ImportingError
from aolink.extensions import needs_extra
from aolink.importing.film import Film, FilmFrame, array_film, grey
from aolink.limits import load_archive, unpacked
from aolink.optics.frame_file import fits_arrays, read_fits
from aolink.optics.pictures import image_pixels, opened_image, read_picture

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".npy", ".fits", ".fit", ".pgm")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".gif", ".wmv")
_LOSSY_TIFF = (6, 7)  # JPEG
_PILLOW_TIFF = (5, *_LOSSY_TIFF)  # LZW and JPEG, which tifffile reads with a further package only
_SECONDS = {
    **dict.fromkeys(("s", "sec", "seconds"), 1.0), **dict.fromkeys(("ms", "msec"), 1e-3), "min": 60.0,
    **dict.fromkeys(("us", "usec", "\N{MICRO SIGN}s", "\N{GREEK SMALL LETTER MU}s", r"\u00B5s"), 1e-6), "ns": 1e-9,
}  # fmt: skip
"""Units of time in the headers of TIFF files."""
_COMPRESSED = "JPEG and video hold light after a gamma curve and lossy compression"


def open_film(source: str | Path, topic: str | None = None) -> Film:
    """Open a film, by the kind of its source.

    Raises `ImportingError` where the source cannot be read, holds no film, or needs a package that is not installed;
    the message says which.

    Parameters
    ----------
    source:
        .npy, .npz, .tif, .fits, a video, .mcap, a ROS bag (.bag, or a folder with metadata.yaml), AO telemetry (AOT, a
        .fits file), or a folder of pictures.
    topic:
        The channel with the pictures, where an MCAP file or a bag has several; of AO telemetry the wavefront sensor.
    """
    path = Path(source)
    if not path.exists():
        raise ImportingError(f"cannot read {path}: there is no such file or folder")
    ends = path.suffix.lower()
    suffix = Path(path.stem).suffix.lower() if ends in (".gz", ".fz") else ends
    with _one_error(path):
        if path.is_dir():
            film = _bag(path, topic) if (path / "metadata.yaml").exists() else _without_topic(path, topic, _folder)
        elif suffix in (".fits", ".fit"):
            film = _fits(path, topic)
        elif suffix in _READERS:
            film = _without_topic(path, topic, _READERS[suffix])
        elif suffix in (".mcap", ".bag"):
            film = _mcap(path, topic) if suffix == ".mcap" else _bag(path, topic)
        elif suffix in _VIDEOS:
            film = _without_topic(path, topic, _video)
        elif suffix == ".db3":
            raise ImportingError(f"{path} is a part of a ROS 2 bag: give the bag's folder, which has metadata.yaml")
        else:
            known = ", ".join([*_READERS, ".fits", ".fit", ".mcap", ".bag", *_VIDEOS])
            raise ImportingError(f"{path} is no kind of film that is known: give {known} or a folder of pictures")
    return replace(film, frames=lambda: _checked(film, path))


def _without_topic(path: Path, topic: str | None, read: Callable[[Path], Film]) -> Film:
    """The film of a source that has one film only, so that a topic makes no sense."""
    if topic is not None:
        raise ImportingError(
            f"{path} has no topics: --topic {topic} says which channel of an MCAP file or a bag, or which wavefront"
            " sensor of AO telemetry, is imported; leave it out"
        )
    return read(path)


@contextmanager
def _one_error(path: Path) -> Iterator[None]:
    """Turn any exception of another package on a damaged file into an ImportingError of one line."""
    try:
        yield
    except AolinkError as error:
        named = str(path) in str(error)
        if isinstance(error, ImportingError) and named:
            raise
        raise ImportingError(str(error) if named else f"{path}: {error}") from error
    except OSError as error:
        raise ImportingError(f"cannot read {path}: {error.strerror or _first_line(error)}") from error
    except Exception as error:
        raise ImportingError(f"{path} is damaged, or not what its name says: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), "") or type(error).__name__


def _checked(film: Film, path: Path) -> Iterator[FilmFrame]:
    """The frames of a film, checked against the size and the number that it announced."""
    count = 0
    with _one_error(path):
        for frame in film.frames():
            if frame.shape != film.shape:
                raise ImportingError(
                    f"{path}: frame {count} is {frame.shape[0]} x {frame.shape[1]} pixels, those before it"
                    f" {film.shape[0]} x {film.shape[1]}: a film has frames of one size"
                )
            yield frame
            count += 1
    if count != film.count:
        raise ImportingError(f"{path} announces {film.count} frames and has {count}: it is damaged")


def _npy(path: Path) -> Film:
    with path.open("rb") as file:
        np.lib.format.read_magic(file)  # `load` takes archives and pickles by this name, too
    return array_film(np.load(path, mmap_mode="r", allow_pickle=False), path.name)


def _npz(path: Path) -> Film:
    arrays = load_archive(path, ImportingError)
    stacks = [name for name in arrays if name == "frames"] or [n for n in arrays if arrays[n].ndim in (3, 4)]
    if len(stacks) != 1:
        have = ", ".join(f"{name} {arrays[name].shape}" for name in arrays) or "nothing"
        raise ImportingError(f"{path} has {have}: name the array with the film 'frames'")
    known: dict[str, Any] = {}
    for key in ("rate_hz", "exposure_s"):
        if key in arrays:
            known[key] = float(_numbers(path, arrays, key, ndims=(0,)))
            if known[key] <= 0:
                raise ImportingError(f"{path}: {key} is {known[key]:g}, expected a number above 0")
    if "times_s" in arrays:
        known["times_ns"] = np.round(_numbers(path, arrays, "times_s", ndims=(1,)) * 1e9).astype(np.int64)
    if "inputs" in arrays:
        inputs = _numbers(path, arrays, "inputs", ndims=(1, 2))
        known["inputs"] = inputs[:, None] if inputs.ndim == 1 else inputs
    return array_film(arrays[stacks[0]], path.name, **known)


def _numbers(path: Path, arrays: dict[str, NDArray[Any]], key: str, ndims: tuple[int, ...]) -> NDArray[np.float64]:
    found = arrays[key]
    if found.ndim not in ndims or found.dtype.kind not in "iuf" or not np.isfinite(found).all():
        axes = " or ".join(map(str, ndims))
        raise ImportingError(f"{path}: {key} is {found.dtype} of shape {found.shape}, expected numbers of {axes} axes")
    return np.asarray(found, dtype=np.float64)


def _tiff(path: Path) -> Film:
    with needs_extra("tiff", ImportingError):
        import tifffile
    with _complaints(path), tifffile.TiffFile(path) as file:
        series = file.series[0]
        axes, shape, dtype = series.axes, series.shape, np.dtype(series.dtype)
        rate_hz, exposure_s = _tiff_times(file.imagej_metadata or {}, file.ome_metadata or "")
        compression = int(file.pages.first.compression)
        kinds = [(each.shape, np.dtype(each.dtype)) for each in file.series]
    colours = axes.endswith("S")  # samples of a pixel
    size = shape[:-1] if colours else shape
    one_by_one = len(size) == 2 and len(kinds) > 1  # pictures that were appended
    if one_by_one and (other := next((kind for kind in kinds if kind != kinds[0]), None)):
        raise ImportingError(
            f"{path} holds pictures of {dtype} of shape {shape} and of {other[1]} of shape {other[0]}: a film has"
            " frames of one size and type"
        )
    size = (len(kinds), *size) if len(size) == 2 else size
    if len(size) != 3 or "S" in axes[:-1]:
        raise ImportingError(f"{path} holds {dtype} of shape {shape}, expected (frames, rows, columns)")

    def pictures() -> Iterator[FilmFrame]:
        if compression in _PILLOW_TIFF:
            from PIL import ImageSequence

            with opened_image(path, ImportingError) as image:
                yield from map(image_pixels, ImageSequence.Iterator(image))
            return
        with tifffile.TiffFile(path) as file:
            pages = [page for each in file.series for page in each.pages] if one_by_one else file.series[0].pages
            if len(pages) == size[0]:
                for page in pages:
                    if page is None or math.prod(page.chunked) > len(page.dataoffsets):  # it would count them all
                        raise ImportingError(f"{path} is damaged: a page lacks some of its pixels")
                    yield page.asarray()
            else:  # ImageJ keeps a large stack as one page
                yield from file.series[0].asarray().reshape(size[0], *shape[-3 if colours else -2 :])

    more = len(kinds) > 1 and not one_by_one
    return Film(
        name=path.name, shape=(size[1], size[2]), dtype=dtype, count=size[0],
        frames=lambda: (grey(picture, path) for picture in pictures()), rate_hz=rate_hz, exposure_s=exposure_s,
        nonlinear=_COMPRESSED if compression in _LOSSY_TIFF else "",
        notes=(f"{path.name} holds {len(kinds)} stacks: the first is taken",) if more else (),
    )  # fmt: skip


def _tiff_times(imagej: dict[str, Any], ome: str) -> tuple[float | None, float | None]:
    """Frame rate and exposure time by the headers of ImageJ and of OME-TIFF, where their unit is known."""

    def seconds(value: object, unit: str) -> float | None:
        number = _float(str(value))
        return number * _SECONDS[unit] if number and unit in _SECONDS else None

    def of_ome(key: str) -> float | None:
        value, unit = (re.search(rf'\b{each}="([^"]*)"', ome) for each in (key, f"{key}Unit"))
        return seconds(value[1], unit[1] if unit else "s") if value else None

    interval = seconds(imagej.get("finterval"), str(imagej.get("tunit", "sec"))) or of_ome("TimeIncrement")
    return 1 / interval if interval else None, of_ome("ExposureTime")


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


def _folder(path: Path) -> Film:
    found = (
        each for each in path.iterdir() if each.suffix.lower() in _PICTURES and each.name[0] != "." and each.is_file()
    )
    files = sorted(found, key=_number_order)
    if not files and any(each.suffix in (".db3", ".mcap") for each in path.iterdir()):
        raise ImportingError(f"{path} has no metadata.yaml, as a ROS 2 bag has: `ros2 bag reindex` makes one")
    if not files:
        raise ImportingError(f"{path} holds no pictures ({', '.join(_PICTURES)})")
    first = _picture(files[0])
    rows, columns = grey(first, files[0]).shape

    def frames() -> Iterator[FilmFrame]:
        for file in files:
            picture = _picture(file)
            if picture.shape[:2] != first.shape[:2] or picture.dtype != first.dtype:
                raise ImportingError(
                    f"{file} has {_described(picture)}, those before it have {_described(first)}: a film has frames of"
                    " one size and type"
                )
            yield grey(picture, file)

    lossy = any(each.suffix.lower() in (".jpg", ".jpeg") for each in files)
    return Film(
        name=path.name, shape=(rows, columns), dtype=first.dtype, count=len(files),
        frames=frames, nonlinear=_COMPRESSED if lossy else "",
        notes=(f"pictures in the order of their names, {files[0].name} to {files[-1].name}",),
    )  # fmt: skip


def _number_order(path: Path) -> tuple[list[tuple[str, int]], str]:
    """A sort key by which frame2 comes before frame10."""
    parts = re.findall(r"([^0-9]*)([0-9]*)", path.name)
    return [(text, int(digits or 0)) for text, digits in parts], path.name


def _picture(path: Path) -> FilmFrame:
    """A picture as it is stored, (rows, columns) or (rows, columns, 3 or 4)."""
    if path.suffix.lower() not in (".fits", ".fit"):
        return read_picture(path)
    try:
        _, stored, scale, zero = next(fits_arrays(read_fits(path, ImportingError)))
    except FrameError as error:
        raise ImportingError(f"{path}: {error}") from None
    return _values(stored, scale, zero)


def _described(picture: FilmFrame) -> str:
    return f"{' x '.join(map(str, picture.shape[:2]))} pixels of {picture.dtype}"


def _values(stored: NDArray[Any], scale: float, zero: float) -> NDArray[Any]:
    """The values of a FITS array, which keeps unsigned numbers as signed ones shifted by half their range."""
    if stored.dtype.kind == "i" and scale == 1 and zero == float(1 << (8 * stored.dtype.itemsize - 1)):
        unsigned = np.dtype(f"u{stored.dtype.itemsize}")
        return (stored.astype(np.int64) + int(zero)).astype(unsigned)
    return stored if (scale, zero) == (1.0, 0.0) else stored * scale + zero


def _fits(path: Path, topic: str | None) -> Film:
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        # Mapped, not read: a cube may be larger than the memory.
        data = unpacked(file, ImportingError) if packed else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        arrays = fits_arrays(data)  # type: ignore[arg-type] # a map is read as bytes are
        header, stored, scale, zero = next(arrays)
    except FrameError as error:
        if b"AOT-VERS" in data[: 100 * 2880]:
            return _aot(path, topic)
        raise ImportingError(f"{path}: {error}") from None
    if "AOT-VERS" in header:
        return _aot(path, topic)
    return _without_topic(path, topic, lambda path: _cube(path, header, stored, scale, zero, arrays))


def _cube(
    path: Path, header: dict[str, str], stored: NDArray[Any], scale: float, zero: float, arrays: Iterator[Any]
) -> Film:
    """The film of the first array of a FITS file, whose other ones are still in ``arrays``."""
    more, damaged = 0, ""
    try:
        for each in arrays:
            more += each[1].ndim > 2 if stored.ndim > 2 else each[1].shape == stored.shape
    except FrameError as error:
        if stored.ndim == 2:
            raise ImportingError(f"{path}: {error}") from None
        damaged = f"{path.name}: what follows the first cube cannot be read ({error})"
    if stored.ndim == 2 and more:
        raise ImportingError(
            f"{path} holds {more + 1} arrays of shape {stored.shape}, and which of them are frames is not known: stack"
            " the frames in one array (frames, rows, columns)"
        )
    cube = stored[None] if stored.ndim == 2 else stored
    while cube.ndim > 3 and len(cube) == 1:  # as cameras with several windows write it
        cube = cube[0]
    if cube.ndim != 3:
        raise ImportingError(f"{path} holds an array of shape {stored.shape}, expected (frames, rows, columns)")
    several = f"{path.name} holds {more + 1} cubes: the first is taken" if more else ""
    numbers = {key: _float(header.get(key)) for key in ("EXPTIME", "EXPOSURE", "FRATE", "FRAMRATE", "KINTIME")}
    cycle = numbers["KINTIME"]
    sample = _values(cube[:1, :1, :1], scale, zero)
    return Film(
        name=path.name, shape=(int(cube.shape[1]), int(cube.shape[2])), dtype=sample.dtype, count=len(cube),
        frames=lambda: (_values(frame, scale, zero) for frame in cube),
        rate_hz=numbers["FRATE"] or numbers["FRAMRATE"] or (1 / cycle if cycle else None),
        exposure_s=numbers["EXPTIME"] or numbers["EXPOSURE"], start_ns=_date(header.get("DATE-OBS")),
        notes=tuple(filter(None, (several, damaged))),
    )  # fmt: skip


def _float(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


def _date(text: str | None) -> int | None:
    """Nanoseconds since 1970 of a date in FITS notation, in UTC."""
    try:
        moment = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000


def _video(path: Path) -> Film:
    with needs_extra("video", ImportingError):
        import imageio.v3 as iio
        import imageio_ffmpeg  # noqa: F401 # imageio would say only that it found nothing that reads the file

    def pictures() -> Iterator[FilmFrame]:
        with iio.imopen(path, "r") as file:
            yield from file.iter()

    with iio.imopen(path, "r") as file:
        about = file.metadata()
    first, count = None, 0
    for picture in pictures():
        first, count = picture, count + 1
    if first is None:
        raise ImportingError(f"{path} has no pictures")
    is_gif = path.suffix.lower() == ".gif"
    rate = 1000 / about["duration"] if is_gif and about.get("duration") else about.get("fps")
    return Film(
        name=path.name, shape=(int(first.shape[0]), int(first.shape[1])), dtype=first.dtype, count=count,
        frames=lambda: (grey(picture, path) for picture in pictures()), rate_hz=float(rate) if rate else None,
        nonlinear=_COMPRESSED,
    )  # fmt: skip


def _mcap(path: Path, topic: str | None) -> Film:
    """Pictures of an MCAP file: foxglove.RawImage and CompressedImage, or sensor_msgs/Image."""
    from aolink.importing import bags

    return bags.mcap_film(path, topic)


def _bag(path: Path, topic: str | None) -> Film:
    from aolink.importing import bags

    return bags.ros_film(path, topic)


def _aot(path: Path, topic: str | None) -> Film:
    from aolink.importing import telemetry

    return telemetry.aot_film(path, topic)


_READERS: dict[str, Callable[[Path], Film]] = {".npy": _npy, ".npz": _npz, ".tif": _tiff, ".tiff": _tiff}
