"""The messages of a recording as bytes, found by the file's index or, where it was cut off or damaged, by a scan."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import Message
from mcap.records import Attachment, Channel, ChunkIndex, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage

from aolink.errors import RecordingError
from aolink.limits import ATTACHMENT_BYTES, Budget, exceeded
from aolink.recording import topics
from aolink.recording.mcap_file import unsealed
from aolink.recording.scan import Loss, Summary, chunk_at, open_recording, read_summary, record_at, scan

END_OF_TIME = 1 << 64
"""After every log time, ns."""


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A message of a recording."""

    topic: str
    log_time_ns: int
    """Log time: the host's clock when the message came, ns."""
    sequence: int
    """Order in the file, from 1."""
    message: Message


class RawMessage(NamedTuple):
    """A message of a recording as bytes."""

    topic: str
    schema: str
    """Full name of its type."""
    log_time_ns: int
    sequence: int
    data: bytes

    @classmethod
    def of(cls, topic: str, message: Message, log_time_ns: int, sequence: int = 0) -> RawMessage:
        """The bytes of a message as it is written: the same fields always give the same bytes."""
        data = message.SerializeToString(deterministic=True)
        return cls(topic, message.DESCRIPTOR.full_name, log_time_ns, sequence, data)


class RecordedMessages:
    """The messages of a file, with its attachments and metadata: surveyed at once, and read when they are wanted."""

    def __init__(self, path: str | Path, *, check: bool) -> None:
        self.path = Path(path)
        self.metadata: dict[str, str] = {}
        """Facts about the session, from its start and its end."""
        self.end_metadata: dict[str, str] = {}
        """Facts from the session's end alone."""
        self.attachments: dict[str, bytes] = {}
        """Attachments by name, among them the rig file and the exposure basis."""
        self.counts: dict[str, int] = {}
        """Number of messages by topic."""
        self.start_ns = self.end_ns = 0
        """Log times of the first and of the last message."""
        self.lost: dict[int, Loss] = {}
        """The parts of the file that could not be read, by their place; negative numbers stand for no place."""
        self.channels: dict[int, tuple[str, str]] = {}
        """Topic and name of the schema, by the channel's id."""
        self.schemas: dict[str, Schema] = {}
        """Schemas by name, as they are in the file."""
        self.encodings: dict[str, str] = {}
        """Encoding of the messages by topic, where the file states it."""
        self.chunk_index: list[ChunkIndex] | None = None
        """The index of chunks; None where the file is scanned."""
        self.left_out: frozenset[str] = frozenset()
        """Topics that are read from side files instead."""
        self._second_rig_text: str | None = None
        self._attached_bytes = 0
        self.rig_text = self._survey(check=check)
        """The text of the rig file; None where the file has none."""

    @property
    def losses(self) -> list[Loss]:
        """The parts that could not be read, so far as the file has been read, in the order of the file."""
        return [self.lost[offset] for offset in sorted(self.lost)]

    @property
    def damage(self) -> str:
        """The reason why the file cannot be read whole, in words; empty where it can."""
        losses = self.losses
        more = f" and {count} more" if (count := sum(each.count for each in losses[1:])) else ""
        return f"{losses[0].what}{more}" if losses else ""

    @property
    def complete(self) -> bool:
        """Whether the file ends as a recording should."""
        return not self.damage

    @cached_property
    def digest(self) -> str:
        """The name of the recording in side files: SHA-256 of its bytes. An index would be cheaper to read, but two
        recordings may have the same one."""
        found = hashlib.sha256()
        with open_recording(self.path) as file, suppress(OSError):  # what the disk cannot read is damage
            hashlib.file_digest(file, lambda: found)
        return found.hexdigest()

    @property
    def side_of(self) -> str:
        """The `digest` of the recording that this is a side file of; empty where it is a recording of its own."""
        return self.metadata.get(topics.SIDE_OF, "")

    @cached_property
    def size(self) -> int:
        """Bytes of the file."""
        return self.path.stat().st_size

    def own_messages(
        self, wanted: Collection[str], low: int = 0, high: int = END_OF_TIME, chunks: slice = slice(None)
    ) -> Iterator[RawMessage]:
        """The messages of the file itself, as bytes: those of these topics (of all, if none is named) whose log time is
        from ``low`` to below ``high``; with an index, only those in these of its chunks."""
        channels = {
            k: names
            for k, names in self.channels.items()
            if (not wanted or names[0] in wanted) and names[0] not in self.left_out
        }
        for record in self._records(channels, low, high, chunks):
            if isinstance(record, McapMessage) and record.channel_id in channels and low <= record.log_time < high:
                topic, schema = channels[record.channel_id]
                yield RawMessage(topic, schema, record.log_time, record.sequence, record.data)

    def _survey(self, *, check: bool) -> str | None:
        """Find out what is in the file: from its index, or else by a scan. Gives the text of the rig file."""
        with open_recording(self.path) as file:
            summary = None if check else read_summary(file)
        held: dict[int, int] = {}
        """Number of messages by the channel's id."""
        if summary is not None and summary.is_index and (known := summary.statistics) is not None:
            self.chunk_index, held = summary.chunks, dict(sorted(known.channel_message_counts.items()))
            self.start_ns, self.end_ns = known.message_start_time, known.message_end_time
            records = self._summarised(summary)
        else:
            records = self._scanned()
        ids: dict[int, str] = {}
        noted: list[Metadata] = []
        for record, sure in records:
            if isinstance(record, McapMessage):
                self.start_ns = min(self.start_ns, record.log_time) if held else record.log_time
                self.end_ns = max(self.end_ns, record.log_time)
                held[record.channel_id] = held.get(record.channel_id, 0) + 1
            elif isinstance(record, Schema):
                if sure or record.id not in ids:
                    ids[record.id] = record.name
                    self.schemas[record.name] = record
            elif isinstance(record, Channel):
                before = self.channels.get(record.id)
                if sure or before is None:  # its schema may have been in a chunk that is lost
                    kind = ids.get(record.schema_id, before[1] if before else "")
                    self.channels[record.id] = (record.topic, kind)
                    self.encodings[record.topic] = record.message_encoding
            elif isinstance(record, Attachment):
                self._attach(record)
            elif isinstance(record, Metadata):
                noted.append(record)
        self.note_metadata(noted)
        for channel_id, number in held.items():
            if channel_id in self.channels:
                topic, _ = self.channels[channel_id]
                self.counts[topic] = self.counts.get(topic, 0) + number
        attached = self.attachments.get(topics.RIG_ATTACHMENT)
        return self._second_rig_text if attached is None else attached.decode(errors="replace")

    def _summarised(self, summary: Summary) -> Iterator[tuple[McapRecord, bool]]:
        """Read the attachments and metadata that the index names, and check that they are undamaged."""
        for record in (*summary.schemas.values(), *summary.channels.values()):
            yield record, True
        others, budget = sorted(summary.others, key=lambda each: each.offset), Budget(str(self.path), self.size)
        with open_recording(self.path) as file:
            for each in others:
                if (found := record_at(file, each, self.lose, budget)) is not None:
                    yield found, True

    def _attach(self, record: Attachment) -> None:
        self.attachments[record.name] = record.data
        self._attached_bytes += len(record.data)
        if self._attached_bytes > ATTACHMENT_BYTES:
            raise exceeded(f"{self.path} holds attachments of {self._attached_bytes} bytes", ATTACHMENT_BYTES)

    def note_metadata(self, records: Sequence[Metadata]) -> None:
        """Keep the facts in the file's metadata."""
        for name, values in unsealed(records):
            if values is None:
                self.lost[-1 - len(self.lost)] = Loss(0, 0, f"the metadata {name!r} is damaged")
            elif name in (topics.SESSION_METADATA, topics.END_METADATA):
                self.metadata.update(values)
                if name == topics.END_METADATA:
                    self.end_metadata.update(values)
            elif name == topics.RIG_METADATA:
                self._second_rig_text = values.get("toml", self._second_rig_text)
            elif name == topics.CHANNEL_METADATA and values.get("id", "").isdigit():
                number = int(values["id"])
                # The chunk that names the channel, or the one that holds its schema, may be lost.
                if not self.channels.get(number, ("", ""))[1]:
                    self.channels[number] = (values.get("topic", ""), values.get("schema", ""))

    def _records(self, channels: Collection[int], low: int, high: int, chunks: slice) -> Iterator[McapRecord]:
        """Records in the order of the file, at least all messages of some channels between two log times."""
        if self.chunk_index is None:
            for record, _ in self._scanned():
                yield record
            return
        wanted = [
            index
            for index in self.chunk_index[chunks]
            if not (index.message_end_time < low or index.message_start_time >= high)
            and (not (held := index.message_index_offsets) or not held.keys().isdisjoint(channels))
        ]
        budget = Budget(str(self.path), self.size)
        with open_recording(self.path) as file:
            for index in wanted:
                yield from chunk_at(file, index, self.lose, budget)

    def _scanned(self) -> Iterator[tuple[McapRecord, bool]]:
        with open_recording(self.path) as file:
            yield from scan(file, self.lose)

    def lose(self, loss: Loss) -> None:
        """Add to `losses`; of several at one place, the first counts."""
        self.lost.setdefault(loss.offset, loss)


def first_facts(path: Path) -> dict[str, str]:
    """The facts from a session's start; none where a file is no recording, or they are damaged."""
    try:
        with open_recording(path) as file:
            for record, in_chunk in scan(file, lambda loss: None):
                if in_chunk:
                    break  # they come before all messages
                if isinstance(record, Metadata) and record.name == topics.SESSION_METADATA:
                    return next(unsealed([record]))[1] or {}
    except RecordingError:
        pass
    return {}


def in_time(messages: Iterator[RawMessage]) -> Iterator[tuple[int, RawMessage]]:
    """Messages with a time that never goes back, so that their order stays."""
    latest = 0
    for raw in messages:
        latest = max(latest, raw.log_time_ns)
        yield latest, raw
