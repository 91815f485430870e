"""The tables ``[devices.camera]`` and ``[devices.mirror]``: which driver a device has, and the driver's own keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from aolink.rig.toml_table import Table


@dataclass(frozen=True, kw_only=True)
class DeviceTable:
    """The driver of one device and its options."""

    driver: str
    """Name of the driver: ``native``, or one that another package brings."""
    options: dict[str, Any]
    """The other keys of the table; the driver checks them."""


def read_devices(table: Table) -> dict[str, DeviceTable]:
    """The table ``[devices]``: by the names ``camera`` and ``mirror``, where it has them. Raises `RigError`."""
    devices = {}
    for kind in ("camera", "mirror"):
        if table.has(kind):
            device = table.table(kind)
            devices[kind] = DeviceTable(driver=device.text("driver"), options=device.others())
    table.finish()
    return devices
