"""Films from adaptive optics telemetry in the AOT format: pictures of a wavefront sensor's detector, and commands."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.film import Film, array_film
from aolink.numerics.arrays import FloatArray

_NOT_APPLIED = ("dark", "flat_field", "sky_background", "bad_pixel_map", "weight_map")
"""What a detector may have that is not applied to its pictures."""


def aot_film(path: Path, uid: str | None = None) -> Film:
    """The pictures of the wavefront sensor ``uid``, or of the first one that has them, with the commands of its loops.

    Where none has pictures, the result is the slopes of the first sensor that has them. A command is held until the
    next one of its loop: by the times of both, otherwise by the loop's rate, otherwise one for each frame, after the
    loop's delay. Raises `ImportingError` where the file is not of this format, or has neither pictures nor slopes.
    """
    with needs_extra("aot", ImportingError):
        import aotpy
    with warnings.catch_warnings():  # that it keeps other tables as they are, such as those of `aolink export`
        warnings.filterwarnings("ignore", r".*HDU '\S+' is not an AOT binary table nor an image")
        warnings.filterwarnings(
            "ignore", r"\[.*\(Error level: "
        )  # about parts that are not read; worse ones are raised
        system = aotpy.AOSystem.read_from_file(path, externals="disallow", memmap=False)
    sensors = system.wavefront_sensors
    if uid is not None:
        have = ", ".join(str(each.uid) for each in sensors) or "none"
        sensors = [each for each in sensors if each.uid == uid]
        if not sensors:
            raise ImportingError(f"{path} has no wavefront sensor {uid!r}: it has {have}")
    pictured = [each for each in sensors if each.detector and each.detector.pixel_intensities]
    usable = pictured or [each for each in sensors if each.measurements]
    sensor = next(iter(usable), None)
    if sensor is None:
        raise ImportingError(f"{path} has neither pictures nor slopes of {_which(uid)}")
    detector = sensor.detector
    others = [str(each.uid) for each in usable[1:]]
    more = [f"{path.name} has those of {', '.join(others)} too: say which with --film topic=NAME"] if others else []
    if pictured:
        series, what = detector.pixel_intensities, f"pictures of the wavefront sensor {sensor.uid}"
        frames = np.asarray(series.data)
        if frames.ndim != 3:
            raise ImportingError(f"{path} has pictures of shape {frames.shape}, expected (frames, rows, columns)")
        if left := [each.replace("_", " ") for each in _NOT_APPLIED if getattr(detector, each) is not None]:
            more.append(f"not applied to the pictures: the detector's {', '.join(left)}")
    else:
        series = sensor.measurements
        what = (
            f"{path.name} holds slopes of the wavefront sensor {sensor.uid} and no pictures: only o1 and open-loop can"
            " use them. Their noise is taken to be that of a centroid by the rig file, their unit"
            f" ({series.unit or 'not said'}) the slope unit; --film scale makes one of the other"
        )
        frames = _slopes(np.asarray(series.data, dtype=np.float64), path)
    known: dict[str, Any] = {"slopes": not pictured}
    if detector:
        known |= {"rate_hz": detector.frame_rate, "exposure_s": detector.integration_time}
    times = _times(series.time, len(frames))
    if times is not None and not np.isfinite(times).all():
        raise ImportingError(f"{path}: some times of {_which(sensor.uid)} are no numbers")
    if times is None and series.time is not None:
        more += _by_numbers(series.time, len(frames), known)
    if times is not None:
        known |= {"times_ns": np.round((times - times[0]) * 1e9).astype(np.int64), "start_ns": round(times[0] * 1e9)}
    elif system.date_beginning is not None:
        known["start_ns"] = round(system.date_beginning.timestamp() * 1e9)
    loops = [
        each
        for each in system.loops
        if isinstance(each, aotpy.ControlLoop) and each.input_sensor is sensor and each.commands is not None
    ]
    notes = [what, *more, *_commands(loops, known, len(frames), None if times is None else times[0])]
    return array_film(frames, path.name, notes=tuple(notes), **known)


def _which(uid: str | None) -> str:
    return "a wavefront sensor" if uid is None else f"the wavefront sensor {uid}"


def _by_numbers(time: Any, count: int, known: dict[str, Any]) -> list[str]:
    """Add times by the frames' numbers to the ``known`` facts where frames are missing; notes say what is not used."""
    numbers = np.asarray(time.frame_numbers, dtype=np.float64)
    if len(numbers) != count:
        stamps = len(time.timestamps)
        return [f"not used: {stamps} times and {len(numbers)} frame numbers for {count} frames"]
    if (np.diff(numbers) == 1).all():
        return []
    steps = np.diff(numbers)
    if not (steps >= 1).all() or np.median(steps) != 1:
        return ["the frame numbers do not count up by one: not used"]
    if not known.get("rate_hz"):
        return ["by their numbers frames are missing, which without a frame rate or times in the file is not used"]
    known["times_ns"] = np.round((numbers - numbers[0]) * 1e9 / known["rate_hz"]).astype(np.int64)
    return ["frames are missing by their numbers"]


def _slopes(found: FloatArray, path: Path) -> FloatArray:
    """Measurements (frames, directions, spots) as rows of slopes, spot after spot, (frames, 1, slopes)."""
    if found.ndim != 3 or found.size == 0 or found.shape[1] > 2:
        raise ImportingError(f"{path} has slopes of shape {found.shape}, expected (frames, 2 directions, subapertures)")
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
    if len({each.delay for each in loops}) > 1:
        return [f"the loops {names} have unlike delays: their commands are left out, the mirror counts as parked"]
    rate, delay = loops[0].framerate, loops[0].delay or 0.0
    if not 0 <= delay < math.inf:
        return [f"the delay of {names} is {delay:g}: their commands are left out, the mirror counts as parked"]
    frame_rate = known.get("rate_hz") or rate
    # From the middle of an exposure to the middle of its command, which is held for a frame as well.
    after_ns = delay * 1e9 / frame_rate if frame_rate else 0.0
    delayed = f", {delay:g} {'frame' if delay == 1 else 'frames'} later, as the loop's delay says" if after_ns else ""
    if first is not None and start_s is not None:
        if (late := np.flatnonzero(np.diff(first) <= 0)).size:
            raise ImportingError(f"command {int(late[0]) + 1} of {loops[0].uid} is not later than the one before")
        known["input_times_ns"] = np.round((first - start_s) * 1e9).astype(np.int64)
        how = "by its own time"
    elif n != count and rate:
        known["input_times_ns"] = np.round(np.arange(n) * 1e9 / rate + after_ns).astype(np.int64)
        how = f"at the loop's {rate:g} commands/s, from the first exposure on{delayed}"
    elif n == count and delayed:
        times_ns = known.get("times_ns")
        of_frames = np.arange(n) * 1e9 / frame_rate if times_ns is None else times_ns - times_ns[0]
        known["input_times_ns"] = np.round(of_frames + after_ns).astype(np.int64)
        how = f"from its picture on{delayed}"
    elif n == count:
        how = "from its picture on" + (", without a frame rate also where the loop has a delay" if delay else "")
    else:
        return [
            f"the {n} commands of {names} for {count} frames have neither times nor a rate: they are left out, the"
            " mirror counts as parked"
        ]
    known["inputs"] = np.hstack(rows)
    return [f"each command of its loops is held to the next, {how}"]
