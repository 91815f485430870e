"""The tables of a rig file, read and validated; an error is one `RigError` that names the key."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import scipy

from aolink.errors import RigError
from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.rig import parts
from aolink.rig.disturbance import DisturbanceModel
from aolink.rig.optical_plant import Optics, read_membrane, read_tip_tilt, read_voltage
from aolink.rig.parts import FAULT_NAMES, Control, Drive, Faults, Light, MirrorDriver, Plant, Timing, UnmodelledSlopes
from aolink.rig.sensor_tables import read_grid
from aolink.rig.toml_table import Table

# One row of inputs, and their limits, must fit into a message of the protocol.
_STILL = 1e-9
"""Range of a mirror that the rig file does not describe: it stays where it is."""
_MOST_INPUTS = 10_000
# Each output has a coefficient of its own for the slopes that the model leaves out, and estimators keep the covariance
# of all coefficients: for 512 it is 2 MB an exposure.
_MOST_UNMODELLED = 512
_MOST_STEP_S = 1e4
_MOST_OFFSET_S, _MOST_DRIFT_PPM = 1e9, 1e5
_MOST_FAULT_S = 60.0
# Largest relative changes that estimators follow: a plant that differs more from its matrices should be identified.
_WANDERING: dict[parts.Wanders, float] = {
    "frequency": 0.2, "gain": 0.5, "process_noise": 3.0, "kernel_width": 0.5, "sensor_noise": 3.0,
}  # fmt: skip


def read_plant(table: Table, root: Table, optics: Optics | None, timing: Timing) -> Plant:
    """Read the table ``[plant]``, with matrices or with the description of a mirror. Raises `RigError`."""
    kind = table.choice("kind", ("matrices", "membrane", "tip-tilt"), "matrices")
    if kind == "membrane":
        if optics is None:
            raise RigError("plant.kind = 'membrane' needs [lenslets], to know the slopes that deflections make")
        model = read_membrane(table, optics, timing.fast_step_s)
    elif kind == "tip-tilt":
        spots = int(optics.lit.sum()) if optics else math.prod(read_grid(root.table("sensor")))
        model = read_tip_tilt(table, spots, timing.fast_step_s)
    else:
        return _plant_by_matrices(table, timing)
    # A number is the variance of each noise.
    W = table.variances("process_noise", model.B_w.shape[1], "noises")
    initial = stationary_covariance(model.A, model.B_w @ W @ model.B_w.T)
    return Plant(
        A=model.A, B=model.B, B_w=model.B_w, C=model.C, process_noise=W, initial_mean=np.zeros(len(model.A)),
        initial_covariance=initial, axes=1, **_beside_the_model(table, len(model.C), timing),
    )  # fmt: skip


def _beside_the_model(table: Table, n_outputs: int, timing: Timing) -> dict[str, Any]:
    """Read the tables ``[plant.unmodelled]`` and ``[plant.wandering]``."""
    if table.has("unmodelled") and n_outputs > _MOST_UNMODELLED:
        raise RigError(
            f"{table.key('unmodelled')} is for at most {_MOST_UNMODELLED} slopes of one plant, this one has"
            f" {n_outputs}: leave it out"
        )
    unmodelled = table.read_any("unmodelled", _unmodelled, timing.fast_step_s)
    return {"unmodelled": unmodelled, "wandering": table.read_any("wandering", _wandering)}


def _unmodelled(table: Table, fast_step_s: float) -> UnmodelledSlopes:
    correlation_s = table.number("correlation_s", above=0.0)
    return UnmodelledSlopes(sd=table.number("sd", above=0.0), correlation_steps=correlation_s / fast_step_s)


def _wandering(table: Table) -> parts.Wandering:
    given = [name for name in _WANDERING if table.has(name)]
    if len(given) != 1:
        raise RigError(
            f"plant.wandering has {' and '.join(given) or 'nothing that drifts'}: give one of {', '.join(_WANDERING)}"
        )
    (name,) = given
    return parts.Wandering(
        parameter=name,
        largest=table.number(name, above=0.0, high=_WANDERING[name]),
        rate_per_minute=table.number("rate_per_minute", above=0.0, high=_WANDERING[name]),
    )


def _plant_by_matrices(table: Table, timing: Timing) -> Plant:
    A = table.square("A", "states x states")
    n = len(A)
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
            raise table.missing(
                "initial_covariance",
                f"plant.A has an eigenvalue of modulus {radius:.6g}, so there is no stationary covariance;"
                " give a matrix",
            )
        covariance = stationary_covariance(A, B_w @ W @ B_w.T)
    else:
        covariance = _covariance(table, "initial_covariance", n, "states x states")
    axes = table.integer("axes", 1, low=1, high=10_000)
    return Plant(
        A=A, B=B, B_w=B_w, C=C, process_noise=W, initial_mean=mean, initial_covariance=covariance, axes=axes,
        **_beside_the_model(table, len(C), timing),
    )  # fmt: skip


def with_disturbance(plant: Plant, model: DisturbanceModel) -> Plant:
    """A plant with the states of a disturbance's model behind its own, and the sum of both as its outputs."""
    n = len(model.A)
    return replace(
        plant, A=_beside(plant.A, model.A), B=np.vstack([plant.B, np.zeros((n, plant.n_inputs))]),
        B_w=_beside(plant.B_w, model.B_w), C=np.hstack([plant.C, model.C]),
        process_noise=_beside(plant.process_noise, model.process_noise),
        initial_mean=np.append(plant.initial_mean, np.zeros(n)),
        initial_covariance=_beside(plant.initial_covariance, model.initial_covariance), disturbance_states=n,
    )  # fmt: skip


