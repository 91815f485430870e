"""On every way out of a session the mirror is left at its safe input, whichever serial mirror it is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import DeviceError
from aolink.extensions import installed
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import Report, record
from aolink.wire import messages_pb2 as pb
from tests.devices.mirrors import bench
from tests.devices.mirrors.serial_mirrors import MIRRORS, UNDER_WAY, with_each
from tests.kinds import messages_of

WATCHDOG_S, RESTS_S = 1.0, 1.5
PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def _camera(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    bench.install(monkeypatch, tmp_path)
    yield
    installed.cache_clear()


@pytest.mark.slow
def test_a_camera_that_fails(tmp_path: Path) -> None:
    np.save(tmp_path / "film.npy", np.full((6, 20, 20), 400, dtype=np.uint16))

    def check(name: str) -> None:
        camera = 'driver = "folder"\npath = "film.npy"\nrepeat = false'
        with MIRRORS[name].make() as device:
            file = tmp_path / f"{name}.toml"
            file.write_text(MIRRORS[name].rig(device, camera).toml)
            rig = load_rig(file)
            with pytest.raises(DeviceError, match=r"film\.npy has ended after 6 pictures"):
                record(rig, None, None, tmp_path / f"{name}.mcap", report=(report := Report()))
            assert device.moves > 1
            assert MIRRORS[name].is_parked(device)
        bench.check_ended(report, tmp_path / f"{name}.mcap")

    with_each(check)


@pytest.mark.slow
def test_an_exception_in_the_session(tmp_path: Path) -> None:
    def check(name: str) -> None:
        def stop() -> bool:
            if device.moves > UNDER_WAY:
                raise ZeroDivisionError("of the program that called")
            return False

        with MIRRORS[name].make() as device:
            rig = MIRRORS[name].rig(device)
            with pytest.raises(ZeroDivisionError, match="of the program that called"):
                record(rig, None, None, tmp_path / f"{name}.mcap", stop=stop)
            assert MIRRORS[name].is_parked(device)
        assert Recording(tmp_path / f"{name}.mcap").complete

    with_each(check)


@pytest.mark.slow
def test_a_session_that_stalls(tmp_path: Path) -> None:
    """The host's watchdog parks a mirror that the session's thread has left alone, and the recording says so."""

    def check(name: str) -> None:
        parked_by_then: list[bool] = []

        def stall() -> bool:
            """Hold up the session's own thread once the mirror moves, until it has rested at its safe input."""
            if device.moves > UNDER_WAY and not parked_by_then:
                deadline = time.monotonic() + PATIENCE_S
                since, moves = time.monotonic(), device.moves
                while time.monotonic() < min(since + RESTS_S, deadline):
                    if device.moves != moves:
                        since, moves = time.monotonic(), device.moves
                    time.sleep(0.01)
                parked_by_then.append(MIRRORS[name].holds_the_safe_input(device))
            return bool(parked_by_then)

        with MIRRORS[name].make() as device:
            rig = MIRRORS[name].rig(device, watchdog_s=WATCHDOG_S)
            record(rig, None, None, tmp_path / f"{name}.mcap", stop=stall)
            assert MIRRORS[name].is_parked(device)
        assert parked_by_then == [True]
        recording = Recording(tmp_path / f"{name}.mcap")
        assert recording.complete
        sources = {each.source for each in messages_of(pb.Applied, recording, topics.APPLIED)}
        assert pb.Applied.WATCHDOG in sources, name

    with_each(check)
