"""Side files: an MCAP file with the estimates of one recording and nothing else, which says what recording that is."""

from __future__ import annotations

from pathlib import Path

from aolink.recording import topics
from aolink.recording.editing import RecordingCopy
from aolink.recording.reader import Recording


def side_file(recording: Recording, path: Path, notes: dict[str, str]) -> RecordingCopy:
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
    known = {key: value for key in ("session", "rig") if (value := recording.metadata.get(key)) is not None}
    facts = {"estimated_from": recording.path.name, topics.SIDE_OF: recording.digest}
    return RecordingCopy(recording, path, known | facts | notes, attachments={})
