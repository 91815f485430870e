"""Recordings made from recordings: salvaged, cut, merged. Messages are copied as bytes; sources stay untouched."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from google.protobuf.message import DecodeError, Message
from mcap.records import Schema
from mcap.well_known import MessageEncoding

from aolink.errors import RecordingError
from aolink.files import open_unfinished, writing
from aolink.recording import topics
from aolink.recording.lead import Lead
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import RawMessage, Recording, in_time
from aolink.recording.scan import Loss
from aolink.recording.writer import begin_recording
from aolink.wire import messages_pb2 as wire

_ALIKE_NS = 2_000_000_000
"""Largest difference in log time at which equal messages in two files are one message."""


@dataclass(slots=True)
class Edited:
    """The contents of a new recording, and what was lost."""

    path: Path
    messages: int = 0
    exposures: int = 0
    losses: list[Loss] = field(default_factory=list)
    """Parts of the source that could not be read."""


class RecordingCopy:
    """A recording that is written message by message, with what the first source has besides its messages.

    Parameters
    ----------
    path:
        An empty file that is there already, as `aolink.files.writing` gives one.
    notes:
        Facts about the session in the place of those that the source has.
    """

    def __init__(self, source: Recording, path: Path, notes: dict[str, str]) -> None:
        self.result = Edited(path)
        self._foreign, self._encodings = source.schemas, source.encodings
        self._schemas: dict[str, Schema] = {}
        self._file = McapFile(path, WriteOptions(), descriptor=open_unfinished(path))
        begin_recording(self._file, source.rig, notes, source.start_ns, source.attachments)

    def add(self, message: RawMessage) -> None:
        schema = self._schemas.get(message.schema) or self._schema(message.schema)
        self.result.messages += 1
        self.result.exposures += message.topic == topics.EXPOSURE
        encoding = self._encodings.get(message.topic, MessageEncoding.Protobuf)
        self._file.add(message.topic, schema, message.data, message.log_time_ns, self.result.messages, encoding)

    def _schema(self, name: str) -> Schema:
        """That of this aolink, or of a kind that it does not know the source's."""
        known = topics.SCHEMAS.get(name)
        schema = schema_of(known) if known is not None else self._foreign.get(name)
        self._schemas[name] = schema = schema or Schema(id=0, name=name, encoding="", data=b"")
        return schema

    def finish(self, losses: list[Loss], end: dict[str, str] | None = None) -> Edited:
        """Write the index, and ``end`` as facts from the session's end."""
        self.result.losses = losses
        damage = {"damage": "; ".join(loss.what for loss in losses[:20])} if losses else {}
        if end or damage:
            self._file.add_metadata(topics.END_METADATA, (end or {}) | damage)
        self._file.finish()
        return self.result

    def give_up(self) -> None:
        """Close the file as it is."""
        self._file.cut_back()


def recover(
    source: Path, target: Path, *, overwrite: bool = False, progress: Callable[[int], None] = lambda exposures: None
) -> Edited:
    """Copy the undamaged parts of a recording into a new one with an index.

    Raises
    ------
    RecordingError
        ``source`` is no recording, or nothing of it can be used; ``target`` exists and not ``overwrite``, or
        cannot be written.
    """
    recording = Recording(source, check=True)
    if not recording.counts:
        raise RecordingError(f"{source} holds no whole message: there is nothing to recover")
    notes = recording.metadata | {"recovered_from": source.name}
    with writing(target, overwrite=overwrite, sources=[source], error=RecordingError) as partial:
        result = _copied(recording, partial, recording.raw_messages(), notes, None, progress)
    result.path = target
    return result


def cut(
    source: Path,
    target: Path,
    start_s: float,
    end_s: float,
    *,
    overwrite: bool = False,
    progress: Callable[[int], None] = lambda exposures: None,
) -> Edited:
    """Copy the exposures that were received between two times, s from the recording's start, with all they need.

    The commands that were given before and reach into the first exposure come along, and the reports on the last one.

    Raises
    ------
    RecordingError
        As `recover`; or there is no exposure between the two times.
    """
    if not -1e9 < start_s < end_s:
        raise RecordingError(f"nothing is {between(start_s, end_s)}: the end must be after the start")
    recording = Recording(source)
    low, high = (recording.start_ns + round(t * 1e9) for t in (min(start_s, 1e9), min(end_s, 1e9)))
    notes = _begun(recording) | {"cut_from": source.name, "cut": f"{start_s:g} s to {end_s:g} s"}
    with writing(target, overwrite=overwrite, sources=[source], error=RecordingError) as partial:
        result = _copied(recording, partial, _between(recording, low, high), notes, None, progress)
        if not result.exposures:
            duration_s = (recording.end_ns - recording.start_ns) / 1e9
            raise RecordingError(f"{source} has no exposure {between(start_s, end_s)}: it is {duration_s:.3g} s long")
    result.path = target
    return result


