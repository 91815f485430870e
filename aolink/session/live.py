"""Exposures on their way through a session: to the estimators, and with the estimates to the controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from aolink.devices.interfaces import Time
from aolink.estimation import Estimate
from aolink.estimation.verdict import Fit
from aolink.exposure import Exposure
from aolink.recording import convert, topics
from aolink.recording import schemas_pb2 as pb
from aolink.recording.exposures import ExposureAssembly
from aolink.rig import Rig
from aolink.session.estimating import Estimating, Outcome
from aolink.session.journal import Journal
from aolink.session.report import LatencyBook

TellController = Callable[[Exposure, Estimate | None, int], None]
"""A function that gives the controller an exposure, the estimate that serves it, and the log time, ns."""


class LiveExposures:
    """Hands exposures over as they come, and records the estimates of them.

    ``serves`` is the estimator whose estimates ``control`` gets; where it is empty, ``control`` gets each exposure at
    once.
    """

    def __init__(
        self, rig: Rig, time: Time, journal: Journal, latencies: LatencyBook, estimating: Estimating,
        control: TellController | None, serves: str,
    ) -> None:  # fmt: skip
        self._rig, self._time, self._journal, self._latencies = rig, time, journal, latencies
        self._report, self._assembly = journal.report, ExposureAssembly(rig)
        self._estimating, self._control, self._serves = estimating, control, serves
        self.newest_frame = 0
        """The newest frame that commands can depend on."""
        self._working: dict[int, int] = {}
        """How many estimators are still working on an exposure, by frame."""
        self._unknown: set[int] = set()
        """Frames of these that have no estimate yet."""
        self._hanging: set[str] = set()
        """The estimators that hang."""

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take the next message of the session; a report or a frame may complete exposures."""
        if exposures := self._assembly.take(topic, message):
            self._take_exposures(exposures, time_ns)

    def flush(self, now_ns: int) -> None:
        """Take the exposures that are still incomplete at the session's end."""
        self._take_exposures(self._assembly.flush(), now_ns)

    def _take_exposures(self, exposures: Sequence[Exposure], log_time_ns: int) -> None:
        for exposure in exposures:
            self._report.exposures += 1
            self._assembly.number(exposure)  # it keeps the number until then
            self._unknown.add(exposure.frame_id)
            if names := self._estimating.names:
                self._working[exposure.frame_id] = len(names)
            outcomes = self._estimating.offer(exposure)
            if self._control is not None and not self._serves:
                self._control(exposure, None, log_time_ns)
            if not names:
                self._know(exposure.frame_id, self._time.now_ns())
            self._take_outcomes(outcomes, log_time_ns)

    def take_estimates(self) -> None:
        """Take the estimates that have become known, and warn of an estimator that hangs."""
        self._take_outcomes(self._estimating.outcomes(), self._time.now_ns())
        hanging = self._estimating.hanging
        for name in hanging.keys() - self._hanging:
            self._journal.warn(f"the estimator {name} hangs, its exposures are skipped: {hanging[name]}")
        self._hanging = {*hanging}

    def finish(self, patience_s: float) -> None:
        """Wait for the estimates under way, and record exposures without an estimate as skipped."""
        self._take_outcomes(self._estimating.finish(patience_s), self._time.now_ns())
        self._note_failures()

    def _take_outcomes(self, outcomes: Sequence[Outcome], log_time_ns: int) -> None:
        for outcome in outcomes:
            name, frame_id, message = outcome.estimator, outcome.exposure.frame_id, outcome.message
            if message is not None:
                self._journal.take(topics.estimate_topic(name), log_time_ns, message)
                self._say_verdict(name, message)
                if self._control is not None and name == self._serves:
                    self._control(outcome.exposure, outcome.estimate(self._rig), log_time_ns)
            if name in self._report.estimation:
                self._report.estimation[name].add(outcome)
                self._journal.take(topics.estimation_topic(name), log_time_ns, outcome.account())
            if message is not None and frame_id in self._unknown:
                self._know(frame_id, self._time.now_ns())
            if message is None:
                self._note_failures()
            self._working[frame_id] -= 1
            if not self._working[frame_id]:
                del self._working[frame_id]
                if frame_id in self._unknown:  # all have skipped it
                    self._know(frame_id, 0)

    def _say_verdict(self, name: str, message: pb.Estimate) -> None:
        """Say that the model no longer fits, or that it does."""
        verdict = convert.verdict_of(message)
        if verdict is not None and verdict.begins_with(message.frame_id):
            say = self._journal.warn if verdict.fit is Fit.DOES_NOT_FIT else self._journal.log
            say(f"{name}, from frame {message.frame_id} on: {verdict.text}")

    def _note_failures(self) -> None:
        for name, why in self._estimating.failures.items():
            if not self._report.estimation[name].failed:
                self._report.estimation[name].failed = why
                text = f"the estimator {name} failed, the recording goes on without it: {why}"
                self._journal.warn(text, Log.ERROR)

    def _know(self, frame_id: int, estimated_ns: int) -> None:
        """Note that commands from now on depend on a frame: its first estimate is there, or there will be none."""
        self._unknown.discard(frame_id)
        self.newest_frame = max(self.newest_frame, frame_id)
        self._latencies.estimated(frame_id, estimated_ns, self._time.now_ns())
