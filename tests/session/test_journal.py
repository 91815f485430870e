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


def test_warnings_that_differ_in_their_numbers_are_said_once_with_their_count(tmp_path: Path) -> None:
    rig, report = load_rig("section-vi"), Report()
    with RecordingWriter(tmp_path / "a.mcap", rig, {}, 0, deterministic=True) as writer:
        journal = Journal(writer, report, Host())
        for frame in range(512):
            journal.warn(f"the model no longer fits (frame {frame}): NIS {frame / 7:.2f}, correlation {frame / 9:+.2g}")
            journal.warn(f"the model fits again (frame {frame})")
        for name in ("o1", "o3", "profile:draws=10", "profile:draws=20"):
            journal.warn(f"the estimator {name} failed: after {len(name)} s")
        writer.close(report.counts())
    fits, again, *others = report.warnings
    assert fits == "the model no longer fits (frame 0): NIS 0.00, correlation +0 (512 times)"
    assert again == "the model fits again (frame 0) (512 times)"
    assert len(others) == 4
    recording = Recording(tmp_path / "a.mcap")
    assert recording.counts[topics.LOG] == 6
    assert len(recording.metadata["warnings"]) < 400
