"""The times of frames of a camera that reports no time, found from their arrival."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

_WINDOW = 64
_LEAST = 4
"""Number of frames from which the jitter is estimated; before that, each frame's own arrival is used."""
_OUTLIER = 3.0
"""A frame that arrived this many times the median deviation later than the others was held up on its way."""
_EARLY = 0.25
"""A frame comes no more than this part of a period earlier than the others' delay predicts, but it may be held up for
longer: a frame that arrives less than 1.75 periods after the frame before was due is the next frame."""


class Arrivals:
    """Arrival times of regular frames, smoothed: each frame has a delay of its own, but the period is steady.

    Parameters
    ----------
    period_ns:
        Time from a frame to the next, as the rig file has it; the true one may differ by some per cent.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._seen: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        """Counts of frames, and when they arrived."""
        self._usual_ns = 0
        """The time at which the newest frame would have arrived with the usual delay."""

    def count_at(self, arrived_ns: int) -> int:
        """The count of a frame that arrives now from a camera that does not count, from 1 on."""
        if not self._seen:
            return 1
        before, before_ns = self._seen[-1]
        if len(self._seen) < _LEAST:
            return before + max(round((arrived_ns - before_ns) / self._period_ns), 1)
        ahead = math.floor((arrived_ns - self._usual_ns) / self._period_ns + _EARLY)
        # The gap before the newest frame was not real: that frame was held up.
        if (over := min(1 - ahead, before - self._seen[-2][0] - 1)) > 0:
            newest = self._seen.pop()
            self._seen = deque([*((frame + over, at) for frame, at in self._seen), newest], maxlen=_WINDOW)
        return before + max(ahead, 1)

    def add(self, frame: int, arrived_ns: int) -> tuple[int, float]:
        """Take a frame; gives the time at which it would have arrived with the usual delay, and the standard deviation,
        ns."""
        self._seen.append((frame, arrived_ns))
        offset_ns = np.array([at - arrived_ns - (k - frame) * self._period_ns for k, at in self._seen], dtype=float)
        frames = np.array([k - frame for k, _ in self._seen], dtype=float)
        late, sd, residual = self._line(frames, offset_ns)
        if len(frames) > _LEAST and (np.abs(residual[-_LEAST:]) > self._period_ns / 2).all():
            # The period is another one: the camera was stopped, or its rate has changed.
            self._seen = deque(list(self._seen)[-_LEAST:], maxlen=_WINDOW)
            late, sd, _ = self._line(frames[-_LEAST:], offset_ns[-_LEAST:])
        self._usual_ns = arrived_ns + round(late)
        return self._usual_ns, sd

    def _line(
        self, frames: NDArray[np.float64], offset_ns: NDArray[np.float64]
    ) -> tuple[float, float, NDArray[np.float64]]:
        """Offset of the newest frame by a straight-line fit to all but the late ones, its standard deviation, and each
        frame's deviation from the fit."""
        if len(frames) < _LEAST:
            return 0.0, self._period_ns / 2, np.zeros(len(frames))
        usable = np.ones(len(frames), dtype=bool)
        for _ in range(2):
            slope, at_newest = np.polyfit(frames[usable], offset_ns[usable], 1)
            residual = offset_ns - at_newest - slope * frames
            usable = residual <= _OUTLIER * max(float(np.median(np.abs(residual))), 1.0)
            if np.count_nonzero(usable) < _LEAST:
                return 0.0, self._period_ns / 2, residual
        some = frames[usable]
        spread = float(((some - some.mean()) ** 2).sum())
        variance = float((residual[usable] ** 2).sum()) / max(len(some) - 2, 1)
        sd = float(np.sqrt(variance * (1 / len(some) + some.mean() ** 2 / max(spread, 1.0))))
        return float(at_newest), sd, residual
