"""A GigE camera before a PlayzerX, in a process of their own: each picture shows where the mirror has moved the spot.

The camera, on the network, runs freely by its own clock; the mirror, on a pseudo terminal, puts its samples out by its
own. Pictures are rendered when they are due: 0.3 ms in which the camera answers nothing.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.exposure import step_shares
from aolink.optics.camera import pixel_noise_sd, to_counts
from aolink.optics.frame import frame_density
from aolink.rig import Rig, load_rig
from tests.devices.cameras.gige import codes, packed
from tests.devices.simulators.gige import Camera, Faults, camera_process, serve
from tests.devices.simulators.playzerx import PlayzerX

FORMAT = "Mono12p"
CAMERA_FAST, MIRROR_FAST = 60e-6, -80e-6
"""By how much the clocks of both are faster than this machine's, as a part."""


NO_FAULTS = Faults()


class Spot:
    """The spot of a rig file, moved by a mirror, and what a camera sees of it."""

    def __init__(self, rig: Rig, mirror: PlayzerX) -> None:
        self._rig, self._mirror = rig, mirror
        self._random = np.random.default_rng(rig.simulation.seed)
        self._noise_root = rig.plant.B_w @ np.linalg.cholesky(rig.plant.process_noise)
        self._to_monotonic_ns = time.monotonic_ns() - time.time_ns()
        self._zero_ns = 0
        self._states = [rig.plant.initial_mean]
        """At the beginning of each of the mirror's samples, (n_states,), and at the end of the last."""
        self._starts: list[float] = []
        """When the exposure of each picture started, samples from the mirror's first; below 0 before that."""

    def picture(self, frame_id: int, end_ns: int) -> NDArray[np.uint8]:
        """The bytes of a picture whose exposure ends now, ns since 1970."""
        rig, mirror, n_steps = self._rig, self._mirror, self._rig.timing.exposure_steps
        end_ns += self._to_monotonic_ns
        with mirror.lock:
            mirror.inputs_at(end_ns)
            zero_ns, held = mirror.zero_ns, np.array([sample[:2] for sample in mirror.put_out]).reshape(-1, 2)
        self._follow(zero_ns, held / 2047.5 - 1)
        start = (end_ns - zero_ns) / mirror.period_ns - n_steps if zero_ns else -1.0
        self._starts.append(start)
        first, offset = divmod(max(start, 0.0), 1.0)
        path = rig.plant.C @ np.array(self._states[int(first) : int(first) + n_steps + 1]).T
        density = frame_density(rig.sensor, path[:, :n_steps])
        beyond = step_shares(n_steps, offset)[n_steps:].sum()
        density += beyond * (frame_density(rig.sensor, path[:, -1:]) - frame_density(rig.sensor, path[:, :1]))
        density += self._random.normal(0.0, pixel_noise_sd(rig.sensor), density.shape)
        picture: NDArray[np.uint8] = packed(to_counts(rig.sensor, density)[None], PIXEL_FORMATS[FORMAT])[0]
        return picture

    def told(self) -> dict[str, Any]:
        """What really happened."""
        path = self._rig.plant.C @ np.array(self._states).T
        return {"starts": self._starts, "path": path.tolist(), "output": self._mirror.at_rest()}

    def _follow(self, zero_ns: int, held: NDArray[np.float64]) -> None:
        """Go on with the samples that the mirror has put out; from the beginning where its queue was emptied."""
        plant = self._rig.plant
        if zero_ns != self._zero_ns:
            self._zero_ns, self._states = zero_ns, [plant.initial_mean]
        for u in held[len(self._states) - 1 :]:
            noise = self._noise_root @ self._random.standard_normal(self._noise_root.shape[1])
            self._states.append(plant.A @ self._states[-1] + plant.B @ u + noise)


class Truth(NamedTuple):
    """What really happened in a session."""

    starts: NDArray[np.float64]
    """When the exposures of all pictures started, samples from the mirror's first."""
    path: NDArray[np.float64]
    """Where the spot was at each sample, (2, samples)."""
    output: list[Any]
    """What the mirror goes on putting out: x, y and its colours."""


class MixedBench:
    """Both devices, seen from a test."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.mirror_port = camera.beside

    def truth(self) -> Truth:
        said = json.loads(self._camera.asked())
        return Truth(np.array(said["starts"]), np.array(said["path"]), said["output"])


@contextmanager
def mixed_bench(folder: Path, rig: Rig, faults: Faults = NO_FAULTS) -> Iterator[MixedBench]:
    """Run both; the rig file is that of the spot, the faults are the camera's."""
    path = folder / "bench.toml"
    path.write_text(rig.toml)
    with camera_process(__name__, rig=str(path), faults=asdict(replace(faults, clock_fast=CAMERA_FAST))) as camera:
        yield MixedBench(camera)


def _serve_both(rig: Rig, faults: Faults) -> None:
    with PlayzerX(rate_error=MIRROR_FAST) as mirror:
        spot = Spot(rig, mirror)
        serve(spot.picture, codes(FORMAT), faults, mirror.port, spot.told)


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    sys.stdin.readline()  # it is its turn
    _serve_both(load_rig(given["rig"]), Faults(**given["faults"]))
