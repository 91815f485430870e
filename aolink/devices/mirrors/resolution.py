"""The check that a rig file's converter is as coarse as the device's own, so that held inputs can be compared with
commanded ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aolink.devices.gate import converter_margin
from aolink.errors import DeviceError
from aolink.rig import MirrorDriver


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
