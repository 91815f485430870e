"""A small rig in real time: a driver of aolink, a simulated mirror on a pseudo terminal, a camera that sees it."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink import estimate
from aolink.devices.paced import Outages
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.extensions import installed
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report
from tests.devices.simulators import spot_camera
from tests.packages import package

FAST_STEP_S = 0.01
Measured = TypeVar("Measured")
_HELD_UP_NS = 100_000_000
_DRIVE_OF_A_STEP = 0.02
"""More than the drive of these rigs changes an input by from step to step."""
_CHANGES = (
    ("fast_step_s = 0.0005", f"fast_step_s = {FAST_STEP_S}"),
    ("exposure_steps = 100 ", "exposure_steps = 10 "),
    ("resonance_hz = 150.0", "resonance_hz = 8.0"),
    ("process_noise = 3e-4", "process_noise = 1e-6"),
    ("dac_bits = 16", "dac_bits = 16\nwatchdog_s = 30.0"),
    ("block_steps = 50", "block_steps = 10"),
    ("period_s = 2.0", "period_s = 4.0"),
)


def rig_with(devices: str) -> Rig:
    """A mirror of two inputs with 10 fast steps of 10 ms in an exposure, and with these tables of its devices."""
    text, disturbed = load_rig("tip-tilt").toml.split("[disturbance]")
    for old, new in _CHANGES:
        assert old in text
        text = text.replace(old, new)
    return parse_rig(f"{text}\n[simulation]{disturbed.split('[simulation]')[1]}\n{devices}")


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, **drivers: str) -> None:
    """A package with the camera of the tests, and with these drivers of mirrors."""
    points = "".join(f"{name} = {target}\n" for name, target in drivers.items())
    camera = "[aolink.cameras]\nspot = tests.devices.simulators.spot_camera:SpotCamera\n"
    package(folder, "bench", f"{camera}[aolink.mirrors]\n{points}")
    monkeypatch.syspath_prepend(folder)
    installed.cache_clear()
    monkeypatch.setattr(spot_camera.mirror, "held", None)


def watch(
    held: list[tuple[int, tuple[float, ...]]], inputs: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> None:
    """Let the camera see a simulated mirror by its list of what it held since when."""
    spot_camera.mirror.held = seen(held, inputs)


def seen(
    held: list[tuple[int, tuple[float, ...]]], inputs: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> spot_camera.Held:
    """What the camera sees of it."""

    def at(time_ns: int) -> NDArray[np.float64]:
        now = bisect.bisect_right(held, time_ns, key=lambda each: each[0])
        return inputs(np.array(held[max(now - 1, 0)][1]))

    return at


def check_session(report: Report, path: Path, mirror: str) -> None:
    """Ten exposures with a mirror whose description begins so: complete, each step accounted for, well estimated."""
    assert (report.ended, report.frames_received) == ("complete", 10)
    ends = (report.commands.applied, report.commands.late, report.commands.superseded, report.commands.not_reported)
    assert (sum(ends), report.commands.clipped) == (report.commands.commanded, 0)
    recording = Recording(path)
    assert recording.metadata["mirror"].startswith(mirror)
    exposures = list(recording)
    assert max(np.abs(each.inputs).max() for each in exposures) > 0.2
    assert all(each.truth is not None for each in exposures)
    check_paths(recording.rig, zip(exposures, estimate(path, "o1").estimates("o1"), strict=True))


def check_paths(rig: Rig, estimated: Iterable[tuple[Exposure, Estimate]], within: float = 0.05) -> None:
    """The paths of exposures are as the camera of the tests saw them; ``within`` is for an input that is a step late.

    A host that is held up cannot tell when the device took an input that it sent just before, and the simulator is held
    up with it. So they may differ where one of them holds an input and the other one has gone on. Then the path may be
    wrong by what the plant makes of the difference, and by a step of its own motion. This excuses a third of the
    exposures at most.
    """
    plant, wrong, pairs, excused = rig.plant, np.zeros_like(rig.plant.initial_mean), list(estimated), 0
    commanded_before = saw_before = rig.mirror.park
    for exposure, found in pairs:
        assert exposure.truth is not None or exposure.n_steps != rig.timing.exposure_steps
        allowance = 0.0
        for commanded, saw in zip(exposure.inputs, spot_camera.saw[exposure.device_start_ns], strict=False):
            allowance = max(allowance, np.abs(plant.C @ wrong).max())
            off = saw - commanded
            if np.abs(off).max() < _DRIVE_OF_A_STEP:
                off = np.zeros_like(off)
            else:
                assert np.array_equal(commanded, commanded_before) or np.array_equal(saw, saw_before)
            wrong, commanded_before, saw_before = plant.A @ wrong + plant.B @ off, commanded, saw
        excused += allowance > within
        if exposure.truth is not None:
            path = exposure.truth.path
            if allowance > 0:
                allowance += np.abs(np.diff(path)).max()
            assert np.abs(found.path - path).max() < within + allowance
    assert excused <= len(pairs) // 3


def check_ended(report: Report, path: Path) -> None:
    """A session that an error has ended: what was recorded until then is whole."""
    recording = Recording(path)
    assert recording.complete
    assert len(list(recording)) >= report.exposures > 0


def undisturbed(measured: Callable[[], Measured]) -> Measured:
    """What is measured in real time, in a try in which the machine holds this process up for less than a tenth of a
    second; of five tries one should be so."""
    for _ in range(5):
        outages = Outages(2_000_000)
        try:
            found = measured()
            if outages.total_ns() < _HELD_UP_NS:
                return found
        except Exception:
            if outages.total_ns() < _HELD_UP_NS:
                raise
        finally:
            outages.close()
    pytest.skip("the machine has held this process up each time")
