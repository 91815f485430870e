"""What a rig is: a TOML file, and the frozen dataclasses that it becomes.

`load_rig` reads and validates the whole file; what is wrong is one `RigError` that names the key.
Quantities are SI (seconds) where the key ends in a unit, and otherwise in the rig's own slope unit:
the unit of ``sensor.field``, of the plant's output and of the kernel's width.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from aolink.blocks import stationary_covariance
from aolink.disturbance import Disturbance, read_disturbance
from aolink.errors import RigError
from aolink.optical_plant import Optics, read_membrane, read_optics, read_tip_tilt, read_voltage
from aolink.optics.mirror import VoltageLaw
from aolink.scene import SceneSensor, read_scene
from aolink.sensor import BaseSensor, read_calibration, read_grid, read_sensor
from aolink.sensor import CalibrationTable as CalibrationTable
from aolink.sensor import Kernel as Kernel
from aolink.sensor import Sensor as Sensor
from aolink.sensor import SpotSensor as SpotSensor
from aolink.toml_table import Table, shape_text

FloatArray = NDArray[np.float64]

# A row of them, and their limits, in one message of the protocol.
_MOST_INPUTS = 10_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Plant:
    """The fast-rate plant, x(k+1) = A x(k) + B u(k) + B_w w(k), theta(k) = C x(k)  (Mishra & Wen (1)).

    ``axes`` independent copies of it make the rig; each has its own state, output and inputs.
    """

    A: FloatArray
    """State transition over one fast step, (n_states, n_states)."""
    B: FloatArray
    """Input matrix, (n_states, n_inputs)."""
    B_w: FloatArray
    """Process-noise input matrix, (n_states, n_noises)."""
    C: FloatArray
    """Output matrix, (n_outputs, n_states); the outputs are spot positions in slope units."""
    process_noise: FloatArray
    """W_f, covariance of w(k) per fast step, (n_noises, n_noises)."""
    initial_mean: FloatArray
    """Mean of x(0), (n_states,)."""
    initial_covariance: FloatArray
    """Covariance of x(0), (n_states, n_states)."""
    axes: int
    """Number of independent copies."""

    @property
    def n_states(self) -> int:
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Inputs of one copy."""
        return int(self.B.shape[1])

    @property
    def n_outputs(self) -> int:
        """Outputs of one copy."""
        return int(self.C.shape[0])


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Fast steps and exposures. Exposure j covers ``exposure_steps`` steps from j * ``frame_period_steps`` on."""

    fast_step_s: float
    """T_f, s."""
    exposure_steps: int
    """N, fast steps in one exposure."""
    frame_period_steps: int
    """Fast steps from the start of one exposure to the start of the next; at least N."""
    exposure_offset: float = 0.0
    """How far into its first fast step an exposure starts, in fast steps, below one; it ends as far into a step."""

    @property
    def fast_step_ns(self) -> int:
        return round(self.fast_step_s * 1e9)

    @property
    def exposure_offset_ns(self) -> int:
        return round(self.exposure_offset * self.fast_step_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorDriver:
    """The mirror driver: limits, resolution, queue."""

    input_min: FloatArray
    """(axes * n_inputs,)"""
    input_max: FloatArray
    """(axes * n_inputs,)"""
    park: FloatArray
    """Declared safe input, (axes * n_inputs,)."""
    dac_bits: int
    """Commands are rounded to 2^dac_bits levels between the limits; 0 means not rounded."""
    block_steps: int
    """Fast steps in one command block."""
    queue_steps: int
    """Fast steps that the device can hold."""
    watchdog_s: float
    """The mirror parks itself when no valid packet has come for so long, s."""
    voltage: VoltageLaw | None = None
    """Where the driver makes voltages whose square pulls: they, not the inputs, are in equal steps."""

    def quantise(self, u: FloatArray) -> FloatArray:
        """The input that the converter puts out for ``u``, (..., axes * n_inputs)."""
        if not self.dac_bits:
            return u.copy()
        if self.voltage is not None:
            volt = self.voltage.max_v / ((1 << self.dac_bits) - 1)
            return self.voltage.force(np.round(self.voltage.volts(u) / volt) * volt)
        step = (self.input_max - self.input_min) / ((1 << self.dac_bits) - 1)
        return self.input_min + np.round((u - self.input_min) / step) * step


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """The known input that a session plays when nothing closes the loop."""

    kind: Literal["none", "sine"]
    amplitude: FloatArray
    """(axes * n_inputs,)"""
    period_s: float
    offset: FloatArray
    """(axes * n_inputs,)"""

    def inputs(self, first_step: int, n_steps: int, fast_step_s: float) -> FloatArray:
        """Inputs for ``n_steps`` fast steps from ``first_step``, (n_steps, axes * n_inputs)."""
        u = np.tile(self.offset, (n_steps, 1))
        if self.kind == "sine":
            t = np.arange(first_step, first_step + n_steps) * fast_step_s
            u += np.sin(2 * np.pi * t / self.period_s)[:, None] * self.amplitude
        return u


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults that the simulated rig injects, by rate and by seed; all zero means a perfect link."""

    bit_flip_rate: float = 0.0
    """Probability that a packet from the device has one bit flipped."""
    packet_loss_rate: float = 0.0
    """Probability that a packet from the device is lost."""
    command_loss_rate: float = 0.0
    """Probability that a packet to the device is lost."""
    duplicate_rate: float = 0.0
    """Probability that a packet from the device is sent twice."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """What the simulated camera looks at, from one start of it to the next."""

    kind: Literal["dark", "flat", "still", "moving"]
    """Nothing; the same density everywhere; the spot held where it is when the camera starts; the spot."""
    level: float | None = None
    """Density of a flat, one over slope units; None: halfway from the black level to the full scale."""


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What only the simulated rig needs to know."""

    seed: int = 1
    light: tuple[Light, ...] = (Light(kind="moving"),)
    """Each start of the camera takes the next one; the last one stays."""
    clock_offset_s: float = 0.0
    """Device clock minus host clock at the start, s."""
    clock_drift_ppm: float = 0.0
    """How much faster the device clock runs than the host's, parts per million."""
    latency_s: float = 100e-6
    """Median one-way latency of the link on virtual time, s."""
    faults: Faults = Faults()


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A whole rig, validated."""

    name: str
    summary: str
    plant: Plant
    timing: Timing
    sensor: BaseSensor
    mirror: MirrorDriver
    drive: Drive
    simulation: Simulation
    calibration: CalibrationTable | None
    """None where the sensor's values were not measured."""
    optics: Optics | None
    """The lenslets, where the file describes them."""
    disturbance: Disturbance | None
    scene: SceneSensor | None
    """The picture sensor that shares the exposure, where the rig has one."""
    folder: Path
    """Of the file; where a file is named in it, its path is relative to this."""
    toml: str
    """The file's text, as read."""

    @property
    def digest(self) -> str:
        """SHA-256 of the file's text: the rig's identity in a recording."""
        return hashlib.sha256(self.toml.encode()).hexdigest()

    @property
    def n_inputs(self) -> int:
        """Inputs of the whole rig: a row of a command."""
        return self.plant.axes * self.plant.n_inputs

    @property
    def n_outputs(self) -> int:
        """Outputs of the whole rig: rows of a path."""
        return self.plant.axes * self.plant.n_outputs


