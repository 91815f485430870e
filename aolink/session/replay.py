"""Replay of a recording: its exposures go through estimators at any pace."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.arguments import names as names_of
from aolink.control import Act, ControlLoop
from aolink.errors import RecordingError
from aolink.estimation import Driver, Estimate
from aolink.exposure import Exposure
from aolink.recording import convert, topics
from aolink.recording.reader import Recording, opened
from aolink.recording.reestimate import Skipped
from aolink.session.journal import View
from aolink.wire import messages_pb2 as wire

_NAP_S = 0.1
"""Longest sleep between two checks whether to stop, s."""


def replay(
    recording: Recording | str | Path, names: str | Sequence[str], *, rate: float = 0.0, sinks: Sequence[View] = (),
    stop: Callable[[], bool] = lambda: False, now_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[tuple[Exposure, list[Estimate]]]:  # fmt: skip
    """Run estimators over a recording, or its file, exposure by exposure; each skips the exposures that it skipped in
    the session.

    Parameters
    ----------
    rate:
        Pace relative to that of the recording; 0 for as fast as possible.
    sinks:
        What gets each message of the recording, with the new estimates in the place of its own.
    now_s, sleep:
        The clock for the pace, in s, and a function that waits for some seconds.
    """
    recording, names = opened(recording), names_of(names, "names")
    skipped = Skipped(recording, names)
    driver = Driver(recording.rig, names, skipped=skipped.frames)
    step_s = recording.rig.timing.fast_step_s
    first_step: int | None = None
    began_s = 0.0

    def give(topic: str, time_ns: int, message: Message) -> None:
        for sink in sinks:
            sink.take(topic, time_ns, message)

    for sink in sinks:
        sink.may_wait = True
    others = [each for each in recording.counts if not each.startswith(topics.ESTIMATE)] if sinks else []
    for step in skipped.steps(dict.fromkeys(others, give)):
        exposure = step.exposure
        if stop():
            break
        if first_step is None:
            first_step, began_s = exposure.first_step, now_s()
        elif rate > 0:
            due_s = began_s + (exposure.first_step - first_step) * step_s / rate
            while (left_s := due_s - now_s()) > 0 and not stop():
                sleep(min(left_s, _NAP_S))
            if stop():
                break
        made = driver.step(exposure)
        for each in made if sinks else ():
            give(topics.estimate_topic(each.estimator), step.time_ns, convert.estimate_message(each))
        yield exposure, made
    if first_step is None and not stop():
        raise RecordingError(f"{recording.path} has no exposure")


@dataclass(frozen=True, kw_only=True, eq=False)
class WouldCommand:
    """The inputs that a controller would have commanded after an exposure, and those that the mirror held."""

    act: Act
    inputs: NDArray[np.float64]
    """Inputs from ``act.first_step`` on to the same step after the next exposure, rounded by the mirror's converter,
    (k, n_inputs)."""
    recorded: NDArray[np.float64]
    """Inputs that the mirror held in these steps, as far as the recording has them, (at most k, n_inputs)."""


def would_command(
    recording: Recording, controller: str, estimator: str, *, stop: Callable[[], bool] = lambda: False
) -> Iterator[WouldCommand]:
    """The inputs that a controller would have commanded in the session, exposure by exposure.

    Each exposure, and the inputs that were pending at its end, are those of the recording: the controller responds to
    what happened in the session, not to the effect of its own commands. Another controller than the session's does not
    fall back, because where it did not act, its benefit cannot be measured.

    Raises
    ------
    ControlError, EstimatorError
        There is no such controller or estimator, or it cannot work on this rig.
    """
    rig = recording.rig
    if recording.metadata.get("controller") != controller:
        rig = replace(rig, control=replace(rig.control, fall_back=False))
    loop = ControlLoop(rig, controller)
    driver = Driver(rig, [estimator] if loop.needs_state else [])
    before: Exposure | None = None
    for exposure in chain(recording.exposures(), [None]):
        if stop():
            return
        held = np.empty((0, rig.n_inputs))
        if exposure is not None:
            held = np.concatenate([exposure.lead_inputs, exposure.inputs])
        if before is None:
            loop.begin(0 if exposure is None else exposure.first_step)
        else:
            end = before.first_step + before.n_steps
            loop.inputs(end, loop.delay_steps)
            loop.applied(end, held)
            estimate = next(iter(driver.step(before)), None)
            act = loop.see(before, estimate, end)
            wanted = rig.mirror.quantise(loop.inputs(act.first_step, rig.timing.frame_period_steps))
            yield WouldCommand(act=act, inputs=wanted, recorded=held[act.first_step - end :][: len(wanted)])
        before = exposure


class RecordedCommands:
    """The inputs that a session commanded, to send them to a rig again.

    Raises
    ------
    RecordingError
        There are no commands in the recording.
    """

    def __init__(self, recording: Recording) -> None:
        self._park = recording.rig.mirror.park
        self._blocks = (
            each.message for each in recording.messages(topics.COMMAND) if isinstance(each.message, wire.CommandBlock)
        )
        self._first: int | None = None
        self._rows: dict[int, NDArray[np.float64]] = {}
        self._known = 0
        """First step since the start that no block read so far covers."""
        if not self._read():
            raise RecordingError(f"{recording.path} holds no commands to send again")
        first = last = None
        for each in recording.messages(topics.EXPOSURE):
            last = each.message.first_step  # type: ignore[attr-defined]
            first = last if first is None else first
        period = recording.rig.timing.frame_period_steps
        self.exposures = 0 if first is None or last is None else 1 + (last - first) // period
        """Number of exposures of the session, lost ones included."""

    def inputs(self, first_step: int, n_steps: int) -> NDArray[np.float64]:
        """Inputs of fast steps counted from the session's first, (n_steps, n_inputs); must be asked for in order."""
        while self._known < first_step + n_steps and self._read():
            pass
        return np.array([self._rows.pop(k, self._park) for k in range(first_step, first_step + n_steps)])

    def _read(self) -> bool:
        block = next(self._blocks, None)
        if block is None:
            return False
        if self._first is None:
            self._first = block.first_step
        rows = np.array(block.u, dtype=np.float64).reshape(block.n_steps, -1)
        since = block.first_step - self._first
        self._rows.update(zip(range(since, since + block.n_steps), rows, strict=True))
        self._known = max(self._known, since + block.n_steps)
        return True
