"""A session whose process was stopped for some seconds says so and goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from aolink.errors import DeviceError
from aolink.jobs.demo import simulated_rig
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from aolink.rig import Rig, load_rig, parse_rig
from aolink.wire import messages_pb2 as pb
from tests.control.rigs import DRIFT, small_rig
from tests.kinds import messages_of
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session
from tests.session.test_account import check_account
from tests.session.test_beside import until

RIG = small_rig(DRIFT)
RIGS = {
    "its watchdog parks the mirror": RIG,
    "the queue runs empty": parse_rig(RIG.toml.replace("watchdog_s = 2.0", "watchdog_s = 20.0")),
    "the queue lasts": parse_rig(RIG.toml.replace("watchdog_s = 2.0", "watchdog_s = 20.0\nqueue_steps = 8000")),
    "with a slew limit": small_rig(DRIFT, mirror="slew_max_per_s = 1.0"),
}


class JumpingHub(SimulatedTimeHub):
    """A host whose clock may jump ahead."""

    ahead_ns = 0

    def now_ns(self) -> int:
        return super().now_ns() + self.ahead_ns

    def jump(self, seconds: float) -> None:
        self.ahead_ns += round(seconds * 1e9)


def session(folder: Path, rig: Rig, happens: Callable[[JumpingHub], None], *, at: int = 20, **options: object) -> Run:
    """A session of 100 exposures, 4 s, after some of which something happens."""
    hub, left = JumpingHub(rig), [happens]
    exposures = options.pop("exposures", 100)

    def progress(exposures: int) -> None:
        if exposures == at and left:
            left.pop()(hub)

    return run_session(hub, rig, folder / "a.mcap", exposures, progress=progress, **options)  # type: ignore[arg-type]


def check(run: Run) -> None:
    """It has gone on to its end, with one word about it; what it recorded is true."""
    assert (run.error, run.report.ended) == (None, "complete")
    assert run.report.frames_received + run.report.frames_lost == 100
    (said,) = [each for each in run.report.warnings if "held up" in each]
    assert said.startswith("the session was held up for 2.5 s after ")
    check_account(run)
    truth = run.hub.truth()
    for block in messages_of(pb.CommandBlock, Recording(run.path), topics.COMMAND)[-5:]:
        assert truth[block.first_step][0]  # the mirror is commanded again


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("controller", ["", "integrator"])
def test_a_session_whose_process_was_stopped_goes_on(tmp_path: Path, name: str, controller: str) -> None:
    run = session(tmp_path, RIGS[name], lambda hub: hub.hold_up(2.5), controller=controller)
    check(run)
    assert run.report.rearmed == (RIGS[name].mirror.watchdog_s < 2.5)
    assert run.report.frames_lost == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["the queue lasts", "with a slew limit"])
def test_a_session_whose_clock_has_jumped_ahead_goes_on(tmp_path: Path, name: str) -> None:
    """As after a computer has slept together with its devices: these still are in the same fast step."""
    run = session(tmp_path, RIGS[name], lambda hub: hub.jump(2.5))
    check(run)
    assert sum("'s clock was set back by 2.5" in each for each in run.report.warnings) == 2
    assert run.report.exposures == 100


def test_a_camera_alone_goes_on(tmp_path: Path) -> None:
    run = session(tmp_path, RIG, lambda hub: hub.hold_up(2.5), alone=True)
    assert (run.error, run.report.exposures, len(run.report.warnings)) == (None, 100, 1)


@pytest.mark.slow
def test_a_session_that_would_have_ended_meanwhile_takes_what_has_come(tmp_path: Path) -> None:
    run = session(tmp_path, RIG, lambda hub: hub.hold_up(5.0), at=80)
    assert (run.error, run.report.ended, run.report.exposures) == (None, "complete", 100)


@pytest.mark.slow
def test_a_camera_that_sends_nothing_more_is_still_an_error(tmp_path: Path) -> None:
    def unplug(hub: JumpingHub) -> None:
        hub.to_host["camera"].cut = True
        hub.hold_up(5.0)

    run = session(tmp_path, RIG, unplug, exposures=0)
    assert isinstance(run.error, DeviceError)
    assert "the camera has sent no frame for 4.0 s: is it still connected?" in str(run.error)


def test_a_short_session_without_a_single_frame_is_an_error(tmp_path: Path) -> None:
    def unplug(hub: JumpingHub) -> None:
        hub.to_host["camera"].cut = True

    run = session(tmp_path, RIG, unplug, at=0, exposures=3)
    assert isinstance(run.error, DeviceError)
    assert "no frame" in str(run.error)
    assert Recording(run.path).complete


@pytest.mark.slow
def test_each_of_several_is_said(tmp_path: Path) -> None:
    left = [80, 50, 20]
    hub = SimulatedTimeHub(RIG)

    def progress(exposures: int) -> None:
        if left and exposures >= left[-1]:
            left.pop()
            hub.hold_up(1.2)

    run = run_session(hub, RIG, tmp_path / "a.mcap", 100, progress=progress)
    assert [each.endswith("may be lost") for each in run.report.warnings] == [True] * 3


@pytest.mark.slow
def test_a_disk_is_not_too_slow_for_a_process_that_did_not_run(tmp_path: Path) -> None:
    """The thread that writes has work and cannot do it: this one does not let it run."""
    message = Log(message="x" * 5000)
    with RecordingWriter(tmp_path / "a.mcap", RIG, {}, 0) as writer:
        for k in range(10_000):
            writer.take(topics.LOG, k, message)
        before = sys.getswitchinterval()
        sys.setswitchinterval(1000)
        until_s = time.monotonic() + 5.2
        while time.monotonic() < until_s:
            pass
        writer.take(topics.LOG, 10_000, message)
        sys.setswitchinterval(before)
    assert Recording(tmp_path / "a.mcap").counts[topics.LOG] == 10_001


@pytest.mark.rare
def test_a_process_that_is_stopped_and_continued(tmp_path: Path) -> None:
    rig, path = load_rig("section-vi"), tmp_path / "a.mcap"
    with simulated_rig("section-vi", "--real-time") as (camera, mirror):
        command = [
            sys.executable, "-m", "aolink", "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi",
            "-o", str(path), "--duration", "8",
        ]  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            until(lambda: path.exists() and path.stat().st_size > 30_000)
            os.kill(process.pid, signal.SIGSTOP)
            time.sleep(3.0)  # the fault itself
            os.kill(process.pid, signal.SIGCONT)
            _, said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert "the session was held up for 3." in said
    recording = Recording(path)
    assert (recording.complete, recording.end_metadata["ended"]) == (True, "complete")
    steps = np.array([each.first_step for each in recording.exposures()])
    assert steps[-1] - steps[0] > 6 / rig.timing.fast_step_s
