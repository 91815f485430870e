"""The account of a session's commands: it records how each commanded step ends, exactly once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.session.report import Report
from aolink.wire import messages_pb2 as wire

_OPEN, _PASSED, _UNKNOWN, _ENDED = range(4)
"""State of a commanded step: not reported yet; reported without the command; held input unknown; counted."""
REFUSALS = (wire.OUT_OF_RANGE, wire.WRONG_SHAPE, wire.NOT_SUPPORTED, wire.LATCHED)
"""Answers by which the mirror refuses a whole block."""


@dataclass(slots=True)
class _Block:
    """A command of which some steps have not ended."""

    first: int
    steps: NDArray[np.int8]
    """State of each step: one of the four above."""
    ack: wire.CommandAck | None = None
    awaited: bool = True
    """Whether its answer may still come."""

    @property
    def end(self) -> int:
        return self.first + len(self.steps)


class Account:
    """Counts, in a `Report`, how each commanded step of a session ended.

    A step is *applied* where the mirror reports it with the command's block. Where it reports another input, or no
    report comes, the mirror's answer to the block decides. The step was *refused*; or *late*, if it had gone by when
    the block came, or if the block was never answered; otherwise it was queued, and is *superseded* (by a later
    command, or by parking, which empties the queue) if another input is reported, and *not reported* if none is.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._blocks: dict[int, _Block] = {}
        self._reported_until = 0
        """First step for which no report has come."""

    def commanded(self, block: wire.CommandBlock) -> None:
        """Note that a block is sent for the first time."""
        steps = np.full(block.n_steps, _OPEN, dtype=np.int8)
        steps[: max(self._reported_until - block.first_step, 0)] = _PASSED
        self._blocks[block.block_id] = _Block(block.first_step, steps)
        self._report.steps_commanded += block.n_steps

    def answered(self, block_id: int, ack: wire.CommandAck | None) -> None:
        """Note that the mirror has acknowledged or refused a block; None if its answer is not waited for any more."""
        if block := self._blocks.get(block_id):
            block.ack, block.awaited = ack, False
            self._settle(block_id, block)

    def reported(self, applied: wire.Applied) -> None:
        """Take a report of the inputs that the mirror held in some steps, or that there is none; each step must be
        reported once."""
        first, end = applied.first_step, applied.first_step + applied.n_steps
        self._reported_until = max(self._reported_until, end)
        for block_id, block in list(self._blocks.items()):
            if first >= block.end or end <= block.first:
                continue
            part = block.steps[max(first - block.first, 0) : end - block.first]
            if applied.block_id == block_id:
                name = "steps_late" if applied.source == wire.Applied.LATE else "steps_applied"
                n_steps = self._count(name, part, part != _ENDED)
                self._report.steps_clipped += n_steps if applied.source == wire.Applied.CLIPPED else 0
            else:
                part[part == _OPEN] = _UNKNOWN if applied.source == wire.Applied.NOT_REPORTED else _PASSED
            self._settle(block_id, block)

    def parked_from(self, step: int) -> None:
        """Note that the mirror was asked to park: the inputs queued for ``step`` and later are dropped."""
        for block_id, block in list(self._blocks.items()):
            part = block.steps[max(step - block.first, 0) :]
            self._count("steps_superseded", part, part == _OPEN)
            self._settle(block_id, block)

    def close(self) -> None:
        """End every step that is still open: no more answers or reports will come."""
        for block_id, block in list(self._blocks.items()):
            block.steps[block.steps == _OPEN] = _UNKNOWN
            self.answered(block_id, block.ack)

    def _settle(self, block_id: int, block: _Block) -> None:
        """Count the steps that have ended, as far as the answer to their block is known."""
        steps, ack = block.steps, block.ack
        if ack is not None and ack.code in REFUSALS:
            self._count("steps_refused", steps, steps != _ENDED)
        elif ack is not None:
            late = steps[: ack.late_steps]
            self._count("steps_late", late, (late == _PASSED) | (late == _UNKNOWN))
            self._count("steps_superseded", steps, steps == _PASSED)
        elif not block.awaited:
            self._count("steps_late", steps, steps == _PASSED)
        if not block.awaited:
            self._count("steps_not_reported", steps, steps == _UNKNOWN)
        if (steps == _ENDED).all():
            del self._blocks[block_id]

    def _count(self, name: str, steps: NDArray[np.int8], ended: NDArray[np.bool_]) -> int:
        """Add steps to a count of the report, and mark them as counted; gives how many."""
        n_steps = int(np.count_nonzero(ended))
        steps[ended] = _ENDED
        setattr(self._report, name, getattr(self._report, name) + n_steps)
        return n_steps
