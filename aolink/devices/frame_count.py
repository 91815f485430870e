"""A native camera's count of its frames, carried on where the device's own counter wraps."""

from __future__ import annotations

_FEWEST_BITS = 8


class FrameCount:
    """Counts the frames of a device whose counter may have any number of bits from eight on.

    The fast steps say how many frames a device can have counted since the one before: where its number is lower than
    that one's, the counter has wrapped if it had to, and otherwise the number stays as it is, for the gate to refuse.
    """

    def __init__(self, period_steps: int) -> None:
        self._period_steps = period_steps
        self._newest: tuple[int, int] | None = None
        """Count and first fast step of the newest frame."""
        self._wrapped = self._wrapped_before = 0
        """What is added to the device's numbers, and what was before the newest wrap ..."""
        self._wrapped_at = 0
        """... which was before the frame from this fast step."""

    def take(self, number: int, first_step: int) -> tuple[int, str]:
        """The count of the frame that the device gives this number; and what has happened, in words, where its counter
        has wrapped with this frame."""
        count = number + (self._wrapped if first_step >= self._wrapped_at else self._wrapped_before)
        before, before_step = self._newest or (count, first_step)
        if first_step < before_step:
            return count, ""
        what = ""
        if count < before:
            most = before + (first_step - before_step) // self._period_steps + 1
            for bits in range(_FEWEST_BITS, 64):
                last = before - self._wrapped
                if max(number, last) < 1 << bits and before < count + (1 << bits) <= most:
                    self._wrapped_before, self._wrapped_at = self._wrapped, first_step
                    self._wrapped += 1 << bits
                    count += 1 << bits
                    what = f"its counter of frames, of {bits} bits, has begun anew with {number} after {last}"
                    break
            else:
                return count, ""
        self._newest = count, first_step
        return count, what

    def of_newest(self, number: int) -> int:
        """The count of a frame that has been taken already."""
        count = number + self._wrapped
        return count if self._newest is None or count <= self._newest[0] else number + self._wrapped_before
