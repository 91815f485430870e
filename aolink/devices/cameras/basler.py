"""Cameras of Basler through pypylon, the maker's own library: GigE, USB, and its emulator."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from aolink.devices.cameras.pictures import Arrived, checked_corner
from aolink.devices.simple import Lacks, SimpleFrame
from aolink.errors import DeviceError
from aolink.extensions import needs_extra
from aolink.rig import Rig

_CLOCKS = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
"""Pairs of features that latch the camera's clock and give its value: those of newer cameras, then those of GigE
cameras."""
_RATES = ("ResultingFrameRate", "BslResultingAcquisitionFrameRate", "ResultingFrameRateAbs")
_RATE_MARGIN = 0.05
"""The most by which the camera's frame rate may differ from the rig file's, as a fraction."""
_BUFFERS = 32
_NO_BLOCK_ID = (1 << 64) - 1
_WRAPS_AT = 65_535
"""Block ids of 16 bits, which GigE cameras may give, go from 1 to this and begin again at 1."""


class BaslerCamera:
    """A camera that runs freely at the rig file's frame rate, or is triggered where ``features`` say so.

    Parameters
    ----------
    serial:
        Its serial number; it may be left out where there is only one camera.
    corner:
        Row and column of the chip at which the sensor's window begins.
    features:
        GenICam features by their names, set in this order before the driver's own: gain, black level, trigger, ...
        A command is executed where the value is true.

    Raises
    ------
    DeviceError
        pypylon is not installed, there is no such camera or another program uses it, or it cannot do what the rig file
        asks for.
    """

    lacks: tuple[Lacks, ...] = (Lacks.TRIGGER,)

    def __init__(
        self, rig: Rig, *, serial: str = "", corner: Sequence[int] = (0, 0),
        features: Mapping[str, bool | int | float | str] | None = None,
    ) -> None:  # fmt: skip
        with needs_extra("basler", DeviceError):
            from pypylon import genicam, pylon
        self._rig, self._pylon, self._genicam = rig, pylon, genicam
        self._arrived = Arrived()
        self._number: int | None = None
        """The count of the newest frame, whether it was grabbed whole or not."""
        row, column = checked_corner(corner) or (0, 0)
        info = _choose(pylon.TlFactory.GetInstance().EnumerateDevices(), serial)
        self._name = f"{info.GetVendorName()} {info.GetModelName()}, serial number {info.GetSerialNumber()}"
        try:
            self._camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(info))
            self._camera.Open()
        except genicam.GenericException as error:
            raise DeviceError(f"{self._name} cannot be opened: {_reason(error)}") from error
        try:
            self._set_up(row, column, dict(features or {}))
        except BaseException:
            self._camera.Close()
            raise
        firmware = self._value("DeviceFirmwareVersion")
        self.description = f"{self._name}, firmware {firmware}, exposure {self._exposure_ns / 1e9:g} s"

    def time_ns(self) -> int | None:
        """The camera's clock, ns since it was switched on; None where it has none."""
        for latch, value in _CLOCKS:
            if (command := self._node(latch)) is not None:
                command.Execute()
                return self._ns(int(self._value(value))) or None
        return None

    def start(self, start_ns: int, exposures: int) -> None:
        """Take frames until stopped; those that begin before ``start_ns`` do not belong to the session."""
        self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne, self._pylon.GrabLoop_ProvidedByInstantCamera)

    def frames(self) -> list[SimpleFrame]:
        """The frames since the last call; one that was not grabbed whole is left out, and its number with it."""
        if self._camera.IsCameraDeviceRemoved():
            raise DeviceError(f"{self._name} is no longer connected")
        return self._arrived.take()

    def stop(self) -> None:
        """Take no more frames."""
        self._camera.StopGrabbing()

    def close(self) -> None:
        """Release the camera."""
        self._camera.Close()

    def _set_up(self, row: int, column: int, features: dict[str, bool | int | float | str]) -> None:
        """Set the features that follow from the rig file, except those that the user has given. Raises DeviceError."""
        timing, sensor = self._rig.timing, self._rig.sensor
        for name, value in features.items():
            self._set(name, value)
        triggered = features.get("TriggerMode") == "On"
        rate = 1 / (timing.frame_period_steps * timing.fast_step_s)
        exposure_us = timing.exposure_steps * timing.fast_step_s * 1e6
        depths = [f"Mono{sensor.bit_depth}{packing}" for packing in ("", "p", "Packed")]
        known = self._node("PixelFormat").Symbolics
        wanted: list[tuple[tuple[str, ...], bool | int | float | str]] = [
            (("AcquisitionMode",), "Continuous"),
            (("PixelFormat",), next((each for each in depths if each in known), depths[0])),
            (("OffsetX",), 0), (("OffsetY",), 0),  # the window must fit before it is moved
            (("Width",), sensor.shape[1]), (("Height",), sensor.shape[0]),
            (("OffsetX",), column), (("OffsetY",), row),
            (("ExposureAuto",), "Off"), (("ExposureTime", "ExposureTimeAbs"), exposure_us),
            *(() if triggered else (
                (("TriggerMode",), "Off"),
                (("AcquisitionFrameRateEnable",), True),
                (("AcquisitionFrameRate", "AcquisitionFrameRateAbs"), rate),
            )),
        ]  # fmt: skip
        for names, value in wanted:
            if not features.keys() & set(names) and (name := self._first(names)):
                self._set(name, value)
        exposure = self._first(("ExposureTime", "ExposureTimeAbs"))
        self._exposure_ns = round(float(self._value(exposure)) * 1e3) if exposure else round(exposure_us * 1e3)
        reached = self._first(_RATES)
        if not triggered and reached and abs(float(self._value(reached)) / rate - 1) > _RATE_MARGIN:
            raise DeviceError(
                f"{self._name} reaches {float(self._value(reached)):.4g} frames a second with these settings, the rig"
                f" file says {rate:.4g}: correct timing.frame_period_steps, or make the exposure or the window smaller"
            )
        frequency = self._first(("GevTimestampTickFrequency",))
        self._tick_ns = 1e9 / float(self._value(frequency)) if frequency else 1.0
        self._tells_time = self.time_ns() is not None
        self.lacks = (*(() if self._tells_time else (Lacks.TIME,)), *(() if triggered else (Lacks.TRIGGER,)))
        self._camera.MaxNumBuffer.Value = _BUFFERS
        self._listener = _listener(self._pylon, self._arrived, self._frame)
        mode, cleanup = self._pylon.RegistrationMode_Append, self._pylon.Cleanup_None
        self._camera.RegisterImageEventHandler(self._listener, mode, cleanup)

    def _frame(self, result: Any, arrived_ns: int) -> None:
        """Take a result of pylon's thread; a grab that failed leaves a gap in the numbers."""
        block_id = int(result.BlockID)
        self._number = int(result.ImageNumber) if block_id == _NO_BLOCK_ID else unwrapped(self._number, block_id)
        if not result.GrabSucceeded():
            return
        stamp_ns = self._ns(int(result.TimeStamp))
        if self._tells_time and not stamp_ns:
            raise DeviceError(f"{self._name} has a clock and gives a frame without a time: switch its time stamps on")
        start_ns = stamp_ns if self._tells_time else None
        frame = SimpleFrame(
            pixels=np.asarray(result.Array), exposure_ns=self._exposure_ns, start_ns=start_ns, arrived_ns=arrived_ns,
            number=self._number,
        )  # fmt: skip
        self._arrived.give(frame)

    def _ns(self, ticks: int) -> int:
        return round(ticks * self._tick_ns) if self._tick_ns != 1.0 else ticks

    def _node(self, name: str) -> Any:
        """A feature of the camera; None where it has none of this name now."""
        node = self._camera.GetNodeMap().GetNode(name)
        return node if node is not None and self._genicam.IsAvailable(node) else None

    def _first(self, names: Sequence[str]) -> str:
        """The first of these features that the camera has: a feature may have several names. Empty for none."""
        return next((name for name in names if self._node(name) is not None), "")

    def _value(self, name: str) -> Any:
        node = self._node(name)
        return None if node is None else node.Value

    def _set(self, name: str, value: bool | int | float | str) -> None:
        """Set a feature, unless it has the right value already. Raises DeviceError."""
        node = self._node(name)
        if node is None:
            raise DeviceError(f"{self._name} has no feature {name} in this state: correct devices.camera.features")
        try:
            if isinstance(node, self._genicam.ICommand):
                if value is True:
                    node.Execute()
            elif not (self._genicam.IsReadable(node) and node.Value == value):
                node.Value = value
        except self._genicam.GenericException as error:
            raise DeviceError(f"{self._name} refuses {name} = {value}: {_reason(error)}") from error
        except TypeError:
            raise DeviceError(f"{self._name} refuses {name} = {value!r}: it is of another type") from None


