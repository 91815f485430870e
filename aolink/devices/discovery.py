"""The serial ports of this machine, the drivers, and the devices that they find."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

from serial.tools import list_ports as serial_ports

from aolink.devices.drivers import KINDS, NATIVE, DeviceKind, calling, driver_names, load_driver
from aolink.devices.gate import printable
from aolink.devices.identity import identify, new_nonce
from aolink.devices.interfaces import lacks_of
from aolink.errors import AolinkError
from aolink.units import counted
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.port import SerialPort


@dataclass(frozen=True)
class FoundDevice:
    """A device that has reported its identity."""

    port: str
    kind: str
    model: str
    serial_number: str
    firmware: str
    protocol_version: int
    geometry: str
    virtual_time: bool

    def text(self) -> str:
        """The device in one line of text."""
        time = "virtual time" if self.virtual_time else "real time"
        return (
            f"{self.kind} {self.model}, serial number {self.serial_number}, firmware {self.firmware},"
            f" protocol {self.protocol_version}, {self.geometry}, {time}"
        )


@dataclass(frozen=True, kw_only=True)
class DriverFound:
    """A driver, what its devices cannot do, and which of them are there."""

    kind: DeviceKind
    name: str
    lacks: list[str] = field(default_factory=list)
    devices: list[tuple[str, str]] = field(default_factory=list)
    """Address and description of each device found: the address is a key of the rig file's ``[devices]``."""
    search: str = ""
    """How its devices can be found; empty where some were found."""
    problem: str = ""
    """Why it cannot be used, or cannot look for devices; empty where it can."""


def find_drivers() -> list[DriverFound]:
    """The installed drivers of cameras and mirrors, each with the devices that it finds on this machine.

    A driver looks for its devices if its module has a function ``discover()``. No device is opened.
    """
    return [_find(kind, name) for kind in KINDS for name in driver_names(kind)]


def _find(kind: DeviceKind, name: str) -> DriverFound:
    if name == NATIVE:
        return DriverFound(kind=kind, name=name, search="`aolink devices PORT...` identifies the device at a port")
    try:
        driver = load_driver(kind, name)
        with calling(kind, "when it was asked what its devices lack"):
            lacks = [str(each) for each in lacks_of(driver)]
    except AolinkError as error:
        return DriverFound(kind=kind, name=name, problem=str(error))
    module = sys.modules.get(getattr(driver, "__module__", ""))
    discover = getattr(module, "discover", None)
    try:
        devices = [(str(address), str(text)) for address, text in discover()] if discover else []
    except Exception as error:  # a library of the maker's that is missing or broken
        return DriverFound(kind=kind, name=name, lacks=lacks, problem=printable(f"it cannot look for devices: {error}"))
    search = "no device found" if discover else "it does not look for devices: the rig file says where they are"
    return DriverFound(kind=kind, name=name, lacks=lacks, devices=devices, search="" if devices else search)


def list_ports() -> list[tuple[str, str]]:
    """The serial ports of this machine: (path, description)."""
    return sorted((port.device, port.description or "") for port in serial_ports.comports())


def identify_port(port: str) -> FoundDevice:
    """Ask the device behind a port for its identity. Raises PortError and DeviceError."""
    hub = Hub()
    try:
        identity = identify(hub, hub.connect(f"given ({port})", SerialPort(port)), new_nonce())
    finally:
        hub.close()
    camera, mirror = identity.camera, identity.mirror
    if identity.kind == pb.Identity.CAMERA:
        geometry = (
            f"{camera.width}x{camera.height} pixels of {camera.bit_depth} bits,"
            f" exposure {camera.exposure_steps} steps of {identity.fast_step_ns / 1e6:g} ms"
        )
    else:
        parked = ", parked by its watchdog" if mirror.latched else ", parked" if mirror.parked else ""
        geometry = f"{counted(mirror.n_inputs, 'input')}, queue of {mirror.queue_steps} steps{parked}"
    return FoundDevice(
        port=port, kind=pb.Identity.Kind.Name(identity.kind).lower(), model=identity.model,
        serial_number=identity.serial_number, firmware=identity.firmware, protocol_version=identity.protocol_version,
        geometry=geometry, virtual_time=identity.virtual_time,
    )  # fmt: skip
