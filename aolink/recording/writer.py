"""The writer of recordings: one or several MCAP files that need no other file.

The file work is done in a thread of its own, so that a slow disk does not reach the loop. The queue to it is bounded;
when the queue or the disk is full, the session gets an error: nothing is lost silently.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import numpy as np
from google.protobuf.message import Message
from mcap.records import Schema

from aolink import files
from aolink.errors import RecordingError
from aolink.estimation import exposure_model
from aolink.recording import topics
from aolink.recording.lead import Lead
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.messages import first_facts
from aolink.rig import Rig
from aolink.timeouts import TIMEOUTS

_QUEUE_BYTES = 256 << 20
"""Most bytes that may wait for the disk."""
_POLL_S = 0.005
"""Time between two checks of the queue, s: waking the thread for each message would cost more than the writing."""
_LOOK_S = 1.0
"""Time between two comparisons of the open file with its path, s."""
_LOOK_BYTES = 16 << 10
"""Bytes that go to the file between two readings of the clock, by which the next synchronisation is noticed."""
_MESSAGE_BYTES = 64
"""Least bytes of a message in the queue besides its data."""
_LARGEST_BASIS = 32 << 20
"""Bytes of an exposure basis that are kept whole."""


_Item = tuple[str, Message | None, bytes, int]
"""A message on its way to the file: topic, the message itself where a later part may need it, its bytes, log time.