def unwrapped(before: int | None, block_id: int) -> int:
    """The count of a frame from its block id, and from the count of the frame before, None for the first.

    A block id that is a little below the one before is that frame again, not one after thousands of lost ones.
    """
    if before is None or block_id > _WRAPS_AT:
        return block_id
    ahead = (block_id - before) % _WRAPS_AT
    return before + (ahead if ahead <= _WRAPS_AT // 2 else ahead - _WRAPS_AT)


def discover() -> list[tuple[str, str]]:
    """Serial number and model of each camera that pylon sees, none of them opened. Raises DeviceError."""
    with needs_extra("basler", DeviceError):
        from pypylon import pylon
    found = pylon.TlFactory.GetInstance().EnumerateDevices()
    return sorted((info.GetSerialNumber(), info.GetFriendlyName()) for info in found)


def _choose(found: Sequence[Any], serial: str) -> Any:
    numbers = sorted(info.GetSerialNumber() for info in found)
    if not numbers:
        raise DeviceError("pylon finds no Basler camera: is it connected and powered, and on this network?")
    if not serial and len(numbers) > 1:
        raise DeviceError(f"there are several Basler cameras: set devices.camera.serial to one of {', '.join(numbers)}")
    if serial and serial not in numbers:
        raise DeviceError(f"there is no Basler camera with the serial number {serial}, there is {', '.join(numbers)}")
    return next(info for info in found if serial in ("", info.GetSerialNumber()))


def _listener(pylon: Any, arrived: Arrived, take: Callable[[Any, int], None]) -> Any:
    """An object that pylon calls on its own thread for each frame: it notes the time before anything else."""

    class Listener(pylon.ImageEventHandler):  # type: ignore[misc] # pypylon is imported where it is used
        def OnImageGrabbed(self, camera: Any, result: Any) -> None:
            arrived_ns = time.monotonic_ns()
            try:
                take(result, arrived_ns)
            except Exception as failure:  # the session gets the error when it asks for frames next
                arrived.fail(failure)

    return Listener()


def _reason(error: Exception) -> str:
    """The message of a GenICam exception, without the place in the library where it was raised."""
    return re.split(r" : \w+ thrown ", " ".join(str(error).split()))[0]