def load_rig(path_or_name: str | Path) -> Rig:
    """Read and validate a rig file.

    Parameters
    ----------
    path_or_name:
        A TOML file, or the name of a rig that comes with aolink (see `builtin_rigs`).

    Raises
    ------
    RigError
        The file cannot be read, or what it says cannot work; the message names the key.
    """
    path = Path(path_or_name)
    if path.suffix != ".toml" and str(path_or_name) in builtin_rigs():
        path = Path(str(resources.files("aolink") / "rigs")) / f"{path_or_name}.toml"
        text = path.read_text()
    else:
        try:
            text = path.read_text()
        except OSError as error:
            if path.name.removesuffix(".toml") in builtin_rigs() and path.parent == Path():
                return load_rig(path.name.removesuffix(".toml"))
            raise RigError(
                f"cannot read the rig file {path}: {error.strerror};"
                f" give a TOML file or one of: {', '.join(builtin_rigs())}"
            ) from None
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
    """Validate the text of a rig file. Raises `RigError`, naming the key."""
    try:
        root = Table(tomllib.loads(text), "")
    except tomllib.TOMLDecodeError as error:
        raise RigError(f"not valid TOML: {error}") from None
    name, summary = root.text("name"), root.text("summary", "")
    timing = _timing(root.table("timing"))
    optics = read_optics(root.table("lenslets"), read_grid(root.table("sensor"))) if root.has("lenslets") else None
    plant = _plant(root, optics, timing)
    seen = (optics.field, optics.light) if optics else (None, None)
    sensor = read_sensor(root.table("sensor"), plant.axes, plant.n_outputs, *seen)
    n_inputs = plant.axes * plant.n_inputs
    mirror = _mirror(root.table("mirror"), n_inputs, timing)
    drive = _drive(root.table("drive", optional=True), n_inputs, mirror)
    disturbance = read_disturbance(root.table("disturbance")) if root.has("disturbance") else None
    if disturbance and optics is None and (disturbance.layers or len(disturbance.zernike_m)):
        raise RigError("disturbance: turbulence and aberrations need [lenslets], to know the slopes that they make")
    scene = read_scene(root.table("scene")) if root.has("scene") else None
    simulation = _simulation(root.table("simulation", optional=True))
    calibration = read_calibration(root.table("calibration")) if root.has("calibration") else None
    root.finish()
    return Rig(
        name=name, summary=summary, plant=plant, timing=timing, sensor=sensor,
        mirror=mirror, drive=drive, simulation=simulation, calibration=calibration,
        optics=optics, disturbance=disturbance, scene=scene, folder=folder or Path(), toml=text,
    )  # fmt: skip


