"""Films from adaptive optics telemetry in the AOT format: pictures of a wavefront sensor's detector, and commands."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.importing.film import Film, array_film
from aolink.numerics.arrays import FloatArray


def aot_film(path: Path) -> Film:
    """The pictures of the first wavefront sensor that has them, with the commands of its loops.

    Where none has pictures, the result is the slopes of the first sensor that has them. A command is held until the
    next one of its loop: by the times of both, otherwise by the loop's rate, otherwise one for each frame.

    Raises
    ------
    ImportingError
        The file is not of this format, or has neither pictures nor slopes.
    """
    with needs_extra("aot", ImportingError):
        import aotpy
    with warnings.catch_warnings():  # that it keeps other tables as they are, such as those of `aolink export`
        warnings.filterwarnings("ignore", r".*HDU '\S+' is not an AOT binary table nor an image")
        system = aotpy.AOSystem.read_from_file(path)
    sensors = system.wavefront_sensors
    pictured = [each for each in sensors if each.detector and each.detector.pixel_intensities]
    sensor = next(iter(pictured or [each for each in sensors if each.measurements]), None)
    if sensor is None:
        raise ImportingError(f"{path} has neither pictures nor slopes of a wavefront sensor")
    detector = sensor.detector
    if pictured:
        series, what = detector.pixel_intensities, f"pictures of the wavefront sensor {sensor.uid}"
        frames = np.asarray(series.data)
    else:
        series = sensor.measurements
        what = (
            f"{path.name} holds slopes of the wavefront sensor {sensor.uid} and no pictures: only o1 and open-loop can"
            " use them. Their noise is taken to be that of a centroid by the rig file, their unit"
            f" ({series.unit or 'not said'}) the slope unit; --scale makes one of the other"
        )
        frames = _slopes(np.asarray(series.data, dtype=np.float64), path)
    known: dict[str, Any] = {"slopes": not pictured}
    if detector:
        known |= {"rate_hz": detector.frame_rate, "exposure_s": detector.integration_time}
    times = _times(series.time, len(frames))
    if times is not None:
        known |= {"times_ns": np.round((times - times[0]) * 1e9).astype(np.int64), "start_ns": round(times[0] * 1e9)}
    elif system.date_beginning is not None:
        known["start_ns"] = round(system.date_beginning.timestamp() * 1e9)
    loops = [
        each
        for each in system.loops
        if isinstance(each, aotpy.ControlLoop) and each.input_sensor is sensor and each.commands is not None
    ]
    notes = [what, *_commands(loops, known, len(frames), None if times is None else times[0])]
    return array_film(frames, path.name, notes=tuple(notes), **known)


def _slopes(found: FloatArray, path: Path) -> FloatArray:
    """Measurements (frames, directions, spots) as rows of slopes, spot after spot, (frames, 1, slopes)."""
    if found.ndim != 3 or found.size == 0:
        raise ImportingError(f"{path} has slopes of shape {found.shape}, expected (frames, directions, subapertures)")
    measured = [d for d in range(found.shape[1]) if not np.isnan(found[:, d]).all()]  # a line sensor has one
    if not measured:
        raise ImportingError(f"{path} has no pictures, and its slopes are all NaN: there is nothing to import")
    return found[:, measured].swapaxes(1, 2).reshape(len(found), 1, -1)


def _times(time: Any, count: int) -> FloatArray | None:
    """Times of a number of rows, s since 1970; None where some rows have none."""
    if time is None or len(time.timestamps) != count:
        return None
    return np.asarray(time.timestamps, dtype=np.float64)


def _commands(loops: list[Any], known: dict[str, Any], count: int, start_s: float | None) -> list[str]:
    """Add the loops' commands to the ``known`` facts about the frames; notes say how, or why this is not possible."""
    if not loops:
        return []
    rows = [np.asarray(each.commands.data, dtype=np.float64) for each in loops]
    rows = [each.reshape(len(each), -1) for each in rows]
    names = " and ".join(f"{each.uid} ({len(one)} rows)" for each, one in zip(loops, rows, strict=True))
    if len({len(each) for each in rows}) > 1:
        return [f"the loops {names} do not command together: their commands are left out, the mirror counts as parked"]
    n = len(rows[0])
    of_loop = [_times(each.commands.time or each.time, n) for each in loops]
    first = of_loop[0]
    if len({None if each is None else each.tobytes() for each in of_loop}) > 1:
        return [f"the loops {names} command at unlike times: their commands are left out, the mirror counts as parked"]
    rate = loops[0].framerate
    if first is not None and start_s is not None:
        if (late := np.flatnonzero(np.diff(first) <= 0)).size:
            raise ImportingError(
                f"command {int(late[0]) + 1} of the loop {loops[0].uid} is not later than the one before"
            )
        known["input_times_ns"] = np.round((first - start_s) * 1e9).astype(np.int64)
        how = "by its own time"
    elif n != count and rate:
        known["input_times_ns"] = np.round(np.arange(n) * 1e9 / rate).astype(np.int64)
        how = f"at the loop's {rate:g} commands/s, from the first exposure on"
    elif n == count:
        how = "from its picture on"
    else:
        return [
            f"the {n} commands of {names} for {count} frames have neither times nor a rate: they are left out, the"
            " mirror counts as parked"
        ]
    known["inputs"] = np.hstack(rows)
    return [f"each command of its loops is held to the next, {how}"]
