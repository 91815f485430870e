"""The description of a rig: a TOML file, and the frozen dataclasses that it becomes.

`load_rig` reads and validates the whole file; an error is one `RigError` that names the key. Quantities are SI
(seconds) where the key ends in a unit, and otherwise in the rig's own slope unit: the unit of ``sensor.field``, of the
plant's output and of the kernel's width.
"""

from __future__ import annotations

import hashlib
import math
import re
import tomllib
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from aolink.errors import RigError
from aolink.keys import checked, read
from aolink.numerics.arrays import Indices
from aolink.optics.scene import SceneSensor
from aolink.optics.sensor import BaseSensor, Windows
from aolink.rig.device_tables import DeviceTable, read_devices
from aolink.rig.disturbance import Disturbance, read_disturbance
from aolink.rig.optical_plant import Optics, read_optics
from aolink.rig.parts import Control, Drive, MirrorDriver, Plant, Simulation, Timing
from aolink.rig.rows import output_delays, readout_steps, with_delays
from aolink.rig.scene_table import named_file, read_scene
from aolink.rig.sensor_tables import CalibrationTable, read_sensor
from aolink.rig.tables import read_control, read_drive, read_mirror, read_plant, read_timing, with_disturbance
from aolink.units import counted

_LONGEST = 16 << 20
_DEEPEST = 200
_MOST_KEYS = 20_000
"""The most characters of a rig file, the most parts of a key, for whose square there must be memory, and the most keys,
tables and rows of matrices together, because each takes a while to read."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Rig:
    """A whole rig, validated."""

    name: str
    summary: str
    plant: Plant
    timing: Timing
    sensor: BaseSensor
    mirror: MirrorDriver
    drive: Drive
    control: Control
    simulation: Simulation
    calibration: CalibrationTable | None
    """The calibration of the sensor; None where its values were not measured."""
    optics: Optics | None
    """The lenslets, where the file describes them."""
    disturbance: Disturbance | None
    scene: SceneSensor | None
    """The picture sensor that shares the exposure, where the rig has one."""
    devices: dict[str, DeviceTable]
    """Drivers of the devices, by the names ``camera`` and ``mirror``, where the file names them."""
    folder: Path | None
    """Folder of the rig file, which paths in the file are relative to. None where the file came out of a recording: it
    may not name files, because no user of this machine has chosen it."""
    toml: str
    """The file's text, as read."""

    def __repr__(self) -> str:
        return f"<Rig {self.name}: {self.size()}>"

    def size(self) -> str:
        """How many inputs and outputs it has, in words."""
        return f"{counted(self.n_inputs, 'input')}, {counted(self.n_outputs, 'output')}"

    @property
    def digest(self) -> str:
        """SHA-256 of the file's text: the rig's identity in a recording."""
        return hashlib.sha256(self.toml.encode()).hexdigest()

    def path_of(self, name: str | Path, key: str) -> Path:
        """The path of a file that the rig file names under ``key``.

        Raises
        ------
        RigError
            The rig file comes out of a recording.
        """
        return named_file(self.folder, name, key)

    @property
    def window_steps(self) -> int:
        """Fast steps of the model in one exposure: more than the camera's where one plant moves spots that the camera
        exposes one after the other."""
        return self.timing.exposure_steps + self.plant.last_delay

    @cached_property
    def axis_delays(self) -> Indices:
        """Fast steps by which each axis is exposed later than the row that is first, (axes,)."""
        if not self.sensor.row_starts_s.any():
            return np.zeros(self.plant.axes, dtype=np.intp)
        delays = output_delays(self.sensor, self.timing)
        return np.asarray(delays.reshape(self.plant.axes, -1).min(axis=1))

    @property
    def input_delay(self) -> int:
        """Fast steps after the end of the first row's exposure up to which inputs belong to an exposure."""
        return int(self.axis_delays.max()) + self.plant.last_delay

    @cached_property
    def readout_steps(self) -> int:
        """Fast steps from the end of the first row's exposure to that of the last row's, the scene's included."""
        starts = [self.sensor.row_starts_s] + ([] if self.scene is None else [self.scene.row_starts_s])
        return max(readout_steps(each, self.timing) for each in starts)

    @property
    def n_inputs(self) -> int:
        """Number of inputs of the whole rig, the length of a command's row."""
        return self.plant.axes * self.plant.n_inputs

    @property
    def n_outputs(self) -> int:
        """Number of outputs of the whole rig, the rows of a path."""
        return self.plant.axes * self.plant.n_outputs


def rig_of(rig: Rig | str | Path) -> Rig:
    """A rig, or the one of a rig file or a name. Raises `RigError`."""
    return rig if isinstance(rig, Rig) else load_rig(rig)


