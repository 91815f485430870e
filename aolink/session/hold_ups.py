"""Times in which a session's own process did not run: no device has failed to answer in them."""

from __future__ import annotations

_LEAST_S = 1.0
"""A turn of the loop that takes longer is one in which the process did not run, s."""
_MOST_S = 60.0
"""A longer hold-up does not excuse that the mirror heard nothing, s: somebody may have touched the bench meanwhile."""


class HoldUps:
    """Follows the turns of a session's loop in real time."""

    def __init__(self) -> None:
        self.newest_s = 0.0
        """How long the newest one lasted, s."""
        self.until_ns = 0
        """Host time at which it ended."""
        self._turn_ns = 0

    def begin_turn(self, now_ns: int) -> None:
        """A turn of the loop begins; what was before it is no hold-up."""
        self._turn_ns = now_ns

    def end_turn(self, now_ns: int) -> bool:
        """A turn of the loop ends, and the next one begins; gives whether it was held up."""
        before_ns, self._turn_ns = self._turn_ns, now_ns
        if now_ns - before_ns < _LEAST_S * 1e9:
            return False
        self.newest_s, self.until_ns = (now_ns - before_ns) / 1e9, now_ns
        return True

    def unexplained_s(self, outage_s: float, now_ns: int) -> float:
        """How long an outage that ends now would have lasted without the newest hold-up, s."""
        within = now_ns - outage_s * 1e9 < self.until_ns and self.newest_s < _MOST_S
        return outage_s - self.newest_s if within else outage_s

    def ended_within(self, seconds: float, now_ns: int) -> bool:
        """Whether the newest one ended so few seconds ago."""
        return now_ns - self.until_ns < seconds * 1e9
