"""Limits of the memory and the reading that a file may cause. Real files are far below them."""

from __future__ import annotations

import gzip
import io
import math
import mmap
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import AolinkError, RecordingError, RigError

RECORD_BYTES = 256 << 20
"""Bytes of a record of a recording: twice a chunk that does not compress. A larger one counts as damage."""
CHUNK_BYTES = 128 << 20
"""Bytes of a chunk without its compression: the largest that aolink writes has 64 MiB, and its last message."""
ATTACHMENT_BYTES = 256 << 20
"""Bytes of all attachments of a file together, which are kept in memory; the largest of a session is the picture of a
scene."""
DESCRIPTION_BYTES = 32 << 20
"""Bytes of all metadata, channels and schemas of a file together, which are kept in memory; a session's are some
kilobytes."""
_RECORDS_PER_KILOBYTE = 256
"""Messages in each thousand bytes of a file: a file of 38 kB can hold 128 MiB of equal messages, and the time that its
reading takes is to be proportional to its size. A chunk and its place in the index count as 32 messages each; a
channel, a schema, metadata or an attachment as 128."""
_FREE_RECORDS = 100_000
"""Messages that are allowed beside these, so that small files need no count."""
_EXPANSION = 255
"""Bytes without compression in each byte of a file: LZ4 cannot exceed it."""
_FREE_BYTES = 1 << 30
"""Bytes that are allowed beside these: they are decompressed within seconds, chunk by chunk."""
_UNPACKED_BYTES = 1 << 30
"""Bytes in a compressed picture or film of the kinds .fits.gz and .npz, and in a .csv table, which are in memory
at once."""
_PICTURE_PIXELS = 1 << 26
"""Pixels of a picture: 8192 rows and columns, which take 512 MiB as doubles."""
_FREE_FILM_BYTES = 1 << 28
"""Bytes of all frames of a film that are allowed beside 255 for each byte of its file."""
LOSSY_EXPANSION = 10_000
"""Bytes of frames for each byte of a video or a JPEG: one that nothing moves in is compressed far more."""


def exceeded(what: str, limit: int, error: type[AolinkError] = RecordingError) -> AolinkError:
    """The error for a file beyond a limit, with what the file holds."""
    return error(
        f"{what}, which is above the limit of {limit}: such a file may be made to fill the memory or to waste time;"
        " give what it holds in smaller files"
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
        self.records = self._most_records = _FREE_RECORDS + size * _RECORDS_PER_KILOBYTE // 1000
        self._bytes = self._most_bytes = _FREE_BYTES + size * _EXPANSION
        self._description_bytes = DESCRIPTION_BYTES

    def take_records(self, count: int) -> None:
        """Raise RecordingError where a file has more records than its size allows."""
        self.records -= count
        if self.records < 0:
            raise exceeded(f"{self._what} hold very many tiny records", self._most_records)

    def take_description(self, count: int) -> None:
        """Raise RecordingError where metadata, channels and schemas take more bytes than is allowed."""
        self._description_bytes -= count
        if self._description_bytes < 0:
            raise exceeded(f"{self._name} holds very long metadata, channels or schemas", DESCRIPTION_BYTES)

    def take_bytes(self, count: int) -> None:
        """Raise RecordingError where a file expands more than is allowed."""
        self._bytes -= count
        if self._bytes < 0:
            raise exceeded(f"{self._what} become very many more without compression", self._most_bytes)


def unpacked(file: IO[bytes], error: type[AolinkError]) -> bytes:
    """The content of a gzip file. Raises ``error`` above the limit, and the errors of `gzip` for a damaged file."""
    with gzip.open(file) as opened:
        data = opened.read(_UNPACKED_BYTES + 1)
    if len(data) > _UNPACKED_BYTES:
        raise exceeded("it holds very much more than its size without compression", _UNPACKED_BYTES, error)
    return data


def load_archive(path: Path, error: type[AolinkError]) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz file by name; raises ``error`` above the limit, and otherwise as `load_array` does."""
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            if (size := sum([each.file_size for each in parts])) > _UNPACKED_BYTES:
                raise exceeded(f"it holds {size} bytes without compression", _UNPACKED_BYTES, error)
            return {each.filename.removesuffix(".npy"): load_array(archive.read(each)) for each in parts}
    except zipfile.BadZipFile as problem:
        raise ValueError(str(problem).lower()) from None


def check_picture(width: int, height: int, error: type[AolinkError]) -> None:
    """Raise ``error`` for a picture that is above the limit."""
    if width * height > _PICTURE_PIXELS:
        raise exceeded(f"it has {width} x {height} pixels", _PICTURE_PIXELS, error)


def check_film(
    shape: Sequence[int], itemsize: int, count: int, size: int, error: type[AolinkError], expansion: int = _EXPANSION
) -> None:
    """Raise ``error`` for a film of ``count`` frames of (rows, columns) whose reading costs more than its ``size``,
    bytes, allows."""
    check_picture(shape[1], shape[0], error)
    held, most = count * shape[0] * shape[1] * itemsize, _FREE_FILM_BYTES + expansion * size
    if held > most:
        raise exceeded(f"its {size} bytes hold {count} frames of {held} bytes in all", most, error)


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
        if (size := path.stat().st_size) > _UNPACKED_BYTES:
            raise exceeded(f"{path} has {size} bytes", _UNPACKED_BYTES, RigError)
        found = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")
    else:
        found = load_array(path)
    try:
        return np.asarray(found, dtype=np.float64)
    except TypeError as error:
        raise ValueError(str(error)) from None
