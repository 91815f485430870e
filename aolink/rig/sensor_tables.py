"""The tables ``[sensor]`` and ``[calibration]`` of a rig file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from aolink.errors import RigError
from aolink.keys import Count, NotNegative, checked, read
from aolink.optics.sensor import BaseSensor, RegionSensor, Sensor, SpotSensor
from aolink.optics.texture import MARGIN


@dataclass(frozen=True, kw_only=True)
class CalibrationTable:
    """Standard deviations of the sensor's values, as `aolink calibrate` wrote them, and the recordings that they were
    measured from.

    A standard deviation is None where its value was not measured.
    """

    black_level_sd: NotNegative | None = None
    noise_density_sd: NotNegative | None = None
    counts_per_density_sd: NotNegative | None = None
    photoelectrons_sd: NotNegative | None = None
    kernel_sigma_sd: NotNegative | None = None
    dark_frames: Count = 0
    flat_frames: Count = 0
    still_frames: Count = 0
    sources: tuple[str, ...] = ()
    """Kind, name and SHA-256 of each recording that was used."""


_LEAST_SIDE, _MOST_SIDE = 2 * MARGIN + 8, 256
"""Pixels along a region's side."""
READ_NOISE = ("read_noise_counts", "read_noise_electrons")
"""Keys in place of ``noise_density``: standard deviation of a pixel by read-out noise, counts or electrons."""


def read_sensor(
    values: dict[str, Any], axes: int, n_outputs: int, field: tuple[float, float] | None = None,
    light: tuple[float, ...] | None = None,
) -> BaseSensor:  # fmt: skip
    """Read the table ``[sensor]``, for a plant of ``axes`` copies with ``n_outputs`` each. Raises `RigError`.

    ``field`` and ``light`` follow from the lenslets where the rig file describes them.
    """
    kind = checked(Literal["line", "spots", "region"], values.get("kind"), "sensor.kind")
    if field and "field" in values:
        raise RigError("sensor.field follows from [lenslets]: leave it out")
    given: dict[str, Any] = {"field": field} if field else {}
    noises = {name: checked(NotNegative, values[name], f"sensor.{name}") for name in READ_NOISE if name in values}
    if len(noises) + ("noise_density" in values and bool(noises)) > 1:
        raise RigError(f"sensor has more than one of noise_density, {', '.join(READ_NOISE)}: give one")
    if noises:
        values = {name: value for name, value in values.items() if name not in noises} | {"noise_density": 0.0}
    if kind == "line":
        sensor: BaseSensor = read(Sensor, values, "sensor", **given)
        _check_line(sensor, axes * n_outputs)
    elif kind == "region":
        sensor = _read_region(values, given)
        if (axes, n_outputs) != (1, 2):
            raise RigError(
                "sensor.kind = 'region' sees one thing move along x and y: it needs plant.axes = 1 and a plant.C of"
                f" two rows, not {axes} with {n_outputs}"
            )
    else:
        sensor = read(SpotSensor, values, "sensor", light=light, **given)
        _check_spots(sensor, axes, n_outputs)
    low, high = sensor.field
    if low >= high:
        raise RigError(f"sensor.field = [{low:g}, {high:g}]: the lower edge must be below the upper one")
    rows, columns = sensor.shape
    if outside := [each for each in sensor.defects if each[0] >= rows or each[1] >= columns]:
        raise RigError(f"sensor.defects has {list(outside[0])}, outside the {rows} x {columns} pixels")
    if sensor.black_level >= sensor.full_scale:
        raise RigError(f"sensor.black_level = {sensor.black_level:g} is not below the full scale, {sensor.full_scale}")
    for name, sd in noises.items():
        if name == "read_noise_electrons" and not sensor.photoelectrons:
            raise RigError(f"sensor.{name} needs sensor.photoelectrons, to know the counts of an electron")
        density = sd / sensor.counts_per_density
        if name == "read_noise_electrons":
            density = sd / sensor.pixel_size / sensor.photoelectrons
        sensor = replace(sensor, noise_density=density**2 * sensor.pixel_size)
    return sensor


def _read_region(values: dict[str, Any], given: dict[str, Any]) -> RegionSensor:
    side = len(values.get("reference") or ())
    if given:
        raise RigError("sensor.kind = 'region' is not behind [lenslets]: leave them out")
    if not _LEAST_SIDE <= side <= _MOST_SIDE:
        raise RigError(f"sensor.reference has {side} rows: a region has from {_LEAST_SIDE} to {_MOST_SIDE}")
    window, field = (side, side), (-side / 2, side / 2)
    sensor = read(RegionSensor, values, "sensor", grid=(1, 1), window=window, field=field, light=None)
    if any(len(row) != side for row in sensor.reference):
        raise RigError(f"sensor.reference has {side} rows that do not all have {side} pixels: a region is a square")
    if not np.ptp(sensor.at_rest[MARGIN:-MARGIN, MARGIN:-MARGIN]):
        raise RigError("sensor.reference shows nothing: its pixels are all alike")
    return sensor


def _check_line(sensor: BaseSensor, outputs: int) -> None:
    if outputs != 1:
        raise RigError(
            f"sensor.kind = 'line' sees one slope, but the plant has {outputs} (plant.axes times the rows of plant.C)"
        )
    if sensor.kernel.matrix is not None:
        raise RigError("sensor.kernel.sigma is a matrix, but a line sensor sees one direction: give a number")


def _check_spots(sensor: SpotSensor, axes: int, n_outputs: int) -> None:
    (rows, columns), (height, width) = sensor.grid, sensor.window
    if height != width:
        raise RigError(f"sensor.window = [{height}, {width}] is not square: a window needs as many rows as columns")
    if axes * n_outputs != 2 * sensor.spots:
        windows = "" if sensor.light is None else f" in {sensor.spots} lit windows"
        raise RigError(
            f"sensor.grid = [{rows}, {columns}] sees {2 * sensor.spots} slopes{windows}, two a spot, but the plant has"
            f" {axes * n_outputs} (plant.axes times the rows of plant.C)"
        )
    if n_outputs > 1 and n_outputs % 2:
        raise RigError(
            f"plant.C has {n_outputs} rows: for sensor.kind = 'spots' it needs one, or two for each spot that it moves"
        )
    if sensor.kernel.matrix is not None and n_outputs == 1:
        raise RigError(
            "sensor.kernel.sigma is a matrix, but each copy of the plant moves a spot along one direction only: give a"
            " number, or a plant.C with two rows for each spot that a copy moves"
        )
