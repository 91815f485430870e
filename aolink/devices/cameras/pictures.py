"""Code that drivers of cameras share: frames that come on a thread of their own, and pictures that become counts."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.simple import SimpleFrame
from aolink.errors import DeviceError

_MOST_WAITING = 64
"""The most frames that wait to be taken: where there are more, the oldest are dropped, and count as lost."""
_JOIN_S = 2.0
"""How long closing a camera waits for its thread, which may be waiting for a frame."""


class Arrived:
    """Frames that one thread gives and the session's thread takes; both may do so at any time."""

    def __init__(self) -> None:
        self._frames: deque[SimpleFrame] = deque(maxlen=_MOST_WAITING)
        self._failure: Exception | None = None

    def give(self, frame: SimpleFrame) -> None:
        self._frames.append(frame)

    def fail(self, failure: Exception) -> None:
        """Make `take` raise ``failure`` as soon as the frames before it are taken."""
        self._failure = failure

    def take(self) -> list[SimpleFrame]:
        """The frames since the last call, in order. Raises the error that was given to `fail`."""
        frames = [self._frames.popleft() for _ in range(len(self._frames))]
        if not frames and self._failure is not None:
            raise self._failure
        return frames


class FrameThread(Arrived):
    """A thread that takes frames from ``frames``, an iterator that ends soon after the event it is given is set."""

    def __init__(self, frames: Callable[[threading.Event], Iterator[SimpleFrame]]) -> None:
        super().__init__()
        self._frames_until, self._stopped = frames, threading.Event()
        self._thread = threading.Thread(target=self._run, name="aolink-camera", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the thread to end; it need not have ended yet."""
        self._stopped.set()

    def join(self) -> None:
        """Wait for the thread, but not for ever: it may be inside a library that waits for a frame."""
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            for frame in self._frames_until(self._stopped):
                self.give(frame)
        except Exception as failure:  # the session gets the error when it asks for frames next
            self.fail(failure)


class ThreadCamera:
    """The common part of cameras whose frames come from a thread, which begins when they are started."""

    thread: FrameThread | None = None
    """A driver's `start` puts it here."""

    def frames(self) -> list[SimpleFrame]:
        """The frames since the last call. Raises DeviceError where there are no more to come."""
        return self.thread.take() if self.thread else []

    def stop(self) -> None:
        """Take no more frames."""
        if self.thread:
            self.thread.stop()

    def close(self) -> None:
        """End the thread, once the frame that is under way has come."""
        if self.thread:
            self.thread.stop()
            self.thread.join()


def checked_corner(corner: Sequence[int] | None) -> tuple[int, int] | None:
    """The key ``corner`` of a rig file as row and column. Raises DeviceError."""
    if corner is None:
        return None
    if not isinstance(corner, list | tuple) or len(corner) != 2 or not all(type(n) is int and n >= 0 for n in corner):
        raise DeviceError(f"devices.camera.corner is {corner!r}, expected the row and the column of a pixel: [0, 0]")
    return corner[0], corner[1]


def check_within(size: tuple[int, int], shape: tuple[int, int], corner: tuple[int, int] | None, name: str) -> None:
    """Compare a picture's rows and columns with the sensor's, which begins at ``corner`` or, if None, is all of it.

    Raises
    ------
    DeviceError
        The sensor is not within the picture.
    """
    row, column = corner or (0, 0)
    if row + shape[0] > size[0] or column + shape[1] > size[1] or (corner is None and size != shape):
        raise DeviceError(
            f"{name} gives {size} pixels, the rig file's sensor has {shape} (rows, columns): correct [sensor], or say"
            " with devices.camera.corner = [row, column] where in the picture the sensor begins"
        )


def sensor_part(
    picture: NDArray[Any], shape: tuple[int, int], corner: tuple[int, int] | None, name: str
) -> NDArray[Any]:
    """The part of a picture, (rows, columns) or (rows, columns, colours), that is the sensor.

    Parameters and errors are those of `check_within`.
    """
    check_within((picture.shape[0], picture.shape[1]), shape, corner, name)
    row, column = corner or (0, 0)
    return picture[row : row + shape[0], column : column + shape[1]]


def as_counts(part: NDArray[Any], name: str) -> NDArray[np.uint16]:
    """Grey values rounded to counts. Raises DeviceError for those that no pixel of 16 bits can have."""
    counts = np.rint(part) if part.dtype.kind == "f" else part
    if not (counts.min() >= 0 and counts.max() <= 0xFFFF):  # so that NaN is refused as well
        raise DeviceError(f"{name} gives values from {part.min()} to {part.max()}, expected counts from 0 to 65535")
    return counts.astype(np.uint16)
