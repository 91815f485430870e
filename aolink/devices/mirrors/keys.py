"""The numbers that a device takes for the rig's inputs, and checks that its range and resolution suffice for these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.gate import converter_margin
from aolink.errors import DeviceError, RigError
from aolink.rig import MirrorDriver

_ROUNDING = 1e-9


class Scale:
    """A device's own numbers for the inputs, (n_inputs,): zero + unit * input.

    Parameters
    ----------
    unit, zero:
        A number for each input in a list, or one that stands for all; no unit may be 0. ``keys`` are their names in the
        rig file.

    Raises
    ------
    RigError
        There are more or fewer numbers than inputs, or one of them cannot be used.
    """

    def __init__(
        self, mirror: MirrorDriver, unit: float | list[float], zero: float | list[float] = 0.0,
        keys: tuple[str, str] = ("unit", "zero"),
    ) -> None:  # fmt: skip
        self._mirror, self._keys, n_inputs = mirror, " and ".join(keys), len(mirror.park)
        for key, value in zip(keys, (unit, zero), strict=True):
            if np.size(value) not in {n_inputs, -1 if isinstance(value, list) else 1} or not np.isfinite(value).all():
                raise RigError(
                    f"devices.mirror.{key}: expected a finite number, or a list of {n_inputs} for the rig's inputs,"
                    f" found {value!r}"
                )
        if not np.all(unit):
            raise RigError(f"devices.mirror.{keys[0]}: expected a number that is not zero, found {unit!r}")
        self.unit, self.zero = (np.broadcast_to(np.asarray(each, dtype=float), n_inputs) for each in (unit, zero))

    def of(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """The device's numbers for inputs (..., n_inputs)."""
        return self.zero + self.unit * u

    def inputs(self, numbers: Any) -> NDArray[np.float64]:
        """The inputs for the device's numbers."""
        return np.asarray((np.asarray(numbers) - self.zero) / self.unit)

    def check(self, low: Any, high: Any, device: str | Sequence[str], unit: str = "", step: Any = 0.0) -> None:
        """Refuse a rig file whose inputs go beyond what a device reaches, or in finer steps. Raises DeviceError.

        Parameters
        ----------
        low, high, step:
            The ends of its range and its steps in its own numbers, (n_inputs,) or a number; ``unit`` is their unit.
        device:
            Its name, or that of each input.
        """
        ends = np.sort(self.of(np.array([self._mirror.input_min, self._mirror.input_max])), axis=0)
        slack = _ROUNDING * np.maximum(np.abs(low), np.abs(high))
        beyond = np.flatnonzero((ends[0] < low - slack) | (ends[1] > high + slack))
        if len(beyond):
            at, shape = beyond[0], ends[0].shape
            least, most = np.broadcast_to(low, shape)[at], np.broadcast_to(high, shape)[at]
            raise DeviceError(
                f"mirror.input_min .. input_max are {ends[0][at]:g} to {ends[1][at]:g}{unit} by devices.mirror's"
                f" {self._keys}, {device if isinstance(device, str) else device[at]} goes from {least:g} to"
                f" {most:g}{unit}: correct one of them"
            )
        mirror, step = self._mirror, np.abs(step / self.unit)
        if (converter_margin(mirror) < step).any():  # the input that it holds would count as another one
            bits = int(np.log2(((mirror.input_max - mirror.input_min) / step).min() * (1 + _ROUNDING) + 1))
            raise DeviceError(
                f"mirror.dac_bits = {mirror.dac_bits} is finer than {device}, which goes in steps of"
                f" {np.max(step):.3g} of an input: set it to {bits}"
            )
