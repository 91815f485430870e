"""The reports of a mirror, fast step by fast step; missing reports are requested again."""

from __future__ import annotations

from dataclasses import dataclass

from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as pb


@dataclass(slots=True)
class _Gap:
    """Fast steps that were left out between two reports."""

    first: int
    end: int
    """The first step after the gap."""
    since_ns: int
    """Host time since which the steps have been missing."""
    asked_ns: int | None = None
    """Host time of the last query; None before the first."""
    tries: int = 0


class AppliedReports:
    """Passes on the input that the mirror held in each fast step exactly once, and keeps the steps to be requested
    again.

    A device sends its reports in order, so a report that begins later than the one before it ended shows a gap.
    Reports may come twice (both the original and an answer): only their new steps are passed on.

    Parameters
    ----------
    fast_step_ns:
        Length of a fast step.
    patience_ns:
        How long a step is requested before it counts as not reported.
    """

    def __init__(self, fast_step_ns: int, patience_ns: int) -> None:
        self._fast_step_ns, self._patience_ns = fast_step_ns, patience_ns
        self._start: int | None = None
        self._next = 0
        """First step that neither a report nor a gap covers."""
        self._gaps: list[_Gap] = []
        self.asked = 0
        """Number of queries so far."""

    def begin(self, first_step: int) -> None:
        """Expect a report of every step from ``first_step`` on. Only the first call counts."""
        if self._start is None:
            self._start = self._next = first_step

    def take(self, applied: pb.Applied, now_ns: int) -> list[pb.Applied]:
        """Take a report; gives its new steps, after an ``AWAITED`` for each gap that it shows."""
        first, end = applied.first_step, applied.first_step + applied.n_steps
        if self._start is None or end <= self._start:  # before the session: nothing depends on it
            return [applied]
        new: list[tuple[int, int]] = []
        gaps: list[_Gap] = []
        for gap in self._gaps:
            low, high = max(first, gap.first), min(end, gap.end)
            if low >= high:
                gaps.append(gap)
                continue
            new.append((low, high))
            if gap.first < low:
                gaps.append(_Gap(gap.first, low, gap.since_ns, gap.asked_ns, gap.tries))
            if high < gap.end:
                gaps.append(_Gap(high, gap.end, now_ns))
        self._gaps = gaps
        awaited: list[pb.Applied] = []
        if end > self._next:
            awaited = self.expect_until(first, now_ns)
            new.append((first if self._next == self._start else max(first, self._next), end))
            self._next = end
        return awaited + [self._part(applied, low, high) for low, high in new]

    def expect_until(self, end: int, now_ns: int) -> list[pb.Applied]:
        """Request every step before ``end`` that has not been reported, also without a later report."""
        if self._start is None or end <= self._next:
            return []
        first, self._next = self._next, end
        if self._gaps and self._gaps[-1].end == first:  # one query will do
            self._gaps[-1].end = end
        else:
            self._gaps.append(_Gap(first, end, now_ns))
        return [pb.Applied(first_step=first, n_steps=end - first, source=pb.Applied.AWAITED)]

    def ask_anew(self, now_ns: int) -> None:
        """Request all missing steps as if they were missing since now: the device could not be asked before."""
        self._gaps = [_Gap(gap.first, gap.end, now_ns) for gap in self._gaps]

    def next_due_ns(self, interval_ns: int) -> int | None:
        """Host time at which `ask` has something to do, with ``interval_ns`` between two tries; None if never."""
        return min((_due_ns(gap, interval_ns) for gap in self._gaps), default=None)

    def ask(self, now_ns: int, interval_ns: int) -> tuple[list[pb.AppliedQuery], list[pb.Applied]]:
        """The queries that are due, and ``NOT_REPORTED`` for steps that were requested for long enough."""
        queries, given_up, gaps = [], [], []
        for gap in self._gaps:
            if _due_ns(gap, interval_ns) <= now_ns:
                if now_ns - gap.since_ns > self._patience_ns and gap.tries >= TIMEOUTS.least_report_tries:
                    n_steps = gap.end - gap.first
                    given_up.append(pb.Applied(first_step=gap.first, n_steps=n_steps, source=pb.Applied.NOT_REPORTED))
                    continue
                queries.append(pb.AppliedQuery(first_step=gap.first, n_steps=gap.end - gap.first))
                gap.asked_ns, gap.tries = now_ns, gap.tries + 1
            gaps.append(gap)
        self._gaps = gaps
        self.asked += len(queries)
        return queries, given_up

    def _part(self, applied: pb.Applied, first: int, end: int) -> pb.Applied:
        if (first, end) == (applied.first_step, applied.first_step + applied.n_steps):
            return applied
        width = len(applied.u) // applied.n_steps
        skipped = first - applied.first_step
        return pb.Applied(
            block_id=applied.block_id,
            first_step=first,
            n_steps=end - first,
            u=applied.u[skipped * width : (end - applied.first_step) * width],
            source=applied.source,
            device_ns=applied.device_ns - (applied.first_step + applied.n_steps - end) * self._fast_step_ns,
        )


def _due_ns(gap: _Gap, interval_ns: int) -> int:
    return gap.since_ns if gap.asked_ns is None else gap.asked_ns + interval_ns
