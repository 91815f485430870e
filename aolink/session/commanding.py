"""The commands of a session: inputs go out in blocks ahead of time, so the loop's own jitter does not reach the mirror.

Where a loop is closed, the inputs that are queued are replaced after each exposure.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from aolink.devices.interfaces import Mirror, Time
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.recording import topics
from aolink.rig import MirrorDriver, Rig
from aolink.session.controlling import MARGIN_S, Controlling
from aolink.session.journal import Journal
from aolink.session.report import LatencyBook

LEAD_BLOCKS = 3
"""Command blocks that are queued on the device ahead of time; in a queue of more than eight blocks, all but five are
filled."""
_ROOM_BLOCKS = 5

Inputs = Callable[[int, int], NDArray[np.float64]]
"""First fast step since the session's start and number of steps -> inputs to command, (n_steps, n_inputs)."""


def lead_steps(mirror: MirrorDriver) -> int:
    """How far ahead of the device commands are sent, fast steps.

    With a queue of more than eight blocks, estimators may take longer than the duration of three blocks.
    """
    return max(LEAD_BLOCKS * mirror.block_steps, mirror.queue_steps - _ROOM_BLOCKS * mirror.block_steps)


class Commanding:
    """Sends the inputs of a session to its mirror.

    Parameters
    ----------
    inputs:
        The inputs to play where no controller gives them; None for the rig's drive.
    """

    def __init__(
        self, rig: Rig, time: Time, mirror: Mirror, inputs: Inputs | None, controlling: Controlling | None,
        journal: Journal, latencies: LatencyBook,
    ) -> None:  # fmt: skip
        self._rig, self._time, self._mirror, self._controlling = rig, time, mirror, controlling
        self._inputs = inputs or partial(rig.drive.inputs, fast_step_s=rig.timing.fast_step_s)
        self._journal, self._latencies = journal, latencies
        self._step_ns, self._lead = rig.timing.fast_step_ns, lead_steps(rig.mirror)
        self._first_step = 0
        self._end_step: int | None = None
        self.queued_until = 0
        """First fast step for which no command was sent."""
        self.ended = False
        """Whether the session has put the mirror into its safe state: the controller changes nothing any more."""

    def begin(self, first_step: int, end_step: int | None) -> None:
        """Begin with this fast step, and send what the queue has room for before it is due; ``end_step`` is the first
        step after the session, None if it goes on until it is stopped."""
        self._first_step = self.queued_until = first_step
        self._end_step = end_step
        reach = self._rig.mirror.queue_steps - self._lead
        self.send(0, min(first_step, self.device_step() + reach))

    def device_step(self) -> int:
        """The fast step that the device is in by its clock; on virtual time, the step that it waits at."""
        if self._time.virtual:
            return self.queued_until
        return self._mirror.since_zero_ns(self._time.now_ns()) // self._step_ns

    def due_steps(self) -> int | None:
        """In how many fast steps the next command is due; None where there is none."""
        if not self._mirror.commanded or (self._end_step is not None and self.queued_until >= self._end_step):
            return None
        return max(self.queued_until - self.device_step() - self._lead, 0) + 1

    def go_back_to(self, step: int) -> None:
        """Send the inputs from a fast step on anew."""
        self.queued_until = min(self.queued_until, step)

    def go_on(self) -> int:
        """Go on with a mirror that has returned; gives the first fast step that is commanded."""
        self.queued_until = max(self._first_step, self.device_step() + self._rig.mirror.block_steps)
        return self.queued_until

    def catch_up(self) -> None:
        """Go on from the fast step that the device is in, where it had been believed to be in another: steps that have
        gone by are not commanded, and steps that its queue has no room for not yet."""
        step = self.device_step() + self._rig.mirror.block_steps
        if self.queued_until < step + self._rig.mirror.queue_steps:
            self._leave_out()
        else:
            self._mirror.withdraw(step)
            self._mirror.go_on_from(step, step)
            self.queued_until = step

    def _reached_step(self) -> int:
        """The first fast step that a command which is sent now reaches in time."""
        margin = 0 if self._time.virtual else round(MARGIN_S * 1e9) // self._step_ns + 1
        return self.device_step() + margin

    def send(self, newest_frame: int, device_step: int | None = None) -> None:
        """Send what is due in a fast step, by default in the one that the device is in; the inputs can depend on the
        exposures up to ``newest_frame``."""
        if not self._mirror.commanded:
            return
        device_step = self.device_step() if device_step is None else device_step
        block_steps, end_step = self._rig.mirror.block_steps, self._end_step
        lead, control, cause = self._lead, self._controlling, newest_frame
        if control is not None:  # queued inputs are sent anew after each exposure
            lead, cause = LEAD_BLOCKS * block_steps, control.cause_frame
        horizon = device_step + lead
        if control is not None and self._time.virtual:
            horizon = control.horizon(device_step)
            end_step = horizon if end_step is None else min(end_step, horizon)
        elif self._rig.mirror.slew_max_per_s and self.queued_until <= device_step and not self._time.virtual:
            self._leave_out()
        while self.queued_until < horizon and (end_step is None or self.queued_until < end_step):
            first = self.queued_until
            n_steps = block_steps if end_step is None else min(block_steps, end_step - first)
            u = control.loop.inputs(first, n_steps) if control else self._inputs(first - self._first_step, n_steps)
            now = self._time.now_ns()
            block = self._mirror.send_block(first, u, cause, now)
            self._journal.take(topics.COMMAND, now, block)
            self._latencies.sent(block, self._time.now_ns())
            self.queued_until += n_steps

    def _leave_out(self) -> None:
        """Leave out inputs that would come too late, so that the slew limit applies from the input that the mirror then
        holds."""
        first, step = self.queued_until, self._reached_step()
        step = step if self._end_step is None else min(step, self._end_step)
        if step <= first:
            return
        held, self.queued_until = self._mirror.go_on_from(first, step), step
        if self._controlling is not None:
            self._controlling.loop.commanded(first, held)

    def control(self, exposure: Exposure, estimate: Estimate | None, log_time_ns: int) -> None:
        """Let the controller change the inputs that are not due yet: they are sent anew, and supersede the queued
        ones."""
        if self._controlling is None or self.ended:
            return
        message, first_step, warnings = self._controlling.see(exposure, estimate, self._reached_step())
        if first_step < self.queued_until:
            # No later than the first changed step: the limits apply from the input that the controller continues from.
            self.queued_until = min(first_step, max(self.device_step() + 1, self._mirror.withdraw(first_step)))
        self._journal.take(topics.CONTROL, log_time_ns, message)
        for warning in warnings:
            self._journal.warn(warning)
