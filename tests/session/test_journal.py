"""What a device counts is recorded by the fields of `ConnectionStatistics`; what these lack does not end a session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from aolink.devices.host import Host
from aolink.devices.no_mirror import NoMirror
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import ConnectionStatistics
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.session.journal import Journal
from aolink.session.report import Report
from tests.kinds import messages_of


class Counting(NoMirror):
    """A mirror of another package, whose driver still uses a former name."""

    def statistics(self) -> dict[str, Any]:
        return {"bytes_sent": 7, "packets_sent": 3}


def test_a_count_that_recordings_have_no_field_for_is_named_once_and_left_out(tmp_path: Path) -> None:
    rig, report, now = load_rig("section-vi"), Report(), [0]
    with RecordingWriter(tmp_path / "a.mcap", rig, {}, 0, deterministic=True) as writer:
        journal = Journal(writer, report, Host())
        for _ in range(2):
            journal.statistics([Counting(rig, lambda: now[0])], 0)
    text = "the mirror counts packets_sent, which recordings have no field for: not recorded"
    assert report.warnings == [text]
    counted = messages_of(ConnectionStatistics, Recording(tmp_path / "a.mcap"), topics.CONNECTION)
    assert counted == [ConnectionStatistics(device="mirror", bytes_sent=7)] * 2
