"""Side files: an MCAP file with the estimates of one recording and nothing else, which says what recording that is."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from aolink.estimation import Estimate
from aolink.files import open_unfinished
from aolink.recording import convert, topics
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import Estimate as EstimateMessage
from aolink.recording.writer import begin_recording


class SideFile:
    """A side file that is being written: the same estimates give the same bytes, but for the facts from its end.

    Parameters
    ----------
    recording:
        What is estimated, with the rig that it is estimated with.
    path:
        An empty file that is there already, as `aolink.files.writing` gives one.
    notes:
        Facts about the estimates.
    """

    def __init__(self, recording: Recording, path: Path, notes: dict[str, str]) -> None:
        known = {key: value for key in ("session", "rig") if (value := recording.metadata.get(key)) is not None}
        facts = {
            "estimated_from": recording.path.name,
            topics.SIDE_OF: recording.digest,
        }
        self._schema = schema_of(EstimateMessage)
        self._count = 0
        self._file = McapFile(path, WriteOptions(), descriptor=open_unfinished(path))
        begin_recording(self._file, recording.rig, known | facts | notes, recording.start_ns, {})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.cut_back()  # nothing, where it is finished

    def add(self, estimate: Estimate, log_time_ns: int) -> None:
        """Write an estimate; ``log_time_ns`` is that of the message that its exposure was whole with."""
        self._count += 1
        data = convert.estimate_message(estimate).SerializeToString(deterministic=True)
        self._file.add(topics.estimate_topic(estimate.estimator), self._schema, data, log_time_ns, self._count)

    def finish(self, end: dict[str, str]) -> None:
        """Write the index, and facts from the end."""
        self._file.add_metadata(topics.END_METADATA, end)
        self._file.finish()