def _beside(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(scipy.linalg.block_diag(first, second))


def _covariance(table: Table, name: str, size: int, why: str) -> FloatArray:
    matrix = table.matrix(name, (size, size), why)
    if not np.allclose(matrix, matrix.T):
        raise RigError(f"{table.key(name)} is not symmetric, a covariance must be")
    lowest = float(np.linalg.eigvalsh(matrix).min())
    if lowest < -1e-12 * max(1.0, float(np.abs(matrix).max())):
        raise RigError(f"{table.key(name)} has the negative eigenvalue {lowest:.3g}, a covariance has none")
    return matrix


def read_timing(table: Table) -> Timing:
    """Read the table ``[timing]``. Raises `RigError`."""
    fast_step_s = table.number("fast_step_s", above=0.0, high=_MOST_STEP_S)
    steps = table.integer("exposure_steps", low=1, high=1_000_000)
    period = table.integer("frame_period_steps", steps, low=1, high=10_000_000)
    if period < steps:
        raise RigError(f"timing.frame_period_steps = {period} is shorter than timing.exposure_steps = {steps}")
    if not (step_ns := round(fast_step_s * 1e9)) or abs(fast_step_s * 1e9 - step_ns) > 1e-6:
        raise RigError(f"timing.fast_step_s = {fast_step_s!r} is not a whole number of nanoseconds")
    offset = table.number("exposure_offset", 0.0, low=0.0)
    if offset >= 1:
        raise RigError(f"timing.exposure_offset = {offset:g} is a part of a fast step: it must be below 1")
    offset_ns = offset * fast_step_s * 1e9
    if abs(offset_ns - round(offset_ns)) > 1e-6:
        raise RigError(f"timing.exposure_offset = {offset!r} of a fast step is not a whole number of nanoseconds")
    return Timing(
        fast_step_s=fast_step_s, exposure_steps=steps, frame_period_steps=period, exposure_offset=offset
    )  # fmt: skip


def read_mirror(table: Table, n_inputs: int, given: bool) -> MirrorDriver:
    """Read the table ``[mirror]``; one that is not ``given`` is that of a film or a camera alone, whose mirror may not
    move. Raises `RigError`."""
    law = table.read_any("voltage", read_voltage)
    if law and (table.has("input_min") or table.has("input_max")):
        raise RigError("mirror.input_min and mirror.input_max follow from [mirror.voltage]: leave them out")
    least, most = (None, None) if given else (-_STILL, _STILL)
    low = np.full(n_inputs, law.input_range[0]) if law else table.vector("input_min", n_inputs, "inputs", least)
    high = np.full(n_inputs, law.input_range[1]) if law else table.vector("input_max", n_inputs, "inputs", most)
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
    return MirrorDriver(
        input_min=low, input_max=high, park=park, dac_bits=table.integer("dac_bits", 16, low=0, high=32),
        block_steps=block, queue_steps=queue, watchdog_s=table.number("watchdog_s", 1.0, above=0.0),
        slew_max_per_s=table.number("slew_max_per_s", 0.0, low=0.0), voltage=law,
    )  # fmt: skip


def read_drive(table: Table, n_inputs: int, mirror: MirrorDriver) -> Drive:
    """Read the table ``[drive]``. Raises `RigError`."""
    kind = table.choice("kind", ("none", "sine"), "none")
    offset = table.vector("offset", n_inputs, "inputs", 0.0)
    amplitude = table.vector("amplitude", n_inputs, "inputs", None if kind == "sine" else 0.0)
    period = table.number("period_s", None if kind == "sine" else 1.0, above=0.0)
    for name, reach in (("input_min", offset - np.abs(amplitude)), ("input_max", offset + np.abs(amplitude))):
        if (reach < mirror.input_min).any() or (reach > mirror.input_max).any():
            raise RigError(f"drive.amplitude and drive.offset reach beyond mirror.{name}: the mirror would refuse it")
    fastest = float(np.abs(amplitude).max(initial=0.0)) * 2 * math.pi / period
    if mirror.slew_max_per_s and kind == "sine" and fastest > mirror.slew_max_per_s:
        raise RigError(
            f"the drive changes by up to {fastest:g} in a second, more than mirror.slew_max_per_s ="
            f" {mirror.slew_max_per_s:g}: the mirror would refuse it"
        )
    return Drive(kind=kind, amplitude=amplitude, period_s=period, offset=offset)


def read_control(table: Table, timing: Timing) -> Control:
    """Read the table ``[control]``. Raises `RigError`."""
    default, frame_s = Control(), timing.frame_period_steps * timing.fast_step_s
    control = Control(
        delay_s=table.number("delay_s", min(default.delay_s, frame_s / 4), low=0.0),
        when_lost=table.choice("when_lost", ("hold", "park"), default.when_lost),
        gain=table.number("gain", default.gain, above=0.0),
        leak=table.rate("leak", default.leak),
        least_singular_value=table.rate("least_singular_value", default.least_singular_value),
        effort=table.number("effort", default.effort, above=0.0),
        fall_back=table.flag("fall_back", default.fall_back),
    )
    if control.delay_s >= frame_s:
        raise RigError(
            f"{table.key('delay_s')} = {control.delay_s:g} is not below the {frame_s:g} s from one exposure to the"
            " next: a loop whose commands come a whole frame too late is not supported"
        )
    return control


def read_simulation(table: Table) -> parts.Simulation:
    """Read the table ``[simulation]``. Raises `RigError`."""
    return parts.Simulation(
        seed=table.integer("seed", 1, low=0),
        light=parse_light(table.text("light", "moving"), table.key("light")),
        clock_offset_s=table.number("clock_offset_s", 0.0, low=-_MOST_OFFSET_S, high=_MOST_OFFSET_S),
        clock_drift_ppm=table.number("clock_drift_ppm", 0.0, low=-_MOST_DRIFT_PPM, high=_MOST_DRIFT_PPM),
        latency_s=table.number("latency_s", 100e-6, low=0.0, high=_MOST_FAULT_S),
        faults=table.read("faults", _faults, optional=True),
    )


def _faults(table: Table) -> Faults:
    faults = {}
    for name, default in asdict(Faults()).items():
        if name.endswith("_rate"):
            faults[name] = table.rate(name)
        else:
            low = -_MOST_FAULT_S if name == "clock_step_s" else 0.0
            faults[name] = table.number(name, default, low=low, high=_MOST_FAULT_S)
    return Faults(**faults)


def with_faults(faults: Faults, texts: Iterable[str]) -> Faults:
    """Faults with some changed: ``NAME=VALUE`` each, where a name is a key of the table or one of `FAULT_NAMES`.

    Raises RigError.
    """
    values: dict[str, object] = asdict(faults)
    for text in texts:
        name, _, number = text.partition("=")
        key = FAULT_NAMES.get(name, name)
        if key not in values:
            raise RigError(f"--fault {text}: expected NAME=VALUE with one of {', '.join([*FAULT_NAMES, *values])}")
        try:
            values[key] = float(number)
        except ValueError:
            raise RigError(f"--fault {text}: expected a number after {name}=") from None
    return _faults(Table(values, "--fault"))


def parse_light(text: str, name: str) -> tuple[Light, ...]:
    """A sequence of lights from a text such as ``dark,flat:4,still``; errors call it ``name``. Raises RigError."""
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
