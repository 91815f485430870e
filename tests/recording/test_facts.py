"""The summary of a recording."""

from __future__ import annotations

from pathlib import Path

from aolink.recording.facts import recording_facts
from aolink.recording.reader import Recording
from tests.recording.small import write_small


def losses(path: Path, **metadata: str) -> dict[str, int]:
    recording = Recording(path)
    recording.metadata |= metadata
    found: dict[str, int] = recording_facts(recording)["losses"]
    return found


def test_faults_of_connections_are_losses(tmp_path: Path) -> None:
    path = write_small(tmp_path / "s.mcap", exposures=1)
    found = losses(path, connection_sequence_gaps="3", connection_bad_crc="0", connection_bad_payload="2")
    assert found == {"connection_sequence_gaps": 3, "connection_bad_payload": 2}
