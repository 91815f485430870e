"""The mirror is asked to park until it has confirmed that: over a bad line, and however often that is interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from aolink.devices.adapted_mirror import AdaptedMirror
from aolink.devices.discovery import identify_port
from aolink.devices.interfaces import CommandAnswered
from aolink.errors import DeviceError
from aolink.jobs.demo import simulated_rig
from aolink.recording.reader import Recording
from aolink.rig import parse_rig
from aolink.signals import Interrupted
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import PacketDecoder, PacketType
from tests.control.rigs import DRIFT, small_rig
from tests.devices.test_simple_drivers import Bench, mirror_of
from tests.session.pulled_line import PulledLine
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session
from tests.session.test_beside import until

RIG = parse_rig(small_rig(DRIFT).toml.replace("watchdog_s = 2.0", "watchdog_s = 9.0\nqueue_steps = 4000"))
"""Neither its watchdog nor an empty queue parks this mirror for seconds."""


class LosingHub(SimulatedTimeHub):
    """A rig that does not hear the first requests to park."""

    def __init__(self, lost: int) -> None:
        super().__init__(RIG)
        self.parks: list[int] = []
        """When the host asked the mirror to park."""
        way, decoder = self.to_device["mirror"], PacketDecoder()
        write = way.write

        def lossy(data: bytes) -> int:
            if not any(packet.type == PacketType.PARK for packet in decoder.feed(data)):
                return write(data)
            self.parks.append(self.clock_ns)
            return write(data) if len(self.parks) > lost else len(data)

        way.write = lossy  # type: ignore[method-assign]


def interrupted_session(hub: LosingHub, folder: Path) -> Run:
    done: list[int] = []
    return run_session(
        hub, RIG, folder / "a.mcap", 0, stop=lambda: bool(done and done[-1] >= 3), progress=done.append
    )  # fmt: skip


def is_parked(hub: LosingHub) -> bool:
    return hub.server.devices.parked and not hub.server.devices.latched


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1, 2, 5, 12])
def test_a_mirror_that_does_not_hear_it_is_asked_again(tmp_path: Path, lost: int) -> None:
    """Also after a request to stop: the session ends in good order, and what was queued is superseded."""
    run = interrupted_session(hub := LosingHub(lost), tmp_path)
    assert (run.error, run.report.ended, run.report.warnings) == (None, "interrupted", [])
    assert is_parked(hub)
    assert len(hub.parks) == lost + 1
    assert run.report.commands.superseded > 1000


@pytest.mark.slow
def test_a_mirror_whose_confirmation_is_lost_is_asked_again(tmp_path: Path) -> None:
    hub, heard = LosingHub(0), list[Message]()

    def forgetful(message: Message) -> Message | None:
        if isinstance(message, pb.Ack) and len(heard) < 4:
            heard.append(message)
            return None
        return message

    hub.change("mirror", forgetful)
    run = interrupted_session(hub, tmp_path)
    assert (run.error, len(heard), len(hub.parks)) == (None, 4, 5)
    assert is_parked(hub)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.01, 0.1])
def test_an_interruption_while_it_parks_does_not_end_that(tmp_path: Path, seconds: float) -> None:
    """A second Ctrl-C comes while the mirror has not confirmed it yet."""
    hub = LosingHub(3)
    interruptions = [seconds]

    def interrupt() -> None:
        if hub.parks and hub.clock_ns - hub.parks[0] > interruptions[0] * 1e9:
            hub.at.clear()
            raise Interrupted(signal.SIGINT)
        hub.at = [(hub.clock_ns + 1_000_000, interrupt)]

    hub.at = [(1_000_000, interrupt)]
    run = interrupted_session(hub, tmp_path)
    assert isinstance(run.error, Interrupted)
    assert not run.report.warnings
    assert is_parked(hub)
    assert len(hub.parks) == 4


@pytest.mark.slow
def test_a_mirror_that_says_nothing_more_is_given_up(tmp_path: Path) -> None:
    """Its watchdog parks it, which has begun when it heard something last."""
    hub, done = LosingHub(100), list[int]()

    def stop() -> bool:
        if done and done[-1] >= 3 and not hub.to_host["mirror"].cut:
            hub.cut()
        return hub.to_host["mirror"].cut

    run = run_session(hub, RIG, tmp_path / "a.mcap", 0, stop=stop, progress=done.append)
    assert isinstance(run.error, DeviceError)
    assert "asked to park" in str(run.error)
    asked_s = (hub.parks[-1] - hub.parks[0]) / 1e9
    assert 9.5 < asked_s < 11  # 5 s, and as long by whoever deals with the error


@pytest.mark.slow
def test_a_mirror_that_talks_and_never_confirms_is_given_up_too(tmp_path: Path) -> None:
    run = interrupted_session(hub := LosingHub(1000), tmp_path)
    assert isinstance(run.error, DeviceError)
    assert len(hub.parks) == 2 * 200


def test_answers_that_have_not_been_taken_are_not_lost() -> None:
    mirror: AdaptedMirror = mirror_of(bench := Bench())
    block = mirror.send_block(0, np.zeros((4, 1)), 0, bench.host_ns)
    (answer,) = mirror.last_answers()
    assert isinstance(answer, CommandAnswered)
    assert (answer.block, answer.tries) == (block, 1)
    assert not mirror.last_answers()


class DeafLine(PulledLine):
    """A line that loses each request to park while it is deaf."""

    deaf, parks = True, 0

    def __init__(self, device_port: str, link: Path) -> None:
        self._from_host = PacketDecoder()
        super().__init__(device_port, link)

    def to_device(self, data: bytes) -> bytes:
        parks = sum(packet.type == PacketType.PARK for packet in self._from_host.feed(data))
        self.parks += parks
        return b"" if parks and self.deaf else data


@pytest.mark.rare
def test_a_second_ctrl_c_does_not_leave_the_mirror_where_it_is(tmp_path: Path) -> None:
    rig, path = tmp_path / "rig.toml", tmp_path / "a.mcap"
    rig.write_text(RIG.toml.replace("watchdog_s = 9.0", "watchdog_s = 60.0").replace("= 4000", "= 40000"))
    with simulated_rig(rig, "--real-time") as (camera, mirror):
        with closing(DeafLine(mirror, tmp_path / "mirror")) as line:
            command = [
                sys.executable, "-m", "aolink", "record", "--camera", camera, "--mirror", line.port, "--rig", str(rig),
                "-o", str(path),
            ]  # fmt: skip
            with subprocess.Popen(
                command, stderr=subprocess.PIPE, text=True,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            ) as process:  # fmt: skip
                try:
                    until(lambda: path.exists() and path.stat().st_size > 30_000)
                    os.kill(process.pid, signal.SIGINT)
                    until(lambda: line.parks > 12)  # for longer than a terminal may take to send one signal twice
                    os.kill(process.pid, signal.SIGINT)
                    before = line.parks
                    until(lambda: line.parks > before + 12)
                    line.deaf = False
                    _, said = process.communicate(timeout=60)
                finally:
                    process.kill()
        assert process.returncode == 130, said
        assert identify_port(mirror).geometry.endswith("queue of 40000 steps, parked")
    assert Recording(path).end_metadata["ended"] == "error: Interrupted('interrupted by SIGINT')"
