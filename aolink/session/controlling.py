"""The closed loop in a session: the steps that an exposure may still change, and the recording and reporting of the
loop."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from google.protobuf.message import Message

from aolink.control import Act, ControllerRow, ControlLoop, State, find_controller
from aolink.estimation import Estimate
from aolink.estimation.registry import DEFAULT_ESTIMATOR
from aolink.exposure import Exposure
from aolink.recording import convert
from aolink.recording import schemas_pb2 as pb
from aolink.rig import Rig
from aolink.session.report import ControlReport
from aolink.wire import messages_pb2 as wire

MARGIN_S = 0.003
"""Real time: how long a block may take to the mirror, at least, before its first step begins."""

_SAID = {
    State.CLOSED: "the loop is closed again from frame {frame} on",
    State.HELD: "the loop is open from frame {frame} on, the mirror holds its input: {reason}",
    State.PARKED: "the loop is open from frame {frame} on, the mirror goes to its safe input: {reason}",
}
"""What is said when the loop comes into a state."""


def served(rig: Rig, controller: str, estimators: Sequence[str]) -> list[str]:
    """A session's estimators, each once; the default one where a controller needs one and none is named."""
    names = list(dict.fromkeys(estimators))
    return names or ([DEFAULT_ESTIMATOR] if controller and find_controller(controller, rig).needs_state else [])


class Controlling:
    """A controller in a session, and the estimator that serves it: the first of those that `served` gives.

    Raises
    ------
    ControlError
        There is no such controller, or it cannot work on this rig.
    """

    def __init__(self, rig: Rig, controller: str | ControllerRow, estimators: Sequence[str]) -> None:
        self.loop = ControlLoop(rig, controller)
        self.estimator = estimators[0] if self.loop.needs_state else ""
        self.report = ControlReport(controller=self.loop.name, estimator=self.estimator)
        self.cause_frame = 0
        """The newest exposure that the inputs depend on."""
        self._step_s, self._period = rig.timing.fast_step_s, rig.timing.frame_period_steps
        self._steps, self._n_inputs = rig.timing.exposure_steps, rig.n_inputs
        self._first_step = 0
        self._state, self._acting = State.CLOSED, self.loop.acting

    def begin(self, first_step: int) -> None:
        """Begin the session with this fast step."""
        self._first_step = first_step
        self.loop.begin(first_step)

    def horizon(self, device_step: int) -> int:
        """On virtual time, the first fast step whose input the next exposure to end may still change.

        Commands go no further: the rig runs to their end at once.
        """
        ended = max(0, (device_step - self._first_step - self._steps) // self._period + 1)
        return self._first_step + ended * self._period + self._steps + self.loop.delay_steps

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take a block of inputs as it was sent, or a report of the inputs that the mirror held."""
        if isinstance(message, wire.CommandBlock | wire.Applied) and message.u:
            tell = self.loop.commanded if isinstance(message, wire.CommandBlock) else self.loop.applied
            tell(message.first_step, np.array(message.u).reshape(message.n_steps, self._n_inputs))

    def see(
        self, exposure: Exposure, estimate: Estimate | None, earliest_step: int
    ) -> tuple[pb.Control, int, list[str]]:
        """Take the next exposure, or its estimate. Raises ControlError where the controller fails.

        Gives what is recorded, the fast step from which on commands are to be sent anew, and warnings for the user,
        none while nothing has changed.
        """
        act = self.loop.see(exposure, estimate, earliest_step)
        self.cause_frame = act.frame_id
        self.report.add(act, self._step_s)
        return convert.control_message(act, self.loop.name, self.estimator), act.first_step, self._news(act)

    def _news(self, act: Act) -> list[str]:
        news, frame = [], act.frame_id
        if act.state is not self._state:
            news.append(_SAID[act.state].format(frame=frame, reason=act.reason))
        if act.acting != self._acting:
            pays = f"{act.acting} would have left {100 * act.gained:.0f} % less of the slopes (rms) than {self._acting}"
            tried = f"{act.acting} is tried again"
            news.append(f"{tried if math.isnan(act.gained) else pays}, and acts from frame {frame} on")
        self._state, self._acting = act.state, act.acting
        return news


def facts(rig: Rig, controlling: Controlling, stability: str) -> dict[str, str]:
    """Facts about the controller, for the recording's metadata."""
    control = rig.control
    numbers = {
        "delay_s": control.delay_s, "when_lost": control.when_lost, "gain": control.gain, "leak": control.leak,
        "least_singular_value": control.least_singular_value, "effort": control.effort, "fall_back": control.fall_back,
    }  # fmt: skip
    return {
        "controller": controlling.loop.name,
        "control_estimator": controlling.estimator,
        "control": ", ".join(f"{name} {value}" for name, value in numbers.items()),
        "control_stability": stability,
    }
