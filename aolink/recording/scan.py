"""Reads an MCAP file record by record, and finds its way again where the file is damaged.

A recording is a sequence of records, [opcode u8 | length u64 | content]; messages are in chunks, which
have a checksum each. Damage costs the chunk that it is in: where a length is damaged, the scan goes on at
the next bytes that can only be a chunk or the end of the data. Nothing in the file is believed about
sizes, so a hostile file costs no memory.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk

from aolink.errors import RecordingError

MAX_RECORD = 256 << 20
"""Bytes; a larger record is damage, not data."""
_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last log time, size and CRC without compression, length of the compression's name."""
_FOOTER_BYTES = _HEAD.size + 20 + len(_MAGIC)
_SEARCH_BYTES = 1 << 20
_COMPRESSIONS = (b"lz4", b"zstd", b"")
_CANDIDATE = re.compile(rb"[\x06\x0f].{4}\x00{4}|\x0c.{4}\x00{4}.\x00{3}aolink", re.DOTALL)
"""A chunk (6), the end of the data (15) or metadata of ours (12), with a length below 4 GiB."""

_PARSERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.FOOTER: Footer.read,
}
"""What is looked into; message indexes and other records are stepped over."""
_LENGTHS: dict[int, int] = {Opcode.FOOTER: 20, Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4}
"""Content that is of one length always."""
_KNOWN = {*_PARSERS, *_LENGTHS}

# What the mcap library and the decompressors raise on content that is damaged.
_DAMAGE = (McapError, struct.error, RuntimeError, ValueError, EOFError, KeyError, zstandard.ZstdError)


@dataclass(frozen=True, slots=True)
class Loss:
    """A part of a file that could not be read."""

    offset: int
    """Byte at which it begins."""
    length: int
    """Bytes."""
    what: str
    """In words."""
    start_ns: int = 0
    """Log times of the messages that were in it, as far as is known; 0 where it is not."""
    end_ns: int = 0

    def text(self) -> str:
        """The loss in words."""
        span = f", {(self.end_ns - self.start_ns) / 1e9:.3g} s of messages" if self.end_ns else ""
        return f"{self.what} ({self.length} bytes{span})"


@dataclass(slots=True)
class Summary:
    """What the end of a file says about it."""

    statistics: Statistics
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    others: list[AttachmentIndex | MetadataIndex] = field(default_factory=list)


def open_recording(path: Path) -> IO[bytes]:
    """Open a file that should be a recording.

    Raises
    ------
    RecordingError
        It cannot be read, or is no MCAP file, nor what is left of one.
    """
    try:
        file = path.open("rb")
        head = file.read(len(_MAGIC) + _HEAD.size)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {os.strerror(error.errno or 0).lower()}") from None
    if len(head) < len(_MAGIC):
        file.close()
        raise RecordingError(f"{path} is empty or too short to be a recording")
    # A bit of the first bytes may be damaged: then the record after them tells.
    if not head.startswith(_MAGIC) and head[len(_MAGIC) :][:1] != bytes([Opcode.HEADER]):
        file.close()
        raise RecordingError(f"{path} is not a recording: it is not an MCAP file")
    return file


def read_summary(file: IO[bytes]) -> Summary | None:
    """The summary at a file's end; None if the file was cut off, or what it says fails its checksum."""
    size = file.seek(0, os.SEEK_END)
    if size < len(_MAGIC) + _FOOTER_BYTES:
        return None
    file.seek(size - _FOOTER_BYTES)
    tail = file.read(_FOOTER_BYTES)
    opcode, length = _HEAD.unpack_from(tail)
    start, _, crc = struct.unpack_from("<QQI", tail, _HEAD.size)
    end = size - _FOOTER_BYTES
    if not tail.endswith(_MAGIC) or (opcode, length) != (Opcode.FOOTER, 20) or not 0 < start <= end:
        return None
    if end - start > MAX_RECORD:
        return None
    file.seek(start)
    data = file.read(end - start)
    if crc and zlib.crc32(tail[: _HEAD.size + 16], zlib.crc32(data)) != crc:
        return None
    return _parse_summary(data)


