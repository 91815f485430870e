"""Films from files: arrays, TIFF stacks, folders of pictures, FITS cubes, videos, MCAP and ROS bags, AO telemetry.

Each reader gives a `Film` whose frames are read one after the other. What a file says about rate, exposure time and
start is taken from it; nothing is guessed.
"""

from __future__ import annotations

import gzip
import math
import mmap
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import FrameError, ImportingError, RestorationError
from aolink.extensions import needs_extra
from aolink.importing.film import Film, Frame
from aolink.optics.frame_file import parse_fits_array
from aolink.optics.pictures import read_picture

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".npy", ".fits", ".fit", ".pgm")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".gif", ".wmv")
_LOSSY_TIFF = (6, 7)  # JPEG
_COMPRESSED = "JPEG and video hold light after a gamma curve and lossy compression"


def open_film(source: str | Path, topic: str | None = None) -> Film:
    """Open a film, by the kind of its source.

    Parameters
    ----------
    source:
        .npy, .npz, .tif, .fits, a video, .mcap, a ROS bag (.bag, or a folder with metadata.yaml), AO telemetry (AOT, a
        .fits file), or a folder of pictures.
    topic:
        The channel with the pictures, where an MCAP file or a bag has several.

    Raises
    ------
    ImportingError
        It cannot be read, holds no film, or needs a package that is not installed; the message says which.
    """
    path = Path(source)
    if not path.exists():
        raise ImportingError(f"cannot read {path}: there is no such file or folder")
    suffix = "".join(path.suffixes[-2:]) if path.suffix == ".gz" else path.suffix
    suffix = suffix.lower().removesuffix(".gz")
    try:
        if path.is_dir():
            return _bag(path, topic) if (path / "metadata.yaml").exists() else _folder(path)
        if suffix in _READERS:
            return _READERS[suffix](path)
        if suffix in (".mcap", ".bag"):
            return _mcap(path, topic) if suffix == ".mcap" else _bag(path, topic)
        if suffix in _VIDEOS:
            return _video(path)
    except (OSError, EOFError) as error:
        what = getattr(error, "strerror", None) or str(error)
        raise ImportingError(f"cannot read {path}: {what.lower()}") from None
    known = ", ".join([*_READERS, ".mcap", ".bag", *_VIDEOS])
    raise ImportingError(f"{path} is no kind of film that is known: give {known} or a folder of pictures")


def array_film(frames: NDArray[Any], name: str, **known: Any) -> Film:
    """A film of frames in memory, (frames, rows, columns); (spots, frames, rows, columns) stand side by side.

    Raises
    ------
    ImportingError
        It has another shape, or no numbers.
    """
    if frames.ndim == 4:  # one film for each spot, all of the same times
        spots, count, rows, columns = frames.shape
        frames = np.moveaxis(frames, 0, 2).reshape(count, rows, spots * columns)
        known["notes"] = (*known.get("notes", ()), f"the films of {spots} spots stand side by side in one picture")
    if frames.ndim != 3 or min(frames.shape) < 1 or frames.dtype.kind not in "biuf":
        raise ImportingError(
            f"{name} holds {frames.dtype} of shape {frames.shape}, expected numbers as (frames, rows, columns)"
        )
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    return Film(name=name, shape=shape, dtype=frames.dtype, count=len(frames), frames=lambda: iter(frames), **known)


def _npy(path: Path) -> Film:
    return array_film(_loaded(path, mmap_mode="r"), path.name)


