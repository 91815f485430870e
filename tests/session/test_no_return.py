"""Ports that vanish during a session, which ends: another device returns, none does, or nobody wants to wait."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from google.protobuf.message import Message

from aolink.errors import DeviceError, PortError, RigError
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.session.pulled_line import pulled_line
from tests.session.test_reconnect import once_latched, pulling

RIG = load_rig("section-vi")
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def ports() -> Iterator[tuple[str, str]]:
    """Camera and mirror of a rig that goes on from test to test."""
    with simulated_rig("section-vi", "--real-time") as ports:
        yield ports


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "why"),
    [
        ("9", "serial_number"),
        ("1", "restarted"),
    ],
)
def test_another_device_on_the_port_ends_the_session(
    ports: tuple[str, str], tmp_path: Path, seed: str, why: str
) -> None:
    """A rig with the same seed has the same serial number, and is what a device is that has been restarted."""
    path, (camera, mirror) = tmp_path / "a.mcap", ports
    with (
        simulated_rig("section-vi", "--real-time", "--seed", seed) as (_, other),
        pulled_line(mirror, tmp_path / "mirror", once_latched) as line,
    ):
        pull = pulling(line, after=2)

        def swap(exposures: int) -> None:
            line.device_port = other
            pull(exposures)

        with pytest.raises(DeviceError, match=why):
            record(RIG, camera, line.port, path, reconnect_s=20, progress=swap)
    assert Recording(path).complete


def test_a_port_that_does_not_return_ends_the_session_with_what_came(ports: tuple[str, str], tmp_path: Path) -> None:
    path, (camera, mirror) = tmp_path / "a.mcap", ports
    with (
        pulled_line(camera, tmp_path / "camera") as line,
        pytest.raises(PortError, match=r"did not return.*saved"),
    ):
        record(RIG, line.port, mirror, path, reconnect_s=0.5, progress=pulling(line, after=2))
    recording = Recording(path)
    assert recording.complete
    assert recording.n_frames >= 2
    assert recording.metadata["ports_vanished"] == "1"


def test_without_the_option_a_port_that_vanishes_ends_the_session(ports: tuple[str, str], tmp_path: Path) -> None:
    path, (camera, mirror) = tmp_path / "a.mcap", ports
    with (
        pulled_line(mirror, tmp_path / "mirror") as line,
        pytest.raises(PortError, match="not be parked"),
    ):
        record(RIG, camera, line.port, path, progress=pulling(line, after=2))
    assert Recording(path).complete


def test_a_session_is_interrupted_while_a_port_is_gone(ports: tuple[str, str], tmp_path: Path) -> None:
    """Ctrl-C is heard; that the mirror could not be told to park is a warning, and its watchdog parks it."""
    path, (camera, mirror) = tmp_path / "a.mcap", ports
    parked = threading.Event()

    def back(message: Message) -> bool:
        if once_latched(message):
            parked.set()
        return False

    with pulled_line(mirror, tmp_path / "mirror", back) as line:
        report = record(
            RIG, camera, line.port, path, reconnect_s=60, progress=pulling(line, after=2), stop=parked.is_set
        )
    assert report.ended == "interrupted"
    assert any("still there" in warning for warning in report.warnings)
    assert Recording(path).complete


@pytest.mark.slow
def test_a_rig_whose_ports_vanish_by_its_rate(aolink: Run) -> None:
    with simulated_rig("section-vi", "--real-time", "--fault", "vanish=0.01", "--fault", "vanish_s=0.3") as ports:
        camera, mirror = ports
        found = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi", "--exposures", "15", "--reconnect",
            "20", "-o", "a.mcap", "--json",
        )  # fmt: skip
    assert found.returncode == 0, found.stderr
    report = json.loads(found.stdout)
    assert report["ports_vanished"] > 0
    assert report["frames_received"] + report["frames_lost"] == 15
    assert not Path(camera).parent.exists()


@pytest.mark.slow
def test_virtual_time_has_no_ports_that_vanish(aolink: Run) -> None:
    rig = aolink("sim", "section-vi", "--fault", "vanish=0.01")
    assert rig.returncode == RigError.exit_code
    assert "--real-time" in rig.stderr
    with simulated_rig("section-vi") as (camera, mirror):
        found = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi", "--reconnect", "5", "-o", "a.mcap"
        )
    assert found.returncode == DeviceError.exit_code
    assert "runs on virtual time" in found.stderr
