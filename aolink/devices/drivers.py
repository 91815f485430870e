"""Drivers by their names: the native ones, and those that other packages bring through entry points."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import EntryPoint
from typing import Any, Literal, get_args

from aolink.errors import AolinkError, DeviceError, RigError
from aolink.extensions import installed, loaded
from aolink.keys import shown
from aolink.rig import Rig
from aolink.rig.device_tables import DeviceTable
from aolink.wire.packet import NO_SIGNING
from aolink.wire.port import check_address

DeviceKind = Literal["camera", "mirror"]
KINDS: tuple[DeviceKind, ...] = get_args(DeviceKind)
_GONE = {"basler": "aravis opens GigE and USB3 Vision cameras, micromanager those that Micro-Manager knows"}
"""Drivers of earlier versions, and what opens their devices now."""
NATIVE = "native"
"""The driver of devices that speak aolink's packets; its only key is ``port``."""


def driver_names(kind: DeviceKind) -> list[str]:
    """Names of the installed drivers; those of other packages may turn out to be broken when they are loaded."""
    return [NATIVE, *sorted(_others(kind))]


def open_driver(kind: DeviceKind, table: DeviceTable, rig: Rig) -> Any:
    """Make the driver that a rig file names, with its own keys.

    Raises
    ------
    DeviceError
        There is no driver of this name, it cannot be loaded, or it fails to open its device.
    RigError
        The driver does not take the keys that the table has.
    """
    make = check_driver(kind, table, rig)
    with calling(kind, "when it was opened"):
        return make(rig, **table.options)


def check_driver(kind: DeviceKind, table: DeviceTable, rig: Rig) -> Callable[..., Any]:
    """The class of the driver that a rig file names, whose keys fit; nothing is opened. Raises as `open_driver`."""
    make = load_driver(kind, table.driver)
    try:
        with suppress(ValueError):  # one that is not written in Python may have no signature
            inspect.signature(make).bind(rig, **table.options)
    except TypeError as error:
        raise RigError(f"devices.{kind}: the driver {table.driver} cannot take these keys: {error}") from None
    return make


def native_port(kind: DeviceKind, table: DeviceTable) -> str:
    """The port of a native device. Raises PortError where it cannot be one, and RigError for other keys."""
    if "key" in table.options:
        raise RigError(f"devices.{kind}.key: {NO_SIGNING}")
    port = table.options.get("port")
    if not isinstance(port, str) or len(table.options) > 1 or table.delay:
        raise RigError(
            f"devices.{kind}: the driver {NATIVE} takes port, a text; found {shown(table.options)}"
            f"{' and a delay, though it reports its time' if table.delay else ''}"
        )
    check_address(port)
    return port


@contextmanager
def calling(kind: str, when: str) -> Iterator[None]:
    """Turn any exception of a driver into a DeviceError."""
    try:
        yield
    except AolinkError:
        raise
    except Exception as error:
        raise DeviceError(f"the driver of the {kind} failed {when}: {error!r}") from error


class Failure:
    """The error that has ended a driver's thread: the session gets it when it calls the driver next."""

    def __init__(self) -> None:
        self.error: Exception | None = None

    def check(self) -> None:
        """Raise the error, if there is one."""
        if self.error is not None:
            raise self.error


def load_driver(kind: DeviceKind, name: str) -> Callable[..., Any]:
    """The class of a driver. Raises DeviceError where there is none of this name, or it cannot be loaded."""
    point = _others(kind).get(name)
    if name in _GONE and point is None:
        raise DeviceError(f"the {kind} driver {name} is no more: {_GONE[name]}")
    if point is None:
        raise DeviceError(
            f"there is no {kind} driver {name}, there is {', '.join(driver_names(kind))}: install the package that"
            f" brings it, or correct devices.{kind}.driver in the rig file"
        )
    return loaded(point, f"{kind} driver", DeviceError)  # type: ignore[no-any-return]


def _others(kind: DeviceKind) -> dict[str, EntryPoint]:
    return {name: point for name, point in installed(f"aolink.{kind}s").items() if name != NATIVE}
