"""The tables ``[devices.camera]`` and ``[devices.mirror]``: which driver a device has, and the driver's own keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from aolink.keys import NotNegative, read


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


@dataclass(frozen=True, kw_only=True)
class _Devices:
    camera: dict[str, Any] | None = None
    mirror: dict[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class _Device:
    driver: str
    delay_s: float | None = None
    delay_sd_s: NotNegative | None = None


def read_devices(values: Any, key: str) -> dict[str, DeviceTable]:
    """Read the table ``[devices]``; its devices are given by the names ``camera`` and ``mirror``. Raises `RigError`."""
    devices = {}
    for kind in vars(read(_Devices, values, key)).keys() & values.keys():
        options = dict(values[kind])
        own = {name: options.pop(name) for name in _Device.__dataclass_fields__ if name in options}
        table = read(_Device, own, f"{key}.{kind}")
        delay = Delay(mean_s=table.delay_s or 0.0, sd_s=table.delay_sd_s or 0.0) if len(own) > 1 else None
        devices[kind] = DeviceTable(driver=table.driver, delay=delay, options=options)
    return devices
