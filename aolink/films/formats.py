"""Films from files: the table of formats, and folders of files of any of them.

Each reader gives a `Film` whose pictures are read one after the other. What a file says about rate, exposure time and
start is taken from it; nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, ImportingError
from aolink.films import arrays, bags, fits, stills, tiff, video
from aolink.films.facts import dated
from aolink.films.film import Film, FilmFrame
from aolink.films.names import by_number
from aolink.limits import LOSSY_EXPANSION, check_film

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".pbm", ".pnm", ".webp", ".jp2")
_FITS = (".fits", ".fit", ".fts")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".gif", ".apng")
_FORMATS: dict[str, Callable[..., Film]] = {
    ".npy": arrays.npy_film, ".npz": arrays.npz_film, ".ser": arrays.ser_film, ".mcap": bags.mcap_film,
    ".bag": bags.ros_film, **dict.fromkeys((".tif", ".tiff"), tiff.tiff_film), **dict.fromkeys(_FITS, fits.fits_film),
    **dict.fromkeys((".h5", ".hdf5"), arrays.hdf5_film), **dict.fromkeys(_VIDEOS, video.video_film),
    **dict.fromkeys(_PICTURES, stills.picture_film),
}  # fmt: skip
"""Readers by the suffix of the file."""
_NOTHING: dict[str, Any] = {"exposure_s": None, "start_ns": None, "notes": ()}
_WITH_TOPICS = (".mcap", ".bag", ".h5", ".hdf5", *_FITS)
"""Formats that may hold several films, one of which the topic names."""


def open_film(source: str | Path, topic: str | None = None) -> Film:
    """Open a film, by the kind of its source.

    Raises `ImportingError` where the source cannot be read, holds no film, or needs a package that is not installed;
    the message says which.

    Parameters
    ----------
    source:
        A file of one of the formats of the table, a ROS 2 bag (a folder with metadata.yaml), or a folder of files.
    topic:
        The channel with the pictures, where an MCAP file or a bag has several; of AO telemetry the wavefront sensor, of
        an HDF5 file the dataset.
    """
    path = Path(source)
    if not path.exists():
        raise ImportingError(f"cannot read {path}: there is no such file or folder")
    suffix = _suffix(path)
    with _one_error(path):
        if not path.is_dir() and not path.is_file():
            raise ImportingError(f"{path} is a pipe or a device: copy what it gives into a file")
        if suffix == ".db3":
            raise ImportingError(f"{path} is a part of a ROS 2 bag: give the bag's folder, which has metadata.yaml")
        is_bag = (path / "metadata.yaml").exists()
        folder = bags.ros_film if is_bag else _folder
        read: Callable[..., Film] | None = folder if path.is_dir() else _FORMATS.get(suffix)
        if read is None:
            known = ", ".join(_FORMATS)
            raise ImportingError(f"{path} is not a film that aolink can read: give {known} or a folder of pictures")
        if is_bag or (path.is_file() and suffix in _WITH_TOPICS):
            film = read(path, topic)
        elif topic is None:
            film = read(path)
        else:
            raise ImportingError(fits.no_topic(path, topic))
        files = path.iterdir() if path.is_dir() else [path]
        size = sum(each.stat().st_size for each in files if each.is_file())
        more = {"expansion": LOSSY_EXPANSION} if film.nonlinear else {}
        check_film(film.shape, film.dtype.itemsize, film.count, size, ImportingError, **more)
    if film.mosaic:
        note = f"its pixels are under a Bayer mosaic, {film.mosaic}: --film colour=green takes one colour"
        film = replace(film, notes=(*film.notes, note))
    if film.start_ns is not None and not dated(film.start_ns):
        note = f"its times begin at {np.datetime64(film.start_ns, 'ns')}, as since a device began: no dates"
        film = replace(film, start_ns=None, notes=(*film.notes, note))
    return replace(film, pictures=lambda: _checked(film, path, size))


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


def _checked(film: Film, path: Path, size: int) -> Iterator[FilmFrame]:
    """The pictures of a film, checked against the size and the number that it announced, and its file's bytes."""
    count, channels = 0, None
    with _one_error(path):
        for picture in film.pictures():
            if picture.shape[:2] != film.shape or channels not in (None, picture.shape[2:]):
                before = (*film.shape, *(channels or ()))
                raise ImportingError(f"{path}: frame {count} has the shape {picture.shape}, those before it {before}")
            if path.is_file() and path.stat().st_size < size:  # for what lacks then, HDF5 gives zeros
                raise ImportingError(f"{path} has become shorter while it was read")
            yield picture
            count, channels = count + 1, picture.shape[2:]
    if count != film.count:
        raise ImportingError(f"{path} announces {film.count} frames and has {count}: it is damaged")


