"""The summary of a recording."""

from __future__ import annotations

from pathlib import Path

from aolink.recording.facts import recording_facts
from aolink.recording.reader import Recording
from tests.recording.small import write_small


def test_faults_of_connections_are_losses(tmp_path: Path) -> None:
    recording = Recording(write_small(tmp_path / "s.mcap", exposures=1))
    recording.metadata |= {"connection_sequence_gaps": "3", "connection_bad_crc": "0", "connection_bad_payload": "2"}
    assert recording_facts(recording)["losses"] == {"connection_sequence_gaps": 3, "connection_bad_payload": 2}
