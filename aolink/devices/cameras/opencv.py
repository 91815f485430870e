"""A webcam, a stream or a video file through OpenCV, as a camera for a first try."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from aolink.devices.cameras import pictures
from aolink.devices.cameras.pictures import check_timing, check_within, checked_corner
from aolink.devices.interfaces import Lacks
from aolink.devices.simple import SimpleFrame, ThreadCamera
from aolink.errors import DeviceError
from aolink.extensions import needs_extra
from aolink.films.film import grey
from aolink.rig import Rig

_RATE_MARGIN = 0.05
"""The most by which the camera's frame rate may differ from the rig file's, as a fraction."""
_V4L2_MANUAL, _V4L2_UNIT_S = 1, 1e-4
"""Video4Linux's value for exposure times that the program sets, and its unit of them."""
_DEVICES = Path("/sys/class/video4linux")


class OpenCVCamera(ThreadCamera):
    """Any source that ``cv2.VideoCapture`` opens, 8 bits a colour, its colours averaged.

    It reports no time and does not count, so frames have the time of their arrival. A thread reads it and notes that
    time. Light is not proportional to counts unless the camera's gamma and white balance are off.

    Parameters
    ----------
    source:
        Index of a webcam, or an address or a file that OpenCV opens; a file is played at its own rate.
    corner:
        Row and column of the pictures at which the sensor begins; None where the sensor is the whole picture.

    Raises
    ------
    DeviceError
        OpenCV is not installed or cannot open the source, or size or rate of its pictures are not the rig file's.
    """

    lacks: tuple[Lacks, ...] = (Lacks.TIME, Lacks.COUNT, Lacks.TRIGGER, Lacks.ROWS)

    def __init__(self, rig: Rig, *, source: int | str = 0, corner: list[int] | None = None) -> None:
        with needs_extra("opencv", DeviceError):
            import cv2
        self._rig, self._corner, timing = rig, checked_corner(corner), rig.timing
        beside = rig.path_of(str(source), "devices.camera.source")
        opened = int(source) if str(source).isdecimal() else str(beside) if beside.exists() else source
        self._name = f"camera {source}" if isinstance(opened, int) else str(source)
        said = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below is clearer
        self._capture: Any = cv2.VideoCapture(opened)
        cv2.utils.logging.setLogLevel(said)
        if not self._capture.isOpened():
            raise DeviceError(f"OpenCV cannot open {self._name}: is it connected, not in use, and may you read it?")
        self._rate, self._exposure_ns = 1e9 / timing.frame_period_ns, timing.exposure_ns
        with ExitStack() as stack:
            stack.callback(self._capture.release)
            self._is_file = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0
            believed = self._is_file or not self._set_exposure(cv2)
            if not self._is_file:
                if corner is None:
                    self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, rig.sensor.shape[0])
                    self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, rig.sensor.shape[1])
                self._capture.set(cv2.CAP_PROP_FPS, self._rate)
            self._check(cv2)
            exposure = f"exposure {self._exposure_ns / 1e9:g} s{' as the rig file says' if believed else ''}"
            self.description = f"OpenCV {cv2.__version__} {self._capture.getBackendName()} {self._name}, {exposure}"
            stack.pop_all()

    def close(self) -> None:
        """Release the camera, once the frame that is under way has come: the thread does it, where there is one."""
        if self._thread is None:
            self._capture.release()
        super().close()

    def _set_exposure(self, cv2: Any) -> bool:
        """Set the exposure time where its unit is known, and read it back; whether that was possible."""
        if self._capture.getBackendName() != "V4L2":
            return False
        units = round(self._exposure_ns / 1e9 / _V4L2_UNIT_S)
        if not (
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _V4L2_MANUAL)
            and self._capture.set(cv2.CAP_PROP_EXPOSURE, units)
            and (found := self._capture.get(cv2.CAP_PROP_EXPOSURE)) > 0
        ):
            return False
        self._exposure_ns = round(found * _V4L2_UNIT_S * 1e9)
        return True

    def _check(self, cv2: Any) -> None:
        size = tuple(int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        check_within((size[0], size[1]), self._rig.sensor.shape, self._corner, self._name)
        if not (self._is_file or self._capture.getBackendName() == "V4L2"):
            return  # OpenCV only guesses the rate of a stream
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        check_timing(self._rig.timing, self._name, self._exposure_ns, rate, _RATE_MARGIN)
        self._rate = rate if rate > 0 else self._rate

    def expose(self, start_ns: int, exposures: int, stopped: threading.Event) -> Iterator[SimpleFrame]:
        """Give frames as they come, those of a file when they are due. The capture belongs to the thread that reads
        it."""
        number = 0
        try:
            while not stopped.is_set():
                number += 1
                due_ns = start_ns + round(number / self._rate * 1e9) if self._is_file else 0
                if stopped.wait(max(due_ns - time.monotonic_ns(), 0) / 1e9):
                    return
                grabbed = self._capture.grab()
                arrived_ns = time.monotonic_ns()
                whole, picture = self._capture.retrieve()
                if not (grabbed and whole):
                    raise DeviceError(
                        f"{self._name} has ended after {number - 1} frames: ask for fewer exposures"
                        if self._is_file
                        else f"{self._name} gives no more frames: is it still connected?"
                    )
                part = pictures.sensor_part(picture, self._rig.sensor.shape, self._corner, self._name)
                counts = pictures.as_counts(grey(part, self._name), self._name)
                yield SimpleFrame(pixels=counts, exposure_ns=self._exposure_ns, arrived_ns=arrived_ns)
        finally:
            self._capture.release()


def discover() -> list[tuple[str, str]]:
    """Index and name of each video device of this machine, none of them opened; Linux only."""
    found = ((each.name.removeprefix("video"), each / "name") for each in _DEVICES.glob("video*"))
    return sorted((index, name.read_text().strip()) for index, name in found if index.isdecimal() and name.is_file())
