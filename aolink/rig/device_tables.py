"""The tables ``[devices.camera]`` and ``[devices.mirror]``: which driver a device has, and the driver's own keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from aolink.rig.toml_table import Table


@dataclass(frozen=True, kw_only=True)
class Delay:
    """A delay that no clock measures.

    For a mirror it is the time from the beginning of an input's fast step until the mirror follows that input; for a
    camera that reports no time, the time from the end of an exposure to its frame's arrival.
    """

    mean_s: float = 0.0
    sd_s: float = 0.0
    """Standard deviation of the mean, s: an error that all exposures of a session have in common."""


@dataclass(frozen=True, kw_only=True)
class DeviceTable:
    """The driver of one device and its options."""

    driver: str
    """Name of the driver: ``native``, or one that another package brings."""
    delay: Delay | None = None
    """Keys ``delay_s`` and ``delay_sd_s``; None where the table has neither."""
    options: dict[str, Any]
    """The other keys of the table; the driver checks them."""


def read_devices(table: Table) -> dict[str, DeviceTable]:
    """Read the table ``[devices]``; its devices are given by the names ``camera`` and ``mirror``. Raises `RigError`."""
    devices = {}
    for kind in ("camera", "mirror"):
        if table.has(kind):
            device = table.table(kind)
            devices[kind] = DeviceTable(driver=device.text("driver"), delay=_delay(device), options=device.others())
    return devices


def _delay(device: Table) -> Delay | None:
    if not (device.has("delay_s") or device.has("delay_sd_s")):
        return None
    return Delay(mean_s=device.number("delay_s", 0.0), sd_s=device.number("delay_sd_s", 0.0, low=0.0))