def load_rig(path_or_name: str | Path) -> Rig:
    """Read and validate a rig file.

    Parameters
    ----------
    path_or_name:
        A TOML file, or the name of a rig that comes with aolink (see `builtin_rigs`).

    Raises
    ------
    RigError
        The file cannot be read, or its values cannot work; the message names the key.
    """
    if not isinstance(path_or_name, str | Path):
        raise RigError(f"give a rig file, or the name of a rig that comes along: found {type(path_or_name).__name__}")
    path = Path(path_or_name)
    if path.suffix != ".toml" and str(path_or_name) in builtin_rigs():
        path = Path(str(resources.files("aolink") / "rigs")) / f"{path_or_name}.toml"
        text = path.read_text()
    else:
        try:
            with path.open(encoding="utf-8-sig") as file:  # a byte order mark is none of it
                text = file.read(_LONGEST + 1)
        except OSError as error:
            if path.name.removesuffix(".toml") in builtin_rigs() and path.parent == Path():
                return load_rig(path.name.removesuffix(".toml"))
            like = get_close_matches(path.name.removesuffix(".toml"), builtin_rigs(), 1)
            meant = f"did you mean {like[0]}? Otherwise " if like else ""
            no_rig = isinstance(error, FileNotFoundError) and path.suffix != ".toml"
            what = f"there is no rig {path}" if no_rig else f"cannot read the rig file {path}: {error.strerror}"
            raise RigError(f"{what}; {meant}give a TOML file or one of: {', '.join(builtin_rigs())}") from None
        except UnicodeDecodeError:
            raise RigError(f"{path} is not a rig file: it is not text") from None
    try:
        return parse_rig(text, path.parent)
    except RigError as error:
        raise RigError(f"{path_or_name}: {error}") from None


def builtin_rigs() -> list[str]:
    """Names of the rigs that come with aolink."""
    files = (resources.files("aolink") / "rigs").iterdir()
    return sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml"))


def parse_rig(text: str, folder: Path | None = None) -> Rig:
    """Validate the text of a rig file. Raises `RigError`, naming the key.

    Parameters
    ----------
    folder:
        The folder of the file; None for a text that comes out of a recording.
    """
    if len(text) > _LONGEST or text.count("=") + text.count("[") > _MOST_KEYS or _deepest_key(text) > _DEEPEST:
        raise RigError(
            f"it is longer than {_LONGEST >> 20} MiB, or has more than {_MOST_KEYS} keys, tables and rows of matrices,"
            f" or a key of more than {_DEEPEST} parts"
        )
    try:
        root = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError, or a number or nesting beyond what Python reads
        raise RigError(f"not valid TOML: {error}") from None
    try:
        return _read(root, text, folder)
    except (ArithmeticError, ValueError) as error:  # a LinAlgError is a ValueError
        raise RigError(f"it has numbers that are too large or too small to compute with ({error})") from error


@dataclass(frozen=True, kw_only=True)
class _File:
    name: str
    summary: str = ""
    plant: dict[str, Any]
    timing: Annotated[Timing, read_timing]
    sensor: dict[str, Any]
    lenslets: dict[str, Any] | None = None
    mirror: dict[str, Any] | None = None
    drive: dict[str, Any] = field(default_factory=dict)
    control: dict[str, Any] = field(default_factory=dict)
    disturbance: dict[str, Any] | None = None
    scene: Annotated[SceneSensor | None, read_scene] = None
    simulation: Simulation = field(default_factory=Simulation)
    calibration: CalibrationTable | None = None
    devices: Annotated[dict[str, DeviceTable], read_devices] = field(default_factory=dict)


def _read(values: dict[str, Any], text: str, folder: Path | None) -> Rig:
    file = read(_File, values, "")
    timing, grid = file.timing, (1, 1)
    if file.lenslets is not None or file.plant.get("kind") == "tip-tilt":
        if "grid" not in file.sensor:
            raise RigError("sensor.grid is missing: the rig file must give it")
        grid = checked(tuple[Windows, Windows], file.sensor["grid"], "sensor.grid")
    optics = None if file.lenslets is None else read_optics(file.lenslets, grid)
    plant = read_plant(file.plant, int(optics.lit.sum()) if optics else math.prod(grid), optics, timing)
    seen = (optics.field, optics.light) if optics else (None, None)
    sensor = read_sensor(file.sensor, plant.axes, plant.n_outputs, *seen)
    n_inputs = plant.axes * plant.n_inputs
    mirror = read_mirror(file.mirror, n_inputs)
    drive = read_drive(file.drive, n_inputs, mirror)
    disturbance = None
    if file.disturbance is not None:
        disturbance = read_disturbance(file.disturbance, plant.n_outputs, timing.fast_step_s)
        if optics is None and (disturbance.layers or len(disturbance.zernike_m)):
            raise RigError("disturbance: turbulence and aberrations need [lenslets], to know the slopes that they make")
        if disturbance.model:
            plant = with_disturbance(plant, disturbance.model)
    plant = with_delays(plant, sensor, timing)
    return Rig(
        name=file.name, summary=file.summary, plant=plant, timing=timing, sensor=sensor, mirror=mirror, drive=drive,
        control=read_control(file.control, timing), simulation=file.simulation, calibration=file.calibration,
        optics=optics, disturbance=disturbance, scene=file.scene, devices=file.devices, folder=folder, toml=text,
    )  # fmt: skip


def _deepest_key(text: str) -> int:
    """An upper bound of the parts of any key in a text, found without parsing it."""
    return max(part.count(".") for part in re.split(r"[,=\[\]\n]", text.replace(" ", "").replace("\t", "")))
