"""Reads a recording back: messages, exposures, estimates."""

from __future__ import annotations

import os
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import lz4.frame
import zstandard
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError, Message
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from aolink.assembly import Assembler
from aolink.errors import RecordingError, RigError
from aolink.estimation import Estimate, ExposureModel
from aolink.exposure import Exposure, Truth
from aolink.recording import convert, schemas_pb2, topics
from aolink.rig import Rig, parse_rig
from aolink.wire import messages_pb2 as wire

_MAX_RECORD = 256 << 20
"""Bytes; a larger record is damage, not data."""


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A message of a recording."""

    topic: str
    log_time_ns: int
    """Host clock."""
    sequence: int
    """Order in the file, from 1."""
    message: Message


class Recording:
    """A recording on disk. It is scanned from its start, so a file that was cut off gives what is whole.

    Raises
    ------
    RecordingError
        The file cannot be read, or is not a recording of aolink.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.metadata: dict[str, str] = {}
        """Facts about the session, from its start and its end."""
        self.counts: dict[str, int] = {}
        """Messages by topic."""
        self.damage = ""
        """Why the file cannot be read to its end, in words; empty where it can."""
        self.start_ns = self.end_ns = 0
        """Log times of the first and of the last message."""
        rig_text = self._survey()
        if rig_text is None:
            raise RecordingError(f"{self.path} is an MCAP file but not a recording of aolink: it holds no rig file")
        try:
            self.rig: Rig = parse_rig(rig_text)
        except RigError as error:
            raise RecordingError(f"{self.path} holds a rig file that this aolink does not take: {error}") from None

    @property
    def complete(self) -> bool:
        """Whether the file ends as a recording should."""
        return not self.damage

    @property
    def estimators(self) -> list[str]:
        """Names of the estimators whose results are in the file."""
        return [name.removeprefix(topics.ESTIMATE) for name in self.counts if name.startswith(topics.ESTIMATE)]

    @cached_property
    def model(self) -> ExposureModel:
        """The exposure model that expands the recorded coefficients."""
        return ExposureModel(self.rig.plant, self.rig.timing.exposure_steps)

    def messages(self, *wanted: str) -> Iterator[RecordedMessage]:
        """The messages of some topics (of all, if none is named) in the order in which they were recorded."""
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, type[Message]]] = {}
        for record in self._records():
            if isinstance(record, McapMessage):
                if record.channel_id not in channels:
                    continue
                topic, kind = channels[record.channel_id]
                try:
                    message = kind.FromString(record.data)
                except DecodeError:
                    raise RecordingError(f"{self.path}: a message on {topic} is damaged") from None
                yield RecordedMessage(topic, record.log_time, record.sequence, message)
            elif isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                known = topics.SCHEMAS.get(schemas.get(record.schema_id, ""))
                if known is not None and (not wanted or record.topic in wanted):
                    channels[record.id] = (record.topic, known)

    def assembled(self, *others: str) -> Iterator[tuple[RecordedMessage | None, list[Exposure]]]:
        """Messages with the exposures that each completes, as they were in the session.

        Of ``others`` all topics if none is named, besides those that make exposures. Exposures that were
        still incomplete when the recording ended come last, with None.
        """
        assembler = Assembler(self.rig)
        info: schemas_pb2.ExposureInfo | None = None
        for recorded in self.messages(*({*others, *_ASSEMBLED} if others else ())):
            message, exposures = recorded.message, list[Exposure]()
            if isinstance(message, wire.CommandBlock):
                assembler.add_command(message)
            elif isinstance(message, wire.Applied):
                exposures = assembler.add_applied(message)
            elif isinstance(message, schemas_pb2.ExposureInfo):
                info = message
            elif recorded.topic == topics.IMAGE and isinstance(message, RawImage) and info is not None:
                exposures = assembler.add_frame(convert.frame_from_messages(info, message))
                info = None
            yield recorded, exposures
        yield None, assembler.flush()

    def exposures(self) -> Iterator[Exposure]:
        """The exposures in order, with their truth where the file has it."""
        truths: dict[int, Truth] = {}
        waiting: deque[Exposure] = deque()
        for recorded, exposures in self.assembled(topics.TRUTH):
            if recorded is not None and isinstance(recorded.message, wire.Truth):
                truths[recorded.message.frame_id] = convert.truth_from_message(recorded.message)
            waiting.extend(exposures)
            # The truth may come after its exposure, but not after the next one.
            while waiting and (waiting[0].frame_id in truths or len(waiting) > 1):
                exposure = waiting.popleft()
                yield replace(exposure, truth=truths.pop(exposure.frame_id, None))
        for exposure in waiting:
            yield replace(exposure, truth=truths.get(exposure.frame_id))

    def estimates(self, name: str) -> list[Estimate]:
        """The estimates that are in the file under a name, in order. Raises RecordingError if there are none."""
        topic = topics.estimate_topic(name)
        if topic not in self.counts:
            known = ", ".join(self.estimators) or "none"
            raise RecordingError(
                f"{self.path} holds no estimates of {name} (it has: {known}): `aolink estimate` makes them"
            )
        latest: dict[int, Exposure] = {}
        messages: list[schemas_pb2.Estimate] = []
        for recorded, exposures in self.assembled(topic):
            if recorded is not None and isinstance(recorded.message, schemas_pb2.Estimate):
                messages.append(recorded.message)
            latest.update((exposure.frame_id, exposure) for exposure in exposures)
        return [
            convert.estimate_from_message(message, self.model, latest[message.frame_id])
            for message in messages
            if message.frame_id in latest
        ]

    def _survey(self) -> str | None:
        """Scan the file once: what is in it. Gives the text of the rig file."""
        rig_text = None
        names: dict[int, str] = {}
        for record in self._records():
            if isinstance(record, McapMessage):
                topic = names.get(record.channel_id, "")
                self.counts[topic] = self.counts.get(topic, 0) + 1
                self.start_ns = min(self.start_ns or record.log_time, record.log_time)
                self.end_ns = max(self.end_ns, record.log_time)
            elif isinstance(record, Channel):
                names[record.id] = record.topic
            elif isinstance(record, Attachment) and record.name == topics.RIG_ATTACHMENT:
                rig_text = record.data.decode(errors="replace")
            elif isinstance(record, Metadata) and record.name in (topics.SESSION_METADATA, topics.END_METADATA):
                self.metadata.update(record.metadata)
        return rig_text

    def _records(self) -> Iterator[McapRecord]:
        """Every whole record; stops where the file is cut off or damaged."""
        try:
            with self.path.open("rb") as file:
                try:
                    for record in StreamReader(file, emit_chunks=True, record_size_limit=_MAX_RECORD).records:
                        if isinstance(record, Chunk):
                            yield from breakup_chunk(_decompressed(record), validate_crc=True)
                        else:
                            yield record
                except InvalidMagic:
                    if file.tell() <= _MAGIC_BYTES:
                        raise RecordingError(f"{self.path} is not a recording: it is not an MCAP file") from None
                    self.damage = "it was cut off at its very end"
                except EndOfFile:
                    if file.tell() < _MAGIC_BYTES:
                        raise RecordingError(f"{self.path} is empty or too short to be a recording") from None
                    self.damage = f"it was cut off: it ends at byte {file.tell()}, in the middle of a record"
                except _DAMAGE as error:
                    self.damage = f"it is damaged before byte {file.tell()} ({error}): what comes after is not read"
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {os.strerror(error.errno or 0).lower()}") from None


_ASSEMBLED = (topics.COMMAND, topics.APPLIED, topics.EXPOSURE, topics.IMAGE)
_MAGIC_BYTES = 8
# What the mcap library and the decompressors raise on a file that is cut off or damaged.
_DAMAGE = (
    McapError,
    CRCValidationError,
    struct.error,
    RuntimeError,
    ValueError,
    EOFError,
    KeyError,
    zstandard.ZstdError,
)


def _decompressed(chunk: Chunk) -> Chunk:
    """A chunk without compression. It may say one size and hold another: neither may fill the memory."""
    if chunk.uncompressed_size > _MAX_RECORD:
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
