"""The tables ``[sensor]`` and ``[calibration]`` of a rig file."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from aolink.errors import RigError
from aolink.optics.sensor import KERNEL_WIDTHS, BaseSensor, Kernel, Sensor, SpotSensor
from aolink.rig.toml_table import Table


@dataclass(frozen=True, kw_only=True)
class CalibrationTable:
    """Standard deviations of the sensor's values, as `aolink calibrate` wrote them, and the recordings that they were
    measured from.

    A standard deviation is None where its value was not measured.
    """

    black_level_sd: float | None = None
    noise_density_sd: float | None = None
    counts_per_density_sd: float | None = None
    photoelectrons_sd: float | None = None
    kernel_sigma_sd: float | None = None
    dark_frames: int = 0
    flat_frames: int = 0
    still_frames: int = 0
    sources: tuple[str, ...] = ()
    """Kind, name and SHA-256 of each recording that was used."""


def read_sensor(
    table: Table, axes: int, n_outputs: int, field: tuple[float, float] | None = None,
    light: tuple[float, ...] | None = None,
) -> BaseSensor:  # fmt: skip
    """Read the table ``[sensor]``, for a plant of ``axes`` copies with ``n_outputs`` each. Raises `RigError`.

    ``field`` and ``light`` follow from the lenslets where the rig file describes them.
    """
    kind = table.choice("kind", ("line", "spots"))
    read_out = _read_out(table, field)
    if kind == "line":
        sensor: BaseSensor = _line(table, axes * n_outputs, read_out)
    else:
        sensor = _spots(table, axes, n_outputs, read_out | {"light": light})
    rows, columns = sensor.shape
    if outside := [each for each in sensor.defects if each[0] >= rows or each[1] >= columns]:
        raise RigError(f"sensor.defects has {list(outside[0])}, outside the {rows} x {columns} pixels")
    if sensor.black_level >= sensor.full_scale:
        raise RigError(f"sensor.black_level = {sensor.black_level:g} is not below the full scale, {sensor.full_scale}")
    return sensor


def read_grid(table: Table) -> tuple[int, ...]:
    """Read ``sensor.grid``, rows and columns of windows."""
    return table.integers("grid", 2, "rows and columns of windows", low=1, high=256)


def _line(table: Table, outputs: int, read_out: dict[str, Any]) -> Sensor:
    if outputs != 1:
        raise RigError(
            f"sensor.kind = 'line' sees one slope, but the plant has {outputs} (plant.axes times the rows of plant.C)"
        )
    sensor = Sensor(kind="line", pixels=table.integer("pixels", low=2, high=65_536), **read_out)
    if sensor.kernel.matrix is not None:
        raise RigError("sensor.kernel.sigma is a matrix, but a line sensor sees one direction: give a number")
    return sensor


def _spots(table: Table, axes: int, n_outputs: int, read_out: dict[str, Any]) -> SpotSensor:
    rows, columns = read_grid(table)
    height, width = table.integers("window", 2, "rows and columns of pixels", low=2, high=256)
    if height != width:
        raise RigError(f"sensor.window = [{height}, {width}] is not square: a window needs as many rows as columns")
    sensor = SpotSensor(kind="spots", grid=(rows, columns), window=(height, width), **read_out)
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
    return sensor


def _read_out(table: Table, known_field: tuple[float, float] | None) -> dict[str, Any]:
    """Read the fields of `BaseSensor`."""
    if known_field and table.has("field"):
        raise RigError("sensor.field follows from [lenslets]: leave it out")
    field = known_field or table.vector("field", 2, "lower and upper edge")
    if field[0] >= field[1]:
        raise RigError(f"sensor.field = [{field[0]:g}, {field[1]:g}]: the lower edge must be below the upper one")
    return {
        "field": (float(field[0]), float(field[1])),
        "noise_density": table.number("noise_density", low=0.0),
        "kernel": table.read("kernel", read_kernel),
        "bit_depth": table.integer("bit_depth", 16, low=1, high=16),
        "black_level": table.number("black_level", 0.0, low=0.0),
        "counts_per_density": table.number("counts_per_density", above=0.0),
        "photoelectrons": table.number("photoelectrons", 0.0, low=0.0),
        "defects": _defects(table),
        "pedestal": table.choice("pedestal", ("known", "free")) if table.has("pedestal") else "known",
        "row_time_s": table.optional_number("row_time_s", low=-1.0, high=1.0),
    }


def _defects(table: Table) -> tuple[tuple[int, int], ...]:
    """Read ``sensor.defects``, [row, column] of each defective pixel."""
    if not table.has("defects") or table.get("defects") == []:
        return ()
    pairs = table.get("defects")
    ok = isinstance(pairs, list) and all(
        isinstance(each, list) and len(each) == 2 and all(type(k) is int and k >= 0 for k in each) for each in pairs
    )
    if not ok:
        raise RigError("sensor.defects must be a list of [row, column], whole numbers from 0, one for each pixel")
    return tuple(sorted({(row, column) for row, column in pairs}))


def read_kernel(table: Table) -> Kernel:
    """Read a table ``kernel``. Raises `RigError`."""
    shape = table.choice("shape", ("gaussian",))
    given = [name for name in KERNEL_WIDTHS if table.has(name)]
    if len(given) > 1:
        raise RigError(f"{table.key(given[0])} and {table.key(given[1])} both say how wide the kernel is: give one")
    if given and given != ["sigma"]:
        return Kernel(shape=shape, sigma=KERNEL_WIDTHS[given[0]] * table.number(given[0], above=0.0))
    if not isinstance(table.get("sigma"), list):
        return Kernel(shape=shape, sigma=table.number("sigma", above=0.0))
    width = table.matrix("sigma", (2, 2), "Sigma of the plane, or a number for a round kernel")
    if width[0, 1] != width[1, 0] or float(np.linalg.eigvalsh(width).min()) <= 0:
        raise RigError(f"{table.key('sigma')} = {width.tolist()} must be symmetric and positive definite")
    (xx, xy), (_, yy) = width.tolist()
    mean = math.sqrt((xx * xx + yy * yy) / 2 + xy * xy)  # of Sigma^2's diagonal
    return Kernel(shape=shape, sigma=mean, matrix=((xx, xy), (xy, yy)))


def read_calibration(table: Table) -> CalibrationTable:
    """Read the table ``[calibration]``. Raises `RigError`."""
    names = [each.name for each in fields(CalibrationTable)]
    deviations: dict[str, Any] = {name: table.optional_number(name, low=0.0) for name in names if name.endswith("_sd")}
    frames = {name: table.integer(name, 0, low=0) for name in names if name.endswith("_frames")}
    return CalibrationTable(**deviations, **frames, sources=table.texts("sources"))
