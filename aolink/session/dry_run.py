"""A session that is checked and not begun: devices, clocks, inputs, estimators, disk. The mirror is sent no input."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from aolink.devices.interfaces import ClockSampled, Device, Time
from aolink.devices.opening import open_devices
from aolink.errors import ControlError, RecordingError
from aolink.estimation import Driver
from aolink.files import check_target
from aolink.rig import Rig
from aolink.session import at_rest, controller
from aolink.session.clocks import ClockQueries
from aolink.session.commanding import Inputs
from aolink.session.controlling import served
from aolink.session.excitation import Excitation, check_inputs

_RECORD_BYTES = 3000
"""The most bytes that an exposure takes in a recording beside its picture and inputs."""


@dataclass(frozen=True, kw_only=True)
class DryRun:
    """The findings of a dry run, in words, by their subject; and warnings."""

    facts: dict[str, str]
    warnings: list[str]


def dry_run(
    rig: Rig, camera_port: str | None, mirror_port: str | None, path: str | Path, *, estimators: Sequence[str] = (),
    exposures: int = 0, calibration: str = "", inputs: Inputs | None = None, control: str = "", force: bool = False,
    overwrite: bool = False, stop: Callable[[], bool] = lambda: False,
) -> DryRun:  # fmt: skip
    """Check a session as far as possible without moving the mirror; parameters as for `aolink.session.record`.

    The devices are opened, asked for their time, and closed. Opening parks a mirror that has a queue of its own,
    and puts one without a queue at its safe input; nothing else is sent. No file is made.

    Raises
    ------
    AolinkError
        The error with which the session would fail at its beginning; the inputs, too, are compared with the mirror's
        limits, over the first million fast steps.
    """
    path, names = Path(path), served(rig, control, estimators)
    check_target(path, overwrite=overwrite, suffix=".mcap", error=RecordingError)
    Driver(rig, names)
    facts = {"rig": f"{rig.name}, digest {rig.digest[:12]}"}
    of_control = controller(rig, control, names, force=force)[1] if control else {}
    rig = at_rest(rig) if calibration else rig
    with open_devices(rig, camera_port, mirror_port, stop) as (clock, camera, mirror, warnings):
        if control and not mirror.commanded:
            raise ControlError("there is no mirror to close the loop with: give --mirror PORT, or [devices.mirror]")
        devices: list[Device] = [camera, mirror] if mirror.commanded else [camera]
        ClockQueries(clock, devices).warm_up(partial(_answered, clock), stop)
        for device in devices:
            offset_s, sigma = device.clock.offset_ns(clock.now_ns()) / 1e9, device.clock.device_ns(clock.now_ns())[1]
            text = f"{device.description}; its clock minus the host's {offset_s:.6f} s, sd {sigma / 1e3:.0f} us"
            facts[device.name] = text + "".join(f"; {each}" for each in device.lacks)
        if mirror.latched:
            warnings.append("the mirror was parked by its watchdog in a session before: the session re-arms it")
        commanded, time = mirror.commanded, "virtual" if clock.virtual else "real"
    facts["time"] = time
    if not commanded:
        facts["inputs"] = "none: there is no mirror"
    elif control:
        facts["inputs"] = f"of the controller {control}: {of_control['control_stability']}"
    else:
        facts["inputs"] = _check_played(rig, inputs, exposures)
    facts["estimators"] = " ".join(names) or "none"
    facts["recording"] = _check_disk(rig, path, exposures)
    return DryRun(facts=facts, warnings=warnings)


def _answered(time: Time, timeout_s: float) -> int:
    """The number of clock queries that are answered in the next ``timeout_s``."""
    return sum(isinstance(event, ClockSampled) for came in time.events(timeout_s) for event in came.events)


def _check_played(rig: Rig, inputs: Inputs | None, exposures: int) -> str:
    """Compare the inputs that the session would play with the limits; gives their description in words."""
    step_s, period = rig.timing.fast_step_s, rig.timing.frame_period_steps
    mirror = rig.mirror
    limits = f"limits {_shown(mirror.input_min)} to {_shown(mirror.input_max)}"
    if mirror.slew_max_per_s:
        limits += f", at most {mirror.slew_max_per_s:g} in a second"
    if isinstance(inputs, Excitation):  # `excitation` has compared it
        return f"{inputs.text}, within {limits}"
    if inputs is None:
        once = round(rig.drive.period_s / step_s) if rig.drive.kind == "sine" else period
        check_inputs(rig, partial(rig.drive.inputs, fast_step_s=step_s), exposures * period or once)
        return f"the rig file's drive ({rig.drive.kind}), within {limits}"
    return f"a function of the program's own; {limits}"


def _check_disk(rig: Rig, path: Path, exposures: int) -> str:
    """The target of the recording and the room on its disk, in words; raises RecordingError where there is too
    little."""
    shapes = [rig.sensor.shape, *([rig.scene.shape] if rig.scene else [])]
    numbers = rig.timing.frame_period_steps * (2 * rig.n_inputs + rig.n_outputs)
    each = sum(2 * rows * columns for rows, columns in shapes) + 8 * numbers + _RECORD_BYTES
    free = shutil.disk_usage(path.absolute().parent).free
    if exposures * each > free:
        raise RecordingError(
            f"{path}: {exposures} exposures take up to {exposures * each / 1e6:.0f} MB, and {free / 1e6:.0f} MB are"
            " free: record fewer, or to another disk"
        )
    if exposures:
        return f"{path}, up to {exposures * each / 1e6:.1f} MB for {exposures} exposures, {free / 1e6:.0f} MB free"
    hours = free / each * rig.timing.frame_period_steps * rig.timing.fast_step_s / 3600
    return f"{path}, until it is stopped; {free / 1e6:.0f} MB free, enough for {hours:.1f} hours at least"


def _shown(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return f"{values[0]:g}" if (values == values[0]).all() else f"{values.min():g} .. {values.max():g}"
