"""Ports that vanish during a session and return: pulled out and plugged in again, with both devices and on TCP."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

import aolink
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate
from aolink.rig import load_rig
from aolink.session import Report, record
from aolink.wire import messages_pb2 as pb
from tests.commands import simulated_rig
from tests.kinds import log_of, messages_of
from tests.session.conftest import Ports
from tests.session.pulled_line import PulledLine, pulled_line

RIG = load_rig("section-vi")
PERIOD = RIG.timing.frame_period_steps


def once_latched(message: Message) -> bool:
    """The mirror has been parked by its watchdog: so long has nobody been there."""
    return isinstance(message, pb.Applied) and message.source == pb.Applied.WATCHDOG


def once_some_frames_are_missed() -> Callable[[Message], bool]:
    missed: set[int] = set()

    def is_time(message: Message) -> bool:
        if isinstance(message, pb.FrameChunk):
            missed.add(message.frame_id)
        return len(missed) > 2

    return is_time


def pulling(*lines: PulledLine, after: int) -> Callable[[int], None]:
    """A session's progress that pulls out lines after some exposures, once."""
    left = list(lines)

    def progress(exposures: int) -> None:
        if exposures >= after:
            while left:
                left.pop().pull()

    return progress


def check_whole(path: Path, report: Report, exposures: int) -> None:
    """Every step and every exposure of a session is accounted for, and estimates are the same offline."""
    assert report.ended == "complete"
    assert report.frames_received + report.frames_lost == exposures
    assert report.commands.commanded == report.commands.ended
    recording = Recording(path)
    assert recording.metadata["ports_vanished"] == str(report.ports_vanished)
    assert recording.metadata["away_s"] == str(report.away_s)
    assert first_difference(recording.estimates("o3"), reestimate(recording, ["o3"], as_recorded=True)["o3"]) is None
    firsts = [each.first_step for each in recording.exposures()]
    assert {(first - firsts[0]) % PERIOD for first in firsts} == {0}


@pytest.mark.slow
def test_a_mirror_that_is_pulled_out_and_plugged_in_goes_on(serve: Ports, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with serve() as (camera, mirror), pulled_line(mirror, tmp_path / "mirror", once_latched) as line:
        report = record(
            RIG, camera, line.port, path, estimators=["o3"], exposures=9, reconnect_s=20,
            progress=pulling(line, after=2),
        )  # fmt: skip
    check_whole(path, report, 9)
    assert (report.ports_vanished, report.rearmed, report.frames_lost) == (1, 1, 0)
    assert report.away_s > 0
    assert report.steps_parked > 0
    held = messages_of(pb.Applied, Recording(path), topics.APPLIED)
    assert any(m.source == pb.Applied.WATCHDOG for m in held)
    assert all(each.inputs_assumed == 0 for each in Recording(path).exposures())
    for text in ("the port of the mirror has vanished", "the mirror has returned", "re-armed", "go on from fast step"):
        assert text in "\n".join(log_of(path))


@pytest.mark.slow
def test_a_camera_that_is_pulled_out_loses_exposures_and_goes_on_with_the_others(serve: Ports, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with serve() as (camera, mirror), pulled_line(camera, tmp_path / "camera", once_some_frames_are_missed()) as line:
        report = record(
            RIG, line.port, mirror, path, estimators=["o3"], exposures=25, reconnect_s=20,
            progress=pulling(line, after=2),
        )  # fmt: skip
    check_whole(path, report, 25)
    assert report.ports_vanished == 1
    assert report.frames_lost > 2
    exposures = list(Recording(path).exposures())
    after = next(each for each in exposures if len(each.lead_inputs))
    assert len(after.lead_inputs) == PERIOD * report.frames_lost
    assert all(each.inputs_assumed == 0 for each in exposures)
    for estimate, exposure in zip(
        aolink.estimate(Recording(path), "moments").estimates("moments"), exposures, strict=True
    ):
        assert exposure.truth is not None
        sigma = math.sqrt(estimate.path_covariance().mean())
        assert abs(estimate.path.mean() - exposure.truth.path.mean()) < 5 * sigma


@pytest.mark.slow
def test_both_ports_vanish_and_return_on_tcp(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with (
        simulated_rig("section-vi", "--real-time") as (camera, mirror),
        pulled_line(camera, None, once_some_frames_are_missed()) as camera_line,
        pulled_line(mirror, None, once_latched) as mirror_line,
    ):
        report = record(
            RIG, camera_line.port, mirror_line.port, path, estimators=["o3"], exposures=12, reconnect_s=20,
            progress=pulling(camera_line, mirror_line, after=2),
        )  # fmt: skip
    check_whole(path, report, 12)
    assert (report.ports_vanished, report.rearmed) == (2, 1)
    assert report.frames_lost > 2


SLEW = 0.05


@contextmanager
def pulled_with_a_slew_limit(folder: Path) -> Iterator[tuple[str, PulledLine]]:
    """The camera's port of a rig whose mirror has a slew limit, and the line to its mirror."""
    (folder / "rig.toml").write_text(RIG.toml.replace("dac_bits = 16", f"dac_bits = 16\nslew_max_per_s = {SLEW}"))
    with (
        simulated_rig(folder / "rig.toml", "--real-time") as (camera, mirror),
        pulled_line(mirror, folder / "mirror", once_latched) as line,
    ):
        yield camera, line


@pytest.mark.slow
def test_with_a_slew_limit_the_mirror_goes_slowly_from_the_safe_input_to_what_is_commanded(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"

    def inputs(first_step: int, n_steps: int) -> np.ndarray:
        """A ramp to 0.01, and there it stays."""
        return np.asarray(np.minimum(np.arange(first_step, first_step + n_steps) * 4e-5, 0.01)[:, None])

    with pulled_with_a_slew_limit(tmp_path) as (camera, line):
        report = record(
            load_rig(tmp_path / "rig.toml"), camera, line.port, path, estimators=["o3"], exposures=11, inputs=inputs,
            reconnect_s=20, progress=pulling(line, after=3),
        )  # fmt: skip
    check_whole(path, report, 11)
    assert report.ports_vanished == 1
    sent = messages_of(pb.CommandBlock, Recording(path), topics.COMMAND)
    steps = np.array([(each.first_step + k, u) for each in sent for k, u in enumerate(each.u)])
    jump = int(np.argmax(np.diff(steps[:, 0])))
    after, most = steps[jump + 1 :, 1], SLEW * RIG.timing.fast_step_s
    assert 0 < after[0] <= 1.001 * most
    assert np.abs(np.diff(after)).max() <= 1.001 * most
    np.testing.assert_allclose(np.diff(after)[after[1:] < 0.01], most)


@pytest.mark.slow
def test_a_closed_loop_with_a_slew_limit_goes_on_after_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pulled_with_a_slew_limit(tmp_path) as (camera, line):
        report = record(
            load_rig(tmp_path / "rig.toml"), camera, line.port, path, estimators=["o3"], exposures=11,
            control="integrator", reconnect_s=20, progress=pulling(line, after=3),
        )  # fmt: skip
    check_whole(path, report, 11)
    assert report.ports_vanished == 1
    for block in messages_of(pb.CommandBlock, Recording(path), topics.COMMAND):
        assert np.abs(np.diff(block.u)).max(initial=0.0) <= 1.001 * SLEW * RIG.timing.fast_step_s
