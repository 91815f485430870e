"""Checks of the rig file: the drivers' own keys in ``[devices.mirror]``, and that its converter is as coarse as the
device's own."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.gate import converter_margin
from aolink.errors import DeviceError, RigError
from aolink.rig import MirrorDriver


def per_input(name: str, value: Any, n_inputs: int) -> NDArray[np.float64]:
    """A number for each input, (n_inputs,); one number stands for all. Raises RigError."""
    values = value if isinstance(value, list) else [value] * n_inputs
    numbers = [each for each in values if isinstance(each, int | float) and not isinstance(each, bool)]
    array = np.array(numbers, dtype=np.float64)
    if len(values) != n_inputs or len(numbers) != n_inputs or not np.isfinite(array).all():
        raise RigError(
            f"devices.mirror.{name}: expected a finite number, or a list of {n_inputs} for the rig's inputs,"
            f" found {value!r}"
        )
    return array


def scale_per_input(name: str, value: Any, n_inputs: int) -> NDArray[np.float64]:
    """A factor for each input, as `per_input`; it must not be zero."""
    scale = per_input(name, value, n_inputs)
    if not scale.all():
        raise RigError(f"devices.mirror.{name}: expected a number that is not zero, found {value!r}")
    return scale


def text(name: str, value: Any) -> str:
    """A key whose value is a text. Raises RigError."""
    if not isinstance(value, str):
        raise RigError(f"devices.mirror.{name}: expected a text, found {value!r}")
    return value


def seconds(name: str, value: Any) -> float:
    """A time in seconds. Raises RigError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
        raise RigError(f"devices.mirror.{name}: expected a number of seconds, found {value!r}")
    return float(value)


def speed(name: str, value: Any) -> int:
    """The speed of a serial line, bits per second. Raises RigError."""
    if isinstance(value, bool) or not isinstance(value, int) or not 50 <= value <= 10_000_000:
        raise RigError(f"devices.mirror.{name}: expected a whole number of bits per second, found {value!r}")
    return value


def check_resolution(mirror: MirrorDriver, step: float | NDArray[np.float64], device: str) -> None:
    """Refuse a rig file with finer steps of the inputs than a device takes.

    Parameters
    ----------
    step:
        The device's steps, in units of the inputs: a number, or (n_inputs,).

    Raises
    ------
    DeviceError
        It is finer: the input that the device holds would count as another input than the one commanded.
    """
    if (converter_margin(mirror) < step).any():
        bits = int(np.log2(((mirror.input_max - mirror.input_min) / step).min() * (1 + 1e-9) + 1))
        raise DeviceError(
            f"mirror.dac_bits = {mirror.dac_bits} is finer than {device}, which goes in steps of"
            f" {np.max(step):.3g} of an input: set it to {bits}"
        )
