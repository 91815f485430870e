"""Recordings made from recordings: recovered, cut and merged ones, and side files.

Messages are copied as bytes; sources stay untouched.
"""

from __future__ import annotations

import heapq
import math
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from mcap.records import Schema
from mcap.well_known import MessageEncoding

from aolink.errors import RecordingError
from aolink.estimation import Estimate
from aolink.exporting.common import Progress, no_progress
from aolink.files import open_unfinished, writing
from aolink.recording import convert, schemas_pb2, topics
from aolink.recording.lead import Lead
from aolink.recording.mcap_file import AT_LEISURE, McapFile, schema_of
from aolink.recording.messages import RawMessage, in_time
from aolink.recording.reader import Recording
from aolink.recording.scan import Loss
from aolink.recording.writer import begin_recording

_ALIKE_NS = 2_000_000_000
"""Largest difference in log time at which equal messages in two files are one message."""


@dataclass(frozen=True)
class Edited:
    """The contents of a new recording, and the losses."""

    path: Path
    messages: int
    exposures: int
    losses: list[Loss]
    """Parts of the source that could not be read."""


class RecordingCopy:
    """A recording that is written message by message, with the attachments and metadata of the first source.

    Parameters
    ----------
    path:
        An empty file that is there already, as `aolink.files.writing` gives one. It is cut back to its last whole part
        if a ``with`` block ends before `finish`.
    notes:
        Facts about the session, instead of those of the source.
    attachments:
        Attachments by name; by default those of the source.
    """

    def __init__(
        self, source: Recording, path: Path, notes: dict[str, str], attachments: Mapping[str, bytes] | None = None
    ) -> None:
        self.messages = self.exposures = 0
        """Numbers of messages and of exposures that have been written."""
        self._foreign, self._encodings = source.schemas, source.encodings
        self._schemas: dict[str, Schema] = {}
        self._file = McapFile(path, AT_LEISURE, descriptor=open_unfinished(path))
        attachments = source.attachments if attachments is None else attachments
        begin_recording(self._file, source.rig, notes, source.start_ns, attachments)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.cut_back()  # this does nothing after `finish`

    def add(self, message: RawMessage) -> None:
        schema = self._schemas.get(message.schema) or self._schema(message.schema)
        self.messages += 1
        self.exposures += message.topic == topics.IMAGE
        encoding = self._encodings.get(message.topic, MessageEncoding.Protobuf)
        self._file.add(message.topic, schema, message.data, message.log_time_ns, self.messages, encoding)

    def _schema(self, name: str) -> Schema:
        """This aolink's schema of a message, or the source's where this aolink does not know the kind."""
        known = topics.SCHEMAS.get(name)
        schema = schema_of(known) if known is not None else self._foreign.get(name)
        self._schemas[name] = schema = schema or Schema(id=0, name=name, encoding="", data=b"")
        return schema

    def finish(self, losses: Sequence[Loss] = (), end: Mapping[str, str] | None = None) -> None:
        """Write the index, with ``end`` as the facts from the session's end."""
        damage = {"damage": "; ".join(loss.what for loss in losses[:20])} if losses else {}
        if facts := {**(end or {}), **damage}:
            self._file.add_metadata(topics.END_METADATA, facts)
        self._file.finish()


def side_file(recording: Recording, path: Path, notes: dict[str, str]) -> RecordingCopy:
    """A side file that is being written: the same estimates give the same bytes, except for the facts from its end.

    Parameters
    ----------
    recording:
        The recording that is estimated, with the rig that it is estimated with.
    path:
        An empty file that is there already, as `aolink.files.writing` gives one.
    notes:
        Facts about the estimates.
    """
    known = {key: value for key in ("session", "rig") if (value := recording.metadata.get(key)) is not None}
    facts = {"estimated_from": recording.path.name, topics.SIDE_OF: recording.digest}
    return RecordingCopy(recording, path, known | facts | notes, attachments={})


def recorded_estimate(estimate: Estimate, log_time_ns: int) -> RawMessage:
    """The message of an estimate."""
    return RawMessage.of(topics.estimate_topic(estimate.estimator), convert.estimate_message(estimate), log_time_ns)


def recover(source: Path, target: Path, *, overwrite: bool = False, progress: Progress = no_progress) -> Edited:
    """Copy the undamaged parts of a recording into a new one with an index.

    Raises
    ------
    RecordingError
        ``source`` is not a recording, or no part of it can be used; ``target`` exists and not ``overwrite``, or
        cannot be written.
    """
    recording = Recording(source, check=True)
    if not recording.counts:
        raise RecordingError(f"{source} holds no whole message: there is nothing to recover")
    notes = recording.metadata | {"recovered_from": source.name}
    messages = (raw for raw, _ in recording.sound_messages())
    return _copied([recording], target, messages, notes, overwrite, progress)


