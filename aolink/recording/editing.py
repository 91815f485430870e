"""Recordings made from recordings: recovered, cut and merged ones, and side files.

Messages are copied as bytes; sources stay untouched.
"""

from __future__ import annotations

import heapq
import math
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
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
        try:
            begin_recording(self._file, source.rig, notes, source.start_ns, attachments)
        except BaseException:
            self._file.cut_back()
            raise

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
    return _copied([recording], target, _sound(recording), notes, overwrite, progress)


def cut(
    source: Path, target: Path, start_s: float, end_s: float, *, overwrite: bool = False,
    progress: Progress = no_progress,
) -> Edited:  # fmt: skip
    """Copy what was recorded between two times, s from the recording's start, with all that its exposures need.

    Each exposure that was received between the two is there with its pictures and estimates, and no other; so are the
    earlier commands that reach into the first one, and the reports on the last one.

    Raises
    ------
    RecordingError
        As `recover`; or there is no exposure between the two times.
    """
    if not -1e9 < start_s < end_s:
        raise RecordingError(f"nothing is {between(start_s, end_s)}: the end must be after the start")
    recording = Recording(source)
    low, high = (recording.start_ns + round(t * 1e9) for t in (min(start_s, 1e11), min(end_s, 1e11)))
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
    """Join the parts of one session, in any order. What several parts hold is written once; equal messages within one
    are several messages.

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
        first.schemas = other.schemas | first.schemas
        first.encodings = other.encodings | first.encodings
        first.attachments = other.attachments | first.attachments
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
    lead, begun, last_step = Lead(), False, -1
    frames: dict[int, bool] = {}  # whether it is between the two; where it was lost, each message counts by itself
    wanted: dict[str, bool] = {}  # the same of the pictures that come next
    message: Any  # it has what its row of the table says
    for raw, message in recording.sound_messages():
        row, chosen = topics.find(raw.topic, message), low <= raw.log_time_ns < high
        if chosen and not begun:
            begun = True
            yield from (RawMessage.of(*each) for each in lead.messages())
        if row.name == topics.EXPOSURE:
            frames[message.frame_id] = chosen
            last_step = message.last_step if chosen else last_step
        elif row.after:
            chosen = wanted.get(raw.topic, chosen)
        elif row.belongs_to == "exposure":
            chosen = frames.get(message.frame_id, chosen)
        elif row.belongs_to == "steps":
            # Also after the end, until the last exposure is complete.
            chosen = begun and (raw.log_time_ns < high or message.first_step <= last_step)
        wanted.update(dict.fromkeys(topics.PICTURES.get(raw.topic, ()), chosen))
        if chosen:
            yield raw
        if message is not None and not begun:
            lead.add(raw.topic, message, raw.log_time_ns, raw.sequence)


def _joined(recordings: Sequence[Recording]) -> Iterator[RawMessage]:
    """A message that several recordings hold is written as often as that one holds it that has it most often."""
    # Its first key is found at once, unlike a dict's. The time of each message, and how often each recording had it.
    recent: OrderedDict[tuple[str, int, bytes], tuple[int, list[int]]] = OrderedDict()
    frames: dict[int, tuple[int, bytes]] = {}
    sound = (zip(repeat(k), in_time(_sound(each))) for k, each in enumerate(recordings))
    for source, (key, raw) in heapq.merge(*sound, key=lambda each: each[1][0]):
        while recent and recent[next(iter(recent))][0] < key - _ALIKE_NS:
            recent.popitem(last=False)
        name = (raw.topic, raw.log_time_ns, raw.data)
        _, held = recent.pop(name, (0, [0] * len(recordings)))
        recent[name] = key, held
        written = max(held)
        held[source] += 1
        if held[source] <= written:
            continue
        if raw.topic == topics.EXPOSURE and raw.schema == schemas_pb2.ExposureInfo.DESCRIPTOR.full_name:
            frame_id = schemas_pb2.ExposureInfo.FromString(raw.data).frame_id
            other, data = frames.setdefault(frame_id, (source, raw.data))
            if other != source and data != raw.data:
                raise RecordingError(
                    f"frame {frame_id} is in two of the recordings, but not the same: nothing to merge"
                )
        yield raw


def _sound(recording: Recording) -> Iterator[RawMessage]:
    return (raw for raw, _ in recording.sound_messages())
