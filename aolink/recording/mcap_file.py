"""One MCAP file that is being written: channels by topic, chunks cut by time, whole up to a known byte."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import Message
from mcap.records import Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from aolink.errors import RecordingError
from aolink.recording import topics

COMPRESSIONS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteOptions:
    """How a recording is cut into chunks, and when they reach the disk.

    Defaults as measured by ``tools/bench recording``: LZ4 keeps the longest single write call under a
    millisecond, and a killed process loses no more than twice ``flush_s``.
    """

    compression: str = "lz4"
    """One of `COMPRESSIONS`."""
    chunk_bytes: int = 128 << 10
    """A chunk that has grown to this size goes to the file."""
    flush_s: float = 0.1
    """A chunk that is this old goes to the file: a killed process loses no more than twice that."""
    fsync_s: float = 1.0
    """How often the file goes to the disk: a power cut loses no more than that and twice ``flush_s``."""
    split_bytes: int = 0
    """A file of this size is ended and another begun; 0 for one file."""
    split_s: float = 0.0
    """The same after this time; 0 for one file."""

    def __post_init__(self) -> None:
        if self.compression not in COMPRESSIONS:
            raise RecordingError(f"compression {self.compression!r} is not known: one of {', '.join(COMPRESSIONS)}")
        for name, low, high in (
            ("chunk_bytes", 1 << 10, 64 << 20),
            ("flush_s", 0.001, 60),
            ("fsync_s", 0.01, 3600),
            ("split_bytes", 0, 1 << 60),
            ("split_s", 0, 1e9),
        ):
            if not low <= getattr(self, name) <= high:
                raise RecordingError(f"{name} is {getattr(self, name):g}: a value from {low:g} to {high:g} is needed")


class _File:
    """A file that writes all or raises."""

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        if path.is_dir():
            raise RecordingError(f"{path} is a folder: give the name of a file in it")
        flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL)
        try:
            self.descriptor = os.open(path, flags | getattr(os, "O_CLOEXEC", 0), 0o666)
        except FileExistsError:
            raise RecordingError(
                f"{path} exists and is not overwritten: give another name, or --overwrite to replace it"
            ) from None
        except OSError as error:
            raise RecordingError(f"cannot create {path}: {os.strerror(error.errno or 0).lower()}") from None
        self._position = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            written = os.write(self.descriptor, view)
            self._position += written
            view = view[written:]
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        os.close(self.descriptor)


@contextlib.contextmanager
def replacing(target: Path, sources: Iterable[Path], *, overwrite: bool) -> Iterator[Path]:
    """A file beside ``target`` to write, which takes its place when the block ends well, and goes when it does not.

    Raises
    ------
    RecordingError
        ``target`` is one of the ``sources``, by whatever name; it exists and not ``overwrite``; it cannot be written.
    """
    if any(target.exists() and source.exists() and target.samefile(source) for source in sources):
        raise RecordingError(f"{target} is the recording itself: give another name for the new one")
    if target.is_dir():
        raise RecordingError(f"{target} is a folder: give the name of a file in it")
    if target.exists() and not overwrite:
        raise RecordingError(f"{target} exists and is not overwritten: give another name, or --overwrite to replace it")
    partial = target.with_name(f".{target.name}.partial")
    try:
        yield partial
        partial.replace(target)
    except RecordingError as error:  # whoever wrote knew of the partial file only
        text = str(error).replace(str(partial), str(target)).removesuffix(_KEPT)
        raise RecordingError(text) from None
    except OSError as error:
        raise RecordingError(f"cannot write {target}: {why_not(error)}") from None
    finally:
        partial.unlink(missing_ok=True)


def why_not(error: OSError) -> str:
    """Why a file cannot be written, in words."""
    if error.errno == errno.EFBIG:
        return "it would be larger than the disk or a limit (ulimit -f) lets a file be"
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return "the disk is full" if full else os.strerror(error.errno or 0).lower()


_KEPT = "; what was recorded until then is in it and can be read"


class McapFile:
    """Writes messages that are bytes already. Not thread-safe; what the disk says is raised as OSError.

    Raises
    ------
    RecordingError
        The file exists and not ``overwrite``, or cannot be created.
    """

    def __init__(self, path: Path, options: WriteOptions, *, overwrite: bool = False) -> None:
        self.path = path
        self._file = _File(path, overwrite=overwrite)
        self._flush_ns = round(options.flush_s * 1e9)
        self._writer = Writer(
            self._file,  # type: ignore[arg-type]
            chunk_size=options.chunk_bytes,
            compression=COMPRESSIONS[options.compression],
        )
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._chunk_start_ns: int | None = None
        self._whole = 0
        self._closed = False

    def start(self) -> None:
        """Write the first bytes."""
        self._writer.start(profile="aolink", library="aolink")

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.tell()

    @property
    def has_unwritten(self) -> bool:
        """Whether a chunk has been begun that is not in the file."""
        return self._chunk_start_ns is not None

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        self.flush()
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)
        self._whole = self.size

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        self.flush()
        self._writer.add_metadata(name, values)
        self._whole = self.size

    def add(
        self, topic: str, schema: Schema, data: bytes, log_time_ns: int, sequence: int,
        encoding: str = MessageEncoding.Protobuf,
    ) -> None:  # fmt: skip
        """Add a message; the chunk before it goes to the file if it is old enough by the messages' own times."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._register(topic, schema, encoding)
        if self._chunk_start_ns is None:
            self._chunk_start_ns = log_time_ns
        elif log_time_ns - self._chunk_start_ns >= self._flush_ns:
            self.flush()
            self._chunk_start_ns = log_time_ns
        self._writer.add_message(channel, log_time_ns, data, log_time_ns, sequence & 0xFFFFFFFF)

    def _register(self, topic: str, schema: Schema, encoding: str) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = self._writer.register_channel(topic, encoding, self._schemas[schema.name])
        # The channel itself is in the chunk. Were that chunk damaged, later ones could not be read: say it twice.
        self._writer.add_metadata(topics.CHANNEL_METADATA, {"id": str(channel), "topic": topic, "schema": schema.name})
        return channel

    def flush(self) -> None:
        """Write the chunk that has been begun."""
        self._writer.flush()
        self._chunk_start_ns = None
        self._whole = self.size

    def sync(self) -> None:
        """Wait until the disk has what the file has."""
        os.fsync(self._file.descriptor)

    def finish(self, *, sync: bool = False) -> None:
        """Write the index and close; with ``sync``, when the disk has it."""
        self.flush()
        self._writer.finish()
        if sync:
            self.sync()
        self._closed = True
        self._file.close()

    def cut_back(self) -> None:
        """Leave a file that ends with its last whole part, and close it. Raises nothing."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(OSError):
            os.ftruncate(self._file.descriptor, self._whole)
        with contextlib.suppress(OSError):
            self._file.close()


def schema_of(message_class: type[Message]) -> Schema:
    """The schema record of a message class, with everything that it needs."""
    data = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
    return Schema(id=0, name=message_class.DESCRIPTOR.full_name, encoding=SchemaEncoding.Protobuf, data=data)
