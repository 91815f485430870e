"""Exposures as AOT telemetry (Gomes et al., aotpy): the quantities that the format defines, and tables for the rest.

Frames are the pixel intensities of a Shack-Hartmann sensor's detector, with the centres of gravity of its spots as
measurements; the inputs that the mirror held are a loop's commands, one row for each fast step. A line sensor is one
spot whose second direction is not measured (NaN). Estimates, truth, the facts about each exposure and the rig file,
for which the format has no place, are binary tables behind these: aotpy warns that they are not of its format and gives
them as extra data, and every program that reads FITS reads them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ExportError
from aolink.estimation.frames.measure import profiles_of
from aolink.exporting.arrays import ESTIMATE, EXPOSURE, TRUTH, Variable, arrays
from aolink.exporting.common import Progress, check_frame, facts, needed
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import to_density
from aolink.optics.centroid import centre_of_gravity
from aolink.optics.sensor import BaseSensor, RegionSensor
from aolink.series import Series

_IN_IMAGES = ("pixels", "inputs")
"""The parts of an exposure that are not in the table, because an image holds them."""


def write_fits(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    """Write a FITS file that aotpy reads. Raises as `arrays`, and ExportError where aotpy is missing."""
    aot = needed("aotpy", "aot", "AOT telemetry (.fits)")
    writer = needed("aotpy.io.fits.writer", "aot", "AOT telemetry (.fits)")
    fits = needed("astropy.io.fits", "aot", "AOT telemetry (.fits)")
    found = arrays(series, names, progress)  # the format needs frames of one size
    check_frame(series, next(series.exposures()))
    hdus = writer.AOTFITSWriter(_system(aot, series, found)).get_hdulist()
    hdus.append(_table(fits, "EXPOSURES", {k: found[k].values for k in EXPOSURE if k not in _IN_IMAGES}))
    if "truth_path" in found:
        hdus.append(_table(fits, "TRUTH", {k: found[k].values for k in TRUTH}))
    for k, name in enumerate(names):
        of_one = {"frame_id": found["frame_id"].values} | {each: found[each].values[k] for each in ESTIMATE}
        hdus.append(_table(fits, _header_text(f"ESTIMATE_{name}"), of_one))
    keys, texts = zip(*facts(series).items(), strict=True)
    hdus.append(_table(fits, "FACTS", {"key": np.array(keys), "value": np.array(texts)}))
    rig_file = np.frombuffer(series.rig.toml.encode(), dtype=np.uint8)
    hdus.append(_table(fits, "RIG", {"toml_utf8": rig_file[None]}))
    with path.open("wb") as file:
        hdus.writeto(file)


def _system(aot: Any, series: Series, found: Mapping[str, Variable]) -> Any:
    """The part of the data that AOT defines."""
    rig, times = series.rig, found["time"].values
    step_s, begun = rig.timing.fast_step_s, times.astype(np.int64) / 1e9
    frames = aot.Time(uid="FRAMES", timestamps=begun.tolist(), frame_numbers=found["frame_id"].values.tolist())
    telescope = aot.MainTelescope(uid="NONE")  # AOT requires a telescope, and a source
    source = aot.NaturalGuideStar(uid="SPOT")
    sensor, pixels = rig.sensor, found["pixels"].values
    slopes = found["slopes"].values if "slopes" in found else _centres(sensor, pixels, found["mask"].values)
    # As the format has them, (frames, 2, spots); NaN where there is no second direction.
    centres = np.full((len(slopes), 2, sensor.spots), np.nan)
    centres[:, : sensor.directions] = slopes.reshape(len(slopes), sensor.spots, -1).swapaxes(1, 2)
    grid = np.full(sensor.grid, -1)
    grid.flat[sensor.lit] = np.arange(sensor.spots)
    camera = aot.Detector(
        uid="CAMERA",
        pixel_intensities=None if "slopes" in found else aot.Image("PIXELS", pixels, unit="adu", time=frames),
        integration_time=rig.timing.exposure_steps * step_s,
        frame_rate=1 / (rig.timing.frame_period_steps * step_s),
    )
    wavefront_sensor = aot.ShackHartmann(
        uid="SENSOR", source=source, n_valid_subapertures=sensor.spots, detector=camera,
        measurements=aot.Image("CENTRES_OF_GRAVITY", centres, unit="slope unit", time=frames),
        subaperture_mask=aot.Image("SUBAPERTURES", grid), mask_offsets=[aot.Coordinates(0, 0)],
        subaperture_size=float(sensor.profile.pixels) if sensor.directions == 2 else None,
        centroiding_algorithm=None if "slopes" in found else "centre of gravity of the window",
    )  # fmt: skip
    mirrors = {1: aot.LinearStage, 2: aot.TipTiltMirror}
    sized = {} if rig.n_inputs in mirrors else {"n_valid_actuators": rig.n_inputs}
    mirror = mirrors.get(rig.n_inputs, aot.DeformableMirror)(uid="MIRROR", telescope=telescope, **sized)
    steps, commands = _commands(found)
    # The start of a fast step, by the exposure that it leads to or is in.
    of_exposure = np.repeat(np.arange(len(times)), found["lead_steps"].values + found["n_steps"].values)
    stamps = begun[of_exposure] + (steps - found["first_step"].values[of_exposure]) * step_s
    loop = aot.ControlLoop(
        uid="LOOP", commanded_corrector=mirror, input_sensor=wavefront_sensor, closed=False, framerate=1 / step_s,
        commands=aot.Image("COMMANDS", commands, unit="input unit"),
        time=aot.Time(uid="FAST_STEPS", timestamps=stamps.tolist(), frame_numbers=steps.tolist()),
    )  # fmt: skip
    cameras = []
    if "scene" in found:
        scene = aot.Detector(uid="SCENE", pixel_intensities=aot.Image("SCENE", found["scene"].values, "adu", frames))
        cameras.append(aot.ScoringCamera(uid="SCENE_CAMERA", detector=scene))
    first, last = (datetime.fromtimestamp(float(each), UTC) for each in (begun[0], begun[-1]))
    return aot.AOSystem(
        ao_mode="SCAO", name=_header_text(rig.name), config=_header_text(rig.summary), date_beginning=first,
        date_end=last, main_telescope=telescope, sources=[source], scoring_cameras=cameras,
        wavefront_sensors=[wavefront_sensor], wavefront_correctors=[mirror], loops=[loop],
    )  # fmt: skip


def _centres(sensor: BaseSensor, pixels: NDArray[np.uint16], mask: NDArray[np.bool_]) -> FloatArray:
    """Centres of gravity of frames, slope units, (frames, outputs); NaN where a window is dark or has lost a pixel."""
    if isinstance(sensor, RegionSensor):
        raise ExportError("an AOT file has the centres of spots, and this recording's sensor sees a region")
    line = sensor.profile
    each = [profiles_of(sensor, frame, whole) for frame, whole in zip(pixels, mask, strict=True)]
    counts, good = np.array([e.counts for e in each]), np.array([e.mask for e in each])
    light = to_density(line, counts.reshape(-1, 1, line.pixels))
    found = line.field[0] + (centre_of_gravity(light)[:, 0] + 0.5) * line.pixel_width
    return np.where(good.reshape(-1, line.pixels).all(axis=1), found, np.nan).reshape(len(pixels), -1)


def _commands(found: Mapping[str, Variable]) -> tuple[NDArray[np.int64], FloatArray]:
    """Fast steps and the inputs in each, between the exposures and in them, in order: (steps,), (steps, inputs)."""
    leads = np.split(found["lead_inputs"].values, np.cumsum(found["lead_steps"].values)[:-1])
    steps, rows = [], []
    for first, lead, inputs in zip(found["first_step"].values, leads, found["inputs"].values, strict=True):
        steps.append(np.arange(first - len(lead), first + len(inputs)))
        rows += [lead, inputs]
    return np.concatenate(steps), np.concatenate(rows)


def _table(fits: Any, name: str, columns: Mapping[str, NDArray[Any]]) -> Any:
    """A binary table with a row for each element of the first dimension."""
    made = []
    for key, values in columns.items():
        if values.dtype.kind == "U":
            values = np.char.encode(values, "ascii", "replace")  # FITS allows no other characters
        flat = values.reshape(len(values), -1)
        code = {"f": "D", "i": "K", "u": "B", "b": "L", "S": "A"}[values.dtype.kind]
        repeat = max(values.dtype.itemsize, 1) if code == "A" else flat.shape[1]
        dim = f"({','.join(map(str, reversed(values.shape[1:])))})" if values.ndim > 2 else None
        made.append(fits.Column(name=key, format=f"{repeat}{code}", array=values, dim=dim))
    return fits.BinTableHDU.from_columns(made, name=name)


def _header_text(text: str) -> str:
    """A text that may stand in a FITS header: one line of printable ASCII."""
    return "".join(c if " " <= c <= "~" else "?" for c in " ".join(text.split()))
