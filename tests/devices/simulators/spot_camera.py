"""A camera that sees the spot which a simulated mirror moves: what the mirror held when, not what it was told."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from aolink.devices.simple import SimpleFrame
from aolink.exposure import Truth
from aolink.optics.camera import to_counts
from aolink.optics.frame import frame_density
from aolink.rig import Rig

Held = Callable[[int], NDArray[np.float64]]
"""The rig's inputs that a mirror holds at a time of `time.monotonic_ns`, (n_inputs,)."""
mirror = SimpleNamespace(held=None)
"""What it looks at."""
mirrors: dict[str, Held] = {}
"""What it looks at where its key ``sees`` says so, for several sessions at once."""
saw: dict[int, NDArray[np.float64]] = {}
"""What the mirror held in each fast step of its exposures, (n_steps, n_inputs), by their starts."""


class SpotCamera:
    """A simple driver of itself. Its exposures begin with a fast step of the mirror, as if they were triggered.

    Where its clock is ``faster`` than the mirror's, by that part, they do so at first only.
    """

    description = "camera of the tests"

    def __init__(self, rig: Rig, *, sees: str = "", faster: float = 0.0) -> None:
        self._rig, self._held = rig, mirrors.pop(sees, mirror.held)
        self._state = rig.plant.initial_mean
        self._start_ns = self._followed_ns = 0
        self._step_ns = round(rig.timing.fast_step_ns * (1 - faster))

    def time_ns(self) -> int:
        return time.monotonic_ns()

    def start(self, start_ns: int, exposures: int) -> None:
        self._start_ns = self._followed_ns = start_ns

    def frames(self) -> Iterable[SimpleFrame]:
        timing = self._rig.timing
        exposure_ns, period_ns = (n * self._step_ns for n in (timing.exposure_steps, timing.frame_period_steps))
        while self._start_ns and self.time_ns() > self._start_ns + exposure_ns:
            truth = self._follow(self._start_ns, timing.exposure_steps)
            pixels = to_counts(self._rig.sensor, frame_density(self._rig.sensor, truth.path))
            yield SimpleFrame(pixels=pixels, start_ns=self._start_ns, exposure_ns=exposure_ns, truth=truth)
            self._start_ns += period_ns

    def stop(self) -> None:
        self._start_ns = 0

    close = stop

    def _follow(self, start_ns: int, n_steps: int) -> Truth:
        """The spot follows what the mirror held in the middle of each fast step, to the end of an exposure."""
        plant, step_ns, passed, held = self._rig.plant, self._step_ns, [], []
        end_ns = start_ns + n_steps * step_ns
        for begin_ns in range(self._followed_ns, end_ns, step_ns):
            passed.append(self._state)
            held.append(self._held(begin_ns + step_ns // 2))
            self._state = plant.A @ self._state + plant.B @ held[-1]
        saw[start_ns] = np.array(held[-n_steps:])
        self._followed_ns, states = end_ns, np.array(passed[-n_steps:])
        return Truth(start_state=states[:1], end_state=self._state[None], path=plant.C @ states.T)
