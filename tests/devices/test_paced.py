"""A mirror without a queue: each step's input goes out when the step begins, and what was late is said."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink.devices.paced import PacedMirror
from aolink.devices.simple import Held, Lacks
from aolink.errors import DeviceError
from aolink.rig import Rig, load_rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    """A rig with fast steps that a busy machine can keep up with: 20 ms."""
    section = load_rig("section-vi")
    return replace(section, timing=replace(section.timing, fast_step_s=0.02, exposure_steps=4, frame_period_steps=4))


class Device:
    """What it was given, and when."""

    description = "bench"
    lacks = (Lacks.READ_BACK,)

    def __init__(self) -> None:
        self.given: list[float] = []
        self.busy = threading.Event()
        self.free = threading.Event()
        self.free.set()
        self.refusal: Exception | None = None
        self.parked = self.closed = 0

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        self.busy.set()
        self.free.wait(30.0)
        if self.refusal:
            raise self.refusal
        self.given.append(float(u[0]))
        return np.round(u, 3)

    def park(self) -> None:
        self.parked += 1

    def close(self) -> None:
        self.closed += 1


class StopsTheHost(Device):
    """It answers its first input after 0.1 s, and then this process stands still for 0.3 s."""

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        if not self.given:
            stop_and_go_on = f"sleep 0.1; kill -STOP {os.getpid()}; sleep 0.3; kill -CONT {os.getpid()}"
            subprocess.run(["sh", "-c", stop_and_go_on], check=True)
        return super().put(u)


def reports(mirror: PacedMirror, end: int, first: int = 0) -> list[tuple[float, bool]]:
    """What the mirror held in each step from ``first`` to ``end``, and whether it was late."""
    reported: list[tuple[float, bool]] = []
    while first + len(reported) < end:
        for held in mirror.applied():
            assert isinstance(held, Held)
            assert held.first_step == first + len(reported)
            assert held.late is not None
            reported += zip(held.u[:, 0].tolist(), held.late.tolist(), strict=True)
        time.sleep(0.002)
    return reported


def test_each_step_gets_its_input_or_is_late(rig: Rig) -> None:
    mirror = PacedMirror(rig, device := Device())
    assert mirror.lacks == [Lacks.READ_BACK, Lacks.QUEUE]
    wanted = np.linspace(0.0101, 0.0211, 12)
    first = mirror.time_ns() // rig.timing.fast_step_ns + 4
    assert mirror.send(first, wanted[:, None]) == 0
    reported = reports(mirror, first + 14)
    mirror.close()
    rest = float(rig.mirror.park[0])
    before = rest
    for (held, late), u in zip(reported[first : first + 12], wanted, strict=True):
        assert held == (before if late else round(u, 3))
        before = held if not late else round(u, 3) if round(u, 3) in np.round(device.given, 3) else before
    assert not any(late for _, late in reported[:first])
    assert reported[first + 13][0] == rest  # nothing is queued: the safe input
    assert set(np.round(device.given, 6)) <= {*np.round(wanted, 6), rest}
    assert device.closed == 1
    assert mirror.timing_sigma_ns > 0


def test_a_device_that_is_busy_goes_on_with_the_newest_step(rig: Rig) -> None:
    mirror = PacedMirror(rig, device := Device())
    first = mirror.time_ns() // rig.timing.fast_step_ns + 3
    device.free.clear()
    mirror.send(first, np.linspace(0.001, 0.03, 30)[:, None])
    assert device.busy.wait(30.0)
    while mirror.time_ns() // rig.timing.fast_step_ns < first + 8:
        time.sleep(0.005)
    device.free.set()
    reported = reports(mirror, first + 12)
    mirror.close()
    assert all(late for _, late in reported[first : first + 6])  # it held the safe input all the time
    assert {held for held, _ in reported[first : first + 6]} == {float(rig.mirror.park[0])}
    assert not {0.002, 0.003, 0.004, 0.005} & set(np.round(device.given, 3).tolist())  # what is over is not sent


def test_a_host_that_is_held_up_does_not_make_the_device_late(rig: Rig) -> None:
    """It stands still for fifteen steps, after the device has taken an input and before the host hears so."""
    mirror = PacedMirror(rig, StopsTheHost())
    first = mirror.time_ns() // rig.timing.fast_step_ns + 5
    mirror.send(first, np.linspace(0.001, 0.03, 30)[:, None])
    reported = reports(mirror, first + 30)
    mirror.close()
    during = reported[first + 8 : first + 18]
    assert all(late for _, late in during)  # their own inputs were not sent
    assert {held for held, _ in during} == {0.001}


def test_parking_empties_the_queue(rig: Rig) -> None:
    mirror = PacedMirror(rig, device := Device())
    first = mirror.time_ns() // rig.timing.fast_step_ns + 3
    mirror.send(first, np.full((50, 1), 0.01))
    reports(mirror, first + 1)
    step = mirror.park()
    assert device.parked == 1
    given = len(device.given)
    list(mirror.applied())
    time.sleep(0.1)
    rest = list(mirror.applied())
    mirror.close()
    assert len(device.given) <= given + 1
    late = [held for report in rest for held in report.u[step + 2 - report.first_step :, 0]]
    assert set(late) <= {float(rig.mirror.park[0])}


def test_what_the_device_raises_reaches_the_session(rig: Rig) -> None:
    mirror = PacedMirror(rig, device := Device())
    device.refusal = DeviceError("the mirror answers OL: overload")
    mirror.send(mirror.time_ns() // rig.timing.fast_step_ns + 2, np.full((4, 1), 0.01))
    with pytest.raises(DeviceError, match="overload"):
        reports(mirror, 10**6)
    mirror.park()
    mirror.close()
    assert (device.parked, device.closed) == (1, 1)


def test_the_steps_in_which_it_is_being_parked_hold_the_input_before(rig: Rig) -> None:
    mirror = PacedMirror(rig, device := Device())
    step_ns = rig.timing.fast_step_ns
    first = mirror.time_ns() // step_ns + 3
    mirror.send(first, np.full((50, 1), 0.01))
    reported = reports(mirror, first + 3)
    asked = mirror.time_ns() // step_ns
    device.park = lambda: time.sleep(0.2)  # type: ignore[method-assign] # ten steps
    safe = mirror.park()
    reported += reports(mirror, safe + 3, len(reported))
    mirror.close()
    assert safe - asked >= 10
    assert {held for held, _ in reported[asked + 1 : safe]} == {0.01}
    assert {held for held, _ in reported[safe:]} == {float(rig.mirror.park[0])}
