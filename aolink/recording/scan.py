"""Reads an MCAP file record by record, as far as it is whole.

A recording is a sequence of records, [opcode u8 | length u64 | content]; messages are in chunks, which
have a checksum each. Damage costs the chunk that it is in: where a length is damaged, the scan goes on where
`aolink.recording.search` finds the next record. Sizes in the file are never trusted, so a hostile file costs no memory,
and no more time than a few readings of it.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from io import BufferedReader, BytesIO
from itertools import pairwise
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard
from mcap import records as kinds
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Chunk, ChunkIndex, McapRecord, MetadataIndex, Schema, Statistics
from mcap.records import Message as McapMessage

from aolink.errors import RecordingError
from aolink.files import why_not
from aolink.limits import ATTACHMENT_BYTES, CHUNK_BYTES, RECORD_BYTES, Budget, exceeded
from aolink.recording.search import HEAD, MESSAGE_HEAD, Search, begins_a_record, is_plausible

_MOST_READINGS = 4
"""The most bytes that are read from invalid records, in units of the file's size."""
_READ_BYTES = 1 << 20
MAGIC = b"\x89MCAP0\r\n"
_FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)

_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")
_PARSERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: kinds.Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT: kinds.Attachment.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: kinds.Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.FOOTER: kinds.Footer.read,
}
"""The kinds of records that are parsed; message indexes and others are skipped."""
_COSTS = dict.fromkeys(_PARSERS, 128) | {Opcode.MESSAGE: 1, Opcode.CHUNK: 32, Opcode.CHUNK_INDEX: 32}
"""How many messages a record counts as, by its kind; 8 for any other. There are few of those that take long to read."""
_LARGE = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT)
"""The kinds of records that are read and have limits of their own; those of the others together is the same."""

# What the mcap library and the decompressors raise on content that is damaged.
_DAMAGE = (McapError, struct.error, RuntimeError, ValueError, OverflowError, EOFError, KeyError, zstandard.ZstdError)


@dataclass(frozen=True, slots=True)
class Loss:
    """A part of a file that could not be read."""

    offset: int
    """Byte at which it begins."""
    length: int
    """Number of bytes."""
    what: str
    """The lost part in words."""
    start_ns: int = 0
    """Log times of the messages that were in it, as far as is known; 0 where it is not."""
    end_ns: int = 0
    count: int = 1
    """Number of losses that it stands for: it may stand for several messages that are wrong in the same way."""

    def text(self) -> str:
        """The loss in words."""
        span = f", {(self.end_ns - self.start_ns) / 1e9:.3g} s of messages" if self.end_ns else ""
        return f"{self.what} ({self.length} bytes{span})"


@dataclass(slots=True)
class Summary:
    """The summary section at the end of a file: its index and statistics."""

    statistics: Statistics | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    others: list[AttachmentIndex | MetadataIndex] = field(default_factory=list)

    @property
    def places(self) -> list[int]:
        """First bytes of the chunks, attachments and metadata that it names, in order."""
        return sorted([each.chunk_start_offset for each in self.chunks] + [each.offset for each in self.others])

    @property
    def is_index(self) -> bool:
        """Whether everything in the file can be found by it: writers may leave parts of it out."""
        known = self.statistics
        if known is None or (known.message_count and not known.chunk_count):
            return False
        counts = known.channel_message_counts
        attachments = sum(isinstance(each, AttachmentIndex) for each in self.others)
        return (
            known.chunk_count == len(self.chunks)
            and (known.attachment_count, known.metadata_count) == (attachments, len(self.others) - attachments)
            and known.message_count == sum(counts.values())
            and all(channel in self.channels for channel, count in counts.items() if count)
            and all(each.schema_id in self.schemas or not each.schema_id for each in self.channels.values())
        )


def open_recording(path: Path) -> BufferedReader:
    """Open a file that should be a recording.

    Raises
    ------
    RecordingError
        The file cannot be read, or is neither an MCAP file nor a part of one.
    """
    try:
        if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
            raise RecordingError(f"{path} is a pipe or a device: a recording must be a file, copy it into one")
        file = path.open("rb")
        head = file.read(len(MAGIC) + HEAD.size)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {os.strerror(error.errno or 0).lower()}") from None
    if len(head) < len(MAGIC):
        file.close()
        raise RecordingError(f"{path} is empty or too short to be a recording")
    # A bit of the first bytes may be damaged: then the record after them decides.
    if not head.startswith(MAGIC) and head[len(MAGIC) :][:1] != bytes([Opcode.HEADER]):
        file.close()
        raise RecordingError(f"{path} is not a recording: it is not an MCAP file")
    return file


