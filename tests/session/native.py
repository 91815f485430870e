"""Native devices, opened for tests that look behind the session's interface."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from aolink.devices.host import Host
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.devices.opening import open_devices
from aolink.rig import Rig


class Native(NamedTuple):
    """What `aolink.devices.opening.open_devices` gives for two ports."""

    host: Host
    camera: NativeCamera
    mirror: NativeMirror


@contextmanager
def open_native(rig: Rig, camera_port: str, mirror_port: str) -> Iterator[Native]:
    with open_devices(rig, camera_port, mirror_port) as (host, camera, mirror, _):
        assert isinstance(host, Host)
        assert isinstance(camera, NativeCamera)
        assert isinstance(mirror, NativeMirror)
        yield Native(host, camera, mirror)