def cut(
    source: Path, target: Path, start_s: float, end_s: float, *, overwrite: bool = False,
    progress: Progress = no_progress,
) -> Edited:  # fmt: skip
    """Copy the exposures that were received between two times, s from the recording's start, with all messages that
    they need.

    The copy also has the earlier commands that reach into the first exposure, and the reports on the last one.

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
    duration_s = (recording.end_ns - recording.start_ns) / 1e9
    nothing = f"{source} has no exposure {between(start_s, end_s)}: it is {duration_s:.3g} s long"
    return _copied([recording], target, _between(recording, low, high), notes, overwrite, progress, nothing=nothing)


def between(start_s: float, end_s: float) -> str:
    """A span of time in words."""
    return f"between {start_s:g} s and {'the end' if end_s == math.inf else f'{end_s:g} s'}"


def merge(
    sources: Sequence[Path], target: Path, *, overwrite: bool = False, progress: Progress = no_progress
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
        if _session_of(other) != _session_of(first):
            raise RecordingError(
                f"{other.path} is not of the same session as {first.path}: only parts of one session can be merged"
            )
    notes = _begun(first) | {"merged_from": " ".join(each.path.name for each in recordings)}
    end = recordings[-1].end_metadata
    return _copied(recordings, target, _joined(recordings), notes, overwrite, progress, end=end)


def _begun(recording: Recording) -> dict[str, str]:
    """Facts from the session's start, without the number of the part."""
    later = recording.end_metadata.keys() | {topics.PART, topics.PART_OF}
    return {name: value for name, value in recording.metadata.items() if name not in later}


def _session_of(recording: Recording) -> tuple[str, str]:
    return recording.rig.digest, recording.metadata.get("session", "")


def _copied(
    recordings: Sequence[Recording], target: Path, messages: Iterator[RawMessage], notes: dict[str, str],
    overwrite: bool, progress: Progress, *, end: Mapping[str, str] | None = None, nothing: str = "",
) -> Edited:  # fmt: skip
    """Write messages of these recordings; ``nothing`` is the error's text where there is no exposure among them."""
    first, sources = recordings[0], [path for each in recordings for path in each.files]
    with (
        writing(target, overwrite=overwrite, sources=sources, error=RecordingError) as partial,
        RecordingCopy(first, partial, notes) as copy,
    ):
        for message in messages:
            copy.add(message)
            progress(copy.exposures)
        if nothing and not copy.exposures:
            raise RecordingError(nothing)
        losses = [loss for each in recordings for loss in each.losses]
        copy.finish(losses, end)
    return Edited(target, copy.messages, copy.exposures, losses)


def _between(recording: Recording, low: int, high: int) -> Iterator[RawMessage]:
    lead, frames = Lead(), set[int]()
    wanted: set[str] = set()  # pictures that belong to an exposure between the two
    last_step = -1
    message: Any  # it has what its row of the table says
    for raw, message in recording.sound_messages():
        row = topics.find(raw.topic, message)
        inside = low <= raw.log_time_ns < high
        if raw.topic in topics.PICTURES:
            among = inside if raw.topic == topics.EXPOSURE else getattr(message, "frame_id", None) in frames
            (wanted.update if among else wanted.difference_update)(topics.PICTURES[raw.topic])
        if raw.topic == topics.EXPOSURE and message is not None:
            if inside:
                if not frames:
                    yield from (RawMessage.of(*each) for each in lead.messages())
                frames.add(message.frame_id)
                last_step = message.last_step
                yield raw
        elif row.after:
            if raw.topic in wanted:
                yield raw
        elif row.belongs_to == "steps":
            # Also after the end, until the last exposure is complete.
            if frames and (inside or message.first_step <= last_step):
                yield raw
        elif row.belongs_to == "exposure":
            if message.frame_id in frames:
                yield raw
        elif inside and frames:
            yield raw
        if message is not None and not frames:
            lead.add(raw.topic, message, raw.log_time_ns, raw.sequence)


def _joined(recordings: Sequence[Recording]) -> Iterator[RawMessage]:
    recent: OrderedDict[tuple[str, int, bytes], int] = OrderedDict()  # its first key is found at once, unlike a dict's
    frames: dict[int, int] = {}
    sound = ((raw for raw, _ in each.sound_messages()) for each in recordings)
    for key, raw in heapq.merge(*map(in_time, sound), key=lambda each: each[0]):
        name = (raw.topic, raw.log_time_ns, raw.data)
        if name in recent:
            continue
        while recent and recent[next(iter(recent))] < key - _ALIKE_NS:
            recent.popitem(last=False)
        recent[name] = key
        if raw.topic == topics.EXPOSURE and raw.schema == schemas_pb2.ExposureInfo.DESCRIPTOR.full_name:
            frame_id = schemas_pb2.ExposureInfo.FromString(raw.data).frame_id
            if frame_id in frames:
                raise RecordingError(
                    f"frame {frame_id} is in two of the recordings, but not the same: nothing to merge"
                )
            frames[frame_id] = key
        yield raw
