"""Sessions in real time with the simulated rig, and with the reference device, which was written from the page alone.

The clock runs here, so nothing is said about how fast; only that order and counts are right.
"""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import aolink
from aolink.devices.discovery import identify_port
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate
from aolink.rig import load_rig
from aolink.session import Report, record
from tests.session.conftest import Ports
from tests.session.native import open_native

RIG = load_rig("section-vi")


@pytest.mark.slow
def test_a_session_has_latencies_and_accounts_for_every_step(serve: Ports, tmp_path: Path) -> None:
    path = tmp_path / "real.mcap"
    report, states = Report(), list[dict[str, Any]]()
    with serve() as (camera, mirror):
        record(
            RIG, camera, mirror, path,
            estimators=["o3"], exposures=4, report=report, progress=lambda done: states.append(report.state()),
        )  # fmt: skip
    assert states[-1]["exposures"] == 4
    assert report.state()["latency_ms"]["estimated"] > 0
    assert "estimated after" in report.note()
    assert (report.ended, report.exposures, report.virtual_time) == ("complete", 4, False)
    assert report.commands.commanded == report.commands.applied + report.steps_parked == 800
    assert report.commands.late == report.steps_parked
    assert len(report.latencies) == 4
    for latency in report.latencies:
        assert 0 < latency.first_byte_ns <= latency.complete_ns <= latency.estimated_ns
    exposures = list(Recording(path).exposures())
    assert [e.frame_id for e in exposures] == [1, 2, 3, 4]
    for exposure in exposures:
        assert exposure.host_receive_ns > exposure.host_start_ns
        assert 0 < exposure.clock_sigma_ns < 200_000_000  # of round trips, which a busy machine makes long
    recording = Recording(path)
    assert first_difference(recording.estimates("o3"), reestimate(recording, ["o3"], as_recorded=True)["o3"]) is None


def test_a_line_is_the_users_only(serve: Ports) -> None:
    with serve() as ports:
        for port in ports:
            assert stat.S_IMODE(os.stat(port).st_mode) == 0o600


@pytest.mark.slow
def test_the_frames_show_where_the_truth_says_the_spot_was(serve: Ports, tmp_path: Path) -> None:
    """Two programs, one plant: the mean of the recorded path is where each frame's light is, within its noise.

    The estimator states the noise. In units of it the mean squared error of 15 exposures is 1 where the models agree,
    and above 3 once in 10^4 times; how busy the machine is changes when commands come, which the reports say.
    """
    path = tmp_path / "a.mcap"
    with serve() as (camera, mirror):
        report = record(RIG, camera, mirror, path, exposures=15)
    recording = Recording(path)
    exposures = list(recording.exposures())
    assert len(exposures) + report.frames_lost == 15
    estimates = aolink.estimate(recording, "profile").estimates("profile")
    sd = np.array([np.sqrt(estimate.path_covariance().mean()) for estimate in estimates])
    errors = np.array(
        [
            estimate.path.mean() - exposure.truth.path.mean()
            for estimate, exposure in zip(estimates, exposures, strict=True)
            if exposure.truth is not None
        ]
    )
    assert len(errors) == len(exposures) > 5
    assert sd.max() < 0.01  # a fifth of the kernel's width
    assert ((errors / sd) ** 2).mean() < 3


def stopped_host(serve: Ports, path: Path, seconds: float) -> Report:
    """A session whose host is held up in the middle of its second exposure."""

    def inputs(first_step: int, n_steps: int) -> np.ndarray:
        if first_step == 300:
            time.sleep(seconds)  # the fault itself, not a wait for something
        return RIG.drive.inputs(first_step, n_steps, RIG.timing.fast_step_s)

    with serve() as (camera, mirror):
        return record(RIG, camera, mirror, path, exposures=8, inputs=inputs)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.3, 1.0])
def test_a_host_that_is_held_up_has_every_step_accounted_for(serve: Ports, tmp_path: Path, seconds: float) -> None:
    report = stopped_host(serve, tmp_path / "a.mcap", seconds)
    assert report.ended == "complete"
    assert report.frames_received + report.frames_lost == 8
    assert report.commands.applied + report.steps_parked == 1600
    assert report.steps_parked > 0
    assert report.commands.superseded == report.commands.not_reported == 0
    assert report.commands.commanded == report.commands.applied + report.commands.late + report.commands.refused
    if not report.rearmed:  # otherwise the watchdog had parked the mirror by then: it refused what came until told
        assert report.commands.late == report.steps_parked


@pytest.mark.slow
def test_what_a_killed_host_left_behind_is_not_in_the_next_session(serve: Ports, tmp_path: Path) -> None:
    """The camera still runs and commands are queued, with a gap before them; the next session knows nothing of it."""
    path = tmp_path / "a.mcap"
    with serve() as ports:
        with open_native(RIG, *ports) as (hub, camera, mirror):
            first = mirror.identity.next_step + 300
            camera.start(first, 0)
            mirror.send_block(first + 50, np.full((50, 1), 0.01), 0, hub.now_ns())
            mirror.send_block(first + 100, np.full((50, 1), 0.01), 0, hub.now_ns())
            hub.wait(0.1)
        report = record(RIG, *ports, path, estimators=["o3"], exposures=3)
    assert (report.ended, report.exposures, report.frames_received) == ("complete", 3, 3)
    exposures = list(Recording(path).exposures())
    assert [e.first_step - exposures[0].first_step for e in exposures] == [0, 200, 400]
    assert np.abs(exposures[0].inputs[0]).max() < 1e-5


def test_a_silent_host_leaves_the_mirror_latched_and_the_next_session_rearms_it(serve: Ports, tmp_path: Path) -> None:
    with serve() as ports:
        with open_native(RIG, *ports) as (hub, _, mirror):
            first = mirror.identity.next_step + 100
            mirror.send_block(first, np.full((50, 1), 0.01), 0, hub.now_ns())
            hub.wait(0.1)
            time.sleep(2 * RIG.mirror.watchdog_s)  # the fault itself: nothing is sent
        with open_native(RIG, *ports) as (_, _, mirror):
            assert (mirror.identity.mirror.parked, mirror.identity.mirror.latched) == (True, True)
        assert identify_port(ports[1]).geometry.endswith("parked by its watchdog")
        report = record(RIG, *ports, tmp_path / "a.mcap", exposures=3)
    assert (report.ended, report.exposures, report.commands.applied) == ("complete", 3, 600)
