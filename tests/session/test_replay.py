"""A recording again: what live estimators gave, at a pace, in parts, and through a rig."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.recording import topics
from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference
from aolink.session import record
from aolink.session.replay import RecordedCommands, replay
from tests.commands import simulated_rig
from tests.conftest import ESTIMATORS, EXPOSURES, Session

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_a_replay_gives_what_the_session_gave(recorded: Session) -> None:
    recording = Recording(recorded.path)
    found = list(replay(recording, ESTIMATORS))
    assert len(found) == EXPOSURES
    for k, name in enumerate(ESTIMATORS):
        assert first_difference([each[k] for _, each in found], recording.estimates(name)) is None


class Clock:
    """Time that passes only while one sleeps, or works."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_the_pace_is_that_of_the_exposures(recorded: Session, rate: float) -> None:
    clock, times = Clock(), []
    for _ in replay(Recording(recorded.path), ["o1"], rate=rate, now_s=lambda: clock.now, sleep=clock.sleep):
        times.append(clock.now)
        clock.now += 0.01 / rate  # work takes time too, and does not add up
    np.testing.assert_allclose(np.diff(times), 0.2 / rate, rtol=1e-9)


def test_as_fast_as_it_goes_nobody_sleeps(recorded: Session) -> None:
    clock = Clock()
    list(replay(Recording(recorded.path), ["o1"], now_s=lambda: clock.now, sleep=clock.sleep))
    assert clock.slept == []


def test_the_commands_are_those_of_the_session(recorded: Session) -> None:
    recording = Recording(recorded.path)
    commands = RecordedCommands(recording)
    assert commands.exposures == EXPOSURES
    whole = np.concatenate([each.inputs for each in recording.exposures()])
    asked = np.concatenate([commands.inputs(k, 70) for k in range(0, len(whole) + 70, 70)])
    np.testing.assert_array_equal(recording.rig.mirror.quantise(asked[: len(whole)]), whole)
    assert np.array_equal(asked[-1], recording.rig.mirror.park), "after the last command the mirror rests"


@pytest.mark.slow
def test_played_to_the_same_simulated_rig_a_recording_comes_out_the_same(
    aolink: Run, recorded: Session, tmp_path: Path
) -> None:
    """The simulated rig of the same seed does the same again: the two recordings are one."""
    with simulated_rig("section-vi-lively") as (camera, mirror):
        result = aolink(
            "record", "--rig", "section-vi-lively", "--input", recorded.path, "--camera", camera, "--mirror", mirror,
            *(word for name in ESTIMATORS for word in ("-e", name)), "-o", "again.mcap",
        )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = compare(Recording(recorded.path), Recording(tmp_path / "again.mcap"))
    assert {topics.IMAGE, topics.APPLIED, topics.TRUTH, "/estimate/o3"} <= found.keys()
    assert all(each.same for each in found.values())


def test_through_a_rig_that_has_served_a_session_before(recorded: Session, tmp_path: Path) -> None:
    """Its frames and fast steps go on: exposure by exposure the inputs are the same, at other times."""
    recording = Recording(recorded.path)
    with simulated_rig("section-vi-lively") as (camera, mirror):
        for name in ("before", "again"):
            record(
                recording.rig, camera, mirror, tmp_path / name, exposures=3,
                inputs=RecordedCommands(recording).inputs,
            )  # fmt: skip
    before, again = Recording(tmp_path / "before"), Recording(tmp_path / "again")
    for one, two in zip(before.exposures(), again.exposures(), strict=True):
        assert one.first_step < two.first_step
        np.testing.assert_array_equal(one.inputs, two.inputs)


@pytest.mark.parametrize("rate", [1e-3, 1e-300, 5e-324])
def test_a_replay_that_waits_can_be_stopped(recorded: Session, rate: float) -> None:
    """However slow it is."""
    clock, steps = Clock(), 0
    for _ in replay(
        Recording(recorded.path), ["o1"], rate=rate, now_s=lambda: clock.now, sleep=clock.sleep,
        stop=lambda: clock.now > 101.0,
    ):  # fmt: skip
        steps += 1
    assert steps == 1
    assert 101.0 < clock.now < 101.2
