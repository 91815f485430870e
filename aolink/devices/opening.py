"""Open both devices of a rig, identify them and compare them with the rig file."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from aolink.devices.drivers import NATIVE, Kind, calling, driver_names, open_driver
from aolink.devices.gate import Gate
from aolink.devices.host import Host
from aolink.devices.identity import check_against_rig, check_kind, identify
from aolink.devices.interfaces import Camera, Mirror, Opened
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.devices.simple import AdaptedCamera, AdaptedMirror, SimpleCamera, SimpleMirror
from aolink.errors import DeviceError, RigError
from aolink.rig import Rig
from aolink.rig.device_tables import DeviceTable
from aolink.wire import messages_pb2 as pb
from aolink.wire.port import SerialPort

_KINDS: tuple[Kind, Kind] = ("camera", "mirror")


@contextmanager
def open_devices(
    rig: Rig, camera_port: str | None = None, mirror_port: str | None = None, stop: Callable[[], bool] = lambda: False
) -> Iterator[Opened]:
    """Open both devices, ask who they are, and check that against the rig file.

    Parameters
    ----------
    camera_port, mirror_port:
        Ports of devices that speak aolink's packets; where None, the rig file's table ``[devices]`` names the driver.
    stop:
        Once it gives True, no device is waited for longer than for one answer.

    Raises
    ------
    PortError
        A port cannot be opened.
    DeviceError
        A device does not answer, is another one, speaks another protocol, or is not that of the rig file; or its driver
        is not installed or fails.
    RigError
        The rig file names no driver for a device, or wrong keys for it.
    """
    tables = {kind: _table(rig, kind, port) for kind, port in zip(_KINDS, (camera_port, mirror_port), strict=True)}
    if tables["camera"].driver == NATIVE != tables["mirror"].driver:
        raise DeviceError(
            f"a native camera counts fast steps together with its own mirror, not with the driver"
            f" {tables['mirror'].driver}: use both native devices, or another driver for the camera"
        )
    host = Host(stop)
    with ExitStack() as stack:
        stack.callback(host.close)
        native_camera, native_mirror, warnings = _open_native(
            rig, host, {kind: _port(kind, table) for kind, table in tables.items() if table.driver == NATIVE}, stop
        )
        mirror: Mirror
        if native_mirror is None:
            driver = _open_simple("mirror", tables["mirror"], rig, SimpleMirror, stack)
            mirror = adapted_mirror = AdaptedMirror(rig, driver, host.now_ns)
            host.polled.append(adapted_mirror)
        else:
            mirror = native_mirror
        camera: Camera
        if native_camera is None:
            driver = _open_simple("camera", tables["camera"], rig, SimpleCamera, stack)
            camera = adapted_camera = AdaptedCamera(rig, driver, mirror, host.now_ns)
            host.polled.append(adapted_camera)
        else:
            camera = native_camera
        yield Opened(host, camera, mirror, warnings)


def _table(rig: Rig, kind: Kind, port: str | None) -> DeviceTable:
    """The driver of a device and its keys, from the port or the rig file."""
    if port is not None:
        return DeviceTable(driver=NATIVE, options={"port": port})
    if kind not in rig.devices:
        raise RigError(
            f"nothing says what drives the {kind}: give --{kind} PORT, or [devices.{kind}] in the rig file with one of"
            f" the drivers {', '.join(driver_names(kind))}"
        )
    return rig.devices[kind]


def _port(kind: Kind, table: DeviceTable) -> str:
    port = table.options.get("port")
    if not isinstance(port, str) or len(table.options) > 1:
        raise RigError(f"devices.{kind}: the driver {NATIVE} takes one key, port, a text; found {table.options}")
    return port


def _open_native(
    rig: Rig, host: Host, ports: dict[Kind, str], stop: Callable[[], bool]
) -> tuple[NativeCamera | None, NativeMirror | None, list[str]]:
    """The devices that speak packets, None for those that do not, and warnings about them."""
    if not ports:
        return None, None, []
    links = {kind: host.connect(kind, SerialPort(port, stop=stop)) for kind, port in ports.items()}
    asked_ns = host.now_ns()
    identities: dict[str, pb.Identity] = {}
    for kind, link in links.items():
        identities[kind] = identify(host, link, secrets.randbits(48))
        check_kind(link, identities[kind], pb.Identity.CAMERA if kind == "camera" else pb.Identity.MIRROR)
    warnings = check_against_rig(rig, identities)
    gate = Gate(rig, host, identities.values(), asked_ns)
    host.budget_bytes += gate.exposure_bytes * (2 + rig.mirror.queue_steps // rig.timing.frame_period_steps)
    if identities["mirror"].virtual_time:
        if "camera" not in identities:
            raise DeviceError(
                "the mirror runs on virtual time, which only the camera of the same simulated rig follows: run the rig"
                " with --real-time"
            )
        host.go_virtual(gate.check_virtual_time)
    mirror = NativeMirror(host, links["mirror"], identities["mirror"], gate)
    host.native.append(mirror)
    camera = None
    if "camera" in links:
        camera = NativeCamera(host, links["camera"], identities["camera"], gate)
        host.native.append(camera)
    for link in host.links:
        link.reset_counts()
    return camera, mirror, warnings


def _open_simple(kind: Kind, table: DeviceTable, rig: Rig, protocol: type, stack: ExitStack) -> Any:
    """A simple driver, which is closed with the others. Raises DeviceError where it has not all of ``protocol``."""
    driver = open_driver(kind, table, rig)
    asked = [name for name in (*protocol.__annotations__, *vars(protocol)) if not name.startswith("_")]
    if lacking := [name for name in asked if not hasattr(driver, name)]:
        raise DeviceError(
            f"the {kind} driver {table.driver} lacks {', '.join(lacking)}: see {protocol.__name__} in"
            " aolink.devices.simple"
        )

    def close() -> None:
        with calling(kind, "when it was closed"):
            driver.close()

    stack.callback(close)
    return driver
