"""Recordings behind URLs, in object storage and on web servers, read through fsspec by the ranges that are needed."""

from __future__ import annotations

import io
import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from aolink.errors import RecordingError
from aolink.extensions import install_command

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

AHEAD = 64 << 10
"""Bytes of a request where the reader has not announced what comes next."""
MOST_AHEAD = 1 << 20
"""The most bytes of a request where the reader has announced it, if no single record is larger."""
_GAP = 16 << 10
"""Bytes between two ranges that are read with them: another request would take longer."""
_KEPT = 3
"""Ranges that stay in memory, besides the first and the last of the file."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


def location(path: str | Path | Url) -> Path | Url:
    """A place as a path, or as a URL where it is one: ``s3://bucket/session.mcap``, ``https://...``,
    ``memory://...``."""
    return Url(path) if isinstance(path, str) and _URL.match(path) else path if isinstance(path, Url) else Path(path)


def only_paths(places: Iterable[Path | Url]) -> list[Path]:
    """The places that are files of this machine."""
    return [each for each in places if isinstance(each, Path)]


class Url:
    """The place of a recording that is not a file of this machine.

    It keeps the first, the last and the latest bytes that were read, so that a recording that is opened again requests
    few bytes twice. Between processes only the URL itself travels.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        """The whole URL. Messages show it without password and query, which may hold a signature."""
        self.ends: dict[int, bytes] = {}
        """The first and the last bytes, as far as they were read, by their position."""
        self.latest: deque[tuple[int, bytes]] = deque(maxlen=_KEPT)
        """The latest ranges that were read: where each begins, and its bytes."""

    def __str__(self) -> str:
        parts = urlsplit(self.text)
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"

    def __repr__(self) -> str:
        return f"Url({str(self)!r})"

    def __reduce__(self) -> tuple[type[Url], tuple[str]]:
        return Url, (self.text,)

    @property
    def name(self) -> str:
        """The last part of its path."""
        return PurePosixPath(urlsplit(self.text).path).name

    @property
    def stem(self) -> str:
        """The name without its suffix."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """The end of the name from its last dot on."""
        return PurePosixPath(self.name).suffix

    @cached_property
    def size(self) -> int:
        """Bytes of the file. Raises RecordingError as `open` does."""
        with self._asked():
            system, path = self._place
            size = system.info(path)["size"]
        if not isinstance(size, int):
            raise RecordingError(f"{self} does not say how long it is: copy the file here")
        return size

    def open(self, expected: Sequence[tuple[int, int]] = ()) -> RangeFile:
        """The file, to be read.

        Parameters
        ----------
        expected:
            First byte and length of the ranges that will be read, in ascending order: neighbouring ranges are requested
            together, and no bytes between others.

        Raises
        ------
        RecordingError
            There is no such file, it may not be read, no server answers, or the extra ``remote`` is not installed.
        """
        return RangeFile(self, expected)

    def read(self, start: int, end: int) -> bytes:
        """Bytes from ``start`` up to ``end``. Raises RecordingError as `open` does."""
        with self._asked():
            system, path = self._place
            data: bytes = system.cat_file(path, start=start, end=end)
        if len(data) != end - start:
            raise RecordingError(
                f"{self}: {end - start} bytes were asked for and {len(data)} came; its server gives no ranges, or the"
                " file has changed: copy it here"
            )
        if start == 0 or end == self.size:
            self.ends[start] = data
        return data

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """A file system of fsspec, and the path in it."""
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise RecordingError(f"reading {self} needs fsspec: {install_command('remote')}") from None
        try:
            found: tuple[Any, str] = url_to_fs(self.text)
        except ImportError as error:
            raise RecordingError(f"reading {self} needs more: {error}; {install_command('remote')}") from None
        except ValueError as error:
            raise RecordingError(f"cannot read {self}: {error}") from None
        return found

    def _hidden(self, error: BaseException) -> str:
        """The first line of an error, without what stands behind a question mark: it may be a signature."""
        text = (str(error) or type(error).__name__).splitlines()[0]
        return re.sub(r"\?[^\s'\")]*", "", text.replace(self.text, str(self)))

    @contextmanager
    def _asked(self) -> Iterator[None]:
        """Turn the exceptions of a file system of fsspec into one error: each file system has its own."""
        try:
            yield
        except RecordingError:
            raise
        except Exception as error:
            cause = error.__cause__ or error  # some file systems report a missing file for any error
            denied = isinstance(error, PermissionError) or getattr(cause, "status", 0) in (401, 403)
            if denied or type(error).__name__ in ("NoCredentialsError", "PartialCredentialsError"):
                why = "no right to read it; give the credentials that its server wants, as AWS_PROFILE for s3"
            elif getattr(cause, "status", 0) >= 500:
                why = f"its server has an error ({self._hidden(cause)})"
            elif isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError):
                why = f"its server does not answer ({self._hidden(cause)})"
            elif isinstance(error, FileNotFoundError):
                what = "" if cause is error else f" ({self._hidden(cause)})"
                why = f"there is no such file, or it may not be listed{what}"
            else:
                why = self._hidden(error)
            raise RecordingError(f"cannot read {self}: {why}") from None


class RangeFile(io.RawIOBase):
    """A file behind a URL, which is requested in ranges."""

    def __init__(self, url: Url, expected: Sequence[tuple[int, int]] = ()) -> None:
        self._url, self._size, self._at = url, url.size, 0
        self._spans = deque(_joined(expected))

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, base + offset)
        return self._at

    def readinto(self, buffer: WriteableBuffer) -> int:
        view = memoryview(buffer).cast("B")
        end = min(self._at + len(view), self._size)
        done = 0
        while self._at < end:
            start, data = self._around(self._at, end)
            part = data[self._at - start : end - start]
            view[done : done + len(part)] = part
            done, self._at = done + len(part), self._at + len(part)
        return done

    def _around(self, position: int, end: int) -> tuple[int, bytes]:
        """The bytes of a range that contains a position, and where it begins; the file will be read up to ``end``."""
        for start, data in (*self._url.ends.items(), *self._url.latest):
            if start <= position < start + len(data):
                return start, data
        start, stop = self._range(position, end)
        stop = min([stop, *(there for there in self._url.ends if there > position)])  # that is known already
        found = start, self._url.read(start, stop)
        self._url.latest.append(found)
        return found

    def _range(self, position: int, end: int) -> tuple[int, int]:
        while self._spans and self._spans[0][1] <= position:
            self._spans.popleft()
        if self._spans and self._spans[0][0] <= position:
            return position, max(end, min(self._spans[0][1], position + MOST_AHEAD, self._size))
        if position < AHEAD:
            return 0, min(max(end, AHEAD), self._size)
        if position >= self._size - AHEAD:  # the index is at the end, and its length is in the last bytes
            return self._size - AHEAD, self._size
        return position, min(max(end, position + AHEAD), self._size)


def _joined(ranges: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """First byte and end of ranges, with neighbouring ones joined."""
    start = end = -1
    for first, length in ranges:
        if start < 0 or first - end > _GAP:
            if start >= 0:
                yield start, end
            start = first
        end = max(end, first + length)
    if start >= 0:
        yield start, end
