"""What a device counts is recorded by the fields of `ConnectionStatistics`; what these lack does not end a session."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from aolink.devices.host import Host
from aolink.devices.no_mirror import NoMirror
from aolink.estimation import make_estimator
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import ConnectionStatistics
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.session.controlling import Controlling
from aolink.session.journal import Journal
from aolink.session.report import Report
from aolink.simulation.model import simulate
from tests.control.rigs import DRIFT, small_rig
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


@pytest.mark.slow
def test_a_controller_whose_model_fits_and_does_not_in_turn_says_so_once(tmp_path: Path) -> None:
    """Its estimates are those of a rig that is shaken more than its file says, and those of one that is not."""
    rig = small_rig(DRIFT)
    right, wrong = (list(simulate(each, 120, seed=4)) for each in (rig, small_rig(DRIFT.replace("0.15", "0.26"))))
    exposures = [
        replace(each, frame_id=k, first_step=40 * k)
        for k, each in enumerate([*right[:70], *wrong[:40], *right[70:], *wrong[40:]] * 2)
    ]
    controlling, estimator = Controlling(rig, "lqg", ["o1"]), make_estimator(rig, "o1")
    controlling.begin(0)
    with RecordingWriter(tmp_path / "a.mcap", rig, {}, 0, deterministic=True) as writer:
        journal = Journal(writer, report := Report(), Host())
        for each in exposures:
            for text in controlling.see(each, estimator.step(each), each.first_step + 41)[2]:
                journal.warn(text)
    assert controlling.report.misfit_exposures > 0
    said = [each for each in report.warnings if "the rig file's model" in each]
    assert len(said) == 2
    assert all(each.endswith(" times)") for each in said)
