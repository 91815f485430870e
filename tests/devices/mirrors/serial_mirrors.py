"""Every serial mirror that aolink drives, with its simulator: what must hold for each of them alike."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.drivers import open_driver
from aolink.rig import Rig, parse_rig
from tests.devices.mirrors import bench
from tests.devices.simulators import spot_camera
from tests.devices.simulators.optotune import OptotuneSimulator
from tests.devices.simulators.pi_gcs2 import PiSimulator
from tests.devices.simulators.serial_device import SerialDevice
from tests.devices.simulators.thorlabs import Aligner, Piezo
from tests.needs import needed

needed("thorlabs_apt_protocol")

PARK = (0.25, -0.5)
"""The safe input: none that a device has when it is switched on, or goes to by itself."""
UNDER_WAY = 25
"""Moves after which a session has recorded exposures of moving spots."""
_UNIT_RAD, _TAN_50 = 0.5, math.tan(math.radians(50))
_PATIENCE_S = 10.0


@dataclass(frozen=True)
class SerialMirror:
    """One of them."""

    make: Callable[..., SerialDevice]
    """Makes its simulator, with ``faults``."""
    keys: str
    """Keys of ``[devices.mirror]``, without the port."""
    inputs: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """The rig's inputs, (2,), from what its simulator holds."""
    called: str
    """How its description begins."""

    def rig(self, device: SerialDevice, camera: str = "", watchdog_s: float = 30.0) -> Rig:
        """A rig with it, and with a camera that sees it, unless it has another one."""
        spot_camera.mirrors[device.port] = bench.seen(device.held, self.inputs)
        camera = camera or f'driver = "spot"\nsees = "{device.port}"'
        tables = f'[devices.camera]\n{camera}\n[devices.mirror]\n{self.keys}\nport = "{device.port}"'
        changed = f"dac_bits = 12\nqueue_steps = 150\npark = {[*PARK]}\nwatchdog_s = {watchdog_s}"
        return parse_rig(bench.rig_with(tables).toml.replace("dac_bits = 16\nwatchdog_s = 30.0", changed))

    def opened(self, device: SerialDevice) -> Any:
        """Its driver, as a session makes it."""
        rig = self.rig(device)
        return open_driver("mirror", rig.devices["mirror"], rig)

    def is_parked(self, device: SerialDevice) -> bool:
        """Whether it comes to hold the safe input, within the time in which it takes what is still on the line."""
        deadline = time.monotonic() + _PATIENCE_S
        while not self.holds_the_safe_input(device) and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.holds_the_safe_input(device)

    def holds_the_safe_input(self, device: SerialDevice) -> bool:
        return bool(np.allclose(self.inputs(np.array(device.now())), PARK, atol=5e-4))


def _bays(**behaviour: Any) -> Piezo:
    return Piezo("BPC303", bays=2, **behaviour)


MIRRORS = {
    "optotune": SerialMirror(
        OptotuneSimulator,
        f'driver = "optotune"\nunit_rad = {_UNIT_RAD}',
        lambda xy: np.asarray(np.arctan(xy * _TAN_50) / _UNIT_RAD),
        "Optotune MR-E-3",
    ),
    "pi_gcs2": SerialMirror(
        PiSimulator,
        'driver = "pi_gcs2"\naxes = ["1", "2"]\nscale = 10\noffset = 17.5',
        lambda positions: (positions[:2] - 17.5) / 10,
        "PI E-727.3SDA",
    ),
    "thorlabs_aligner": SerialMirror(
        Aligner, 'driver = "thorlabs_aligner"\nunit = 5.0\nzero = 1.0', lambda volts: (volts - 1) / 5, "Thorlabs KPA101"
    ),
    "thorlabs_piezo": SerialMirror(
        _bays, 'driver = "thorlabs_piezo"\nunit = 30.0\nzero = 35.0\nbays = [1, 2]', lambda volts: (volts - 35) / 30,
        "Thorlabs BPC303",
    ),
}  # fmt: skip


def with_each(check: Callable[[str], None], names: Iterable[str] = MIRRORS) -> None:
    """Do something with each of these mirrors, one after the other: a simulator that waits for others is late."""
    for name in names:
        try:
            check(name)
        except BaseException as error:
            error.add_note(f"with {name}")
            raise