def _plant(root: Table, optics: Optics | None, timing: Timing) -> Plant:
    table = root.table("plant")
    kind = table.choice("kind", ("matrices", "membrane", "tip-tilt"), "matrices")
    if kind == "membrane":
        if optics is None:
            raise RigError("plant.kind = 'membrane' needs [lenslets], to know the slopes that deflections make")
        model = read_membrane(table, optics, timing.fast_step_s)
    elif kind == "tip-tilt":
        spots = int(optics.lit.sum()) if optics else math.prod(read_grid(root.table("sensor")))
        model = read_tip_tilt(table, spots, timing.fast_step_s)
    else:
        return _plant_by_matrices(table)
    # A number is the variance of each noise.
    W = np.diag(table.vector("process_noise", model.B_w.shape[1], "noises"))
    if (W < 0).any():
        raise RigError("plant.process_noise has a variance below zero")
    table.finish()
    initial = stationary_covariance(model.A, model.B_w @ W @ model.B_w.T)
    return Plant(
        A=model.A, B=model.B, B_w=model.B_w, C=model.C, process_noise=W, initial_mean=np.zeros(len(model.A)),
        initial_covariance=initial, axes=1,
    )  # fmt: skip


def _plant_by_matrices(table: Table) -> Plant:
    A = table.matrix("A", (None, None), "states x states")
    n = A.shape[0]
    if A.shape != (n, n):
        raise RigError(f"plant.A has shape {shape_text(A)}, expected a square matrix (states x states)")
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius > 1 + 1e-9:
        raise RigError(f"plant.A is unstable: its largest eigenvalue has modulus {radius:.6g}, it must be at most 1")
    B = table.matrix("B", (n, None), "states x inputs")
    B_w = table.matrix("B_w", (n, None), "states x process noises")
    C = table.matrix("C", (None, n), "outputs x states")
    if not C.any():
        raise RigError("plant.C is zero: the camera sees nothing of the plant, nothing is observable")
    W = _covariance(table, "process_noise", B_w.shape[1], "noises x noises")
    mean = table.vector("initial_mean", n, "states", 0.0)
    if table.get("initial_covariance", "stationary") == "stationary":
        if radius > 1 - 1e-9:
            raise RigError(
                f"plant.initial_covariance is missing: plant.A has an eigenvalue of modulus {radius:.6g},"
                " so there is no stationary covariance; give a matrix"
            )
        covariance = stationary_covariance(A, B_w @ W @ B_w.T)
    else:
        covariance = _covariance(table, "initial_covariance", n, "states x states")
    axes = table.integer("axes", 1, low=1, high=10_000)
    table.finish()
    return Plant(
        A=A, B=B, B_w=B_w, C=C, process_noise=W, initial_mean=mean, initial_covariance=covariance, axes=axes
    )  # fmt: skip


def _covariance(table: Table, name: str, size: int, why: str) -> FloatArray:
    matrix = table.matrix(name, (size, size), why)
    if not np.allclose(matrix, matrix.T):
        raise RigError(f"{table.key(name)} is not symmetric, a covariance must be")
    lowest = float(np.linalg.eigvalsh(matrix).min())
    if lowest < -1e-12 * max(1.0, float(np.abs(matrix).max())):
        raise RigError(f"{table.key(name)} has the negative eigenvalue {lowest:.3g}, a covariance has none")
    return matrix


def _timing(table: Table) -> Timing:
    fast_step_s = table.number("fast_step_s", above=0.0)
    steps = table.integer("exposure_steps", low=1, high=1_000_000)
    period = table.integer("frame_period_steps", steps, low=1, high=10_000_000)
    if period < steps:
        raise RigError(f"timing.frame_period_steps = {period} is shorter than timing.exposure_steps = {steps}")
    if abs(fast_step_s * 1e9 - round(fast_step_s * 1e9)) > 1e-6:
        raise RigError(f"timing.fast_step_s = {fast_step_s!r} is not a whole number of nanoseconds")
    offset = table.number("exposure_offset", 0.0, low=0.0)
    if offset >= 1:
        raise RigError(f"timing.exposure_offset = {offset:g} is a part of a fast step: it must be below 1")
    offset_ns = offset * fast_step_s * 1e9
    if abs(offset_ns - round(offset_ns)) > 1e-6:
        raise RigError(f"timing.exposure_offset = {offset!r} of a fast step is not a whole number of nanoseconds")
    table.finish()
    return Timing(
        fast_step_s=fast_step_s, exposure_steps=steps, frame_period_steps=period, exposure_offset=offset
    )  # fmt: skip


