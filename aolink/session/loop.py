"""The live loop: joins devices, recorder and estimators.

One thread waits for both devices; their messages are recorded, made into exposures and handed to the estimators, which
in real time run beside the loop. Commands go out in blocks ahead of time, so the loop's own jitter does not reach the
mirror. The same loop runs in real time and on virtual time; on virtual time it sends whenever the rig waits.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial

from foxglove_schemas_protobuf.Log_pb2 import Log

from aolink.assembly import Frame
from aolink.devices import interfaces
from aolink.devices.clock import QUERY_PERIOD_S, SUSPICION_PERIOD_S, WARM_UP_QUERIES
from aolink.devices.interfaces import Camera, ClockSampled, CommandAnswered, Device, Event, Mirror, Returned, Time
from aolink.errors import DeviceError, PortError
from aolink.estimation import Driver
from aolink.recording import topics
from aolink.recording.account import REFUSALS, Account
from aolink.recording.writer import RecordingWriter
from aolink.rig import Rig
from aolink.session.commanding import Commanding, Inputs, lead_steps
from aolink.session.controlling import Controlling
from aolink.session.estimating import Estimating, InTheLoop
from aolink.session.journal import Journal, View, command_answer
from aolink.session.live import LiveExposures
from aolink.session.received import ReceivedFrames
from aolink.session.report import EstimatorReport, LatencyBook, Report
from aolink.wire import messages_pb2 as wire

_START_DELAY_S = 0.25
"""In real time, the least time from the first command to its first step, s; with a long queue it is the queue's length,
so that the queue is full then."""
_START_TRIES = 5
_STATISTICS_PERIOD_S = 1.0
ANSWER_NS = 200_000_000
"""How long the start waits for the answer to one clock query."""
_GRACE_S = 1.5
"""In real time, how long a frame may take after its exposure's end before it counts as lost, s."""
_FIRST_FRAME_S = 5.0
"""In real time, how long a camera may take until its first frame, s: some start slowly, above all on a busy machine."""
_HELD_UP_S = 1.0
"""In real time, a turn of the loop that takes longer is one in which this process did not run, s."""
_KEEP_ALIVES = 3
"""Least number of messages that a mirror is sent in the time of its watchdog."""
_OUTAGE_WATCHDOGS = 2.0
"""A mirror that answers nothing for this many times its watchdog's time ends the session."""
ESTIMATES_S = 5.0
"""In real time, how long the session's end waits for estimates that are under way, s."""
_NOT_YET = 1 << 63
"""The first fast step of a session that has not begun."""