def _npz(path: Path) -> Film:
    arrays = _loaded(path)
    stacks = [name for name in arrays if name == "frames"] or [n for n in arrays if arrays[n].ndim in (3, 4)]
    if len(stacks) != 1:
        have = ", ".join(f"{name} {arrays[name].shape}" for name in arrays) or "nothing"
        raise ImportingError(f"{path} has {have}: name the array with the film 'frames'")
    known: dict[str, Any] = {}
    for key in ("rate_hz", "exposure_s"):
        if key in arrays:
            known[key] = float(arrays[key])
    if "times_s" in arrays:
        known["times_ns"] = np.round(np.asarray(arrays["times_s"], dtype=np.float64) * 1e9).astype(np.int64)
    if "inputs" in arrays:
        known["inputs"] = np.atleast_2d(np.asarray(arrays["inputs"], dtype=np.float64).T).T
    return array_film(arrays[stacks[0]], path.name, **known)


def _loaded(path: Path, **options: Any) -> Any:
    try:
        return np.load(path, allow_pickle=False, **options)
    except (ValueError, EOFError) as error:
        raise ImportingError(f"{path} is damaged or not NumPy's: {error}") from None


def _tiff(path: Path) -> Film:
    with needs_extra("tiff", ImportingError):
        import tifffile
    try:
        with tifffile.TiffFile(path) as file:
            series = file.series[0]
            shape, dtype = series.shape, np.dtype(series.dtype)
            interval = (file.imagej_metadata or {}).get("finterval")
            lossy = int(file.pages.first.compression) in _LOSSY_TIFF
        if len(shape) == 2:
            shape = (1, *shape)
        if len(shape) != 3:
            raise ImportingError(f"{path} holds {dtype} of shape {shape}, expected (frames, rows, columns) in grey")
    except (tifffile.TiffFileError, ValueError, IndexError) as error:
        raise ImportingError(f"{path} is damaged or no TIFF file: {error}") from None

    def frames() -> Iterator[Frame]:
        with tifffile.TiffFile(path) as file:
            pages = file.series[0].pages
            if len(pages) == shape[0]:
                yield from (page.asarray() for page in pages if page is not None)
            else:  # ImageJ keeps a large stack as one page
                yield from file.series[0].asarray().reshape(shape)

    return Film(
        name=path.name, shape=(shape[1], shape[2]), dtype=dtype, count=shape[0], frames=frames,
        rate_hz=1 / float(interval) if interval else None, nonlinear=_COMPRESSED if lossy else "",
    )  # fmt: skip


def _folder(path: Path) -> Film:
    files = sorted((each for each in path.iterdir() if each.suffix.lower() in _PICTURES), key=_number_order)
    if not files:
        raise ImportingError(f"{path} holds no pictures ({', '.join(_PICTURES)})")
    first = _picture(files[0])

    def frames() -> Iterator[Frame]:
        for file in files:
            picture = _picture(file)
            if picture.shape != first.shape:
                raise ImportingError(
                    f"{file} is {picture.shape[0]} x {picture.shape[1]} pixels, the pictures before it are"
                    f" {first.shape[0]} x {first.shape[1]}: a film has frames of one size"
                )
            yield picture

    lossy = any(each.suffix.lower() in (".jpg", ".jpeg") for each in files)
    return Film(
        name=path.name, shape=(int(first.shape[0]), int(first.shape[1])), dtype=first.dtype, count=len(files),
        frames=frames, nonlinear=_COMPRESSED if lossy else "",
        notes=(f"pictures in the order of their names, {files[0].name} to {files[-1].name}",),
    )  # fmt: skip


