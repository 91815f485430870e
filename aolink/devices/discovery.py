"""The serial ports of this machine, and the devices behind them."""

from __future__ import annotations

import secrets
from dataclasses import dataclass

from serial.tools import list_ports as serial_ports

from aolink.devices.identity import identify
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.port import SerialPort


@dataclass(frozen=True)
class Found:
    """A device that said who it is."""

    port: str
    kind: str
    model: str
    serial_number: str
    firmware: str
    protocol_version: int
    geometry: str
    virtual_time: bool

    def text(self) -> str:
        """In one line."""
        time = "virtual time" if self.virtual_time else "real time"
        return (
            f"{self.kind} {self.model}, serial number {self.serial_number}, firmware {self.firmware},"
            f" protocol {self.protocol_version}, {self.geometry}, {time}"
        )


def list_ports() -> list[tuple[str, str]]:
    """The serial ports of this machine: (path, description)."""
    return sorted((port.device, port.description or "") for port in serial_ports.comports())


def identify_port(port: str) -> Found:
    """Ask the device behind a port who it is. Raises PortError and DeviceError."""
    hub = Hub()
    try:
        identity = identify(hub, hub.connect(f"given ({port})", SerialPort(port)), secrets.randbits(48))
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
        geometry = f"{mirror.n_inputs} inputs, queue of {mirror.queue_steps} steps{parked}"
    return Found(
        port=port,
        kind=pb.Identity.Kind.Name(identity.kind).lower(),
        model=identity.model,
        serial_number=identity.serial_number,
        firmware=identity.firmware,
        protocol_version=identity.protocol_version,
        geometry=geometry,
        virtual_time=identity.virtual_time,
    )
