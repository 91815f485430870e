"""Limits of the memory and the reading that a file may cause. The environment variable AOLINK_LIMITS raises them."""

from __future__ import annotations

import gzip
import io
import math
import mmap
import os
import zipfile
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, RecordingError, RigError

VARIABLE = "AOLINK_LIMITS"
_FREE_RECORDS = 100_000
"""Records that are allowed beside those of `Limits.records_per_kilobyte`."""
_FREE_BYTES = 1 << 30
"""Bytes that are allowed beside those of `Limits.expansion`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The sizes that are accepted in a file. Real recordings are far below them; larger ones would cost memory or time.

    A file of 38 kB can hold 128 MiB of equal messages, so that some limits grow with the file: the time that its
    reading takes is proportional to its size.
    """

    record_bytes: int = 256 << 20
    """Bytes of a record of the file. A larger one counts as damage."""
    chunk_bytes: int = 128 << 20
    """Bytes of a chunk without its compression: the largest that aolink writes has 64 MiB, and its last message."""
    attachment_bytes: int = 256 << 20
    """Bytes of all attachments of a file together; they are kept in memory."""
    description_bytes: int = 32 << 20
    """Bytes of all metadata, channels and schemas of a file together; they are kept in memory."""
    records_per_kilobyte: int = 256
    """Messages in each thousand bytes of a file, beside the first 100,000 of them. A chunk and its
    place in the index count as 32 messages each, a channel, a schema, metadata or an attachment as 128."""
    expansion: int = 255
    """Bytes without compression in each byte of a file, beside the first GiB. LZ4 cannot exceed it."""
    unpacked_bytes: int = 1 << 30
    """Bytes in a compressed picture or film of the kinds .fits.gz and .npz."""
    picture_pixels: int = 1 << 26
    """Pixels of a picture: 8192 rows and columns."""


@lru_cache(maxsize=1)
def _read(text: str) -> Limits:
    known = [field.name for field in fields(Limits)]
    found: dict[str, int] = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, _, value = part.partition("=")
        try:
            found[name.strip()] = int(float(value))
        except (ValueError, OverflowError):
            found[name.strip()] = 0
        if name.strip() not in known or found[name.strip()] < 1:
            raise RecordingError(
                f"{VARIABLE}: {part!r} is no limit: expected NAME=NUMBER, with one of {', '.join(known)}, and commas"
                " between several"
            )
    return Limits(**found)


def limits() -> Limits:
    """The limits that apply in this process.

    Raises
    ------
    RecordingError
        AOLINK_LIMITS has a value that does not set limits.
    """
    return _read(os.environ.get(VARIABLE, ""))


def exceeded(what: str, name: str, error: type[AolinkError] = RecordingError) -> AolinkError:
    """The error for a file beyond a limit, with what the file holds and the limit's name."""
    return error(
        f"{what}, which is above the limit of {getattr(limits(), name)} for {name}. Such a file may be made to fill the"
        f" memory or to waste time; if you trust it, set {VARIABLE}={name}=NUMBER to a larger number and read it again"
    )


def check_room(count: int, what: str, error: type[AolinkError]) -> None:
    """Raise ``error`` where a limit of this process leaves fewer bytes than ``what`` takes, in words."""
    try:
        mmap.mmap(-1, count, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()
    except (OSError, MemoryError):
        raise error(
            f"{what} takes {count >> 20} MiB of memory, and this process may not have them: raise its limit (ulimit -v,"
            " ulimit -d)"
        ) from None


class Budget:
    """The remaining budget for one reading of a file of ``size`` bytes."""

    def __init__(self, name: str, size: int) -> None:
        self._name, self._what = name, f"the {size} bytes of {name}"
        self.records = _FREE_RECORDS + size * limits().records_per_kilobyte // 1000
        self._bytes = _FREE_BYTES + size * limits().expansion
        self._description_bytes = limits().description_bytes

    def take_records(self, count: int) -> None:
        """Raise RecordingError where a file has more records than its size allows."""
        self.records -= count
        if self.records < 0:
            raise exceeded(f"{self._what} hold very many tiny records", "records_per_kilobyte")

    def take_description(self, count: int) -> None:
        """Raise RecordingError where metadata, channels and schemas take more bytes than is allowed."""
        self._description_bytes -= count
        if self._description_bytes < 0:
            raise exceeded(f"{self._name} holds very long metadata, channels or schemas", "description_bytes")

    def take_bytes(self, count: int) -> None:
        """Raise RecordingError where a file expands more than is allowed."""
        self._bytes -= count
        if self._bytes < 0:
            raise exceeded(f"{self._what} become very many more without compression", "expansion")


def unpacked(file: IO[bytes], error: type[AolinkError]) -> bytes:
    """The content of a gzip file. Raises ``error`` above the limit, and the errors of `gzip` for a damaged file."""
    most = limits().unpacked_bytes
    with gzip.open(file) as opened:
        data = opened.read(most + 1)
    if len(data) > most:
        raise exceeded("it holds very much more than its size without compression", "unpacked_bytes", error)
    return data


def load_archive(path: Path, error: type[AolinkError]) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name; raises ``error`` above the limit, and otherwise as `load_array` does."""
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            if (size := sum([each.file_size for each in parts])) > limits().unpacked_bytes:
                raise exceeded(f"it holds {size} bytes without compression", "unpacked_bytes", error)
            return {each.filename.removesuffix(".npy"): load_array(archive.read(each)) for each in parts}
    except zipfile.BadZipFile as problem:
        raise ValueError(str(problem).lower()) from None


def check_picture(width: int, height: int, error: type[AolinkError]) -> None:
    """Raise ``error`` for a picture that is above the limit."""
    if width * height > limits().picture_pixels:
        raise exceeded(f"it has {width} x {height} pixels", "picture_pixels", error)


def load_array(source: Path | bytes) -> NDArray[Any]:
    """The array of a .npy file, given by its path or its bytes, which must hold as much as its header says.

    Raises
    ------
    ValueError
        The file is not a .npy file, is cut off, or holds Python objects.
    OSError
        The file cannot be read.
    """
    with io.BytesIO(source) if isinstance(source, bytes) else source.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
        start = file.tell()
        held = file.seek(0, os.SEEK_END) - start
        if dtype.hasobject:
            raise ValueError("it holds objects of Python's, expected numbers")
        if math.prod(shape) * dtype.itemsize > held:
            raise ValueError(f"it is cut off: {shape} numbers are announced")
        file.seek(0)
        return np.asarray(np.load(file, allow_pickle=False))


def load_table(path: Path) -> NDArray[np.float64]:
    """The numbers of a .csv file with commas, of a .npy file, or of a .npz file with one array.

    Raises
    ------
    RigError
        The file is above the limit of unpacked bytes.
    ValueError
        The file holds something else.
    OSError
        The file cannot be read.
    """
    if path.suffix == ".npz":
        arrays = load_archive(path, RigError)
        if len(arrays) != 1:
            raise ValueError(f"it holds {len(arrays)} arrays, expected one")
        (found,) = arrays.values()
    elif path.suffix == ".csv":
        if (size := path.stat().st_size) > limits().unpacked_bytes:
            raise exceeded(f"{path} has {size} bytes", "unpacked_bytes", RigError)
        found = np.loadtxt(path, delimiter=",", ndmin=2)
    else:
        found = load_array(path)
    try:
        return np.asarray(found, dtype=np.float64)
    except TypeError as error:
        raise ValueError(str(error)) from None