def read_summary(file: IO[bytes]) -> Summary | None:
    """The summary at a file's end; None if the file was cut off, or the summary is damaged.

    It is empty where the writer has left it out.
    """
    try:
        return _read_summary(file)
    except OSError:  # the disk cannot read it
        return None


def _read_summary(file: IO[bytes]) -> Summary | None:
    size = file.seek(0, os.SEEK_END)
    if size < len(MAGIC) + _FOOTER_BYTES:
        return None
    file.seek(size - _FOOTER_BYTES)
    tail = file.read(_FOOTER_BYTES)
    opcode, length = HEAD.unpack_from(tail)
    start, _, crc = struct.unpack_from("<QQI", tail, HEAD.size)
    end = size - _FOOTER_BYTES
    if not tail.endswith(MAGIC) or (opcode, length) != (Opcode.FOOTER, 20) or start > end:
        return None
    start = start or end
    if end - start > RECORD_BYTES:
        return None
    file.seek(start)
    data = file.read(end - start)
    if crc and zlib.crc32(tail[: HEAD.size + 16], zlib.crc32(data)) != crc:
        return None
    summary = _parse_summary(data, Budget(_name(file), size))
    if summary is None:
        return None
    # Where it leads out of the file, or to one place twice and so not to another, it is no index.
    places = summary.places
    return summary if all(a < b for a, b in pairwise([*places, start])) else None


def _parse_summary(data: bytes, budget: Budget) -> Summary | None:
    summary = Summary()
    records: list[McapRecord] = []
    position = 0
    try:
        while position < len(data):
            opcode, length = HEAD.unpack_from(data, position)
            position += HEAD.size
            _charge(budget, opcode, length)
            if opcode == Opcode.CHUNK_INDEX:
                records.append(_chunk_index(data[position : position + length]))
            elif opcode in _PARSERS:
                records.append(_PARSERS[opcode](ReadDataStream(BytesIO(data[position : position + length]))))
            position += length
    except _DAMAGE:
        return None
    for record in records:
        if isinstance(record, Statistics):
            summary.statistics = record
        elif isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, ChunkIndex):
            summary.chunks.append(record)
        elif isinstance(record, AttachmentIndex | MetadataIndex):
            summary.others.append(record)
    summary.chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    return summary


def _chunk_index(data: bytes) -> ChunkIndex:
    """The result of `ChunkIndex.read`, in a fifth of the time: a recording of an hour has 18,000 of them."""
    start, end, offset, length, held = _CHUNK_INDEX_HEAD.unpack_from(data)
    at = _CHUNK_INDEX_HEAD.size + held
    index_length, letters = struct.unpack_from("<QI", data, at)
    compressed, uncompressed = struct.unpack_from("<QQ", data, at + 12 + letters)
    return ChunkIndex(
        message_start_time=start, message_end_time=end, chunk_start_offset=offset, chunk_length=length,
        message_index_offsets=dict(struct.iter_unpack("<HQ", data[_CHUNK_INDEX_HEAD.size : at])),
        message_index_length=index_length, compression=data[at + 12 : at + 12 + letters].decode(),
        compressed_size=compressed, uncompressed_size=uncompressed,
    )  # fmt: skip


def scan(file: IO[bytes], on_loss: Callable[[Loss], None]) -> Iterator[tuple[McapRecord, bool]]:
    """Every whole record of a file from its start to its index, those in chunks too, each with whether a checksum
    confirms it; losses go to ``on_loss``. Where the disk cannot read the file, it is lost from there on.
    """
    try:
        yield from _scan(file, on_loss)
    except OSError as error:
        at, size = file.tell(), file.seek(0, os.SEEK_END)
        on_loss(Loss(at, size - at, f"the disk cannot read it from byte {at} on: {why_not(error)}"))