def _mirror(table: Table, n_inputs: int, timing: Timing) -> MirrorDriver:
    law = read_voltage(table.table("voltage")) if table.has("voltage") else None
    if law and (table.has("input_min") or table.has("input_max")):
        raise RigError("mirror.input_min and mirror.input_max follow from [mirror.voltage]: leave them out")
    low = np.full(n_inputs, law.input_range[0]) if law else table.vector("input_min", n_inputs, "inputs")
    high = np.full(n_inputs, law.input_range[1]) if law else table.vector("input_max", n_inputs, "inputs")
    if (low >= high).any():
        raise RigError("mirror.input_min must be below mirror.input_max for every input")
    park = table.vector("park", n_inputs, "inputs", 0.0)
    if (park < low).any() or (park > high).any():
        raise RigError("mirror.park is outside mirror.input_min .. mirror.input_max: the safe input must be allowed")
    if n_inputs > _MOST_INPUTS:
        raise RigError(
            f"the mirror has {n_inputs} inputs (plant.axes times the columns of plant.B): at most {_MOST_INPUTS}"
        )
    # A block is one packet, 4 KiB of 8-byte numbers; where not even one step fits, it goes in parts.
    in_packet, in_parts = 4096 // (8 * n_inputs), 65_536 // (8 * n_inputs)
    most = in_packet or max(1, in_parts)
    block = table.integer("block_steps", min(50, most), low=1)
    if block > most:
        room = "one packet" if in_packet else "64 KiB"
        raise RigError(f"mirror.block_steps = {block} does not fit into {room}: at most {most} for {n_inputs} inputs")
    queue = table.integer("queue_steps", 8 * block, low=1)
    if queue < 2 * block:
        raise RigError(f"mirror.queue_steps = {queue} must hold at least two blocks of mirror.block_steps = {block}")
    driver = MirrorDriver(
        input_min=low,
        input_max=high,
        park=park,
        dac_bits=table.integer("dac_bits", 16, low=0, high=32),
        block_steps=block,
        queue_steps=queue,
        watchdog_s=table.number("watchdog_s", 1.0, above=0.0),
        voltage=law,
    )
    table.finish()
    return driver


def _drive(table: Table, n_inputs: int, mirror: MirrorDriver) -> Drive:
    kind = table.choice("kind", ("none", "sine"), "none")
    offset = table.vector("offset", n_inputs, "inputs", 0.0)
    amplitude = table.vector("amplitude", n_inputs, "inputs", None if kind == "sine" else 0.0)
    period = table.number("period_s", None if kind == "sine" else 1.0, above=0.0)
    for name, reach in (("input_min", offset - np.abs(amplitude)), ("input_max", offset + np.abs(amplitude))):
        if (reach < mirror.input_min).any() or (reach > mirror.input_max).any():
            raise RigError(f"drive.amplitude and drive.offset reach beyond mirror.{name}: the mirror would refuse it")
    table.finish()
    return Drive(kind=kind, amplitude=amplitude, period_s=period, offset=offset)


def _simulation(table: Table) -> Simulation:
    faults_table = table.table("faults", optional=True)
    faults = Faults(**{name: faults_table.rate(name) for name in Faults.__dataclass_fields__})
    faults_table.finish()
    simulation = Simulation(
        seed=table.integer("seed", 1, low=0),
        light=parse_light(table.text("light", "moving"), table.key("light")),
        clock_offset_s=table.number("clock_offset_s", 0.0),
        clock_drift_ppm=table.number("clock_drift_ppm", 0.0),
        latency_s=table.number("latency_s", 100e-6, low=0.0),
        faults=faults,
    )
    table.finish()
    return simulation


def parse_light(text: str, name: str) -> tuple[Light, ...]:
    """Lights in a row, ``dark,flat:4,still``; ``name`` is what an error calls them. Raises RigError."""
    lights = []
    for word in text.split(","):
        kind, colon, level = word.strip().partition(":")
        if kind not in ("dark", "flat", "still", "moving") or (colon and kind != "flat"):
            raise RigError(f"{name}: {word.strip()!r} is not known: use dark, flat, flat:DENSITY, still, moving")
        try:
            density = float(level) if colon else None
        except ValueError:
            density = math.nan
        if density is not None and not 0 < density < math.inf:
            raise RigError(f"{name}: the density of {word.strip()!r} must be a number above 0")
        lights.append(Light(kind=kind, level=density))  # type: ignore[arg-type] # one of the four, as checked
    return tuple(lights)