def _parse_summary(data: bytes) -> Summary | None:
    summary: Summary | None = None
    records: list[McapRecord] = []
    position = 0
    try:
        while position < len(data):
            opcode, length = _HEAD.unpack_from(data, position)
            position += _HEAD.size
            if opcode in _PARSERS:
                records.append(_PARSERS[opcode](ReadDataStream(BytesIO(data[position : position + length]))))
            position += length
    except _DAMAGE:
        return None
    for record in records:
        if isinstance(record, Statistics):
            summary = Summary(record)
    if summary is None:
        return None
    for record in records:
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, ChunkIndex):
            summary.chunks.append(record)
        elif isinstance(record, AttachmentIndex | MetadataIndex):
            summary.others.append(record)
    summary.chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    return summary


def scan(file: IO[bytes], on_loss: Callable[[Loss], None]) -> Iterator[tuple[McapRecord, bool]]:
    """Every whole record of a file from its start to its index, those in chunks too; losses go to ``on_loss``.

    With each record, whether a checksum says that it is what was written.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        on_loss(Loss(0, len(_MAGIC), "the first bytes are damaged"))
    position = len(_MAGIC)
    while position < size:
        file.seek(position)
        head = file.read(_HEAD.size)
        length = _HEAD.unpack(head)[1] if len(head) == _HEAD.size else 0
        end = position + _HEAD.size + length
        if len(head) < _HEAD.size or end > size or not _is_plausible(head[0], length, file):
            found = end if _begins_a_record(file, end, size) else _next_chunk(file, position + 1, size)
            if found is None:
                on_loss(
                    Loss(
                        position, size - position, f"it was cut off: it ends at byte {size}, in the middle of a record"
                    )
                )
                return
            on_loss(Loss(position, found - position, f"{found - position} bytes make no sense"))
            position = found
            continue
        lost: list[Loss] = []
        record = _record_at(file, position, lost.append)
        if lost:  # its length may be wrong: what it covers may hold whole chunks
            end = _next_chunk(file, position + 1, size, before=end) or end
            on_loss(replace(lost[0], length=end - position))
        elif isinstance(record, Chunk):
            yield from ((each, True) for each in broken_up(record, position, on_loss))
        elif record is not None:
            yield record, False
        position = end
        file.seek(position)
        if head[0] == Opcode.DATA_END:
            if read_summary(file) is None:
                on_loss(Loss(end, size - end, "its index is damaged or was cut off"))
            return
    on_loss(Loss(size, 0, f"it was cut off: it ends at byte {size}, without an index"))


def chunk_at(file: IO[bytes], index: ChunkIndex, on_loss: Callable[[Loss], None]) -> list[McapRecord]:
    """What is in a chunk that the summary names; nothing if it is damaged."""
    file.seek(index.chunk_start_offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or head[0] != Opcode.CHUNK or _HEAD.unpack(head)[1] > MAX_RECORD:
        on_loss(_chunk_loss(index.chunk_start_offset, index.chunk_length, index))
        return []
    record = _record_at(file, index.chunk_start_offset, on_loss)
    return broken_up(record, index.chunk_start_offset, on_loss) if isinstance(record, Chunk) else []


def record_at(file: IO[bytes], offset: int) -> McapRecord | None:
    """A record that the summary names; None if it is damaged."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or _HEAD.unpack(head)[1] > MAX_RECORD:
        return None
    return _record_at(file, offset, lambda loss: None)


def broken_up(chunk: Chunk, offset: int, on_loss: Callable[[Loss], None]) -> list[McapRecord]:
    """The records in a chunk; nothing if it is damaged."""
    try:
        return breakup_chunk(_decompressed(chunk), validate_crc=True)
    except _DAMAGE:
        on_loss(_chunk_loss(offset, _HEAD.size + len(chunk.data), chunk))
        return []


