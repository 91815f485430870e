"""Draws a session: its exposures with their estimates, and its other messages by the rows of `topics.TOPICS`. A
recording and a live session are drawn by it alike, part by part."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from itertools import groupby

import rerun as rr
from google.protobuf.message import Message

from aolink.colours import by_rank
from aolink.estimation.score import Scorer, score_table
from aolink.exposure import Exposure
from aolink.gathered import has_pupil, lost_before
from aolink.recording import topics
from aolink.recording.messages import RecordedMessage
from aolink.series import Step
from aolink.viewing import camera, devices, entities, incidents, motion, pupil, scene
from aolink.viewing.blueprint import blueprint
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import Timebase

_MOST_WAITING = 10_000
"""Messages that wait for the first exposure, which places them in time."""


class Sender:
    """Draws what comes since it was last asked to; a drawing's estimators are those that are drawn."""

    def __init__(self, drawing: Drawing) -> None:
        self.drawing = drawing
        drawing.estimators = by_rank(drawing.estimators)
        self.timebase: Timebase | None = None
        self.last: Exposure | None = None
        """The last exposure that was sent."""
        self.sent = self.lost = 0
        """Exposures that have been sent, and frames lost between them."""
        self._messages: deque[RecordedMessage] = deque(maxlen=_MOST_WAITING if drawing.live else None)
        self._scorers = {name: Scorer() for name in drawing.estimators}
        self._skipped: Counter[str] = Counter()

    def see(self, topic: str, time_ns: int, message: Message) -> None:
        """Take a message that is drawn as it is."""
        self._messages.append(RecordedMessage(topic, time_ns, 0, message))

    def send(self, steps: Sequence[Step], *, following: Exposure | None = None) -> Timebase:
        """Draw the next exposures, and the messages that have come; gives the timebase.

        ``following`` is the exposure after them, where it is known. There may be no exposure if there was one before.
        """
        timebase = self._send_exposures(steps, following) if steps else self.timebase
        assert timebase is not None
        by_topic = sorted(self._messages, key=lambda each: each.topic)
        self._messages.clear()
        for topic, records in groupby(by_topic, key=lambda each: each.topic):
            row, some = topics.named(topic), list(records)
            if row.curves:
                devices.log_curves(self.drawing, timebase, row, some)
            if shows := _shows(row):
                shows(self.drawing, timebase, some)
        return timebase

    def lay_out(self, *, alone: bool = False) -> None:
        """Send the layout for what has been drawn."""
        # Active too: a viewer that gets the data over the network would otherwise keep a layout of its own.
        layout = blueprint(self.drawing, alone=alone)
        self.drawing.stream.send_blueprint(layout, make_active=True, make_default=True)

    def say(self, part: str = "", lacks: Sequence[str] = ()) -> None:
        """Send a page of Markdown about the session: what it has and ``lacks``, and where the truth is known, the
        estimators' scores."""
        rig, timebase = self.drawing.rig, self.timebase
        assert timebase is not None
        steps = rig.timing.exposure_steps
        lines = [
            f"## {rig.name}",
            f"{self.sent} exposure{'s' if self.sent != 1 else ''}{part} of {steps} fast steps,"
            f" {steps * rig.timing.fast_step_s:g} s each; {self.lost} frames lost. The first began at"
            f" {timebase.origin_ns / 1e9:.6f} s of the camera's clock.",
            "",
        ]
        if self._scorers:
            found = score_table({name: scorer.result() for name, scorer in self._scorers.items()})
            heads = ["estimator", *found.heads]
            table = [heads, ["---"] * len(heads), *([name, *cells] for name, cells in found.rows.items())]
            lines += [*(f"| {' | '.join(cells)} |" for cells in table), "", *found.notes]
        if self._skipped:
            counts = ", ".join(f"{name} {count}" for name, count in self._skipped.items())
            lines += ["", f"Exposures skipped for want of time: {counts}"]
        text = "\n".join([*lines, "", " ".join(lacks), "", rig.summary])
        self.drawing.log(entities.SESSION, rr.TextDocument(text, media_type="text/markdown"))

    def _send_exposures(self, steps: Sequence[Step], following: Exposure | None) -> Timebase:
        drawing, exposures = self.drawing, [each.exposure for each in steps]
        before = self.timebase
        timebase = self.timebase = before.followed_by(exposures) if before else Timebase.of(drawing.rig, exposures)
        camera.log_camera(drawing, timebase, steps, following=following)
        motion.log_truth(drawing, timebase, steps)
        incidents.log_exposures(drawing, timebase, exposures, self.last)
        incidents.log_warnings(drawing, timebase, steps, self.last)
        for name in drawing.estimators:
            motion.log_estimates(drawing, timebase, name, steps)
            incidents.log_status(drawing, timebase, name, steps)
        if has_pupil(drawing.rig):
            pupil.log_maps(drawing, timebase, steps)
        scene.log_scenes(drawing, timebase, exposures)
        for each in steps:
            self._skipped.update(each.skipped)
            for name, estimate in each.estimates.items():
                self._scorers[name].add(each.exposure, estimate)
        self.lost += lost_before(exposures, self.last)
        self.last, self.sent = exposures[-1], self.sent + len(exposures)
        return timebase


def is_drawn(topic: str) -> bool:
    """Whether a topic's messages are drawn as they are, and not only as exposures, estimates or pictures."""
    row = topics.named(topic)
    return bool(row.curves) or _shows(row) is not None


def _shows(row: topics.Topic) -> Callable[[Drawing, Timebase, Sequence[RecordedMessage]], None] | None:
    """The function of `devices` that a topic's messages are handed to."""
    module, _, function = row.shown_by.partition(".")
    shows: Callable[[Drawing, Timebase, Sequence[RecordedMessage]], None] | None
    shows = getattr(devices, function) if module == "devices" else None
    return shows
