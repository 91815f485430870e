"""Rows about mirrors without a queue, and about the comparison of two clocks."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aolink.devices.paced import PacedMirror
from aolink.jobs.demo import simulated_rig
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from bench_rows.row import Effort, Row

_STEP_S = 0.002
_STEPS = 10_000
_FEW = 10
"""Limit of the late steps in `_STEPS` steps."""
_SLEEPER = """
import sys, time
step_ns, n_steps = map(int, sys.argv[1:])
first_ns, late = time.monotonic_ns() + step_ns, 0
for begins_ns in range(first_ns, first_ns + n_steps * step_ns, step_ns):
    time.sleep(max(begins_ns - time.monotonic_ns(), 0) / 1e9)
    late += time.monotonic_ns() - begins_ns > step_ns // 2
print(late)
"""
"""A process that only sleeps until each step begins, and counts those in which it woke later than half-way."""


class _AtOnce:
    """A mirror that takes its inputs in no time."""

    description = "at once"

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        return u

    def park(self) -> None: ...

    def close(self) -> None: ...


def late_steps(effort: Effort) -> Row:
    """How many steps come late because this machine does something else, with a mirror that the host drives, and in
    how many a process beside it that only sleeps wakes late."""
    rig = load_rig("section-vi")
    rig = replace(rig, timing=replace(rig.timing, fast_step_s=_STEP_S))
    mirror, n_steps = PacedMirror(rig, _AtOnce()), effort.of(_STEPS, 50)
    arguments = [sys.executable, "-c", _SLEEPER, str(rig.timing.fast_step_ns), str(n_steps)]
    sleeper = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
    first = mirror.time_ns() // rig.timing.fast_step_ns + 50
    mirror.send(first, np.linspace(0.0, 0.05, n_steps)[:, None])
    late, reported = 0, 0
    while reported < first + n_steps:
        for held in mirror.applied():
            reported = held[0] + len(held[1])
            late += int(np.count_nonzero(np.asarray(held[2]))) if len(held) > 2 else 0
        time.sleep(0.01)
    mirror.close()
    asleep = int(sleeper.communicate()[0])
    few = _FEW * n_steps / _STEPS
    return Row(
        f"steps of {_STEP_S * 1e3:g} ms that are late without a queue", f"{late} of {n_steps}",
        f"a bare sleep {asleep}, limit {few:.1f}", few / max(late, 0.1), 1.0,
    )  # fmt: skip


def clock_sd(effort: Effort) -> Row:
    """How well the clock of a device behind a pseudo terminal is known, in a session in real time."""
    rig = load_rig("section-vi")
    with tempfile.TemporaryDirectory() as folder, simulated_rig("section-vi", "--real-time") as (camera, mirror):
        path = Path(folder) / "a.mcap"
        record(rig, camera, mirror, path, exposures=effort.of(50, 3))
        sd_ns = np.median([each.clock_sigma_ns for each in Recording(path).exposures()])
    limit_ns = rig.timing.fast_step_ns / 5
    return Row(
        "sd of a clock on a pseudo terminal", f"{sd_ns / 1e3:.0f} us", f"a fifth of a step: {limit_ns / 1e3:.0f} us",
        float(limit_ns / sd_ns), 1.0,
    )  # fmt: skip