Without the message, Python's collector of reference cycles soon forgets these tuples: it would look through all of a
long queue again and again, and through everything else that the process holds.
"""


def begin_recording(
    file: McapFile, rig: Rig, metadata: dict[str, str], start_ns: int, attachments: Mapping[str, bytes]
) -> None:
    """Write the beginning of a recording: the rig file, twice, the exposure basis, and facts about the session.

    Those of ``attachments``, by name, are added that are not among them.
    """
    file.start()
    model = exposure_model(rig.plant, rig.window_steps)
    outputs, basis = model.factors
    # A large basis is kept only in the columns of the start state, which are all that o1 to o3 have.
    basis = basis if basis.nbytes <= _LARGEST_BASIS else basis[..., : rig.plant.n_states]
    file.add_attachment(topics.RIG_ATTACHMENT, "application/toml", rig.toml.encode(), start_ns)
    arrays = {topics.BASIS_ATTACHMENT: basis} | ({} if outputs is None else {topics.OUTPUTS_ATTACHMENT: outputs})
    for name, array in arrays.items():
        data = io.BytesIO()
        np.save(data, array)
        file.add_attachment(name, "application/octet-stream", data.getvalue(), start_ns)
    for name, value in attachments.items():
        if name not in topics.OF_EACH_FILE:
            file.add_attachment(name, "application/octet-stream", value, start_ns)
    file.add_metadata(topics.SESSION_METADATA, metadata)
    file.add_metadata(topics.RIG_METADATA, {"toml": rig.toml})  # without it nothing can be read


class RecordingWriter:
    """A recording that is being written.

    Parameters
    ----------
    path:
        The file; it must not exist unless ``overwrite``. Where the options ask for several files, their
        names are this one with -001, -002 ... before the suffix. An old file stays as it was until the first exposure
        is on the disk, and so do the parts of an older session of this name.
    rig:
        The rig, which goes into the file as an attachment, with its exposure basis.
    metadata:
        Facts about the session, written at the start.
    start_ns:
        Host time of the start.
    attachments:
        Further attachments that go into the file at its start, by name.
    deterministic:
        Whether to divide the file by the messages' own times only, not by the wall clock as well, so that the same
        messages give the same bytes. It is for sessions on virtual time and for re-estimation.

    Raises
    ------
    RecordingError
        The file exists, or cannot be written: at once, or from any later call.
    """

    def __init__(
        self, path: str | Path, rig: Rig, metadata: dict[str, str], start_ns: int, *, overwrite: bool = False,
        deterministic: bool = False, attachments: Mapping[str, bytes] | None = None,
        options: WriteOptions | None = None,
    ) -> None:  # fmt: skip
        self.path = Path(path)
        self.paths: list[Path] = []
        """The files so far; none while the first is still beside the old one."""
        self.notes: list[str] = []
        """What it did with files of others, in sentences."""
        self._options = options or WriteOptions()
        self._rig, self._metadata, self._overwrite = rig, metadata, overwrite
        self._attachments = attachments or {}
        self._deterministic = deterministic
        self._classes: dict[str, type[Message]] = {}
        """The class of each topic's messages."""
        self._schemas: dict[str, Schema] = {}
        """The schema of each topic so far."""
        self._lead = Lead() if self._options.split_bytes or self._options.split_s else None
        self._part = 0
        self._old_parts: list[Path] = []
        self._sequence = 0
        self._has_exposure = False
        self._end_metadata: dict[str, str] = {}
        self._error: RecordingError | None = None
        self._closed = False
        self._queue: deque[_Item] = deque()
        self._ending = threading.Event()
        self._put_bytes = self._taken_bytes = 0
        self._busy_since: float | None = None
        """The time at which the thread began its present work on the file."""
        if self._lead is not None:
            self._old_parts = self._parts_before()
        try:
            self._begin(start_ns)
        except OSError as error:
            raise RecordingError(f"cannot write {self.path}: {files.why_not(error)}") from None
        self._thread = threading.Thread(target=self._run, name="aolink-recorder", daemon=True)
        self._thread.start()

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Record a message with its log time, ns. Raises RecordingError if the file can no longer be written."""
        if self._error:
            raise self._error
        data = message.SerializeToString()  # fields by their numbers: without maps always the same bytes
        if self._put_bytes - self._taken_bytes > _QUEUE_BYTES:
            self._wait_for_room()
        if topic not in self._classes:
            self._classes[topic] = type(message)
        self._put_bytes += len(data)
        self._queue.append((topic, None if self._lead is None else message, data, time_ns))

    def write(self, topic: str, message: Message, time_ns: int) -> None:
        """Record a message, for who is no stream: as `take`."""
        self.take(topic, time_ns, message)

    def _wait_for_room(self) -> None:
        while self.waiting_bytes > _QUEUE_BYTES:
            if self._error:
                raise self._error
            if not self._deterministic:  # a caller that has time to wait, waits
                raise RecordingError(f"the disk of {self.path} is too slow for this session: record to a faster one")
            time.sleep(0.01)

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the disk."""
        return self._put_bytes - self._taken_bytes

    @property
    def held_up_s(self) -> float:
        """How long the disk has been at its present work, s."""
        since = self._busy_since
        return 0.0 if since is None else time.monotonic() - since

    def close(self, end_metadata: dict[str, str] | None = None) -> None:
        """Write the queued messages, the index and ``end_metadata``. Raises RecordingError as `take` does."""
        if self._closed:
            return
        self._closed = True
        self._end_metadata = end_metadata or {}
        self._ending.set()
        while self._thread.is_alive() and self.held_up_s < TIMEOUTS.disk_end_s:
            self._thread.join(0.1)
        if self._thread.is_alive():
            raise RecordingError(f"the disk of {self.path} does not answer: the end of the recording may be missing")
        if self._error:
            raise self._error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if error is None:
            self.close()
        else:
            with contextlib.suppress(RecordingError):
                self.close({"ended": f"error: {error}"})

    def _parts_before(self) -> list[Path]:
        """The parts of an older session of this name, by their own metadata. Raises RecordingError where they, or
        another file, stand in the way."""
        name = re.compile(re.escape(self.path.stem) + r"-(\d{3,})" + re.escape(self.path.suffix))
        folder, known, session = self.path.parent, list[Path](), None
        try:
            found = sorted((int(match[1]), each) for each in folder.iterdir() if (match := name.fullmatch(each.name)))
        except OSError:  # there is no such folder, or it may not be read: creating the file will tell
            return []
        for number, each in found:
            facts = first_facts(each)
            of_this_name = facts.get(topics.PART_OF) == self.path.name
            if each == self._part_path(number) and facts.get(topics.PART) == str(number) and of_this_name:
                session = session or facts.get("session")
                if facts.get("session") == session:
                    known.append(each)
        if (first := self._part_path(1)) not in known and os.path.lexists(first):
            raise RecordingError(
                f"{first} exists and is no part of an older session {self.path.name}, so it is not replaced: give"
                " another name"
            )
        if known and not self._overwrite:
            raise RecordingError(
                f"{known[0]} exists and is not overwritten: give another name, or --overwrite to remove"
                f" {'it' if len(known) == 1 else f'all {len(known)} parts'}"
            )
        for each in known:
            if files.is_being_written(each):
                raise RecordingError(f"{each} is being written by another command: give another name")
        return known

    def _part_path(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.stem}-{number:03d}{self.path.suffix}")

    def _begin(self, start_ns: int) -> None:
        """Create the file, or the next of several."""
        metadata, path = self._metadata, self.path
        if self._lead is not None:
            self._part += 1
            while self._part > 1 and os.path.lexists(self._part_path(self._part)):
                self.notes.append(f"{self._part_path(self._part)} was there already, and is no part of this session")
                self._part += 1
            path = self._part_path(self._part)
            metadata = metadata | {topics.PART: str(self._part), topics.PART_OF: self.path.name}
        self._place = files.create(path, overwrite=self._overwrite and not self._has_exposure, error=RecordingError)
        self._part_start_ns = start_ns
        with contextlib.ExitStack() as undo:  # without its beginning it is no recording
            undo.callback(self._place.close, remove=True)
            self._file = McapFile(path, self._options, descriptor=os.dup(self._place.descriptor))
            undo.callback(self._file.cut_back)
            begin_recording(self._file, self._rig, metadata, start_ns, self._attachments)
            undo.pop_all()
        if not self._place.is_aside:
            self.paths.append(path)

    def _take_place(self) -> None:
        """Put the file in the place of the old one, and remove the parts of the older session: there is an exposure."""
        self._has_exposure = True
        self._file.flush()
        if self._place.is_aside:
            self._file.sync()
            self._place.take_place()
            self.paths.append(self._place.path)
        removed = []
        for each in self._old_parts:
            with contextlib.suppress(OSError):  # where it may not be removed, the parts of this session go round it
                if each not in self.paths:
                    each.unlink()
                    removed.append(str(each))
        if removed:
            self.notes.append(f"parts of an older session were removed: {', '.join(removed)}")

    def _look(self) -> None:
        """End the session where the file's name is no longer its own, or its content is gone."""
        if self._error is None and not self._place.is_there():
            self._error = RecordingError(f"{self._place.path} was removed, renamed or replaced by another program")
        self._error = self._error or self._file.loss

    def _run(self) -> None:
        options = self._options
        last_sync = last_write = last_look = time.monotonic()
        while True:
            ending = self._ending.is_set()  # read first: nothing is queued after it is set
            self._busy_since = now = time.monotonic()
            try:
                while self._queue:
                    self._write_some()
                    self._busy_since = last_write = time.monotonic()
                    if not self._deterministic and last_write - last_sync > options.fsync_s:
                        self._file.flush()
                        self._file.sync()
                        self._busy_since = last_sync = time.monotonic()
                if now - last_look > _LOOK_S:
                    self._look()
                    last_look = now
                if ending:
                    self._finish(self._end_metadata)
                    return
                if not self._deterministic:
                    if self._file.has_unwritten and now - last_write > options.flush_s:
                        self._file.flush()
                    if now - last_sync > options.fsync_s:
                        self._file.sync()
                        last_sync = time.monotonic()
            except Exception as error:  # the session must learn of any error
                self._give_up(error)
                return
            finally:
                self._busy_since = None
            self._ending.wait(_POLL_S)

    def _write_some(self) -> None:
        """Add queued messages to the file, until the clock is to be read."""
        queue, schemas, taken = self._queue, self._schemas, 0
        while queue and taken < _LOOK_BYTES:
            topic, message, data, log_time_ns = queue.popleft()
            if self._lead is not None:
                self._lead_in(self._lead, topic, message, log_time_ns)
            # Streams may share a log time: the sequence is the order.
            self._sequence += 1
            schema = schemas.get(topic) or self._schema(topic)
            self._file.add(topic, schema, data, log_time_ns, self._sequence)
            if topic == topics.IMAGE and not self._has_exposure:
                self._take_place()
            taken += _MESSAGE_BYTES + len(data)
            self._taken_bytes += len(data)

    def _lead_in(self, lead: Lead, topic: str, message: Message | None, log_time_ns: int) -> None:
        """Begin the next part if this one is full, with the messages that it needs from this one; keep those that the
        part after it may need."""
        if topic == topics.EXPOSURE and self._has_exposure and self._part_is_full(log_time_ns):
            self._finish({"ended": "goes on in the next part"})
            self._begin(log_time_ns)
            for lead_topic, each, time_ns, sequence in lead.messages():
                lead_data = each.SerializeToString()
                self._file.add(lead_topic, self._schema(lead_topic), lead_data, time_ns, sequence)
        lead.add(topic, message, log_time_ns, self._sequence + 1)

    def _part_is_full(self, now_ns: int) -> bool:
        size, seconds = self._options.split_bytes, self._options.split_s
        return bool((size and self._file.size >= size) or (seconds and now_ns - self._part_start_ns >= seconds * 1e9))

    def _schema(self, topic: str) -> Schema:
        if topic not in self._schemas:
            self._schemas[topic] = schema_of(self._classes[topic])
        return self._schemas[topic]

    def _finish(self, end_metadata: dict[str, str]) -> None:
        if end_metadata:
            self._file.add_metadata(topics.END_METADATA, end_metadata)
        try:
            self._file.finish(sync=not self._deterministic)
        except RecordingError as error:
            self._error = self._error or error
        self._look()
        if not (self._place.is_there() or self._place.is_aside):
            self._busy_since = None  # a copy may take long, and nothing waits for it but the session's end
            self._save()
        self._place.close()

    def _save(self) -> None:
        """Say where a file is whose name is no longer its own; one that was removed is copied beside its name."""
        assert self._error is not None
        if (place := self._place.moved_to()) is not None:
            said = f"the recording is {place} now"
        else:
            try:
                said = f"what was recorded is saved as {self._place.saved()}"
            except OSError as error:
                said = f"what was recorded is lost, because a copy cannot be written: {files.why_not(error)}"
        self._error.args = (f"{self._error}; {said}",)

    def _give_up(self, error: Exception) -> None:
        """Cut the file back to its last whole part, because the disk is full or gone."""
        self._file.cut_back()
        if not isinstance(error, RecordingError):
            what = files.why_not(error) if isinstance(error, OSError) else repr(error)
            kept = "; what was recorded until then is in it and can be read" if self.paths else ""
            error = RecordingError(f"cannot write {self._place.target}: {what}{kept}")
        self._error = self._error or error
        self._place.close()