def _scan(file: IO[bytes], on_loss: Callable[[Loss], None]) -> Iterator[tuple[McapRecord, bool]]:
    whole = True

    def lose(loss: Loss) -> None:
        nonlocal whole
        whole = False
        on_loss(loss)

    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        lose(Loss(0, len(MAGIC), "the first bytes are damaged"))
    position = len(MAGIC)
    search, before = Search(file, size), 0
    whole_end: bool | None = None
    places: list[int] = []
    readings, budget = _MOST_READINGS * size, Budget(_name(file), size)
    while position < size:
        opcode, length = _head_at(file, position)
        end = position + HEAD.size + length
        if end > size or not is_plausible(opcode, length, file, before):
            found = end if begins_a_record(file, end, size) else search.next(position + 1)
            if found is None:
                what = f"it was cut off: it ends at byte {size}, in the middle of a record"
                lose(Loss(position, size - position, what))
                return
            lose(Loss(position, found - position, f"{found - position} bytes make no sense"))
            position, before = found, 0
            continue
        if opcode in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA):
            places.append(position)
        lost: list[Loss] = []
        record = _record_at(file, position, lost.append, budget)
        if lost:
            # Its length may be wrong, and the bytes that it covers may hold whole chunks. Searching for them costs
            # another reading: a file that was made to waste time gets a few.
            readings -= length
            end = (search.next(position + 1, before=end) if readings > 0 else None) or end
            lose(replace(lost[0], length=end - position))
        elif isinstance(record, Chunk):
            yield from ((each, True) for each in broken_up(record, position, lose, budget))
        elif record is not None:
            yield record, False
        if opcode == Opcode.DATA_END:
            if whole_end is None:
                summary = read_summary(file)
                whole_end = summary is not None
                if summary is not None and whole and summary.is_index and summary.places != places:
                    lose(Loss(end, size - end, "its index is damaged: it names other places"))
            if whole_end:
                if whole:
                    _check_data(file, position, on_loss)
                return
            found = search.next(end)  # it may not have been the end
            lose(Loss(end, (found or size) - end, "its index is damaged or was cut off"))
            if found is None:
                return
            end = found
        position, before = end, opcode
    lose(Loss(size, 0, f"it was cut off: it ends at byte {size}, without an index"))


def _check_data(file: IO[bytes], end: int, on_loss: Callable[[Loss], None]) -> None:
    """Compare all bytes before the end of the data with the checksum that stands there, if there is one."""
    file.seek(end)
    (expected,) = struct.unpack("<I", file.read(HEAD.size + 4)[HEAD.size :])
    file.seek(0)
    found, left = 0, end if expected else 0
    while left and (data := file.read(min(left, _READ_BYTES))):
        found, left = zlib.crc32(data, found), left - len(data)
    if found != expected:
        on_loss(Loss(0, end, "its bytes are not those that were written: their checksum is another"))


def chunk_at(
    file: IO[bytes], index: ChunkIndex, on_loss: Callable[[Loss], None], budget: Budget
) -> Iterator[McapRecord]:
    """The records in a chunk that the summary names; none if it is damaged."""
    loss = _chunk_loss(index.chunk_start_offset, index.chunk_length, index)
    record = _named_record(file, Opcode.CHUNK, loss, on_loss, budget)
    if isinstance(record, Chunk):
        yield from broken_up(record, index.chunk_start_offset, on_loss, budget)


def record_at(
    file: IO[bytes], index: AttachmentIndex | MetadataIndex, on_loss: Callable[[Loss], None], budget: Budget
) -> McapRecord | None:
    """An attachment or metadata that the summary names; None, and a loss, if it is damaged."""
    kind = Opcode.ATTACHMENT if isinstance(index, AttachmentIndex) else Opcode.METADATA
    loss = Loss(index.offset, index.length, f"the {kind.name.lower()} {index.name!r} is damaged")
    return _named_record(file, kind, loss, on_loss, budget)


def _named_record(
    file: IO[bytes], kind: Opcode, loss: Loss, on_loss: Callable[[Loss], None], budget: Budget
) -> McapRecord | None:
    """The record that the summary names; None, and a loss, where it is damaged, another, or the disk cannot read it."""
    try:
        opcode, length = _head_at(file, loss.offset)
        if opcode == kind and length <= RECORD_BYTES:
            return _record_at(file, loss.offset, on_loss, budget)
    except OSError:
        pass
    on_loss(loss)
    return None


