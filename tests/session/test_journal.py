"""What a device counts is recorded by the fields of `ConnectionStatistics`; what these lack does not end a session."""

from __future__ import annotations

import os
import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from aolink.devices.host import Host
from aolink.devices.no_mirror import NoMirror
from aolink.recording import topics
from aolink.recording.mcap_file import WriteOptions
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
        journal.add(writer)
        for _ in range(2):
            journal.statistics([Counting(rig, lambda: now[0])], 0)
    text = "the mirror counts packets_sent, which recordings have no field for: not recorded"
    assert report.warnings == [text]
    counted = messages_of(ConnectionStatistics, Recording(tmp_path / "a.mcap"), topics.CONNECTION)
    assert counted == [ConnectionStatistics(device="mirror", bytes_sent=7)] * 2


class Seconds(Host):
    """A clock that goes on by as much as it is told."""

    now = 0

    def now_ns(self) -> int:
        return self.now


def test_warnings_of_one_kind_are_limited_in_their_rate_and_the_others_counted(tmp_path: Path) -> None:
    rig, report, time = load_rig("section-vi"), Report(), Seconds()
    with RecordingWriter(tmp_path / "a.mcap", rig, {}, 0, deterministic=True) as writer:
        journal = Journal(writer, report, time)
        journal.add(writer)
        for frame in range(512):
            journal.warn(f"the model no longer fits (frame {frame}): NIS {frame / 7:.2f}, correlation {frame / 9:+.2g}")
        for name in ("o1", "o3", "theirs:order=10", "theirs:order=20"):
            journal.warn(f"the estimator {name} failed: after {len(name)} s")
        time.now += 3_600_000_000_000
        journal.warn("the model no longer fits (frame 9999): NIS 3.10, correlation +2")
        writer.close(report.counts())
    fits, others = report.warnings[:5], report.warnings[5:9]
    assert [each.partition("frame ")[2][0] for each in fits] == [*"01234"]
    assert fits[4].endswith("(and 507 more of this kind)")
    assert len({*others}) == 4
    assert "frame 9999" in report.warnings[9]
    assert Recording(tmp_path / "a.mcap").counts[topics.LOG] == len(report.warnings) == 10


def test_a_warning_with_another_number_is_said(tmp_path: Path) -> None:
    report = Report()
    with RecordingWriter(tmp_path / "a.mcap", load_rig("section-vi"), {}, 0, deterministic=True) as writer:
        journal = Journal(writer, report, Host())
        journal.add(writer)
        said = [f"the camera's clock was set forward by {step} s" for step in ("0.000120", "3600.000000")]
        for text in said:
            journal.warn(text)
    assert report.warnings == said


def test_a_disk_that_is_held_up_is_a_warning_not_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However long a write takes, few bytes wait; the warning says how long, and nothing is lost."""
    goes_on, held_up, sync = threading.Event(), threading.Event(), os.fsync

    def slow(descriptor: int) -> None:
        held_up.set()
        goes_on.wait()
        sync(descriptor)

    report, clock, begin = Report(), [0.0], time.monotonic()
    with RecordingWriter(
        tmp_path / "a.mcap", load_rig("section-vi"), {}, 0, options=WriteOptions(fsync_s=0.01)
    ) as writer:
        journal = Journal(writer, report, Host())
        journal.add(writer)
        monkeypatch.setattr(os, "fsync", slow)
        held_up.wait()
        monkeypatch.setattr(time, "monotonic", lambda: begin + clock[0])
        clock[0] = 30.0
        journal.log("goes on")
        journal.disk()
        goes_on.set()
    (warning,) = report.warnings
    assert re.search(r"(29|30)\.\d s", warning)
    assert Recording(tmp_path / "a.mcap").counts[topics.LOG] == 2
