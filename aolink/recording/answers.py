"""What the mirror answered to the command blocks of a session, and why no effect is known of some of them."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from aolink.recording.schemas_pb2 import CommandAnswer
from aolink.wire.messages_pb2 import Applied

_REMEMBERED = 4096
"""Most blocks that are waited for, and that are remembered to have had an effect."""
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
class Answers:
    """Counts of the command blocks of a session by what the mirror answered: the names of `CommandAnswer.Answer`."""

    blocks: int = 0
    by_answer: dict[str, int] = field(default_factory=dict)
    sent_again: int = 0
    """Blocks that were sent more than once."""
    most_tries: int = 0
    without_effect: list[WithoutEffect] = field(default_factory=list)

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Self:
        """The counts that `dataclasses.asdict` has made plain."""
        return cls(**{**facts, "without_effect": [WithoutEffect(**each) for each in facts["without_effect"]]})

    def lines(self) -> list[str]:
        """The counts in words, and a line for each reason why blocks had no effect; none where there were no blocks."""
        if not self.blocks:
            return []
        again = f"; {self.sent_again} sent more than once, at most {self.most_tries} times" if self.sent_again else ""
        counts = ", ".join(f"{name} {count}" for name, count in self.by_answer.items())
        return [f"{self.blocks} blocks: {counts}{again}", *(each.text() for each in self.without_effect)]


class AnswerCounter:
    """Counts answers, and finds in the mirror's reports which blocks had an effect; both in the order of the session,
    and in the same memory however many there are."""

    def __init__(self) -> None:
        self._counts = Counter[int]()
        self._sent_again = self._most_tries = 0
        self._effective: OrderedDict[int, None] = OrderedDict()
        """The newest blocks that had an effect."""
        self._open: dict[int, tuple[CommandAnswer, int, str]] = {}
        """Blocks that may still have an effect, how many of their steps have not been reported, and what the mirror
        held instead in the others."""
        self._without: dict[str, WithoutEffect] = {}

    def answered(self, answer: CommandAnswer) -> None:
        """Take the answer to a block."""
        self._counts[answer.answer] += 1
        self._sent_again += answer.tries > 1
        self._most_tries = max(self._most_tries, answer.tries)
        if answer.block_id in self._effective:
            return
        left = answer.n_steps - answer.late_steps
        if answer.answer != CommandAnswer.OK or left <= 0:
            refused = f"refused as {_NAMES.get(answer.answer, answer.answer)}: {answer.text}".removesuffix(": ")
            self._count(answer, _WITHOUT_WORDS.get(answer.answer or CommandAnswer.TOO_LATE, refused))
            return
        self._open[answer.block_id] = answer, left, ""
        if len(self._open) > _REMEMBERED:
            self._give_up(next(iter(self._open)))

    def applied(self, applied: Applied) -> None:
        """Take a report of what the mirror held."""
        if applied.source == Applied.AWAITED:
            return
        first, end = applied.first_step, applied.first_step + applied.n_steps
        if applied.block_id and applied.source != Applied.LATE:
            self._open.pop(applied.block_id, None)
            self._effective[applied.block_id] = None
            if len(self._effective) > _REMEMBERED:
                self._effective.popitem(last=False)
        for block_id, (answer, left, instead) in list(self._open.items()):
            begin = answer.first_step + answer.late_steps
            if (reported := min(answer.first_step + answer.n_steps, end) - max(begin, first)) > 0:
                self._open[block_id] = answer, left - reported, instead or _INSTEAD.get(applied.source, "")
                if left <= reported:
                    self._give_up(block_id)

    def result(self) -> Answers:
        """The counts, now that no more messages come."""
        for block_id in list(self._open):
            self._give_up(block_id)
        return Answers(
            blocks=self._counts.total(),
            by_answer={_NAMES.get(answer, str(answer)): count for answer, count in sorted(self._counts.items())},
            sent_again=self._sent_again, most_tries=self._most_tries,
            without_effect=sorted(self._without.values(), key=lambda each: -each.blocks),
        )  # fmt: skip

    def _give_up(self, block_id: int) -> None:
        answer, _, instead = self._open.pop(block_id)
        self._count(answer, instead or "not reported before the session ended, which empties the queue")

    def _count(self, answer: CommandAnswer, reason: str) -> None:
        if reason in self._without:
            self._without[reason].blocks += 1
            return
        self._without[reason] = WithoutEffect(
            blocks=1, reason=reason, first_block=answer.block_id, first_step=answer.first_step,
            n_steps=answer.n_steps, tries=answer.tries,
        )  # fmt: skip