def between(start_s: float, end_s: float) -> str:
    """A span of time in words."""
    return f"between {start_s:g} s and {'the end' if end_s == math.inf else f'{end_s:g} s'}"


def merge(
    sources: Sequence[Path],
    target: Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int], None] = lambda exposures: None,
) -> Edited:
    """Join the parts of one session, in any order. Messages that are in several parts are written once.

    Raises
    ------
    RecordingError
        As `recover`; or the files are not of one session.
    """
    if len(sources) < 2:
        raise RecordingError("one recording is nothing to merge: give two or more")
    recordings = sorted((Recording(source) for source in sources), key=lambda each: each.start_ns)
    first = recordings[0]
    for other in recordings[1:]:
        if _identity(other) != _identity(first):
            raise RecordingError(
                f"{other.path} is not of the same session as {first.path}: only parts of one session can be merged"
            )
    notes = _begun(first) | {"merged_from": " ".join(each.path.name for each in recordings)}
    with writing(target, overwrite=overwrite, sources=sources, error=RecordingError) as partial:
        result = _copied(first, partial, _joined(recordings), notes, recordings[-1].end_metadata, progress)
    result.losses = [loss for each in recordings for loss in each.losses]
    result.path = target
    return result


def _begun(recording: Recording) -> dict[str, str]:
    """Facts from the session's start, without the number of the part."""
    later = recording.end_metadata.keys() | {"part"}
    return {name: value for name, value in recording.metadata.items() if name not in later}


def _identity(recording: Recording) -> tuple[str, str]:
    return recording.rig.digest, recording.metadata.get("session", "")


def _copied(
    recording: Recording,
    path: Path,
    messages: Iterator[RawMessage],
    notes: dict[str, str],
    end: dict[str, str] | None,
    progress: Callable[[int], None],
) -> Edited:
    copy = RecordingCopy(recording, path, notes)
    try:
        for message in messages:
            copy.add(message)
            progress(copy.result.exposures)
        return copy.finish(recording.losses, end)
    except BaseException:
        copy.give_up()
        raise


def _decoded(message: RawMessage) -> Message | None:
    kind = topics.SCHEMAS.get(message.schema)
    try:
        return kind.FromString(message.data) if kind else None
    except DecodeError:
        raise RecordingError(f"a message on {message.topic} is damaged: `aolink recover` leaves it out") from None


def _between(recording: Recording, low: int, high: int) -> Iterator[RawMessage]:
    lead, frames = Lead(), set[int]()
    wanted: set[str] = set()  # pictures that belong to an exposure between the two
    last_step = -1
    for raw in recording.raw_messages():
        message = _decoded(raw)
        row = topics.find(raw.topic, message)
        inside = low <= raw.log_time_ns < high
        if raw.topic in topics.PICTURES:
            among = inside if raw.topic == topics.EXPOSURE else getattr(message, "frame_id", None) in frames
            (wanted.update if among else wanted.difference_update)(topics.PICTURES[raw.topic])
        if raw.topic == topics.EXPOSURE and message is not None:
            if inside:
                if not frames:
                    yield from _raw(lead)
                frames.add(message.frame_id)  # type: ignore[attr-defined]
                last_step = message.last_step  # type: ignore[attr-defined]
                yield raw
        elif row.after:
            if raw.topic in wanted:
                yield raw
        elif isinstance(message, wire.CommandBlock | wire.Applied):
            # Also after the end, until all is known of the last exposure.
            if frames and (inside or message.first_step <= last_step):
                yield raw
        elif row.belongs_to == "exposure":
            if message.frame_id in frames:  # type: ignore[union-attr] # as the table says
                yield raw
        elif inside and frames:
            yield raw
        if message is not None and not frames:
            lead.add(raw.topic, message, raw.log_time_ns, raw.sequence)


def _raw(lead: Lead) -> Iterator[RawMessage]:
    for topic, message, log_time_ns, sequence in lead.messages():
        data = message.SerializeToString(deterministic=True)
        yield RawMessage(topic, message.DESCRIPTOR.full_name, log_time_ns, sequence, data)


def _joined(recordings: Sequence[Recording]) -> Iterator[RawMessage]:
    recent: dict[tuple[str, int, bytes], int] = {}
    frames: dict[int, int] = {}
    for key, raw in heapq.merge(*(in_time(each.raw_messages()) for each in recordings), key=lambda each: each[0]):
        name = (raw.topic, raw.log_time_ns, raw.data)
        if name in recent:
            continue
        if len(recent) > 100 and recent[next(iter(recent))] < key - _ALIKE_NS:
            recent = {each: time for each, time in recent.items() if time >= key - _ALIKE_NS}
        recent[name] = key
        if raw.topic == topics.EXPOSURE and (message := _decoded(raw)) is not None:
            frame_id = message.frame_id  # type: ignore[attr-defined]
            if frame_id in frames:
                raise RecordingError(
                    f"frame {frame_id} is in two of the recordings, but not the same: nothing to merge"
                )
            frames[frame_id] = key
        yield raw
