"""A mirror without a queue, driven by the host: each step is reported with what the device held in it."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from aolink.devices.paced import PacedMirror
from aolink.rig import load_rig

RIG = load_rig("section-vi")


class Slow:
    """A device that takes an input only when it is told that it may."""

    description = "slow"

    def __init__(self) -> None:
        self.asked, self.may = threading.Event(), threading.Event()

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        self.asked.set()
        self.may.wait()
        return u

    def park(self) -> None:
        pass

    def close(self) -> None:
        pass


def test_reports_taken_while_the_device_is_busy_are_of_the_steps_before() -> None:
    paced = PacedMirror(RIG, device := Slow())
    paced.send(5, np.full((100_000, 1), 0.01))
    device.asked.wait()
    steps: list[int] = []
    inputs: list[float] = []
    while 0.01 not in inputs:
        for held in paced.applied():
            steps += range(held.first_step, held.first_step + len(held.u))
            inputs += held.u[:, 0].tolist()
        device.may.set()
    paced.close()
    assert steps == list(range(len(steps)))
    assert {*inputs[:5]} == {RIG.mirror.park[0]}
