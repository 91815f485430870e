"""A folder of pictures, or any other film that `aolink import` reads, played as a camera for experiments."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from aolink.devices.cameras.pictures import as_counts, checked_corner, sensor_part
from aolink.devices.simple import SimpleFrame, ThreadCamera
from aolink.errors import DeviceError, ImportingError
from aolink.films.formats import open_film
from aolink.rig import Rig


class FolderCamera(ThreadCamera):
    """Plays pictures at the rig file's frame rate, by this computer's clock, as if each were exposed when it is due.

    Parameters
    ----------
    path:
        A folder of pictures, in the order of their names, or a film in one file; relative to the rig file.
    repeat:
        Whether to begin again after the last picture; otherwise a session that asks for more pictures ends there.
    corner:
        Row and column of the pictures at which the sensor begins; None where the sensor is the whole picture.

    Raises
    ------
    DeviceError
        The pictures cannot be read, or the sensor is not within them.
    """

    lacks = ()

    def __init__(self, rig: Rig, *, path: str, repeat: bool = True, corner: list[int] | None = None) -> None:
        self._rig, self._repeat, self._corner = rig, repeat, checked_corner(corner)
        try:
            self._film = open_film(rig.path_of(Path(path).expanduser(), "devices.camera.path"))
            self._counts(next(self._film.frames()))
        except ImportingError as error:
            raise DeviceError(str(error)) from error
        odd = f"; {self._film.nonlinear}" if self._film.nonlinear else ""
        self.description = f"{self._film.count} pictures of {self._film.name}{', repeated' if repeat else ''}{odd}"

    def time_ns(self) -> int:
        """This computer's clock, ns."""
        return time.monotonic_ns()

    def expose(self, start_ns: int, exposures: int, stopped: threading.Event) -> Iterator[SimpleFrame]:
        """Play the pictures, the first one as if exposed from ``start_ns`` on."""
        exposure_ns, period_ns = self._rig.timing.exposure_ns, self._rig.timing.frame_period_ns
        pictures = self._pictures()
        for number in range(exposures) if exposures else count():
            begin_ns = start_ns + number * period_ns
            counts = self._counts(next(pictures))
            late_ns = time.monotonic_ns() - begin_ns - exposure_ns
            if stopped.wait(max(-late_ns, 0) / 1e9):
                return
            if late_ns < period_ns:  # one that could not be read in time counts as lost
                yield SimpleFrame(pixels=counts, exposure_ns=exposure_ns, start_ns=begin_ns, number=number)

    def _pictures(self) -> Iterator[NDArray[Any]]:
        try:
            for _ in count() if self._repeat else range(1):
                yield from self._film.frames()
        except ImportingError as error:
            raise DeviceError(str(error)) from error
        raise DeviceError(
            f"{self._film.name} has ended after {self._film.count} pictures: ask for fewer exposures, or let it repeat"
            " (devices.camera.repeat = true)"
        )

    def _counts(self, picture: NDArray[Any]) -> NDArray[Any]:
        name = self._film.name
        return as_counts(sensor_part(picture, self._rig.sensor.shape, self._corner, name), name)