def broken_up(chunk: Chunk, offset: int, on_loss: Callable[[Loss], None], budget: Budget) -> Iterator[McapRecord]:
    """The records in a chunk, one by one; none if it is damaged."""
    try:
        data, cost = _decompressed(chunk, budget), 0
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("checksum")
        for opcode, at, length in _heads(data):
            cost += _COSTS.get(opcode, 8)
            if cost > budget.records:
                break
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                budget.take_description(length)
                _parsed(opcode, data[at : at + length])
            elif opcode == Opcode.MESSAGE and length < MESSAGE_HEAD.size:
                raise ValueError("a message without its times")
    except _DAMAGE:
        on_loss(_chunk_loss(offset, HEAD.size + len(chunk.data), chunk))
        return
    budget.take_records(cost)
    for opcode, at, length in _heads(data):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield _parsed(opcode, data[at : at + length])


def _heads(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, first byte and length of the content of each record of a chunk."""
    position = 0
    while position < len(data):
        opcode, length = HEAD.unpack_from(data, position)
        position += HEAD.size
        if length > len(data) - position:
            raise ValueError("a record that goes beyond its chunk")
        yield opcode, position, length
        position += length


def _parsed(opcode: int, content: bytes) -> McapRecord:
    """A record; raises one of `_DAMAGE` if its content is not of its kind and length."""
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
        return McapMessage(channel, log_time, content[MESSAGE_HEAD.size :], publish_time, sequence)
    stream = ReadDataStream(BytesIO(content))
    record = _PARSERS[opcode](stream)
    if stream.count != len(content):
        raise ValueError("size")
    return record


def _chunk_loss(offset: int, length: int, chunk: Chunk | ChunkIndex) -> Loss:
    return Loss(
        offset, length, f"the chunk at byte {offset} is damaged", chunk.message_start_time, chunk.message_end_time
    )


def _head_at(file: IO[bytes], position: int) -> tuple[int, int]:
    """Opcode and length of a record; 0 and 0 where the file ends within them."""
    file.seek(position)
    head = file.read(HEAD.size)
    return HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)


def _name(file: IO[bytes]) -> str:
    return str(getattr(file, "name", "the file"))


def _charge(budget: Budget, opcode: int, length: int) -> None:
    """Raise RecordingError where a file has more records, or longer ones, than is allowed."""
    budget.take_records(_COSTS.get(opcode, 8))
    if opcode in _PARSERS and opcode not in _LARGE:
        budget.take_description(length)


def _record_at(file: IO[bytes], position: int, on_loss: Callable[[Loss], None], budget: Budget) -> McapRecord | None:
    """The record at a position, whose length is known to be possible; None if it is damaged or of no interest."""
    opcode, length = _head_at(file, position)
    _charge(budget, opcode, length)
    if opcode not in _PARSERS and opcode != Opcode.MESSAGE:
        return None
    if opcode == Opcode.ATTACHMENT and length > ATTACHMENT_BYTES:
        raise exceeded(f"it holds an attachment of {length} bytes", ATTACHMENT_BYTES)
    content = file.read(length)
    try:
        record = _parsed(opcode, content)
        if opcode == Opcode.ATTACHMENT:
            (crc,) = struct.unpack("<I", content[-4:])
            if crc and crc != zlib.crc32(memoryview(content)[:-4]):
                raise ValueError("checksum")
    except _DAMAGE:
        kind = Opcode(opcode).name.lower().replace("_", " ")
        on_loss(Loss(position, HEAD.size + length, f"the {kind} at byte {position} is damaged"))
        return None
    return record


def _decompressed(chunk: Chunk, budget: Budget) -> bytes:
    """The content of a chunk. Its stated and its real size may differ: neither may fill the memory."""
    if chunk.uncompressed_size > CHUNK_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    budget.take_bytes(chunk.uncompressed_size)
    data = chunk.data
    if chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    elif chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(chunk.uncompressed_size + 1)
    elif chunk.compression:
        raise ValueError(f"the compression {chunk.compression} is not known")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk that is not of the size that it says")
    return data
