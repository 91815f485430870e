"""The clock of a device that plays a queue of samples and says only how many it has taken: seen from the host."""

from __future__ import annotations

import math

_DRIFT = 200e-6
"""No crystal drifts from the host's clock by more, as a part of the time that passes."""
_SETTLING_S = 2.0
"""The reported time follows the counts with about this time constant, s, so that it never jumps."""
_TOLERANCE = 0.05
"""A count that contradicts the earlier ones by more than this part of a sample cannot be explained by drift."""


class SampleClock:
    """The time at which sample 0 was put out, from later counts of samples.

    A count of n, true at some time between its question and its answer, says that sample n - 1 was being put out then:
    sample 0 began n sample periods before at the earliest, and n - 1 at the latest. All counts together leave an
    interval for that time, which is narrower the more phases of a sample they were asked in; it widens with time,
    because the host's clock and the device's drift apart.

    Parameters
    ----------
    period_ns:
        Time of one sample by the device's clock, ns.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._zero: tuple[float, float] | None = None
        """Earliest and latest host time at which sample 0 can have begun, less ``_base_ns``, ns."""
        self._base_ns = self._at_ns = 0
        self._reported_ns = self._rate = 0.0
        """The host time reported for it, less ``_base_ns``, ns, and its rate of change against the time that passes."""

    def add(self, taken: int, asked_ns: int, answered_ns: int) -> float:
        """Take a count into account, which was true at some time between two host times.

        Gives 0, or the samples by which the device is behind the earlier counts (above 0) or ahead of them: such a
        count is not used.
        """
        if self._zero is None:
            self._base_ns = asked_ns - taken * self._period_ns
            self._zero = 0.0, float(answered_ns - asked_ns + self._period_ns)
            self._reported_ns, self._at_ns = sum(self._zero) / 2, answered_ns
            return 0.0
        elapsed_ns = max(answered_ns - self._at_ns, 0)
        widened = elapsed_ns * _DRIFT
        earliest = asked_ns - taken * self._period_ns - self._base_ns
        latest = answered_ns - (taken - 1) * self._period_ns - self._base_ns
        before = self._zero[0] - widened, self._zero[1] + widened
        low, high = max(before[0], earliest), min(before[1], latest)
        if low > high:
            slip = (low - high) / self._period_ns * (1 if earliest > before[1] else -1)
            if abs(slip) > _TOLERANCE:
                return slip
            low = high = (low + high) / 2
        self._zero, self._at_ns = (low, high), answered_ns
        self._follow((low + high) / 2, elapsed_ns)
        return 0.0

    def doubt(self, by_ns: int) -> None:
        """Widen the interval because the device has stood still: the times of its samples may be wrong by this much."""
        assert self._zero is not None, "add a count first"
        self._zero = self._zero[0] - by_ns, self._zero[1] + by_ns

    def time_ns(self, host_ns: int) -> int:
        """Time since sample 0 began, on the device's clock, at a host time of now, ns."""
        assert self._zero is not None, "add a count first"
        moved = self._reported_ns + self._rate * (host_ns - self._at_ns)
        return host_ns - self._base_ns - round(moved)

    @property
    def sigma_ns(self) -> float:
        """Standard deviation of the reported time, ns: that of the interval which the counts leave, and the distance of
        the reported time from it.

        The line's asymmetry, at most half a round trip, does not show in the counts.
        """
        assert self._zero is not None, "add a count first"
        earliest, latest = self._zero
        return math.hypot((latest - earliest) / math.sqrt(12), self._reported_ns - (earliest + latest) / 2)

    def settle(self) -> None:
        """Report from now on exactly the time that the counts give, even if it jumps: for use before any time was
        reported."""
        assert self._zero is not None, "add a count first"
        self._reported_ns = sum(self._zero) / 2

    def _follow(self, middle_ns: float, elapsed_ns: int) -> None:
        """Advance a phase-locked loop of second order, critically damped: it has no lag where the drift is constant."""
        step = min(elapsed_ns / (_SETTLING_S * 1e9), 0.5)
        self._reported_ns += self._rate * elapsed_ns
        apart = middle_ns - self._reported_ns
        self._reported_ns += 2 * step * apart
        if elapsed_ns:
            self._rate += step * step * apart / elapsed_ns
