"""Films from adaptive optics telemetry in the AOT format: pictures of a wavefront sensor's detector, and commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.importing.film import Film
from aolink.importing.readers import array_film


def aot_film(path: Path) -> Film:
    """The pictures of the first wavefront sensor that has them, with what its loops commanded meanwhile.

    Commands are taken where there is one for each picture: each is held until the next.

    Raises
    ------
    ImportingError
        It is not such a file, or has no pictures.
    """
    with needs_extra("aot", ImportingError):
        import aotpy
    system = aotpy.AOSystem.read_from_file(path)
    pictured = [each for each in system.wavefront_sensors if each.detector and each.detector.pixel_intensities]
    if not pictured:
        slopes = [each.uid for each in system.wavefront_sensors if each.measurements]
        has = f"slopes of {', '.join(slopes)}, but no pictures" if slopes else "no pictures of a wavefront sensor"
        raise ImportingError(f"{path} has {has}: the blur that estimators read is in the pixels")
    sensor = pictured[0]
    detector, pictures = sensor.detector, sensor.detector.pixel_intensities
    known: dict[str, Any] = {"rate_hz": detector.frame_rate, "exposure_s": detector.integration_time}
    if pictures.time is not None and len(pictures.time.timestamps) == len(pictures.data):
        times = np.asarray(pictures.time.timestamps, dtype=np.float64)
        known["times_ns"] = np.round((times - times[0]) * 1e9).astype(np.int64)
        known["start_ns"] = round(times[0] * 1e9)
    elif system.date_beginning is not None:
        known["start_ns"] = round(system.date_beginning.timestamp() * 1e9)
    notes = [f"pictures of the wavefront sensor {sensor.uid}"]
    commands = [
        each.commands.data
        for each in system.loops
        if isinstance(each, aotpy.ControlLoop) and each.commands is not None and each.input_sensor is sensor
    ]
    if commands and all(len(each) == len(pictures.data) for each in commands):
        known["inputs"] = np.hstack([np.asarray(each, np.float64).reshape(len(each), -1) for each in commands])
        notes.append("each command of its loops is held from its picture to the next")
    return array_film(np.asarray(pictures.data), path.name, notes=tuple(notes), **known)
