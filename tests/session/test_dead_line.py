"""A mirror whose line is cut, over real pseudo terminals and in real time."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import subprocess
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from aolink.errors import DeviceError
from aolink.recording import topics
from aolink.recording.account import Commands
from aolink.recording.facts import recording_facts
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig
from aolink.session import Report, record
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MessageDecoder, PacketDecoder
from aolink.wire.port import SerialPort
from tests.commands import simulated_rig
from tests.kinds import log_of, messages_of


class Forwarder:
    """A line of two pseudo terminals whose middle can be cut; it goes on reading what comes from the device."""

    def __init__(self, device_port: str) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._device = SerialPort(device_port)
        self._cut = threading.Event()
        self._end = threading.Event()
        self.mend_when_latched = False
        self._packets, self._messages = PacketDecoder(), MessageDecoder()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def cut(self) -> None:
        self._cut.set()

    def mend(self) -> None:
        self._cut.clear()

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self._device.close()
        os.close(self._master)
        os.close(self._slave)

    def to_device(self, data: bytes) -> bytes:
        """What the device gets of what the host has sent."""
        return data

    def _run(self) -> None:
        while not self._end.is_set():
            ready, _, _ = select.select([self._master, self._device.fileno()], [], [], 0.1)
            from_host = os.read(self._master, 65_536) if self._master in ready else b""
            from_device = self._device.read_some() if self._device.fileno() in ready else b""
            if self._cut.is_set():
                if self.mend_when_latched and self._says_latched(from_device):
                    self._cut.clear()
                continue
            if from_host:
                self._device.write(self.to_device(from_host))
            if from_device:
                os.write(self._master, from_device)

    def _says_latched(self, data: bytes) -> bool:
        messages = [self._messages.take(packet) for packet in self._packets.feed(data)]
        return any(isinstance(m, pb.Applied) and m.source == pb.Applied.WATCHDOG for m in messages)


@contextlib.contextmanager
def line_of(rig_file: Path) -> Iterator[tuple[str, Forwarder]]:
    """The camera's port of a rig in real time, and its mirror's line, which can be cut."""
    with simulated_rig(rig_file, "--real-time") as (camera, mirror):
        forwarder = Forwarder(mirror)
        try:
            yield camera, forwarder
        finally:
            forwarder.close()


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    text = load_rig("section-vi").toml
    path.write_text(text.replace("block_steps = 50", "block_steps = 50\nwatchdog_s = 1.5"))
    return path


def recorded(
    rig: Rig, camera: str, line: Forwarder, path: Path, exposures: int, cut_after: int = -1
) -> tuple[Report | None, str]:
    """A session whose mirror line is cut after some exposures; gives its report or its error."""

    cuts = [cut_after]

    def progress(done: int) -> None:
        if done in cuts:
            cuts.clear()  # once
            line.cut()

    try:
        return record(rig, camera, line.port, path, exposures=exposures, progress=progress), ""
    except DeviceError as error:
        return None, str(error)


@pytest.mark.slow
def test_a_dead_line_ends_the_session_and_the_mirror_stays_parked_until_it_is_told(
    rig_file: Path, tmp_path: Path, aolink: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    rig = load_rig(rig_file)
    with line_of(rig_file) as (camera, line):
        _, error = recorded(rig, camera, line, tmp_path / "a.mcap", 1000, cut_after=3)
        line.mend()
        listed = aolink("devices", line.port).stdout
        again, _ = recorded(rig, camera, line, tmp_path / "b.mcap", 3)
    assert "not acknowledged" in error
    assert "parked by its watchdog" in listed
    recording = Recording(tmp_path / "a.mcap")
    assert recording.complete
    commands = Commands.of(recording_facts(recording)["commands"])
    assert commands.commanded == commands.ended
    assert commands.not_reported > 0
    assert again is not None
    assert (again.ended, again.rearmed) == ("complete", 1)


@pytest.mark.slow
def test_a_line_that_comes_back_is_told_to_go_on_and_the_gap_is_recorded(rig_file: Path, tmp_path: Path) -> None:
    rig = load_rig(rig_file)
    with line_of(rig_file) as (camera, line):
        line.mend_when_latched = True
        report, error = recorded(rig, camera, line, tmp_path / "a.mcap", 20, cut_after=3)
    assert report is not None, error
    assert (report.ended, report.rearmed) == ("complete", 1)
    assert report.commands.commanded == report.commands.ended
    recording = Recording(tmp_path / "a.mcap")
    held = messages_of(pb.Applied, recording, topics.APPLIED)
    assert any(m.source == pb.Applied.WATCHDOG for m in held)
    assert any("re-armed" in text for text in log_of(recording.path))
