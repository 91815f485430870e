"""Drivers of another package: a mirror that plays a queue, and a camera that sees the spot that it moves.

Both simulate themselves by the computer's clock. What a driver of a real device asks its maker's library stands here
as a few lines of NumPy.
"""

import time
from types import SimpleNamespace

import numpy as np

from aolink.devices.simple import SimpleFrame
from aolink.errors import DeviceError
from aolink.exposure import Truth
from aolink.optics.camera import to_counts
from aolink.optics.frame import frame_density

light = SimpleNamespace(zero_ns=0, held=[])  # what goes from the mirror to the camera: its inputs, step by step


class Mirror:
    description = "example mirror"

    def __init__(self, rig):
        self._electronics, self._step_ns = rig.mirror, rig.timing.fast_step_ns
        self._queue, self._reported = {}, 0
        light.zero_ns, light.held = time.monotonic_ns(), []

    def time_ns(self):
        return time.monotonic_ns() - light.zero_ns

    def send(self, first_step, u):
        self._play()
        late = min(max(len(light.held) - first_step, 0), len(u))
        self._queue.update(enumerate(self._electronics.quantise(u)[late:], first_step + late))
        return late

    def applied(self):
        self._play()
        first, self._reported = self._reported, len(light.held)
        return [(first, np.array(light.held[first:]))] if self._reported > first else []

    def park(self):
        self._play()
        self._queue.clear()
        return len(light.held)

    def close(self):
        self._queue.clear()

    def _play(self):
        """Put out what is queued for the steps that have begun, and the safe input where nothing is."""
        while len(light.held) <= self.time_ns() // self._step_ns:
            light.held.append(self._queue.pop(len(light.held), self._electronics.park))


class Camera:
    description = "example camera"

    def __init__(self, rig, *, clock_offset_s=12.5):
        if rig.plant.axes > 1:
            raise DeviceError(f"the example camera sees one copy of the plant, {rig.name} has {rig.plant.axes}")
        self._rig, self._offset_ns, self._start_ns = rig, round(clock_offset_s * 1e9), None
        self._state, self._step = rig.plant.initial_mean, 0
        light.zero_ns = light.zero_ns or time.monotonic_ns()

    def time_ns(self):
        return time.monotonic_ns() + self._offset_ns

    def start(self, start_ns, exposures):
        ahead_ns = start_ns - self._offset_ns - light.zero_ns
        self._start_ns = start_ns + -ahead_ns % self._rig.timing.fast_step_ns  # it is triggered by the mirror's steps

    def frames(self):
        timing = self._rig.timing
        exposure_ns, period_ns = (n * timing.fast_step_ns for n in (timing.exposure_steps, timing.frame_period_steps))
        while self._start_ns is not None and self.time_ns() > self._start_ns + exposure_ns + 2 * timing.fast_step_ns:
            first_step = round((self._start_ns - self._offset_ns - light.zero_ns) / timing.fast_step_ns)
            truth = self._move(first_step, timing.exposure_steps)
            pixels = to_counts(self._rig.sensor, frame_density(self._rig.sensor, truth.path))
            yield SimpleFrame(pixels=pixels, start_ns=self._start_ns, exposure_ns=exposure_ns, truth=truth)
            self._start_ns += period_ns

    def stop(self):
        self._start_ns = None

    close = stop

    def _move(self, first_step, n_steps):
        """The spot follows the mirror as the rig's plant says, step by step to the end of an exposure."""
        plant, passed, held = self._rig.plant, [], light.held or [self._rig.mirror.park]
        for step in range(self._step, first_step + n_steps):
            passed.append(self._state)
            self._state = plant.A @ self._state + plant.B @ held[min(step, len(held) - 1)]
        self._step, states = first_step + n_steps, np.array(passed[-n_steps:])
        return Truth(start_state=states[:1], end_state=self._state[None], path=plant.C @ states.T)