def _folder(path: Path) -> Film:
    """The films of a folder's files, one after the other."""
    found = {each for each in path.iterdir() if _suffix(each) in _FORMATS.keys() - {".mcap", ".bag"}}
    files = [each for each in found if each.name[0] != "." and (each.is_file() or each.is_symlink())]
    if not files and any(each.suffix in (".db3", ".mcap") for each in path.iterdir()):
        raise ImportingError(f"{path} has no metadata.yaml, as a ROS 2 bag has: `ros2 bag reindex` makes one")
    notes = []
    lossless = [each for each in files if _suffix(each) not in stills.LOSSY]
    if lossless and (left := len(files) - len(lossless)):
        if left > len(lossless):
            raise ImportingError(f"{path} holds {left} JPEG files and {len(lossless)} others: which are the frames?")
        notes.append(f"{left} JPEG files beside other pictures are left out, as previews of them")
        files = lossless
    names: dict[str, Path] = {}
    for each in sorted(files):
        if (other := names.setdefault(_name(each), each)) != each:
            raise ImportingError(f"{other} and {each.name} have one name: leave one file for each frame in the folder")
    order, numbers, more = by_number(list(names))
    files = [list(names.values())[k] for k in order]
    there = np.array([each.is_file() for each in files], np.bool_)
    if not there.any():
        raise ImportingError(f"{path} holds no pictures ({', '.join(_FORMATS)})")
    if not there.all():
        notes.append(f"{len(files) - there.sum()} links lead to no file: these frames are missing")
        numbers = np.arange(len(files)) if numbers is None else numbers
    numbers = None if numbers is None else numbers[there]
    files = [each for each, here in zip(files, there, strict=True) if here]
    first = open_film(files[0])
    parts: dict[Path, Film] = {files[0]: first}
    read = set(first.files)
    for each in files[1:]:
        if each.name in read:  # a stack over several files, which has come as a whole
            continue
        # Single pictures are opened when they are needed; of the later ones only what they say is read here.
        single = _suffix(each) in _PICTURES
        parts[each] = replace(first, **(_NOTHING | stills.said(each)[0])) if single else open_film(each)
        read |= parts[each].files

    def pictures() -> Iterator[FilmFrame]:
        for each, known in parts.items():
            part = open_film(each) if _suffix(each) in _PICTURES else known
            if (part.shape, part.dtype, part.top) != (first.shape, first.dtype, first.top):
                raise ImportingError(f"{each} has {_described(part)}, those before it have {_described(first)}")
            yield from part.pictures()

    notes += [f"pictures in the order of their names, {files[0].name} to {files[-1].name}", *more]
    known = _times_of(list(parts.values()), notes)
    notes += dict.fromkeys(note for part in parts.values() for note in part.notes)
    if len({each.count for each in parts.values()}) > 1 or len(parts) < len(files):
        numbers = None
    elif numbers is not None:  # of stacks, those of their frames
        numbers = (numbers[:, None] * first.count + np.arange(first.count)).ravel()
    return replace(first, name=path.name, count=sum(each.count for each in parts.values()), files=frozenset(),
                   pictures=pictures, inputs=None, numbers=numbers, notes=tuple(notes), **known)  # fmt: skip


def _times_of(parts: list[Film], notes: list[str]) -> dict[str, Any]:
    """Times of all frames of several films one after the other, where each says its own; notes say what is not used."""
    known: dict[str, Any] = {"times_ns": None}
    exposures = {each.exposure_s for each in parts}
    if len(exposures) > 1:
        notes.append("the exposure time differs from file to file: that of the first is taken")
    times = [each for part in parts if (each := _own_times(part)) is not None]
    if len(times) == len(parts) and sum(part.count for part in parts) > 1:
        joined = np.concatenate(times)
        if (np.diff(joined) == 0).any():
            notes.append("several frames have the same time of their own: these times are not used")
        else:
            known |= {"times_ns": joined, "start_ns": int(joined[0])}
    elif times and len(parts) > 1:
        notes.append(f"{len(times)} of {len(parts)} files have a time of their own: these times are not used")
    return known


def _own_times(film: Film) -> NDArray[np.int64] | None:
    """Time of each frame, ns since 1970, where the film knows all of them."""
    if film.start_ns is None or (film.times_ns is None and film.rate_hz is None and film.count > 1):
        return None
    if film.times_ns is not None:
        return np.asarray(film.start_ns + film.times_ns - film.times_ns[0])
    return np.asarray(film.start_ns + np.rint(np.arange(film.count) * 1e9 / (film.rate_hz or 1)).astype(np.int64))


def _suffix(path: Path) -> str:
    """What a file's name says of its format, under a compression."""
    ends = path.suffix.lower()
    return Path(path.stem).suffix.lower() if ends in (".gz", ".fz") else ends


def _name(path: Path) -> str:
    return path.name.lower().rpartition(_suffix(path))[0]


def _described(film: Film) -> str:
    return f"{film.shape[0]} x {film.shape[1]} pixels of {film.dtype}"
