"""What comes from the devices of a session becomes messages: frames, reports and answers of the mirror, their clocks
and their texts. Each kind of event has its method here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any, cast

from foxglove_schemas_protobuf.Log_pb2 import Log

from aolink.assembly import Frame
from aolink.devices.interfaces import Camera, ClockSampled, CommandAnswered, Device, Event, Mirror, Time
from aolink.errors import DeviceError
from aolink.recording import convert, topics
from aolink.recording import schemas_pb2 as pb
from aolink.recording.account import REFUSALS
from aolink.rig import Rig
from aolink.session.journal import Journal
from aolink.session.report import LatencyBook
from aolink.session.schedule import Schedule
from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as wire

_ALIGNED = 0.2
"""Largest standard deviation of an exposure's alignment without a warning, as a part of the exposure: estimates'
intervals hold up to there."""
Handler = Callable[[Device, Any, int], None]
"""Takes an event of a device, with the time at which it came."""


class Received:
    """Makes messages of the devices' events; `handlers` may be given those of other events."""

    def __init__(
        self, rig: Rig, time: Time, camera: Camera, mirror: Mirror, journal: Journal, latencies: LatencyBook,
        schedule: Schedule,
    ) -> None:  # fmt: skip
        self._timing, self._time, self._camera, self._mirror = rig.timing, time, camera, mirror
        self._step_ns, self._exposure_ns = rig.timing.fast_step_ns, rig.timing.exposure_steps * rig.timing.fast_step_ns
        self._journal, self._latencies, self._schedule = journal, latencies, schedule
        self._check_alignment = mirror.commanded
        """Whether an exposure that is not aligned well enough is to be warned of."""
        self.newest_frame_ns = 0
        """When the newest frame came."""
        self._newest_steps: dict[int, int] = {}
        """First fast step of the newest frame, by its sensor's number on the wire."""
        self._restarted: set[int] = set()
        """Numbers of the sensors from which no frame has come since the camera was started again."""
        self.handlers: dict[type, Handler] = {
            Frame: self._frame, wire.Applied: self._applied, CommandAnswered: self._answer, ClockSampled: self._clock,
            wire.Truth: self._truth, wire.Event: self._text,
        }  # fmt: skip

    def take(self, device: Device, events: Sequence[Event], receive_ns: int) -> None:
        """Take the events of a device that came at one time."""
        for event in events:
            self.handlers[type(event)](device, event, receive_ns)

    def camera_restarted(self) -> None:
        """Note that the camera was started again: it does not number the exposures that it has missed."""
        self._restarted = set(self._newest_steps)

    def _frame(self, device: Device, frame: Frame, receive_ns: int) -> None:
        """A frame, with the host's time of its start and all frames lost before it."""
        if frame.first_step < self._schedule.first_step:  # of an earlier session
            return
        if not frame.plane:
            self.newest_frame_ns = receive_ns
            if self._mirror.commanded and not self._time.virtual:
                # A mirror may report nothing at all, so that no gap shows.
                late = frame.first_step - round(TIMEOUTS.grace_s * 1e9) // self._step_ns
                self.take(self._mirror, self._mirror.await_reports(late, receive_ns), receive_ns)
        before, lost = self._newest_steps.get(frame.plane), frame.frames_lost_before
        self._newest_steps[frame.plane] = frame.first_step
        if before is not None and frame.plane in self._restarted:
            self._restarted.remove(frame.plane)
            lost = max(lost, (frame.first_step - before) // self._timing.frame_period_steps - 1)
        since_zero_ns = frame.first_step * self._step_ns + frame.exposure_offset_ns
        length_ns = (frame.last_step + 1 - frame.first_step) * self._step_ns
        # The end's time first: it may raise the doubt about the start.
        device.host_ns(frame.device_end_ns, since_zero_ns + length_ns, receive_ns)
        start_ns, sigma_ns = device.host_ns(frame.device_start_ns, since_zero_ns, receive_ns)
        frame = replace(frame, frames_lost_before=lost, host_start_ns=start_ns, clock_sigma_ns=sigma_ns)
        kind, report = "scenes" if frame.plane else "frames", self._journal.report
        for name, count in {"received": 1, "incomplete": frame.chunks_lost > 0, "lost": lost}.items():
            setattr(report, f"{kind}_{name}", getattr(report, f"{kind}_{name}") + count)
        info, image = convert.frame_messages(frame)
        if frame.plane:
            self._journal.take(topics.SCENE_EXPOSURE, receive_ns, info)
            self._journal.take(topics.SCENE, receive_ns, image)
            return
        if self._check_alignment and frame.alignment_sigma_ns > _ALIGNED * self._exposure_ns:
            self._check_alignment = False
            report.warnings.append(
                "which of the mirror's fast steps an exposure covers is known only to"
                f" {frame.alignment_sigma_ns / self._exposure_ns:.2g} of an exposure (sd, frame {frame.frame_id}):"
                f" intervals of estimates are reliable up to {_ALIGNED:g}; give delay_s and delay_sd_s of the devices"
                " as well as they are known"
            )
        if not self._time.virtual:
            end_ns, _ = device.clock.host_ns(frame.device_end_ns)
            self._latencies.frame(
                pb.Latency(
                    frame_id=frame.frame_id, exposure_end_ns=end_ns, first_byte_ns=frame.host_first_byte_ns,
                    complete_ns=frame.host_receive_ns,
                )
            )  # fmt: skip
        self._journal.take(topics.EXPOSURE, receive_ns, info)
        self._journal.take(topics.IMAGE, receive_ns, image)

    def _applied(self, device: Device, applied: wire.Applied, receive_ns: int) -> None:
        end = applied.first_step + applied.n_steps
        is_report = applied.source not in (wire.Applied.AWAITED, wire.Applied.NOT_REPORTED)
        if is_report and applied.first_step >= self._schedule.first_step:  # not before the clock is known
            end_ns, _ = device.host_ns(applied.device_ns, end * self._step_ns, receive_ns)
            if applied.block_id and not self._time.virtual:
                self._latencies.applied(applied.block_id, end_ns - applied.n_steps * self._step_ns, receive_ns)
        if applied.source in (wire.Applied.PARKED, wire.Applied.WATCHDOG):  # of this session
            until = end if self._schedule.end_step is None else min(end, self._schedule.end_step)
            steps = until - max(applied.first_step, self._schedule.first_step)
            self._journal.report.steps_parked += max(0, steps)
        self._journal.take(topics.APPLIED, receive_ns, applied)

    def _answer(self, device: Device, answer: CommandAnswered, receive_ns: int) -> None:
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

    def _clock(self, device: Device, sampled: ClockSampled, receive_ns: int) -> None:
        """The comparison of a device's clock with the host's."""
        clock, exchange, report = device.clock, sampled.exchange, self._journal.report
        sample = pb.ClockSample(
            device=device.name, round_trip_ns=exchange.round_trip_ns, accepted=sampled.accepted, **asdict(exchange)
        )
        if clock.ready:
            _, sigma_ns = clock.device_ns(exchange.host_receive_ns)
            sample.offset_ns = clock.offset_ns(exchange.host_receive_ns)
            sample.frequency_ppm, sample.sigma_ns = clock.frequency_ppm, sigma_ns
            report.clock_offset_ns, report.clock_frequency_ppm = sample.offset_ns, sample.frequency_ppm
            report.clock_sigma_ns = sigma_ns
        self._journal.take(topics.CLOCK, exchange.host_receive_ns, sample)
        if (step := sampled.step) is not None:
            self._journal.warn(
                f"the {device.name}'s clock was set {'forward' if step.size_ns > 0 else 'back'} by"
                f" {abs(step.size_ns) / 1e9:.6f} s: host times of its stamps in the"
                f" {(step.before_ns - step.after_ns) / 1e9:.3f} s from {step.after_ns} ns on may be off by as much"
            )

    def _truth(self, device: Device, truth: wire.Truth, receive_ns: int) -> None:
        self._journal.take(topics.TRUTH, receive_ns, truth)

    def _text(self, device: Device, event: wire.Event, receive_ns: int) -> None:
        level = {wire.Event.INFO: Log.INFO, wire.Event.WARNING: Log.WARNING}.get(event.level, Log.ERROR)
        self._journal.log(f"{device.name}: {event.text}", level)


def command_answer(mirror: Mirror, answered: CommandAnswered, receive_ns: int) -> pb.CommandAnswer:
    """The mirror's answer to a command block as it is recorded, or that none came."""
    block, ack, kind, clock = answered.block, answered.ack, pb.CommandAnswer, mirror.clock
    message = kind(
        block_id=block.block_id, first_step=block.first_step, n_steps=block.n_steps, answer=kind.NONE,
        tries=answered.tries, times_full=answered.times_full, sent_ns=answered.sent_ns,
    )  # fmt: skip
    if ack is not None:
        message.answer = cast(pb.CommandAnswer.Answer, ack.code)
        message.text, message.answered_ns = ack.text, receive_ns
        message.late_steps, message.superseded_steps = ack.late_steps, ack.superseded_steps
        message.queue_end_step = ack.queue_end_step
        message.device_ns = clock.device_ns(receive_ns)[0] if clock.ready else 0
    return message
