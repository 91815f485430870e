"""The tables of a rig file whose values depend on each other; an error is one `RigError` that names the key."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy

from aolink.errors import RigError
from aolink.keys import Positive, array, checked, read
from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.optics.mirror import VoltageLaw
from aolink.rig.disturbance import DisturbanceModel
from aolink.rig.optical_plant import Optics, plant_of_membrane, plant_of_tip_tilt
from aolink.rig.parts import FAULT_NAMES, Control, Drive, Faults, MirrorDriver, Plant, Timing, UnmodelledSlopes

_STILL = 1e-9
"""Range of a mirror that the rig file does not describe: it stays where it is."""
# One row of inputs, and their limits, must fit into a message of the protocol.
_MOST_INPUTS = 10_000
# Each output has a coefficient of its own for the slopes that the model leaves out, and estimators keep the covariance
# of all coefficients: for 512 it is 2 MB an exposure.
_MOST_UNMODELLED = 512


def read_plant(values: dict[str, Any], spots: int, optics: Optics | None, timing: Timing) -> Plant:
    """Read the table ``[plant]``, with matrices or with the description of a mirror before so many spots. Raises
    `RigError`."""
    values = dict(values)
    kind = checked(Literal["matrices", "membrane", "tip-tilt"], values.pop("kind", "matrices"), "plant.kind")
    if kind == "matrices":
        plant = _plant_by_matrices(values)
    elif kind == "tip-tilt":
        plant = plant_of_tip_tilt(values, spots, timing.fast_step_s)
    elif optics is None:
        raise RigError("plant.kind = 'membrane' needs [lenslets], to know the slopes that deflections make")
    else:
        plant = plant_of_membrane(values, optics, timing.fast_step_s)
    if plant.unmodelled is None:
        return plant
    if plant.n_outputs > _MOST_UNMODELLED:
        raise RigError(
            f"plant.unmodelled is for at most {_MOST_UNMODELLED} slopes of one plant, this one has {plant.n_outputs}:"
            " leave it out"
        )
    table = read(_Unmodelled, plant.unmodelled, "plant.unmodelled")
    slopes = UnmodelledSlopes(sd=table.sd, correlation_steps=table.correlation_s / timing.fast_step_s)
    return replace(plant, unmodelled=slopes)


@dataclass(frozen=True, kw_only=True)
class _Unmodelled:
    sd: Positive
    """Standard deviation of the slopes at any one time, slope units."""
    correlation_s: Positive
    """Time in which their correlation falls to 1/e, s."""


def _plant_by_matrices(values: dict[str, Any]) -> Plant:
    sizes: dict[str, int] = {}
    plant = read(Plant, {"initial_covariance": "stationary"} | values, "plant", sizes, disturbance_states=0)
    radius = float(np.abs(np.linalg.eigvals(plant.A)).max())
    if radius > 1 + 1e-9:
        raise RigError(f"plant.A is unstable: its largest eigenvalue has modulus {radius:.6g}, it must be at most 1")
    if not plant.C.any():
        raise RigError("plant.C is zero: the camera sees nothing of the plant, nothing is observable")
    _check_covariance(plant.process_noise, "plant.process_noise")
    initial: Any = plant.initial_covariance
    if isinstance(initial, str) and initial == "stationary":
        if radius > 1 - 1e-9:
            raise RigError(
                f"plant.initial_covariance is missing: plant.A has an eigenvalue of modulus {radius:.6g}, so there is"
                " no stationary covariance; give a matrix"
            )
        covariance = stationary_covariance(plant.A, plant.B_w @ plant.process_noise @ plant.B_w.T)
    else:
        key = "plant.initial_covariance"
        covariance = array(initial, key, ("states", "states"), sizes)
        _check_covariance(covariance, key)
    return replace(plant, initial_covariance=covariance)


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


def _check_covariance(matrix: FloatArray, key: str) -> None:
    if not np.allclose(matrix, matrix.T):
        raise RigError(f"{key} is not symmetric, a covariance must be")
    lowest = float(np.linalg.eigvalsh(matrix).min())
    if lowest < -1e-12 * max(1.0, float(np.abs(matrix).max())):
        raise RigError(f"{key} has the negative eigenvalue {lowest:.3g}, a covariance has none")


def read_timing(values: Any, key: str) -> Timing:
    """Read the table ``[timing]``. Raises `RigError`."""
    steps = checked(dict, values, key).get("exposure_steps")
    timing = read(Timing, {"frame_period_steps": steps} | values, key)
    if timing.frame_period_steps < timing.exposure_steps:
        raise RigError(
            f"{key}.frame_period_steps = {timing.frame_period_steps} is shorter than {key}.exposure_steps = {steps}"
        )
    step_ns = timing.fast_step_s * 1e9
    if not round(step_ns) or abs(step_ns - round(step_ns)) > 1e-6:
        raise RigError(f"{key}.fast_step_s = {timing.fast_step_s!r} is not a whole number of nanoseconds")
    offset_ns = timing.exposure_offset * step_ns
    if abs(offset_ns - round(offset_ns)) > 1e-6:
        raise RigError(
            f"{key}.exposure_offset = {timing.exposure_offset!r} of a fast step is not a whole number of nanoseconds"
        )
    return timing


def read_mirror(values: dict[str, Any] | None, n_inputs: int) -> MirrorDriver:
    """Read the table ``[mirror]``; None is that of a film or a camera alone, whose mirror may not move. Raises
    `RigError`."""
    defaults: dict[str, Any] = {"input_min": -_STILL, "input_max": _STILL} if values is None else {}
    values = values or {}
    if "voltage" in values:
        law = checked(VoltageLaw, values["voltage"], "mirror.voltage")
        if law.max_v <= law.bias_v:
            raise RigError(f"mirror.voltage.bias_v = {law.bias_v:g} must be below max_v = {law.max_v:g}")
        if {"input_min", "input_max"} & values.keys():
            raise RigError("mirror.input_min and mirror.input_max follow from [mirror.voltage]: leave them out")
        defaults = dict(zip(("input_min", "input_max"), law.input_range, strict=True))
    if n_inputs > _MOST_INPUTS:
        raise RigError(
            f"the mirror has {n_inputs} inputs (plant.axes times the columns of plant.B): at most {_MOST_INPUTS}"
        )
    # A block is one packet, 4 KiB of 8-byte numbers; where not even one step fits, it goes in parts.
    in_packet, in_parts = 4096 // (8 * n_inputs), 65_536 // (8 * n_inputs)
    most = in_packet or max(1, in_parts)
    defaults["block_steps"] = block = values.get("block_steps", min(50, most))
    defaults["queue_steps"] = 8 * block if type(block) is int else None
    mirror = read(MirrorDriver, defaults | values, "mirror", {"inputs": n_inputs})
    low, high, park, block = mirror.input_min, mirror.input_max, mirror.park, mirror.block_steps
    if (low >= high).any():
        raise RigError("mirror.input_min must be below mirror.input_max for every input")
    if (park < low).any() or (park > high).any():
        raise RigError("mirror.park is outside mirror.input_min .. mirror.input_max: the safe input must be allowed")
    if block > most:
        room = "one packet" if in_packet else "64 KiB"
        raise RigError(f"mirror.block_steps = {block} does not fit into {room}: at most {most} for {n_inputs} inputs")
    if mirror.queue_steps < 2 * block:
        raise RigError(
            f"mirror.queue_steps = {mirror.queue_steps} must hold at least two blocks of mirror.block_steps = {block}"
        )
    return mirror


def read_drive(values: dict[str, Any], n_inputs: int, mirror: MirrorDriver) -> Drive:
    """Read the table ``[drive]``. Raises `RigError`."""
    rest = {} if values.get("kind") == "sine" else {"amplitude": 0.0, "period_s": 1.0}
    drive = read(Drive, rest | values, "drive", {"inputs": n_inputs})
    reach = np.abs(drive.amplitude)
    for name, least in (("input_min", drive.offset - reach), ("input_max", drive.offset + reach)):
        if (least < mirror.input_min).any() or (least > mirror.input_max).any():
            raise RigError(f"drive.amplitude and drive.offset reach beyond mirror.{name}: the mirror would refuse it")
    fastest = float(reach.max(initial=0.0)) * 2 * math.pi / drive.period_s
    if mirror.slew_max_per_s and drive.kind == "sine" and fastest > mirror.slew_max_per_s:
        raise RigError(
            f"the drive changes by up to {fastest:g} in a second, more than mirror.slew_max_per_s ="
            f" {mirror.slew_max_per_s:g}: the mirror would refuse it"
        )
    return drive


def read_control(values: dict[str, Any], timing: Timing) -> Control:
    """Read the table ``[control]``. Raises `RigError`."""
    frame_s = timing.frame_period_steps * timing.fast_step_s
    control = read(Control, {"delay_s": min(Control().delay_s, frame_s / 4)} | values, "control")
    if control.delay_s >= frame_s:
        raise RigError(
            f"control.delay_s = {control.delay_s:g} is not below the {frame_s:g} s from one exposure to the next: a"
            " loop whose commands come a whole frame too late is not supported"
        )
    return control


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
    return read(Faults, values, "--fault")
