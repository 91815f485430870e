"""The table ``[scene]`` of a rig file, and the picture that it names."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aolink.errors import RestorationError, RigError
from aolink.numerics.arrays import FloatArray
from aolink.optics.scene import SceneSensor
from aolink.rig.sensor_tables import read_kernel
from aolink.rig.toml_table import Table, named_file

_SHIPPED = Path(__file__).parent.parent / "rigs"


_LUMINANCE = (0.2126, 0.7152, 0.0722)


def read_scene(table: Table) -> SceneSensor:
    """Read the table ``[scene]``; the picture itself is not opened. Raises `RigError`."""
    rows, columns = table.integers("pixels", 2, "rows and columns", low=2, high=8192)
    sensor = SceneSensor(
        shape=(rows, columns),
        pixel_scale=table.number("pixel_scale", above=0.0),
        kernel=table.read("kernel", read_kernel),
        noise_sd=table.number("noise_sd", low=0.0),
        bit_depth=table.integer("bit_depth", 16, low=1, high=16),
        black_level=table.number("black_level", 0.0, low=0.0),
        counts_per_intensity=table.number("counts_per_intensity", above=0.0),
        picture=table.text("picture", ""),
        picture_pixels=table.integer("picture_pixels", 1, low=1, high=64),
        row_time_s=table.optional_number("row_time_s", low=-1.0, high=1.0),
    )
    if sensor.black_level >= sensor.full_scale:
        raise RigError(f"scene.black_level = {sensor.black_level:g} is not below the full scale, {sensor.full_scale}")
    return sensor


def read_scene_picture(sensor: SceneSensor, folder: Path | None) -> FloatArray:
    """The picture that a simulated rig shows, in its own, finer pixels, (rows, columns); grey, integers scaled to 0..1.

    Parameters
    ----------
    folder:
        Folder of the rig file; a picture that is not there may be one that comes with aolink. None is for a rig file
        that comes out of a recording: it may name only pictures that come with aolink.

    Raises
    ------
    RigError
        The rig names no picture, or the picture cannot be read or is smaller than the sensor's frame.
    """
    if not sensor.picture:
        raise RigError("scene.picture is missing: a simulated rig needs a picture to show")
    shipped = _SHIPPED / sensor.picture
    comes_along = shipped.parent == _SHIPPED and shipped.is_file()
    from aolink.films.pictures import read_picture  # it loads packages that a rig file alone does not need

    beside = shipped if comes_along and folder is None else named_file(folder, sensor.picture, "scene.picture")
    try:
        found = read_picture(shipped if comes_along and not beside.is_file() else beside, RestorationError)
    except RestorationError as error:
        raise RigError(f"scene.picture: {error}") from None
    if found.ndim == 3 and found.shape[2] in (3, 4):
        grey = found[..., :3] @ np.array(_LUMINANCE)
    else:
        grey = found.astype(np.float64) if found.dtype.kind in "buif" else np.zeros(0)
    if found.dtype.kind in "ui":
        grey = grey / np.iinfo(found.dtype).max
    needed = tuple(n * sensor.picture_pixels for n in sensor.shape)
    if grey.ndim != 2 or grey.shape[0] < needed[0] or grey.shape[1] < needed[1] or not np.isfinite(grey).all():
        raise RigError(
            f"scene.picture: {beside} has shape {found.shape}, expected at least {needed[0]} x {needed[1]} finite"
            " numbers (scene.pixels times scene.picture_pixels), better more: the scene goes on beyond the frame"
        )
    return np.asarray(grey, dtype=np.float64)
