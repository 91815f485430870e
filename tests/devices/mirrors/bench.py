"""A small rig in real time: a driver of aolink, a simulated mirror on a pseudo terminal, a camera that sees it."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink import estimate
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.extensions import installed
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report
from tests.devices.simulators import spot_camera

FAST_STEP_S = 0.01
_DRIVE_OF_A_STEP = 0.02
"""More than the drive of these rigs changes an input by from step to step."""
_HELD_UP_STEPS = 100
"""A busy machine does not run for this long."""
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
    info = folder / "bench-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench\nVersion: 1.0\n")
    points = "".join(f"{name} = {target}\n" for name, target in drivers.items())
    (info / "entry_points.txt").write_text(
        f"[aolink.cameras]\nspot = tests.devices.simulators.spot_camera:SpotCamera\n[aolink.mirrors]\n{points}"
    )
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
    ends = (report.steps_applied, report.steps_late, report.steps_superseded, report.steps_not_reported)
    assert (sum(ends), report.steps_clipped) == (report.steps_commanded, 0)
    recording = Recording(path)
    assert recording.metadata["mirror"].startswith(mirror)
    exposures = list(recording)
    assert max(np.abs(each.inputs).max() for each in exposures) > 0.2
    assert all(each.truth is not None for each in exposures)
    check_paths(recording.rig, zip(exposures, estimate(path, "o1"), strict=True))


def check_paths(rig: Rig, estimated: Iterable[tuple[Exposure, Estimate]], within: float = 0.05) -> None:
    """The paths of exposures are as the camera of the tests saw them; ``within`` is for an input that is a step late.

    A host that is held up cannot tell when the device took an input that it sent just before, and the simulator is held
    up with it: they may differ about when a jump was. The path may be wrong then by what the plant makes of that, and
    by no more; and by a step of its own motion, since exposures begin where a step does or nearly so.
    """
    plant, wrong, pairs = rig.plant, np.zeros_like(rig.plant.initial_mean), list(estimated)
    told = np.concatenate([exposure.inputs for exposure, _ in pairs])
    now = 0
    for exposure, found in pairs:
        excused = 0.0
        for row in spot_camera.saw[exposure.device_start_ns][: exposure.n_steps]:
            near = told[max(now - _HELD_UP_STEPS, 0) : now + _HELD_UP_STEPS]
            assert np.abs(near - row).max(axis=1).min() < _DRIVE_OF_A_STEP
            off = row - told[now]
            excused = max(excused, np.abs(plant.C @ wrong).max())
            wrong = plant.A @ wrong + plant.B @ off * bool(np.abs(off).max() >= _DRIVE_OF_A_STEP)
            now += 1
        if exposure.truth is not None:
            path = exposure.truth.path
            excused += np.abs(np.diff(path)).max()
            assert np.abs(found.path - path).max() < within + excused


def check_ended(report: Report, path: Path) -> None:
    """A session that an error has ended: what was recorded until then is whole."""
    recording = Recording(path)
    assert recording.complete
    assert len(list(recording)) >= report.exposures > 0


def steps_ended(report: Report) -> int:
    """How many commanded steps ended in one way or another."""
    return sum((report.steps_applied, report.steps_late, report.steps_superseded, report.steps_refused,
                report.steps_not_reported))  # fmt: skip
