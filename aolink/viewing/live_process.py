"""The process that draws a session while it goes on. `aolink.viewing.live` starts it and writes the messages to its
standard input."""

from __future__ import annotations

import pickle
import sys
import time
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import rerun as rr
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.estimation import exposure_model
from aolink.recording import topics
from aolink.recording.exposures import Walk
from aolink.recording.messages import RawMessage
from aolink.restoration import deblur
from aolink.rig import Rig
from aolink.series import Step
from aolink.session.waiting import most_waiting
from aolink.viewing import entities, scene
from aolink.viewing.look import APPLICATION
from aolink.viewing.sender import Sender, is_drawn
from aolink.viewing.series import Drawing

_SAY_S = 1.0
"""Time between two versions of the page about the session, s."""
_FLUSH_S = 30.0
_PATIENCE = 4
"""An exposure waits for its estimates for as long as so many times the exposures that an estimator may have waiting."""


class LiveSender(Sender):
    """Draws a session's messages, of any of its topics, as they come."""

    def __init__(
        self, stream: rr.RecordingStream, rig: Rig, estimators: Sequence[str],
        true_scene: NDArray[np.uint16] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(Drawing(stream=stream, rig=rig, estimators=list(estimators), live=True))
        self._true_scene = true_scene
        self._counts = dict.fromkeys(map(topics.estimate_topic, self.drawing.estimators), sys.maxsize)
        self._counts |= {topics.TRUTH: 1} | ({topics.SCENE: 1} if rig.scene else {})
        self._walk = self._new_walk()
        self._steps: list[Step] = []
        self._laid_out: set[str] = set()
        """The entities for which there is a layout."""
        self._left_out = 0
        self._now_ns = 0
        self._said_s = -np.inf

    def _new_walk(self) -> Walk:
        rig = self.drawing.rig
        model = exposure_model(rig.plant, rig.window_steps)
        most = _PATIENCE * most_waiting(rig.timing)
        return Walk(rig, self.drawing.estimators, self._counts, lambda: model, most=most)

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take the next message."""
        self._steps += self._walk.take(topic, time_ns, message)
        self._now_ns = time_ns
        if is_drawn(topic):
            self.see(topic, time_ns, message)

    def leave_out(self, messages: int) -> None:
        """Note that so many messages were left out here, because the view is too slow."""
        self._steps += self._walk.flush(self._now_ns)
        self._walk, self._left_out = self._new_walk(), self._left_out + messages
        self.draw()
        self.last = None  # the exposures between were not lost

    def draw(self, *, ended: bool = False) -> None:
        """Draw what has come."""
        if ended:
            self._steps += self._walk.flush(self._now_ns)
        steps, self._steps = self._steps, []
        drawing = self.drawing
        if not steps and self.timebase is None:
            return
        timebase = self.send(steps)
        if drawing.rig.scene is not None:
            for step in steps:
                focus = step.estimates.get(drawing.estimators[-1]) if drawing.estimators else None
                if focus is not None and step.exposure.scene is not None:
                    starts = {step.exposure.frame_id: step.exposure.first_step}
                    scene.log_restored(drawing, timebase, starts, [deblur(drawing.rig, step.exposure, focus)])
            if not drawing.has(entities.TRUE_SCENE):
                scene.log_true_scene(drawing, self._true_scene)
        if (now_s := time.monotonic()) > self._said_s + _SAY_S or ended:
            self._said_s = now_s
            behind = f"{self._left_out} messages were left out: the view is too slow for this session."
            self.say(" so far", [behind] if self._left_out else [])
        if drawing.sent != self._laid_out:
            self._laid_out = set(drawing.sent)
            self.lay_out()


def main() -> None:
    """Draw the messages that come until there are no more."""
    coming = sys.stdin.buffer
    address, rig, estimators, true_scene = pickle.load(coming)
    stream = rr.RecordingStream(APPLICATION)
    if address.startswith("rerun+http"):
        stream.connect_grpc(address)
    else:
        stream.save(address)
    stream.send_recording_name(f"{rig.name} · live")
    sender = LiveSender(stream, rig, estimators, true_scene)
    sender.lay_out()  # Rerun would make one of its own, of all entities
    print("ready", flush=True)
    with suppress(EOFError):
        while True:
            missing, batch = pickle.load(coming)
            if missing:
                sender.leave_out(missing)
            for raw in batch:
                take_raw(sender, raw)
            sender.draw()
    sender.draw(ended=True)
    stream.flush(timeout_sec=_FLUSH_S)
    stream.disconnect()


def take_raw(sender: LiveSender, raw: RawMessage) -> None:
    """Give a message, as bytes, to a sender."""
    sender.take(raw.topic, raw.log_time_ns, topics.SCHEMAS[raw.schema].FromString(raw.data))
