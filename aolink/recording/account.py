"""The account of a session's commands: how each step ended, what the mirror answered, which blocks had no effect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.recording.schemas_pb2 import CommandAnswer
from aolink.wire.messages_pb2 import Applied, CommandBlock

REFUSALS = (CommandAnswer.OUT_OF_RANGE, CommandAnswer.WRONG_SHAPE, CommandAnswer.NOT_SUPPORTED, CommandAnswer.LATCHED)
"""Answers by which the mirror refuses a whole block."""
STEPS = ("commanded", "applied", "superseded", "late", "refused", "not_reported", "clipped")
"""The fields of `Commands` that count steps."""
OPEN, PASSED, UNKNOWN, ENDED = range(4)
"""State of a commanded step: not reported yet; reported without the command; held input unknown; counted."""
QUEUED, LATE, REFUSED, UNANSWERED = range(4)
"""What the mirror has said of a step's command: it was in time; the step had gone by; it refused the whole block; it
said nothing, and is not waited for any more."""
ENDS = {
    QUEUED: {PASSED: "superseded", UNKNOWN: "not_reported"},
    LATE: {PASSED: "late", UNKNOWN: "late"},
    REFUSED: {OPEN: "refused", PASSED: "refused", UNKNOWN: "refused"},
    UNANSWERED: {PASSED: "late", UNKNOWN: "not_reported"},
}
"""The count with which a step ends, by what the mirror has said of it and by its state; a step that is not here stays
open. A step that is reported with its own command ends at once, as applied or as late."""
_MOST_OPEN = 10_000
"""Most blocks of which some steps have not ended: in a recording reports may be missing."""
_NAMES = {value: name for name, value in CommandAnswer.Answer.items()}
_WITHOUT_WORDS = {
    CommandAnswer.QUEUE_FULL: "refused, the queue was full",
    CommandAnswer.TOO_LATE: "all of its steps had gone by when it came",
    CommandAnswer.LATCHED: "refused, the watchdog had parked the mirror",
    CommandAnswer.NONE: "never answered",
}
_INSTEAD = {
    Applied.COMMAND: "replaced by a later block",
    Applied.CLIPPED: "replaced by a later block",
    Applied.PARKED: "dropped from the queue, for the mirror was parked",
    Applied.WATCHDOG: "dropped from the queue, for the watchdog parked the mirror",
    Applied.NOT_REPORTED: "accepted, but the mirror did not report what it held",
    Applied.LATE: "its steps had gone by when it was their turn",
}
"""What the mirror held in the steps of a block that it had accepted."""


@dataclass(kw_only=True)
class WithoutEffect:
    """Blocks of which no effect is known, for the same reason."""

    blocks: int
    reason: str
    first_block: int
    first_step: int
    n_steps: int
    tries: int
    """How often the first of them was sent."""

    def text(self) -> str:
        which = f"block {self.first_block}, fast steps {self.first_step} to {self.first_step + self.n_steps - 1}"
        more = f", and {self.blocks - 1} more" if self.blocks > 1 else ""
        times = "once" if self.tries == 1 else f"{self.tries} times"
        return f"no effect is known of {which}, sent {times}{more}: {self.reason}"


@dataclass(kw_only=True)
class Commands:
    """Counts of the commands of a session: of steps by how they ended, of blocks by what the mirror answered."""

    commanded: int = 0
    """Steps of all command blocks; at the end of the session they are the sum of the five counts that follow."""
    applied: int = 0
    superseded: int = 0
    """Steps that were queued, and replaced by a later command, or dropped when the mirror parked."""
    late: int = 0
    """Steps that had gone by when their block came, or whose block was never answered and another input was applied."""
    refused: int = 0
    not_reported: int = 0
    """Steps in which the mirror held an unknown input: the reports did not come, although they were requested again."""
    clipped: int = 0
    """Applied steps whose input the device's own protection had changed."""
    by_answer: dict[str, int] = field(default_factory=dict)
    """Blocks by the names of `CommandAnswer.Answer`."""
    sent_again: int = 0
    """Blocks that were sent more than once."""
    most_tries: int = 0
    without_effect: list[WithoutEffect] = field(default_factory=list)

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Self:
        """The counts that `dataclasses.asdict` has made plain."""
        return cls(**{**facts, "without_effect": [WithoutEffect(**each) for each in facts["without_effect"]]})

    @property
    def ended(self) -> int:
        """Steps that have ended."""
        return self.applied + self.superseded + self.late + self.refused + self.not_reported

    def lines(self) -> list[str]:
        """The answers in words, and a line for each reason why blocks had no effect; none where there was no answer."""
        if not self.by_answer:
            return []
        again = f"; {self.sent_again} sent more than once, at most {self.most_tries} times" if self.sent_again else ""
        counts = ", ".join(f"{name} {count}" for name, count in self.by_answer.items())
        answers = f"{sum(self.by_answer.values())} blocks: {counts}{again}"
        return [answers, *(each.text() for each in self.without_effect)]


@dataclass(slots=True)
class _Block:
    """A command of which some steps have not ended."""

    block_id: int
    first: int
    end: int
    """First step after it."""
    steps: NDArray[np.int8]
    """State of each step: one of the four above."""
    answer: CommandAnswer | None = None
    closed: bool = False
    """Whether no answer will come any more."""
    applied: bool = False
    """Whether the mirror has applied some of it."""
    instead: str = ""
    """What it held instead."""


