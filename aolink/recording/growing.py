"""A recording that a session may still be writing: its exposures as they come, each once, up to its end."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from itertools import chain
from pathlib import Path

from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage

from aolink import files
from aolink.errors import RecordingError
from aolink.recording import topics
from aolink.recording.messages import END_OF_TIME, RawMessage
from aolink.recording.reader import Recording
from aolink.recording.scan import MAGIC, Loss, grown, open_recording
from aolink.rig import Rig


class GrowingRecording(Recording):
    """A recording whose exposures, and the session's estimates of them, come as they are written: the iterator waits.

    They end with the file: with the end of its data or, where it was cut off, when no process writes it any longer.
    They can be read once, in order; numbers, slices and counts need an index.

    Parameters
    ----------
    wait:
        Called where there is nothing new, before the file is read again.
    rig:
        The rig, as for `Recording`.

    Raises
    ------
    RecordingError
        As for `Recording`; or the file does not begin with its rig file.
    """

    def __init__(self, path: str | Path, wait: Callable[[], None], *, rig: Rig | None = None) -> None:
        self._wait = wait
        self._coming: Iterator[McapRecord] = self._written(Path(path))
        self._names: dict[int, str] = {}
        """Names of the schemas by their ids."""
        super().__init__(path, rig=rig)

    def survey(self, *, check: bool) -> str | None:
        """Read up to the rig file and the session's facts, which are written before any message."""
        rig_text = None
        for record in self._coming:
            if isinstance(record, Attachment) and record.name == topics.RIG_ATTACHMENT:
                rig_text = record.data.decode(errors="replace")
            elif isinstance(record, Metadata) and record.name == topics.SESSION_METADATA:
                self.note_metadata([record])
                if rig_text is not None:
                    break
            elif isinstance(record, McapMessage):
                if rig_text is None:
                    text = f"{self.path} has messages before its rig file: it can only be read when finished"
                    raise RecordingError(text)
                self._coming = chain([record], self._coming)
                break
        # How many there will be is not known: an exposure waits until its estimates are there, or it was skipped.
        names = self.metadata.get("estimators", "").split()
        self.counts |= dict.fromkeys(map(topics.estimate_topic, names), END_OF_TIME)
        return rig_text

    def own_messages(
        self, wanted: Collection[str], low: int = 0, high: int = 1 << 64, chunks: slice = slice(None)
    ) -> Iterator[RawMessage]:
        for record in self._coming:
            if isinstance(record, Schema):
                self._names[record.id] = record.name
            elif isinstance(record, Channel):
                self.channels[record.id] = (record.topic, self._names.get(record.schema_id, ""))
            elif isinstance(record, Metadata):
                self.note_metadata([record])
            elif isinstance(record, McapMessage) and record.channel_id in self.channels:
                topic, schema = self.channels[record.channel_id]
                if topic in wanted and low <= record.log_time < high:
                    yield RawMessage(topic, schema, record.log_time, record.sequence, record.data)

    def _written(self, path: Path) -> Iterator[McapRecord]:
        """The records of the file, those in chunks too, as they are written."""
        # The session may have only just begun: an old file is in its place until the first exposure.
        while files.is_being_replaced(path) or (
            path.exists() and path.stat().st_size < len(MAGIC) and _is_being_written(path)
        ):
            self._wait()
        with open_recording(path) as file:
            position, ended, written = len(MAGIC), False, True
            while not ended:
                before = position
                position, records, ended = grown(file, position, self.lose)
                yield from records
                if position > before:
                    continue
                if not written:
                    what = f"it was cut off: it ends at byte {position}, without an index"
                    self.lose(Loss(position, 0, what))
                    return
                # Records written between the last reading and the writer's end are still read.
                if written := _is_being_written(path):
                    self._wait()


def _is_being_written(path: Path) -> bool:
    """Whether the file is being written, as by `files.is_being_written`; true where that cannot be found out, as for a
    read-only file."""
    try:
        return files.is_being_written(path)
    except OSError:
        return True
