"""Open both devices of a rig, identify them and compare them with the rig file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any

from aolink.devices.adapted_camera import AdaptedCamera
from aolink.devices.adapted_mirror import AdaptedMirror
from aolink.devices.drivers import KINDS, NATIVE, DeviceKind, calling, driver_names, native_port, open_driver
from aolink.devices.gate import Gate
from aolink.devices.host import Host
from aolink.devices.identity import check_against_rig, check_kind, identify, new_nonce
from aolink.devices.interfaces import Mirror, Opened
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.devices.no_mirror import NoMirror
from aolink.devices.paced import PacedMirror
from aolink.devices.simple import DirectMirror, SimpleCamera, SimpleMirror
from aolink.errors import AolinkError, DeviceError, PortError, RigError
from aolink.rig import Rig
from aolink.rig.device_tables import Delay, DeviceTable
from aolink.wire import messages_pb2 as pb
from aolink.wire.port import SerialPort


@contextmanager
def open_devices(
    rig: Rig, camera_port: str | None = None, mirror_port: str | None = None,
    stop: Callable[[], bool] = lambda: False, reconnect_s: float = 0.0,
) -> Iterator[Opened]:  # fmt: skip
    """Open both devices, ask for their identities, and check these against the rig file.

    Parameters
    ----------
    camera_port, mirror_port:
        Ports of devices that speak aolink's packets; where None, the rig file's table ``[devices]`` names the driver.
        Where that names no mirror, the camera is opened alone.
    stop:
        Once it gives True, the wait for a device is no longer than for one answer.
    reconnect_s:
        How long to wait for the port of a native device that has vanished, s; with 0 that is an error at once.

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
    tables = _tables(rig, camera_port, mirror_port)
    if "camera" not in tables:
        raise RigError(
            "nothing says what drives the camera: give --camera PORT, or [devices.camera] in the rig file with one of"
            f" the drivers {', '.join(driver_names('camera'))}"
        )
    if "mirror" in tables and tables["camera"].driver == NATIVE != tables["mirror"].driver:
        raise DeviceError(
            f"a native camera counts fast steps together with its own mirror, not with the driver"
            f" {tables['mirror'].driver}: use both native devices, or another driver for the camera"
        )
    given = [each.options.get("port") for each in tables.values() if each.driver == NATIVE]
    if len(given) == 2 and given[0] == given[1]:
        raise PortError(f"camera and mirror are both at {given[0]}: each has a port of its own, give both")
    host = Host(stop)
    with ExitStack() as stack:
        stack.callback(host.close)
        ports = {kind: native_port(kind, table) for kind, table in tables.items() if table.driver == NATIVE}
        native_camera, native_mirror, warnings = _open_native(rig, host, ports, stop)
        if reconnect_s:
            _allow_return(host, stop, reconnect_s)
        mirror: Mirror
        if "mirror" in tables:
            mirror = native_mirror or _open_mirror(rig, tables["mirror"], host, stack)
        else:
            mirror = no_mirror = NoMirror(rig, host.now_ns, native_camera.since_zero_ns if native_camera else None)
            host.polled.append(no_mirror)
            if rig.drive.kind != "none":
                warnings.append("no mirror is named (--mirror, [devices.mirror]): the rig file's drive is not played")
        camera = native_camera or _open_camera(rig, tables["camera"], mirror, host, stack)
        yield Opened(host, camera, mirror, warnings)


def _tables(rig: Rig, camera_port: str | None, mirror_port: str | None) -> dict[DeviceKind, DeviceTable]:
    """Drivers and their keys, from the ports or the rig file, for the devices that either names."""
    tables: dict[DeviceKind, DeviceTable] = {}
    for kind, port in zip(KINDS, (camera_port, mirror_port), strict=True):
        if port is not None:
            tables[kind] = DeviceTable(driver=NATIVE, options={"port": port})
        elif kind in rig.devices:
            tables[kind] = rig.devices[kind]
    return tables


def _open_mirror(rig: Rig, table: DeviceTable, host: Host, stack: ExitStack) -> AdaptedMirror:
    with _opened("mirror", table, rig) as driver:
        paced = hasattr(driver, "put")
        _check_whole("mirror", table, driver, DirectMirror if paced else SimpleMirror)
        simple = PacedMirror(rig, driver) if paced else driver
        mirror = AdaptedMirror(rig, simple, table.delay or Delay(), host.now_ns)
        _close_with(stack, mirror.close)
    host.polled.append(mirror)
    return mirror