class Account:
    """Counts how each commanded step of a session ended, from the messages of the session in their order.

    A step is *applied* where the mirror reports it with the command's block. Where it reports another input, or no
    report comes, the mirror's answer to the block decides. The step was *refused*; or *late*, if it had gone by when
    the block came, or if the block was never answered; otherwise it was queued, and is *superseded* (by a later
    command, or by parking, which empties the queue) if another input is reported, and *not reported* if none is.
    """

    def __init__(self, counts: Commands | None = None) -> None:
        self.counts = counts or Commands()
        self._blocks: dict[int, _Block] = {}
        self._without: dict[str, WithoutEffect] = {}
        self._reported_until = 0
        """First step for which no report has come."""

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take the next message of the session, of any topic."""
        if isinstance(message, CommandBlock):
            self.commanded(message)
        elif isinstance(message, CommandAnswer):
            self.answered(message)
        elif isinstance(message, Applied):
            self.reported(message)

    def commanded(self, block: CommandBlock) -> None:
        """Note that a block is sent for the first time."""
        steps = np.full(block.n_steps, OPEN, dtype=np.int8)
        steps[: max(self._reported_until - block.first_step, 0)] = PASSED
        self._blocks[block.block_id] = _Block(block.block_id, block.first_step, block.first_step + block.n_steps, steps)
        self.counts.commanded += block.n_steps
        if len(self._blocks) > _MOST_OPEN:
            self._close(next(iter(self._blocks.values())))

    def answered(self, answer: CommandAnswer) -> None:
        """Take the mirror's answer to a block, or that it is not waited for any more."""
        counts, name = self.counts, _NAMES.get(answer.answer, str(answer.answer))
        counts.by_answer[name] = counts.by_answer.get(name, 0) + 1
        counts.sent_again += answer.tries > 1
        counts.most_tries = max(counts.most_tries, answer.tries)
        if block := self._blocks.get(answer.block_id):
            block.answer = answer
            self._settle(block)

    def reported(self, applied: Applied) -> None:
        """Take a report of the inputs that the mirror held in some steps, or that there is none; each step must be
        reported once."""
        if applied.source == Applied.AWAITED:
            return
        first, end = applied.first_step, applied.first_step + applied.n_steps
        self._reported_until = max(self._reported_until, end)
        for block in list(self._blocks.values()):
            if first >= block.end or end <= block.first:
                continue
            part = block.steps[max(first - block.first, 0) : end - block.first]
            if applied.block_id == block.block_id and applied.source != Applied.LATE:
                block.applied = True
                n_steps = self._count("applied", part, part != ENDED)
                self.counts.clipped += n_steps if applied.source == Applied.CLIPPED else 0
            else:
                if not block.instead or applied.source == Applied.NOT_REPORTED:
                    block.instead = _INSTEAD.get(applied.source, "")
                if applied.block_id == block.block_id:
                    self._count("late", part, part != ENDED)
                part[part == OPEN] = UNKNOWN if applied.source == Applied.NOT_REPORTED else PASSED
            self._settle(block)

    def parked_from(self, step: int) -> None:
        """Note that the mirror was asked to park: the inputs queued for ``step`` and later are dropped."""
        for block in list(self._blocks.values()):
            part = block.steps[max(step - block.first, 0) :]
            self._count("superseded", part, part == OPEN)
            self._settle(block)

    def close(self) -> Commands:
        """End every step that is still open: no more answers or reports will come. Gives the counts."""
        for block in list(self._blocks.values()):
            self._close(block)
        self.counts.without_effect = sorted(self._without.values(), key=lambda each: -each.blocks)
        return self.counts

    def _close(self, block: _Block) -> None:
        block.steps[block.steps == OPEN] = UNKNOWN
        block.closed = True
        self._settle(block)

    def _settle(self, block: _Block) -> None:
        """Count the steps that have ended, as far as the answer to their block is known."""
        steps, answer = block.steps, block.answer
        parts: dict[int, NDArray[np.int8]]
        if answer is None or answer.answer == CommandAnswer.NONE:
            parts = {UNANSWERED: steps} if answer is not None or block.closed else {}
        elif answer.answer in REFUSALS:
            parts = {REFUSED: steps}
        else:
            parts = {LATE: steps[: answer.late_steps], QUEUED: steps[answer.late_steps :]}
        for said, part in parts.items():
            for state, name in ENDS[said].items():
                self._count(name, part, part == state)
        if (steps == ENDED).all():
            del self._blocks[block.block_id]
            if not block.applied:
                self._count_without_effect(block)

    def _count(self, name: str, steps: NDArray[np.int8], ended: NDArray[np.bool_]) -> int:
        """Add steps to a count, and mark them as counted; gives how many."""
        n_steps = int(np.count_nonzero(ended))
        steps[ended] = ENDED
        setattr(self.counts, name, getattr(self.counts, name) + n_steps)
        return n_steps

    def _count_without_effect(self, block: _Block) -> None:
        reason = block.instead or "not reported before the session ended, which empties the queue"
        if (answer := block.answer) is not None:
            code = answer.answer
            if code == CommandAnswer.OK and answer.late_steps >= answer.n_steps:
                code = CommandAnswer.TOO_LATE
            if code != CommandAnswer.OK:
                refused = f"refused as {_NAMES.get(code, code)}: {answer.text}".removesuffix(": ")
                reason = _WITHOUT_WORDS.get(code, refused)
        found = self._without.setdefault(
            reason,
            WithoutEffect(
                blocks=0, reason=reason, first_block=block.block_id, first_step=block.first, n_steps=len(block.steps),
                tries=answer.tries if answer is not None else 1,
            ),
        )  # fmt: skip
        found.blocks += 1