class SessionLoop:
    """One session, from the first command to the last frame."""

    def __init__(
        self, rig: Rig, time: Time, camera: Camera, mirror: Mirror, writer: RecordingWriter, driver: Driver,
        inputs: Inputs | None = None, views: Sequence[View] = (), beside: Estimating | None = None,
        report: Report | None = None, controlling: Controlling | None = None,
    ) -> None:  # fmt: skip
        self.report = report or Report()
        self.report.virtual_time = time.virtual
        self._rig, self._time, self._camera, self._mirror = rig, time, camera, mirror
        self._estimating = beside or InTheLoop(driver)
        if beside is not None:
            self.report.estimation |= {name: EstimatorReport() for name in beside.names}
        self._controlling = controlling
        if controlling is not None:
            self.report.control = controlling.report
        self._step_ns = rig.timing.fast_step_ns
        self._first_step = _NOT_YET
        self._devices: list[Camera | Mirror] = [camera, mirror] if mirror.commanded else [camera]
        """The devices in the order in which their clocks are queried; the next one first."""
        self._last_query_ns = self._next_statistics_ns = 0
        self._last_frame_ns = 0
        self._turn_ns = self._held_up_until_ns = 0
        """Host times: when this turn of the loop began, and when this process went on after it last did not run."""
        self._catching_up = False
        """Whether nothing is commanded, until the mirror's clock says in which fast step it is after a hold-up."""
        self._end_step: int | None = None
        """First fast step after the session; None if it goes on until it is stopped."""
        self._parked_from: int | None = None
        """First fast step of the safe state, once the mirror has confirmed that `make_safe` has parked it."""
        self._camera_stopped = False
        self._absent: list[Device] = []
        """Devices whose port has vanished, until the session goes on with them."""
        self._returned: list[Device] = []
        """Vanished devices that have been identified again; their clocks are being queried."""
        self._account = Account(self.report.commands)
        self._journal = Journal(writer, self.report, time)
        self._latencies = LatencyBook(
            self.report, partial(self._journal.take, topics.LATENCY), commanded=mirror.commanded
        )
        self._frames = ReceivedFrames(rig, time, camera, mirror, self._journal, self._latencies)
        self._commanding = Commanding(rig, time, mirror, inputs, controlling, self._journal, self._latencies)
        control, serves = (None, "") if controlling is None else (self._commanding.control, controlling.estimator)
        self._live = LiveExposures(rig, time, self._journal, self._latencies, self._estimating, control, serves)
        shown = [self._journal.shown_by(each) for each in views]
        controls = [controlling] if controlling is not None else []
        # The account first: the recorder may be what has failed. The exposures last: they make messages themselves.
        self._journal.sinks += [self._account, writer, *shown, *controls, self._live]

    def run(self, exposures: int, stop: Callable[[], bool], progress: Callable[[int], None]) -> None:
        self._estimating.get_ready(stop)
        self._warm_up_clocks(stop)
        if stop():
            self.report.ended = "interrupted"
            self.make_safe()
            return
        timing, time = self._rig.timing, self._time
        if self._mirror.latched:
            self._rearm("in a session before")
        self._first_step = self._start_camera(self._soon, lambda first_step: exposures)
        if self._controlling is not None:
            self._controlling.begin(self._first_step)
        if exposures:
            self._end_step = self._first_step + (exposures - 1) * timing.frame_period_steps + timing.exposure_steps
            self._end_step += self._rig.readout_steps
        self._commanding.begin(self._first_step, self._end_step)
        self._receive(0.0)
        self._last_frame_ns = self._turn_ns = time.now_ns()
        self._journal.log(f"session of {exposures or 'unlimited'} exposures from fast step {self._first_step}")
        self.report.ended = "interrupted"
        while not stop():
            self._receive(self._send_due())
            progress(self.report.exposures)
            self._go_on_after_hold_up()
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

    def finish_estimates(self, patience_s: float = ESTIMATES_S) -> None:
        """Wait for the estimates under way, and record exposures without an estimate as skipped."""
        self._live.finish(patience_s)

    def _receive(self, timeout_s: float) -> int:
        """Handle the events of the next ``timeout_s``; gives the number of clock queries that were answered."""
        answers = 0
        for device, events, receive_ns in self._time.events(timeout_s):
            answers += sum(isinstance(event, ClockSampled) for event in events)
            self._take(device, events, receive_ns)
        self._live.take_estimates()
        return answers

    def _warm_up_clocks(self, stop: Callable[[], bool]) -> None:
        for _ in range(2 * WARM_UP_QUERIES):
            if stop():
                return
            self._query_next_clock(self._time.now_ns())
            deadline_ns = self._time.now_ns() + ANSWER_NS
            while not self._receive(0.05) and not self._time.virtual and self._time.now_ns() < deadline_ns:
                pass
        for device in self._devices:
            if not device.clock.ready:
                raise DeviceError(f"the {device.name} does not answer clock queries: is it still connected?")
        self._next_statistics_ns = self._time.now_ns() + round(_STATISTICS_PERIOD_S * 1e9)

    def _query_next_clock(self, now: int) -> None:
        """Query the clocks of camera and mirror in turn, so that one query does not wait for the other."""
        asked = self._devices.pop(0)
        self._devices.append(asked)
        asked.query_clock(now)
        self._last_query_ns = now

    def _next_query_ns(self) -> int:
        """The time of the next query of one of the two clocks: soon where one may have been set, so that this is
        decided soon."""
        suspected = self._camera.clock.suspected or self._mirror.clock.suspected
        return self._last_query_ns + round((SUSPICION_PERIOD_S if suspected else QUERY_PERIOD_S) / 2 * 1e9)

    def _soon(self) -> int:
        """The first fast step of a session that is about to begin."""
        step = self._mirror.start_step(self._time.now_ns())
        if self._time.virtual:
            return step
        return step + max(round(_START_DELAY_S * 1e9) // self._step_ns, lead_steps(self._rig.mirror))

    def _start_camera(self, begin: Callable[[], int], exposures: Callable[[int], int]) -> int:
        """Start the camera at the fast step ``begin()``, for ``exposures`` from that step on; gives the step."""
        for _ in range(_START_TRIES):
            first_step = begin()
            if self._camera.start(first_step, exposures(first_step)):
                return first_step
        raise DeviceError(
            f"the camera was asked {_START_TRIES} times to start {_START_DELAY_S:g} s later or more, each time it came"
            " too late: is the line or this machine so slow, do both devices count the same fast steps?"
        )

    def _send_due(self) -> float:
        """Send what is due; gives the time until something is due again, s."""
        time = self._time
        for device in [each for each in self._returned if not each.clock.suspected]:
            self._go_on_with(device)
        is_there = self._mirror not in self._absent
        if self._catching_up and not (self._mirror.clock.suspected and self._was_held_up()):
            self._catching_up = False
            self._commanding.catch_up()
        if self._mirror.latched and is_there:
            self._rearm("in this session")
        now, due_ns = time.now_ns(), self._mirror.next_due_ns() if is_there else None
        if due_ns is not None and time.virtual:  # the rig has handled everything, so this frame was lost
            time.elapse_until(due_ns)
            now = time.now_ns()
        if due_ns is not None and due_ns <= now:
            self._take(self._mirror, self._mirror.serve(now), now)
        if now >= self._next_query_ns():
            self._query_next_clock(now)
        if not time.virtual and now >= self._keep_alive_ns():
            self._mirror.query_clock(now)
        if now >= self._next_statistics_ns:
            self._note_statistics(now)
            self._next_statistics_ns = now + round(_STATISTICS_PERIOD_S * 1e9)
        if is_there and not self._catching_up and not (time.virtual and self._mirror.in_flight):
            self._commanding.send(self._live.newest_frame)
        if time.virtual:
            return 0.0
        due = [self._next_query_ns() - now, self._keep_alive_ns() - now]
        if is_there and (due_steps := self._commanding.due_steps()) is not None:
            due.append(due_steps * self._step_ns)
        if is_there and (due_ns := self._mirror.next_due_ns()) is not None:
            due.append(due_ns - now)
        return max(0, min(due)) / 1e9

    def _go_on_after_hold_up(self) -> None:
        """Where this turn of the loop took so long that this process cannot have run, say so and go on."""
        now = self._time.now_ns()
        turn_ns, self._turn_ns = now - self._turn_ns, now
        if self._time.virtual or turn_ns < _HELD_UP_S * 1e9:
            return
        self._held_up_until_ns = now
        self._last_frame_ns += turn_ns
        self._journal.warn(
            f"the session was held up for {turn_ns / 1e9:.1f} s after {self.report.exposures} exposure(s): its process"
            " was stopped, or the computer slept or was too busy; what came meanwhile may be lost"
        )
        if self._mirror.commanded:
            self._catching_up = True
            self._mirror.clock.suspect(self._step_ns, now)

    def _was_held_up(self) -> bool:
        """Whether that is so short a time ago that what has come meanwhile may not have been read."""
        return self._time.now_ns() - self._held_up_until_ns < _GRACE_S * 1e9

    def _keep_alive_ns(self) -> int:
        """Host time by which the mirror must be sent something, command or not."""
        return self._mirror.last_sent_ns + round(self._rig.mirror.watchdog_s * 1e9 / _KEEP_ALIVES)

    def _rearm(self, when: str) -> None:
        """Re-arm a mirror that its watchdog has parked; one that answers nothing for too long has ended the session."""
        outage_s, step = self._mirror.outage_s, self._mirror.rearm()
        self.report.rearmed += 1
        out = f", {outage_s:.2f} s after its last command" if outage_s else ""
        parked = f"the mirror was parked by its watchdog {when}"
        self._journal.log(f"{parked}: re-armed at fast step {step}{out}", Log.WARNING)
        self._commanding.go_back_to(step)  # the queued inputs are dropped
        self._turn_ns = self._time.now_ns()  # until now it was the mirror that was waited for

    def _vanished(self, device: Device, why: str) -> None:
        if device not in self._absent:
            self._absent.append(device)
        if device in self._returned:
            self._returned.remove(device)
        self.report.ports_vanished += 1
        self._journal.log(f"the port of the {device.name} has vanished; the session waits for it: {why}", Log.WARNING)

    def _has_returned(self, device: Device, away_s: float) -> None:
        self._returned.append(device)
        self.report.away_s += away_s
        self._journal.log(f"the {device.name} has returned {away_s:.2f} s after its port had vanished", Log.WARNING)

    def _go_on_with(self, device: Device) -> None:
        """Go on with a device that has returned: it takes no frames, or is parked, since it was opened again."""
        self._returned.remove(device)
        self._absent.remove(device)
        try:
            if device is self._camera:
                self._go_on_with_camera()
            else:
                if self._mirror.latched:
                    self._rearm("while its port was gone")
                step = self._commanding.go_on()
                self._journal.log(f"commands to the mirror go on from fast step {step}")
        except PortError:
            self._absent.append(device)  # it has vanished again, and the session waits for it as before

    def _go_on_with_camera(self) -> None:
        """Start the camera again with the next exposure of its schedule."""
        timing, first, end = self._rig.timing, self._first_step, self._end_step
        period = timing.frame_period_steps

        def begin() -> int:
            soon = self._commanding.device_step() + round(_START_DELAY_S * 1e9) // self._step_ns
            return first + max(0, -(-(soon - first) // period)) * period

        def left(first_step: int) -> int:
            return (
                0
                if end is None
                else max(0, (end - timing.exposure_steps - self._rig.readout_steps - first_step) // period + 1)
            )

        if end is None or left(begin()):
            step = self._start_camera(begin, left)
            self._journal.log(f"the camera goes on with the exposure from fast step {step}")
        self._frames.camera_restarted()
        self._last_frame_ns = self._turn_ns = self._time.now_ns()

    def _is_over(self, exposures: int) -> bool:
        if self._time.virtual:
            all_sent = self._end_step is not None and self._commanding.queued_until >= self._end_step
            return all_sent and not self._mirror.in_flight
        now, timing = self._time.now_ns(), self._rig.timing
        if self._absent:
            self._last_frame_ns = now
            return False
        if self._end_step is not None:
            late_step = self._end_step + _GRACE_S * 1e9 / self._step_ns
            is_late = self._commanding.device_step() > late_step
            if self.report.exposures >= exposures:
                return True
            if is_late and self.report.frames_received and not self._was_held_up():
                return True
        patience_ns = 3 * timing.frame_period_steps * self._step_ns + (_GRACE_S + _START_DELAY_S) * 1e9
        # A camera and a mirror of one device are held up together, and the mirror is waited for that long.
        patience_ns = max(patience_ns, _OUTAGE_WATCHDOGS * self._rig.mirror.watchdog_s * 1e9)
        patience_ns = max(patience_ns, 0 if self.report.frames_received else _FIRST_FRAME_S * 1e9)
        if now - self._last_frame_ns > patience_ns:
            raise DeviceError(
                f"the camera has sent no frame for {(now - self._last_frame_ns) / 1e9:.1f} s: is it still connected?"
            )
        return False

    def _finish(self, exposures: int) -> None:
        """Take the messages that are still on their way when the last command has been applied, and end the session."""
        self._receive(0.0)
        self._collect_reports()
        now = self._time.now_ns()
        self._take(self._camera, list(self._camera.flush()), now)
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
        end, now = self._commanding.queued_until, self._time.now_ns()
        end = end if self._parked_from is None else min(end, self._parked_from)
        self._take(self._mirror, self._mirror.await_reports(end, now), now)
        while (due_ns := self._mirror.next_due_ns()) is not None:
            self._time.elapse_until(due_ns)
            now = self._time.now_ns()
            if due_ns <= now:
                self._take(self._mirror, self._mirror.serve(now), now)
            self._receive(max(0, due_ns - now) / 1e9)

    def _take(self, device: Device, events: Sequence[Event], receive_ns: int) -> None:
        for event in events:
            if isinstance(event, Frame):
                if event.first_step >= self._first_step:  # not one of an earlier session
                    self._take_frame(event, receive_ns)
            elif isinstance(event, wire.Applied):
                self._take_applied(event, receive_ns)
            elif isinstance(event, wire.Truth):
                self._journal.take(topics.TRUTH, receive_ns, event)
            elif isinstance(event, ClockSampled):
                self._journal.clock(device, event)
            elif isinstance(event, CommandAnswered):
                self._take_answer(event, receive_ns)
            elif isinstance(event, interfaces.Vanished):
                self._vanished(device, event.why)
            elif isinstance(event, Returned):
                self._has_returned(device, event.away_s)
            else:
                level = {wire.Event.INFO: Log.INFO, wire.Event.WARNING: Log.WARNING}.get(event.level, Log.ERROR)
                self._journal.log(f"{device.name}: {event.text}", level)

    def _take_frame(self, frame: Frame, receive_ns: int) -> None:
        if not frame.plane:
            self._last_frame_ns = receive_ns
            if self._mirror.commanded and not self._time.virtual:
                # A mirror may report nothing at all, so that no gap shows.
                late = frame.first_step - round(_GRACE_S * 1e9) // self._step_ns
                self._take(self._mirror, self._mirror.await_reports(late, receive_ns), receive_ns)
        self._frames.take(frame, receive_ns)

    def _take_applied(self, applied: wire.Applied, receive_ns: int) -> None:
        is_report = applied.source not in (wire.Applied.AWAITED, wire.Applied.NOT_REPORTED)
        if is_report and applied.first_step >= self._first_step:  # not before the clock is known
            since_zero_ns = (applied.first_step + applied.n_steps) * self._step_ns
            end_ns, _ = self._mirror.host_ns(applied.device_ns, since_zero_ns, receive_ns)
            if applied.block_id and not self._time.virtual:
                self._latencies.applied(applied.block_id, end_ns - applied.n_steps * self._step_ns, receive_ns)
        if applied.source in (wire.Applied.PARKED, wire.Applied.WATCHDOG):
            end = applied.first_step + applied.n_steps
            end = end if self._end_step is None else min(end, self._end_step)
            self.report.steps_parked += max(0, end - max(applied.first_step, self._first_step))  # of this session
        self._journal.take(topics.APPLIED, receive_ns, applied)

    def _take_answer(self, answer: CommandAnswered, receive_ns: int) -> None:
        ack, message = answer.ack, command_answer(self._mirror, answer, receive_ns)
        self._journal.take(topics.ANSWER, receive_ns, message)
        if ack is None:
            return
        self._latencies.acknowledged(ack.block_id, receive_ns)
        if message.answer in REFUSALS and ack.code != wire.LATCHED:
            raise DeviceError(
                f"the mirror refused command block {ack.block_id} from fast step {answer.block.first_step}:"
                f" {ack.text or wire.Code.Name(ack.code)}"
            )

    def _note_statistics(self, now: int) -> None:
        self._count_tries()
        self._journal.statistics(self._devices, now)
        self._journal.disk()
        self.report.chunks_refused = self._camera.chunks_refused

    def _count_tries(self) -> None:
        counts = self._mirror.statistics()
        self.report.blocks_retransmitted = counts.get("retransmits", 0)
        self.report.reports_asked = counts.get("reports_asked", 0)