def _open_camera(rig: Rig, table: DeviceTable, mirror: Mirror, host: Host, stack: ExitStack) -> AdaptedCamera:
    with _opened("camera", table, rig) as driver:
        _check_whole("camera", table, driver, SimpleCamera)
        tells_time, period_s = driver.time_ns() is not None, rig.timing.frame_period_ns / 1e9
        # Where the delay of frames is not known, a frame may arrive at any time within the frame period after its
        # exposure.
        delay = table.delay or (Delay() if tells_time else Delay(mean_s=period_s / 2, sd_s=period_s / math.sqrt(12)))
        camera = AdaptedCamera(rig, driver, mirror, delay, host.now_ns)
        _close_with(stack, camera.close)
    host.polled.append(camera)
    return camera


def _close_with(stack: ExitStack, close: Callable[[], None]) -> None:
    """Close a device with ``stack``. Where a session has failed, an error from closing does not hide the reason."""

    def leave(failed: type[BaseException] | None, *_: object) -> None:
        with suppress(*([AolinkError] if failed else [])):
            close()

    stack.push(leave)


@contextmanager
def _opened(kind: DeviceKind, table: DeviceTable, rig: Rig) -> Iterator[Any]:
    """A driver, closed where it turns out to be unusable. Raises DeviceError for any exception of the driver."""
    driver = open_driver(kind, table, rig)
    try:
        with calling(kind, "when it was opened"):
            yield driver
    except BaseException:
        with suppress(Exception):  # it may lack ``close`` as well
            driver.close()
        raise


def _open_native(
    rig: Rig, host: Host, ports: dict[DeviceKind, str], stop: Callable[[], bool]
) -> tuple[NativeCamera | None, NativeMirror | None, list[str]]:
    """The devices that speak packets, None for those that do not, and warnings about them."""
    if not ports:
        return None, None, []
    links = {kind: host.connect(kind, SerialPort(port, stop=stop)) for kind, port in ports.items()}
    asked_ns = host.now_ns()
    identities: dict[str, pb.Identity] = {}
    for kind, link in links.items():
        identities[kind] = identify(host, link, new_nonce())
        check_kind(link, identities[kind], pb.Identity.CAMERA if kind == "camera" else pb.Identity.MIRROR)
    warnings = check_against_rig(rig, identities)
    virtual = any(identity.virtual_time for identity in identities.values())
    if virtual and len(identities) < 2:
        raise DeviceError(
            "the camera runs on virtual time, which the mirror's line hands on: give --mirror PORT too"
            if "camera" in identities
            else "the mirror runs on virtual time, which only the camera of the same simulated rig follows: run the rig"
            " with --real-time"
        )
    gate = Gate(rig, host, identities.values(), asked_ns)
    host.budget_bytes += gate.exposure_bytes * (2 + rig.mirror.queue_steps // rig.timing.frame_period_steps)
    if virtual:
        host.go_virtual(gate.check_virtual_time)
    mirror = NativeMirror(host, links["mirror"], identities["mirror"], gate) if "mirror" in links else None
    camera = NativeCamera(host, links["camera"], identities["camera"], gate) if "camera" in links else None
    host.native += [each for each in (mirror, camera) if each is not None]
    for link in host.links:
        link.reset_counts()
    return camera, mirror, warnings


def _allow_return(host: Host, stop: Callable[[], bool], within_s: float) -> None:
    """Let the session wait for native devices whose port vanishes. Raises DeviceError where there is none that can
    return."""
    if host.virtual or not host.native:
        why = "this rig runs on virtual time" if host.virtual else "the devices here have drivers of their own"
        raise DeviceError(
            f"only a port of aolink's own packets is opened again, in real time ({why}): do not reconnect"
        )
    for device in host.native:
        transport = device.link.transport
        assert isinstance(transport, SerialPort)
        device.port.allow(partial(SerialPort, transport.url, stop=stop), within_s)


def _check_whole(kind: DeviceKind, table: DeviceTable, driver: Any, protocol: type) -> None:
    """Refuse a driver that lacks a member of ``protocol``. Raises DeviceError."""
    asked = [name for name in (*protocol.__annotations__, *vars(protocol)) if not name.startswith("_")]
    if lacking := [name for name in asked if not hasattr(driver, name)]:
        raise DeviceError(
            f"the {kind} driver {table.driver} lacks {', '.join(lacking)}: see {protocol.__name__} in"
            " aolink.devices.simple"
        )
