"""The live loop: joins devices, recorder and estimators.

One thread waits for both devices; their messages are recorded, made into exposures and handed to the estimators, which
in real time run beside the loop. Commands go out in blocks ahead of time, so the loop's own jitter does not reach the
mirror. The same loop runs in real time and on virtual time; on virtual time it sends whenever the rig waits.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial

from aolink.devices.interfaces import Camera, ClockSampled, Mirror, Time
from aolink.errors import DeviceError
from aolink.estimation import Driver
from aolink.recording import topics
from aolink.recording.account import Account
from aolink.recording.exposures import ASSEMBLED
from aolink.recording.writer import RecordingWriter
from aolink.rig import Rig
from aolink.session.clocks import ClockQueries
from aolink.session.commanding import Commanding, Inputs
from aolink.session.controlling import Controlling
from aolink.session.estimating import Estimating, InTheLoop
from aolink.session.interruptions import Interruptions
from aolink.session.journal import Journal, View
from aolink.session.live import LiveExposures
from aolink.session.received import Received, command_answer
from aolink.session.report import EstimatorReport, LatencyBook, Report
from aolink.session.schedule import Schedule
from aolink.timeouts import TIMEOUTS


class SessionLoop:
    """One session, from the first command to the last frame."""

    def __init__(
        self, rig: Rig, time: Time, camera: Camera, mirror: Mirror, writer: RecordingWriter, driver: Driver,
        inputs: Inputs | None = None, views: Sequence[View] = (), beside: Estimating | None = None,
        report: Report | None = None, controlling: Controlling | None = None,
    ) -> None:  # fmt: skip
        self.report = report or Report()
        self.report.virtual_time = time.virtual
        if beside is not None:
            self.report.estimation |= {name: EstimatorReport() for name in beside.names}
        if controlling is not None:
            self.report.control = controlling.report
        self._rig, self._time, self._camera, self._mirror = rig, time, camera, mirror
        self._estimating, self._controlling = beside or InTheLoop(driver), controlling
        self._account = Account(self.report.commands)
        self._journal = journal = Journal(writer, self.report, time)
        self._latencies = LatencyBook(self.report, partial(journal.take, topics.LATENCY), commanded=mirror.commanded)
        self._schedule = Schedule(rig, time, camera, mirror)
        self._commanding = Commanding(rig, time, mirror, inputs, controlling, journal, self._latencies)
        self._received = Received(rig, time, camera, mirror, journal, self._latencies, self._schedule)
        self._interruptions = Interruptions(
            rig, time, camera, mirror, journal, self._schedule, self._commanding, self._received
        )
        control, serves = (None, "") if controlling is None else (self._commanding.control, controlling.estimator)
        self._live = LiveExposures(rig, time, journal, self._latencies, self._estimating, control, serves)
        self._clocks = ClockQueries(time, [camera, mirror] if mirror.commanded else [camera])
        self._next_statistics_ns = 0
        self._parked_from: int | None = None
        """First fast step of the safe state, once the mirror has confirmed that `make_safe` has parked it."""
        self._camera_stopped = False
        # The account first: the recorder may be what has failed. The exposures last: they make messages themselves.
        journal.add(self._account, topics.COMMAND, topics.ANSWER, topics.APPLIED)
        journal.add(writer)
        for view in views:
            journal.show(view)
        if controlling is not None:
            journal.add(controlling, topics.COMMAND, topics.APPLIED)
        journal.add(self._live, *ASSEMBLED)

    def run(self, exposures: int, stop: Callable[[], bool], progress: Callable[[int], None]) -> None:
        """Wait, handle what comes, send what is due, until the last of the exposures (0: for ever) or ``stop()``."""
        self._estimating.get_ready(stop)
        self._clocks.warm_up(self._receive, stop)
        self.report.ended = "interrupted"
        if stop():
            self.make_safe()
            return
        self._begin(exposures)
        while not stop():
            self._receive(self._send_due())
            progress(self.report.exposures)
            self._interruptions.begin_turn()
            if self._is_over(exposures):
                self.report.ended = "complete"
                break
        self.make_safe()
        self._finish(exposures)

    def make_safe(self) -> None:
        """Park the mirror and stop the camera; try both even if one cannot be reached. Called again, after an error or
        an interruption, it asks for what has not been confirmed."""
        self._commanding.ended = True
        try:
            if self._parked_from is None:
                self._parked_from = self._mirror.park()
        finally:
            if not self._camera_stopped:
                self._camera.stop()
                self._camera_stopped = True

    def close_account(self) -> None:
        """End each commanded step that is still open: no more answers and reports of the mirror will come."""
        now = self._time.now_ns()
        with contextlib.ExitStack() as every:  # also where the recorder has failed
            every.callback(self._count_tries)
            every.callback(self._account.close)
            if self._parked_from is not None:
                every.callback(self._account.parked_from, self._parked_from)
            for each in reversed(list(self._mirror.last_answers())):
                every.callback(self._journal.take, topics.ANSWER, now, command_answer(self._mirror, each, now))

    def finish_estimates(self, patience_s: float = TIMEOUTS.estimates_s) -> None:
        """Wait for the estimates under way, and record exposures without an estimate as skipped."""
        self._live.finish(patience_s)

    def _receive(self, timeout_s: float) -> int:
        """Handle the events of the next ``timeout_s``; gives the number of clock queries that were answered."""
        answers = 0
        for device, events, receive_ns in self._time.events(timeout_s):
            answers += sum(isinstance(event, ClockSampled) for event in events)
            self._received.take(device, events, receive_ns)
        self._live.take_estimates()
        return answers

    def _begin(self, exposures: int) -> None:
        self._next_statistics_ns = self._time.now_ns() + round(TIMEOUTS.statistics_s * 1e9)
        if self._mirror.latched:
            self._interruptions.rearm("in a session before")
        self._schedule.begin(exposures)
        first_step = self._schedule.first_step
        if self._controlling is not None:
            self._controlling.begin(first_step)
        self._commanding.begin(first_step, self._schedule.end_step)
        self._receive(0.0)
        self._received.newest_frame_ns = self._time.now_ns()
        self._interruptions.waited()
        self._journal.log(f"session of {exposures or 'unlimited'} exposures from fast step {first_step}")

    def _send_due(self) -> float:
        """Send what is due; gives the time until something is due again, s."""
        time, mirror = self._time, self._mirror
        may_command = self._interruptions.may_command()
        is_there = mirror not in self._interruptions.absent
        now, due_ns = time.now_ns(), mirror.next_due_ns() if is_there else None
        if due_ns is not None and time.virtual:  # the rig has handled everything, so this frame was lost
            time.elapse_until(due_ns)
            now = time.now_ns()
        if due_ns is not None and due_ns <= now:
            self._received.take(mirror, mirror.serve(now), now)
        if now >= self._clocks.due_ns():
            self._clocks.ask(now)
        if not time.virtual and now >= self._keep_alive_ns():
            mirror.query_clock(now)
        if now >= self._next_statistics_ns:
            self._note_statistics(now)
            self._next_statistics_ns = now + round(TIMEOUTS.statistics_s * 1e9)
        if may_command and not (time.virtual and mirror.in_flight):
            self._commanding.send(self._live.newest_frame)
        if time.virtual:
            return 0.0
        due = [self._clocks.due_ns() - now, self._keep_alive_ns() - now]
        if is_there and (due_steps := self._commanding.due_steps()) is not None:
            due.append(due_steps * self._rig.timing.fast_step_ns)
        if is_there and (due_ns := mirror.next_due_ns()) is not None:
            due.append(due_ns - now)
        return max(0, min(due)) / 1e9

    def _keep_alive_ns(self) -> int:
        """Host time by which the mirror must be sent something, command or not."""
        return self._mirror.last_sent_ns + round(self._rig.mirror.watchdog_s * 1e9 / TIMEOUTS.keep_alives)

    def _is_over(self, exposures: int) -> bool:
        end_step = self._schedule.end_step
        if self._time.virtual:
            all_sent = end_step is not None and self._commanding.queued_until >= end_step
            return all_sent and not self._mirror.in_flight
        now, timing = self._time.now_ns(), self._rig.timing
        if self._interruptions.absent:
            self._received.newest_frame_ns = now
            return False
        if end_step is not None:
            late_step = end_step + TIMEOUTS.grace_s * 1e9 / timing.fast_step_ns
            is_late = self._commanding.device_step() > late_step
            if self.report.exposures >= exposures:
                return True
            if is_late and self.report.frames_received and not self._interruptions.was_held_up():
                return True
        silent_s = (now - self._received.newest_frame_ns) / 1e9
        patience_s = max(
            3 * timing.frame_period_steps * timing.fast_step_s + TIMEOUTS.grace_s + TIMEOUTS.start_delay_s,
            # A camera and a mirror of one device are held up together, and the mirror is waited for that long.
            TIMEOUTS.mirror_watchdogs * self._rig.mirror.watchdog_s,
            0 if self.report.frames_received else TIMEOUTS.first_frame_s,
        )
        if silent_s > patience_s:
            raise DeviceError(f"the camera has sent no frame for {silent_s:.1f} s: is it still connected?")
        return False

    def _finish(self, exposures: int) -> None:
        """Take the messages that are still on their way when the last command has been applied, and end the session."""
        self._receive(0.0)
        self._collect_reports()
        now = self._time.now_ns()
        self._received.take(self._camera, self._camera.flush(), now)
        self._live.flush(now)
        self.finish_estimates()
        self._latencies.close(self._time.now_ns())
        self.close_account()
        if exposures and self.report.ended == "complete":
            # A camera that goes on after a lost frame makes up for it; the gap is a lost frame all the same.
            self.report.frames_lost = max(self.report.frames_lost, exposures - self.report.frames_received)
            if self._rig.scene:
                self.report.scenes_lost = exposures - self.report.scenes_received
        self._note_statistics(now)
        self._journal.log(f"session {self.report.ended}: {self.report.exposures} exposures")

    def _collect_reports(self) -> None:
        """Request the reports that have not come, now that the mirror is parked."""
        end, now, mirror = self._commanding.queued_until, self._time.now_ns(), self._mirror
        end = end if self._parked_from is None else min(end, self._parked_from)
        self._received.take(mirror, mirror.await_reports(end, now), now)
        while (due_ns := mirror.next_due_ns()) is not None:
            self._time.elapse_until(due_ns)
            now = self._time.now_ns()
            if due_ns <= now:
                self._received.take(mirror, mirror.serve(now), now)
            self._receive(max(0, due_ns - now) / 1e9)

    def _note_statistics(self, now: int) -> None:
        self._count_tries()
        self._journal.statistics(self._clocks.devices, now)
        self._journal.disk()
        self.report.chunks_refused = self._camera.chunks_refused

    def _count_tries(self) -> None:
        counts = self._mirror.statistics()
        self.report.blocks_retransmitted = counts.get("retransmits", 0)
        self.report.reports_asked = counts.get("reports_asked", 0)
