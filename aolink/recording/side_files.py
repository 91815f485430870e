"""Whether a recording is a side file, which holds estimates of another recording and nothing else."""

from __future__ import annotations

from aolink.errors import RecordingError
from aolink.recording.messages import RecordedMessages


def check_is_side_of(side: RecordedMessages, recording: RecordedMessages) -> None:
    """Raise RecordingError where a file does not hold estimates of a recording and nothing else."""
    if not side.side_of:
        raise RecordingError(
            f"{side.path} is a recording of its own and no side file of {recording.path}: `aolink estimate -o DIR/`"
            " writes those"
        )
    if side.side_of != recording.digest:
        name = side.metadata.get("estimated_from", "another recording")
        raise RecordingError(
            f"{side.path} does not belong to {recording.path}: its estimates are of another file, which was called"
            f" {name}; give that one, or estimate again"
        )


def check_stands_alone(recording: RecordedMessages) -> None:
    """Raise RecordingError for a side file, which shows nothing without its recording."""
    if recording.side_of:
        name = recording.metadata.get("estimated_from", "a recording")
        raise RecordingError(
            f"{recording.path} is a side file with the estimates of {name} alone: give {name}, and after it this file"
            " where the command takes side files"
        )
