"""Writes a recording: an MCAP file that needs nothing but itself.

The file work is done in a thread of its own, so that a slow disk does not reach the loop. The queue to
it is bounded; when it is full, or when the disk is, the session gets an error: nothing is lost silently.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import queue
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from google.protobuf.message import Message
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from aolink.errors import RecordingError
from aolink.estimation import ExposureModel
from aolink.recording import topics
from aolink.rig import Rig

FLUSH_S = 0.1
"""How often what was recorded goes to the file: a killed process loses no more than twice that."""
FSYNC_S = 1.0
"""How often the file goes to the disk: a power cut loses no more than that and twice FLUSH_S."""
CHUNK_BYTES = 128 << 10
_QUEUE_BYTES = 256 << 20
"""What may wait for the disk."""
_STALL_S = 5.0
"""A disk that takes longer over one write stops the session."""
_LARGEST_BASIS = 32 << 20
"""Bytes of an exposure basis that are kept whole."""


@dataclass(frozen=True, slots=True)
class _Item:
    """A message on its way to the file."""

    topic: str
    message_class: type[Message]
    data: bytes
    log_time_ns: int


class _File:
    """A file that writes all or raises, and can be cut back to its last whole part."""

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


class RecordingWriter:
    """A recording that is being written.

    Parameters
    ----------
    path:
        The file; it must not exist unless ``overwrite``.
    rig:
        Goes into the file as an attachment, with its exposure basis.
    metadata:
        Facts about the session, written at the start.
    start_ns:
        Host time of the start.
    deterministic:
        Cut the file by the messages' own times only, not by the wall clock as well: the same messages
        give the same bytes. For sessions on virtual time and for re-estimation.

    Raises
    ------
    RecordingError
        The file exists, or cannot be written: at once, or from any later call.
    """

    def __init__(
        self,
        path: str | Path,
        rig: Rig,
        metadata: dict[str, str],
        start_ns: int,
        *,
        overwrite: bool = False,
        deterministic: bool = False,
    ) -> None:
        self.path = Path(path)
        self._file = _File(self.path, overwrite=overwrite)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)  # type: ignore[arg-type]
        self._deterministic = deterministic
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence = 0
        self._chunk_start_ns: int | None = None
        self._whole = 0
        """Bytes up to which the file is whole."""
        self._end_metadata: dict[str, str] = {}
        self._error: RecordingError | None = None
        self._closed = False
        self._queue: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()
        self._put_bytes = self._taken_bytes = 0
        self._busy_since: float | None = None
        """When the thread began what it is doing with the file."""
        try:
            self._begin(rig, metadata, start_ns)
        except OSError as error:
            self._give_up(error)
            self._closed = True
            raise self._error or RecordingError(str(error)) from None
        self._thread = threading.Thread(target=self._run, name="aolink-recorder", daemon=True)
        self._thread.start()

    def write(self, topic: str, message: Message, log_time_ns: int) -> None:
        """Record a message. Raises RecordingError if the file can no longer be written."""
        if self._error:
            raise self._error
        item = _Item(topic, type(message), message.SerializeToString(deterministic=True), log_time_ns)
        while self._is_stalled() or self._put_bytes - self._taken_bytes > _QUEUE_BYTES:
            if self._error:
                raise self._error
            if self._is_stalled() or not self._deterministic:  # who has time to wait, waits
                raise RecordingError(f"the disk of {self.path} is too slow for this session: record to a faster one")
            time.sleep(0.01)
        self._put_bytes += len(item.data)
        self._queue.put(item)

    def _is_stalled(self) -> bool:
        since = self._busy_since
        return since is not None and time.monotonic() - since > _STALL_S

    def close(self, end_metadata: dict[str, str] | None = None) -> None:
        """Write what is queued, the index and ``end_metadata``. Raises RecordingError as `write` does."""
        if self._closed:
            return
        self._closed = True
        self._end_metadata = end_metadata or {}
        self._queue.put(None)
        while self._thread.is_alive() and not self._is_stalled():
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

    def _begin(self, rig: Rig, metadata: dict[str, str], start_ns: int) -> None:
        self._writer.start(profile="aolink", library="aolink")
        model = ExposureModel(rig.plant, rig.timing.exposure_steps)
        basis = io.BytesIO()
        # Of a large one only the columns of the start state: o1 to o3, which know such plants, have no others.
        np.save(basis, model.basis if model.basis.nbytes <= _LARGEST_BASIS else model.state_rows)
        for name, kind, data in (
            (topics.RIG_ATTACHMENT, "application/toml", rig.toml.encode()),
            (topics.BASIS_ATTACHMENT, "application/octet-stream", basis.getvalue()),
        ):
            self._writer.add_attachment(start_ns, start_ns, name, kind, data)
        self._writer.add_metadata(topics.SESSION_METADATA, metadata)
        self._whole = self._file.tell()

    def _run(self) -> None:
        last_sync = time.monotonic()
        while True:
            try:
                item = self._queue.get(timeout=None if self._deterministic else FLUSH_S)
            except queue.Empty:
                item = _NOTHING
            self._busy_since = time.monotonic()
            try:
                if item is None:
                    self._finish()
                    return
                if item is not _NOTHING:
                    self._add(item)
                    self._taken_bytes += len(item.data)
                elif self._chunk_start_ns is not None:
                    self._flush()
                if not self._deterministic and time.monotonic() - last_sync > FSYNC_S:
                    os.fsync(self._file.descriptor)
                    last_sync = time.monotonic()
            except Exception as error:  # whatever it is, the session must hear of it
                self._give_up(error)
                return
            finally:
                self._busy_since = None

    def _add(self, item: _Item) -> None:
        channel = self._channels.get(item.topic)
        if channel is None:
            channel = self._channels[item.topic] = self._register(item)
        if self._chunk_start_ns is None:
            self._chunk_start_ns = item.log_time_ns
        elif item.log_time_ns - self._chunk_start_ns >= FLUSH_S * 1e9:
            self._flush()
            self._chunk_start_ns = item.log_time_ns
        # Streams may share a log time: the sequence is the order.
        self._sequence += 1
        self._writer.add_message(channel, item.log_time_ns, item.data, item.log_time_ns, self._sequence & 0xFFFFFFFF)

    def _register(self, item: _Item) -> int:
        name = item.message_class.DESCRIPTOR.full_name
        if name not in self._schemas:
            data = build_file_descriptor_set(item.message_class).SerializeToString(deterministic=True)
            self._schemas[name] = self._writer.register_schema(name, SchemaEncoding.Protobuf, data)
        return self._writer.register_channel(item.topic, MessageEncoding.Protobuf, self._schemas[name])

    def _flush(self) -> None:
        self._writer.flush()
        self._chunk_start_ns = None
        self._whole = self._file.tell()

    def _finish(self) -> None:
        self._flush()
        if self._end_metadata:
            self._writer.add_metadata(topics.END_METADATA, self._end_metadata)
            self._whole = self._file.tell()
        self._writer.finish()
        if not self._deterministic:
            os.fsync(self._file.descriptor)
        self._file.close()

    def _give_up(self, error: Exception) -> None:
        """The disk is full or gone: leave a file that ends with its last whole part."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._file.descriptor, self._whole)
        with contextlib.suppress(OSError):
            self._file.close()
        what = repr(error)
        if isinstance(error, OSError):
            full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            what = "the disk is full" if full else os.strerror(error.errno or 0).lower()
        self._error = RecordingError(
            f"cannot write {self.path}: {what}; what was recorded until then is in it and can be read"
        )


_NOTHING = _Item("", Message, b"", 0)
