"""One MCAP file that is being written: it has a channel for each topic and schema and chunks divided by time, and is
whole up to a known byte."""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import Message
from mcap.records import Metadata, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from aolink import files
from aolink.errors import RecordingError
from aolink.recording import topics

COMPRESSIONS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


_SEAL = "crc32"
"""Key of the checksum in metadata."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteOptions:
    """How a recording is divided into chunks, and when they reach the disk.

    Defaults as measured by ``tools/bench recording``: LZ4 keeps the longest single write call under a
    millisecond, and a killed process loses no more than twice ``flush_s``.
    """

    compression: str = "lz4"
    """The compression, one of `COMPRESSIONS`."""
    chunk_bytes: int = 128 << 10
    """A chunk that has grown to this size goes to the file."""
    flush_s: float = 0.1
    """A chunk that is this old goes to the file: a killed process loses no more than twice that."""
    fsync_s: float = 1.0
    """Time between two synchronisations with the disk, s: a power cut loses no more than that and twice ``flush_s``."""
    split_bytes: int = 0
    """A file of this size is ended and another begun; 0 for one file."""
    split_s: float = 0.0
    """A file that is this old is ended and another begun; 0 for one file."""

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


AT_LEISURE = WriteOptions(compression="zstd", chunk_bytes=1 << 20, flush_s=60.0)
"""For a file that no session waits for, and that is whole or not there: large chunks take a third less room."""


class _File:
    """An open file that writes all bytes or raises an error.

    Where another program has shortened it, its beginning is written again, so that what comes afterwards can be read.
    """

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.beginning: list[bytes] = []
        """The first bytes, as far as nothing can be read without them."""
        self.is_begun = self.was_shortened = False
        self._position = 0

    def check_size(self) -> None:
        """Note whether the file is shorter than what was written to it. Raises OSError."""
        if os.fstat(self.descriptor).st_size < self._position:
            self.was_shortened = True
            os.pwrite(self.descriptor, b"".join(self.beginning), 0)
            os.ftruncate(self.descriptor, self._position)

    def write(self, data: bytes) -> int:
        self.check_size()
        if not self.is_begun:
            self.beginning.append(data)
        view = memoryview(data)
        while view:
            written = os.write(self.descriptor, view)
            self._position += written
            view = view[written:]
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Do nothing: no bytes are held back."""

    def close(self) -> None:
        os.close(self.descriptor)


class McapFile:
    """Writes messages that are bytes already. It is not thread-safe; errors of the disk are raised as OSError.

    Parameters
    ----------
    descriptor:
        Descriptor of ``path`` if that is open for writing and empty already; otherwise the file is created.

    Raises
    ------
    RecordingError
        The file exists, another command is writing it, or it cannot be created.
    """

    def __init__(self, path: Path, options: WriteOptions, *, descriptor: int | None = None) -> None:
        self.path = path
        if descriptor is None:
            descriptor = files.create(path, error=RecordingError).descriptor
        self._file = _File(descriptor)
        self._flush_ns = round(options.flush_s * 1e9)
        self._writer = Writer(
            self._file,  # type: ignore[arg-type]
            chunk_size=options.chunk_bytes,
            compression=COMPRESSIONS[options.compression],
            enable_data_crcs=True,
        )
        self._channels: dict[tuple[str, str], int] = {}
        """Channels by topic and name of the schema."""
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

    @property
    def loss(self) -> RecordingError | None:
        """What to raise where another program has emptied or shortened the file. Raises OSError."""
        if not self._closed:
            self._file.check_size()
        if not self._file.was_shortened:
            return None
        return RecordingError(
            f"{self.path} was emptied or shortened by another program: what it held until then is lost"
        )

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        self.flush()
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)
        self._whole = self.size

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        self.flush()
        self._writer.add_metadata(name, sealed(name, values))
        self._whole = self.size

    def add(
        self, topic: str, schema: Schema, data: bytes, log_time_ns: int, sequence: int,
        encoding: str = MessageEncoding.Protobuf,
    ) -> None:  # fmt: skip
        """Add a message; the chunk before it goes to the file if it is old enough by the messages' own times."""
        self._file.is_begun = True
        channel = self._channels.get((topic, schema.name))
        if channel is None:
            channel = self._channels[topic, schema.name] = self._register(topic, schema, encoding)
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
        # The channel itself is in the chunk. If that chunk were damaged, later ones could not be read, so the channel
        # is written twice.
        known = {"id": str(channel), "topic": topic, "schema": schema.name}
        self._writer.add_metadata(topics.CHANNEL_METADATA, sealed(topics.CHANNEL_METADATA, known))
        return channel

    def flush(self) -> None:
        """Write the chunk that has been begun."""
        self._writer.flush()
        self._chunk_start_ns = None
        self._whole = self.size

    def sync(self) -> None:
        """Wait until the file's content is on the disk."""
        os.fsync(self._file.descriptor)

    def finish(self, *, sync: bool = False) -> None:
        """Write the index and close; with ``sync``, wait until it is on the disk.

        Raises
        ------
        RecordingError
            Another program has emptied or shortened the file.
        """
        self.flush()
        self._writer.finish()
        if sync:
            self.sync()
        loss = self.loss
        self._closed = True
        self._file.close()
        if loss is not None:
            raise loss

    def cut_back(self) -> None:
        """Cut the file back to its last whole part, and close it. Raises nothing."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(OSError):
            os.ftruncate(self._file.descriptor, self._whole)
        with contextlib.suppress(OSError):
            self._file.close()


def sealed(name: str, values: Mapping[str, str]) -> dict[str, str]:
    """Metadata with a checksum, which MCAP gives to chunks and attachments but not to metadata."""
    return {**values, _SEAL: _checksum(name, values)}


def unsealed(records: Sequence[Metadata]) -> Iterator[tuple[str, dict[str, str] | None]]:
    """The name and the facts of each metadata without their checksum, or None where that is wrong.

    Where one record of a file has a checksum, all of aolink's must have one, because damage to a length may hide the
    key. Metadata of older files and of other writers have none, and are accepted.
    """
    is_sealed = any(_SEAL in each.metadata for each in records)
    for each in records:
        facts = {key: value for key, value in each.metadata.items() if key != _SEAL}
        expected = is_sealed and each.name.startswith(topics.SESSION_METADATA)
        found = each.metadata.get(_SEAL, None if expected else _checksum(each.name, facts))
        yield each.name, facts if found == _checksum(each.name, facts) else None


def _checksum(name: str, values: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps([name, sorted(values.items())]).encode()):08x}"


def schema_of(message_class: type[Message]) -> Schema:
    """The schema record of a message class, with all types that it needs."""
    data = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
    return Schema(id=0, name=message_class.DESCRIPTOR.full_name, encoding=SchemaEncoding.Protobuf, data=data)