def _chunk_loss(offset: int, length: int, chunk: Chunk | ChunkIndex) -> Loss:
    return Loss(
        offset, length, f"the chunk at byte {offset} is damaged", chunk.message_start_time, chunk.message_end_time
    )


def _record_at(file: IO[bytes], position: int, on_loss: Callable[[Loss], None]) -> McapRecord | None:
    """The record at a position, whose length is known to be possible; None if it is damaged or of no interest."""
    file.seek(position)
    opcode, length = _HEAD.unpack(file.read(_HEAD.size))
    if opcode not in _PARSERS:
        file.seek(length, os.SEEK_CUR)
        return None
    content = file.read(length)
    stream = ReadDataStream(BytesIO(content))
    try:
        record = _PARSERS[opcode](stream)
        if stream.count != length:
            raise ValueError("size")
        if opcode == Opcode.ATTACHMENT and zlib.crc32(content[:-4]) != struct.unpack("<I", content[-4:])[0]:
            raise ValueError("checksum")
    except _DAMAGE:
        kind = Opcode(opcode).name.lower().replace("_", " ")
        on_loss(Loss(position, _HEAD.size + length, f"the {kind} at byte {position} is damaged"))
        return None
    return record


def _is_plausible(opcode: int, length: int, file: IO[bytes]) -> bool:
    """Whether a record can be what it says: one flipped bit makes a chunk another kind, which would be skipped."""
    if opcode == Opcode.MESSAGE_INDEX:
        rest = file.read(6)
        return len(rest) == 6 and length == 6 + struct.unpack_from("<I", rest, 2)[0]
    return opcode in _KNOWN and length <= MAX_RECORD and _LENGTHS.get(opcode, length) == length


def _begins_a_record(file: IO[bytes], position: int, size: int) -> bool:
    """Whether what stands at a position can be the next record: only its kind is damaged then, not its length."""
    file.seek(min(position, size))
    head = file.read(_HEAD.size)
    return len(head) == _HEAD.size and _is_plausible(head[0], _HEAD.unpack(head)[1], file)


def _next_chunk(file: IO[bytes], position: int, size: int, before: int | None = None) -> int | None:
    """Where the next whole chunk, metadata or the end of the data begins; None if that is not ``before`` a byte."""
    before = size if before is None else before
    while position < before:
        file.seek(position)
        block = file.read(_SEARCH_BYTES + 128)
        for match in _CANDIDATE.finditer(block):
            at = match.start()
            if at >= min(_SEARCH_BYTES, before - position):
                break
            opcode, length = _HEAD.unpack_from(block, at)
            if opcode != Opcode.CHUNK:
                if length == 4 or opcode == Opcode.METADATA:
                    return position + at
            elif length <= MAX_RECORD and position + at + length <= size and _is_chunk_head(block[at:], length):
                return position + at
        position += _SEARCH_BYTES
    return None


def _is_chunk_head(data: bytes, length: int) -> bool:
    """Whether these are the first bytes of a chunk of this length: its fields must agree with each other."""
    if len(data) < _HEAD.size + _CHUNK_HEAD.size + 12:
        return False
    start, end, _, _, name_length = _CHUNK_HEAD.unpack_from(data, _HEAD.size)
    at = _HEAD.size + _CHUNK_HEAD.size
    if start > end or name_length > 4 or data[at : at + name_length] not in _COMPRESSIONS:
        return False
    (held,) = struct.unpack_from("<Q", data, at + name_length)
    return bool(length == _CHUNK_HEAD.size + name_length + 8 + held)


def _decompressed(chunk: Chunk) -> Chunk:
    """A chunk without compression. It may say one size and hold another: neither may fill the memory."""
    if chunk.uncompressed_size > MAX_RECORD:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    if chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    elif chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(chunk.uncompressed_size + 1)
    else:
        return chunk
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk that is not of the size that it says")
    return replace(chunk, compression="", data=data)


__all__ = [
    "MAX_RECORD",
    "Loss",
    "McapMessage",
    "Summary",
    "broken_up",
    "chunk_at",
    "open_recording",
    "read_summary",
    "record_at",
    "scan",
]