def _number_order(path: Path) -> list[Any]:
    """frame2 comes before frame10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _picture(path: Path) -> Frame:
    try:
        if path.suffix.lower() in (".fits", ".fit"):
            _, stored, scale, zero = parse_fits_array(path.read_bytes())
            return _grey(_values(stored, scale, zero), path)
        return _grey(read_picture(path), path)
    except (RestorationError, FrameError) as error:
        raise ImportingError(f"{path}: {error}") from None


def _grey(picture: Frame, what: object) -> Frame:
    """Colours become their mean, which is proportional to light where they are; (rows, columns)."""
    if picture.ndim == 3 and picture.shape[2] in (3, 4):
        return np.asarray(picture[..., :3].mean(axis=2))
    if picture.ndim != 2 or picture.dtype.kind not in "biuf":
        raise ImportingError(f"{what} holds {picture.dtype} of shape {picture.shape}, expected a picture")
    return picture


def _values(stored: NDArray[Any], scale: float, zero: float) -> NDArray[Any]:
    """FITS keeps unsigned numbers as signed ones and a shift of half their range."""
    if stored.dtype.kind == "i" and scale == 1 and zero == float(1 << (8 * stored.dtype.itemsize - 1)):
        unsigned = np.dtype(f"u{stored.dtype.itemsize}")
        return (stored.astype(np.int64) + int(zero)).astype(unsigned)
    return stored if (scale, zero) == (1.0, 0.0) else stored * scale + zero


def _fits(path: Path) -> Film:
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        # Mapped, not read: a cube may be larger than the memory.
        data = gzip.decompress(file.read()) if packed else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        header, stored, scale, zero = parse_fits_array(data)  # type: ignore[arg-type] # a map is read as bytes are
    except FrameError as error:
        if b"AOT-VERS" in data[: 100 * 2880]:
            return _aot(path)
        raise ImportingError(f"{path}: {error}") from None
    if "AOT-VERS" in header:
        return _aot(path)
    cube = stored[None] if stored.ndim == 2 else stored
    if cube.ndim != 3:
        raise ImportingError(f"{path} holds an array of shape {stored.shape}, expected (frames, rows, columns)")
    numbers = {key: _float(header.get(key)) for key in ("EXPTIME", "EXPOSURE", "FRATE", "FRAMRATE", "KINTIME")}
    cycle = numbers["KINTIME"]
    sample = _values(cube[:1, :1, :1], scale, zero)
    return Film(
        name=path.name, shape=(int(cube.shape[1]), int(cube.shape[2])), dtype=sample.dtype, count=len(cube),
        frames=lambda: (_values(frame, scale, zero) for frame in cube),
        rate_hz=numbers["FRATE"] or numbers["FRAMRATE"] or (1 / cycle if cycle else None),
        exposure_s=numbers["EXPTIME"] or numbers["EXPOSURE"], start_ns=_date(header.get("DATE-OBS")),
    )  # fmt: skip


def _float(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


def _date(text: str | None) -> int | None:
    """ns since 1970 of a date as FITS writes it, in UTC."""
    try:
        moment = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000


def _video(path: Path) -> Film:
    with needs_extra("video", ImportingError):
        import imageio.v3 as iio
    try:
        about = iio.immeta(path)
        first = next(iio.imiter(path))
        count = sum(1 for _ in iio.imiter(path))
    except (OSError, ValueError, RuntimeError, StopIteration, IndexError) as error:
        raise ImportingError(f"{path} cannot be read as a video: {str(error).splitlines()[0]}") from None
    rate = about.get("fps") or (1000 / about["duration"] if about.get("duration") and path.suffix == ".gif" else None)
    return Film(
        name=path.name, shape=(int(first.shape[0]), int(first.shape[1])), dtype=first.dtype, count=count,
        frames=lambda: (_grey(frame, path) for frame in iio.imiter(path)), rate_hz=float(rate) if rate else None,
        nonlinear=_COMPRESSED,
    )  # fmt: skip


def _mcap(path: Path, topic: str | None) -> Film:
    """Pictures of an MCAP file: foxglove.RawImage and CompressedImage, or sensor_msgs/Image."""
    from aolink.importing import bags

    return bags.mcap_film(path, topic)


def _bag(path: Path, topic: str | None) -> Film:
    from aolink.importing import bags

    return bags.ros_film(path, topic)


def _aot(path: Path) -> Film:
    from aolink.importing import telemetry

    return telemetry.aot_film(path)


_READERS: dict[str, Callable[[Path], Film]] = {
    ".npy": _npy, ".npz": _npz, ".tif": _tiff, ".tiff": _tiff, ".fits": _fits, ".fit": _fits,
}  # fmt: skip
