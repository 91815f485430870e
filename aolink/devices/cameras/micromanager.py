"""Any camera that Micro-Manager has a device adapter for, through pymmcore: what a laboratory already runs."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from typing import Any

from aolink.devices.cameras.pictures import as_counts, check_timing, check_within, checked_corner
from aolink.devices.simple import FREE_RUNNING, Lacks, SimpleFrame, ThreadCamera, Trigger
from aolink.errors import DeviceError
from aolink.extensions import needs_extra
from aolink.rig import Rig

_LABEL = "Camera"
"""Name of the camera in Micro-Manager's core where the rig file names its adapter."""
_LOOK_S = 0.0005
"""Time between two looks for a frame, s."""
_PATH = "MICROMANAGER_PATH"
_MOST_WAITING = 1024
"""Frames that Micro-Manager keeps for us, if its own limit has room for them. It makes room for as many as that limit
takes, a million small ones, which holds up the first frame for seconds on a busy machine."""


class MicroManagerCamera(ThreadCamera):
    """A camera that takes frames with the exposure time of the rig file, by itself one every frame period.

    Micro-Manager tells when a frame came to this machine, not when the camera took it.

    Parameters
    ----------
    config:
        A configuration file (.cfg) of Micro-Manager, whose camera is taken; or
    adapter, device:
        the names of the adapter and of its device, such as ``"DemoCamera"`` and ``"DCam"``.
    folder:
        The folder of the device adapters, that of the Micro-Manager installation; by default the environment's
        ``MICROMANAGER_PATH``.
    properties:
        Properties of the camera by their names, set in this order: ``PixelType``, ``Gain``, a trigger, ...
    trigger:
        A hardware trigger is set by ``properties``, whose names each adapter has its own; it is declared here.
    corner:
        Row and column of the chip at which the sensor begins.

    Raises
    ------
    DeviceError
        pymmcore is not installed, the adapter or its camera cannot be opened, or it cannot do what the rig file says.
    """

    lacks: tuple[Lacks, ...] = (Lacks.TIME, Lacks.TRIGGER, Lacks.ROWS)
    triggers = ("free-running", "hardware")

    def __init__(
        self, rig: Rig, *, config: str = "", adapter: str = "", device: str = "", folder: str = "",
        properties: dict[str, Any] | None = None, corner: list[int] | None = None, trigger: Trigger = FREE_RUNNING,
    ) -> None:  # fmt: skip
        with needs_extra("micromanager", DeviceError):
            import pymmcore
        if bool(config) == bool(adapter and device):
            raise DeviceError("devices.camera needs config (a .cfg file of Micro-Manager), or adapter and device")
        self.lacks = trigger.lacks(self.lacks)
        self._rig, self._metadata = rig, pymmcore.Metadata
        row, column = checked_corner(corner) or (0, 0)
        self._core: Any = pymmcore.CMMCore()
        self._name = f"Micro-Manager's {device or config}"
        try:
            if place := folder or os.environ.get(_PATH, ""):
                self._core.setDeviceAdapterSearchPaths([place])
            if config:
                self._core.loadSystemConfiguration(str(rig.path_of(config, "devices.camera.config")))
            else:
                self._core.loadDevice(_LABEL, adapter, device)
                self._core.initializeDevice(_LABEL)
                self._core.setCameraDevice(_LABEL)
            self._label = self._core.getCameraDevice()
            for name, value in (properties or {}).items():
                self._core.setProperty(self._label, name, int(value) if isinstance(value, bool) else value)
            self._set_up(row, column)
        except BaseException as error:
            self._core.reset()
            if not isinstance(error, RuntimeError | OSError):
                raise
            reason = " ".join(str(error).split())
            raise DeviceError(f"{self._name} cannot be opened: {reason}; is {_PATH} its folder?") from None
        version = self._core.getVersionInfo()
        self.description = f"{self._name}, {version}, exposure {self._exposure_ns / 1e9:g} s"

    def close(self) -> None:
        """Release the camera."""
        super().close()
        self._core.reset()

    def _set_up(self, row: int, column: int) -> None:
        core, sensor, timing = self._core, self._rig.sensor, self._rig.timing
        height, width = sensor.shape
        core.clearROI()
        check_within((core.getImageHeight(), core.getImageWidth()), (height, width), (row, column), self._name)
        core.setROI(column, row, width, height)
        check_within((core.getImageHeight(), core.getImageWidth()), (height, width), None, self._name)
        if core.getNumberOfComponents() != 1 or core.getImageBitDepth() > sensor.bit_depth:
            raise DeviceError(
                f"{self._name} gives {core.getNumberOfComponents()} colour(s) of {core.getImageBitDepth()} bits, the"
                f" rig file's sensor has one of {sensor.bit_depth}: set devices.camera.properties, such as PixelType"
            )
        frames_mib = 1 + (_MOST_WAITING * height * width * core.getBytesPerPixel() >> 20)
        core.setCircularBufferMemoryFootprint(min(core.getCircularBufferMemoryFootprint(), frames_mib))
        core.setExposure(timing.exposure_ns / 1e6)
        self._exposure_ns = round(core.getExposure() * 1e6)
        check_timing(timing, self._name, self._exposure_ns)

    def expose(self, start_ns: int, exposures: int, stopped: threading.Event) -> Iterator[SimpleFrame]:
        core = self._core
        core.startContinuousSequenceAcquisition(self._rig.timing.frame_period_ns / 1e6)
        try:
            while not stopped.is_set():
                if core.isBufferOverflowed():
                    raise DeviceError(f"{self._name} gave frames faster than they were taken: this machine is too slow")
                if not core.getRemainingImageCount():
                    if not core.isSequenceRunning():
                        raise DeviceError(f"{self._name} takes no more frames: is it still connected?")
                    stopped.wait(_LOOK_S)
                    continue
                arrived_ns, about = time.monotonic_ns(), self._metadata()
                pixels = as_counts(core.popNextImageMD(about), self._name)
                number = about.GetSingleTag("ImageNumber").GetValue() if about.HasTag("ImageNumber") else ""
                yield SimpleFrame(
                    pixels=pixels, exposure_ns=self._exposure_ns, arrived_ns=arrived_ns,
                    number=int(number) if number.isdecimal() else None,
                )  # fmt: skip
        except RuntimeError as error:
            raise DeviceError(f"{self._name} failed: {' '.join(str(error).split())}") from None
        finally:
            if core.isSequenceRunning():
                core.stopSequenceAcquisition()
