"""Both devices of a rig are opened, identified and compared with the rig file."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from aolink.devices.gate import Gate
from aolink.devices.host import Host
from aolink.devices.identity import check_against_rig, check_kind, identify
from aolink.devices.interfaces import Opened
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.rig import Rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.port import SerialPort


@contextmanager
def open_devices(
    rig: Rig, camera_port: str, mirror_port: str, stop: Callable[[], bool] = lambda: False
) -> Iterator[Opened]:
    """Open both ports, identify what is behind them, and check it against the rig file.

    Raises
    ------
    PortError
        A port cannot be opened.
    DeviceError
        No device answers, it is another one, speaks another protocol, or is not what the rig file says.
    """
    host = Host(stop)
    try:
        camera_link = host.connect("camera", SerialPort(camera_port, stop=stop))
        mirror_link = host.connect("mirror", SerialPort(mirror_port, stop=stop))
        asked_ns = host.now_ns()
        camera_identity = identify(host, camera_link, secrets.randbits(48))
        check_kind(camera_link, camera_identity, pb.Identity.CAMERA)
        mirror_identity = identify(host, mirror_link, secrets.randbits(48))
        check_kind(mirror_link, mirror_identity, pb.Identity.MIRROR)
        warnings = check_against_rig(rig, {"camera": camera_identity, "mirror": mirror_identity})
        gate = Gate(rig, host, (camera_identity, mirror_identity), asked_ns)
        host.budget_bytes += gate.exposure_bytes * (2 + rig.mirror.queue_steps // rig.timing.frame_period_steps)
        if camera_identity.virtual_time:
            host.go_virtual(gate.check_virtual_time)
        camera = NativeCamera(host, camera_link, camera_identity, gate)
        mirror = NativeMirror(host, mirror_link, mirror_identity, gate)
        host.native = [camera, mirror]
        for link in host.links:
            link.reset_counts()
        yield Opened(host, camera, mirror, warnings)
    finally:
        host.close()
