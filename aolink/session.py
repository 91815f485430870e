"""The live loop: joins devices, recorder and estimators.

One thread waits on both ports; what comes is recorded, made into exposures and estimated. Commands go
out in blocks ahead of time, so the loop's own jitter does not reach the mirror. The same loop runs in
real time and on virtual time; on virtual time it sends whenever the rig waits.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from aolink.assembly import Assembler, Frame
from aolink.devices.interfaces import Camera, ClockSampled, CommandAnswered, Event, Mirror
from aolink.devices.native import NativeCamera, NativeMirror, check_against_rig, check_kind, identify
from aolink.errors import AolinkError, DeviceError
from aolink.estimation import Driver
from aolink.exposure import Exposure
from aolink.recording import convert, topics
from aolink.recording import schemas_pb2 as pb
from aolink.recording.writer import RecordingWriter
from aolink.rig import Drive, Rig
from aolink.wire import messages_pb2 as wire
from aolink.wire.clock import QUERY_PERIOD_S, WARM_UP_QUERIES
from aolink.wire.hub import Hub
from aolink.wire.link import Link
from aolink.wire.port import SerialPort

LEAD_BLOCKS = 3
"""Command blocks that are queued on the device ahead of time."""
_START_DELAY_S = 0.25
"""Real time: from the first command to its first step."""
_LINK_PERIOD_S = 1.0
_ANSWER_NS = 200_000_000
"""How long the start waits for the answer to one clock query."""
_GRACE_S = 1.5
"""Real time: how long a frame may take after its exposure's end before it counts as lost."""


@dataclass(kw_only=True)
class Report:
    """What a session did: its counts, and its latencies where time was real."""

    ended: str = "running"
    """complete, interrupted, or error: and what it was."""
    virtual_time: bool = False
    exposures: int = 0
    frames_received: int = 0
    frames_incomplete: int = 0
    """Received with chunks missing; their pixels are masked."""
    frames_lost: int = 0
    """Never received at all."""
    packets_bad_crc: int = 0
    packets_bad_framing: int = 0
    packets_missing: int = 0
    """Gaps in the sequence numbers of either device."""
    steps_commanded: int = 0
    steps_applied: int = 0
    steps_parked: int = 0
    """Steps of the session in which the mirror was parked for want of a command."""
    steps_late: int = 0
    steps_superseded: int = 0
    steps_clipped: int = 0
    blocks_retransmitted: int = 0
    clock_offset_ns: float = float("nan")
    clock_frequency_ppm: float = float("nan")
    clock_sigma_ns: float = float("nan")
    latencies: list[pb.Latency] = field(default_factory=list)

    def counts(self) -> dict[str, str]:
        """Everything but the latencies, as text, for the recording's metadata."""
        facts = asdict(self)
        del facts["latencies"]
        return {name: str(value) for name, value in facts.items()}


@contextlib.contextmanager
def open_devices(rig: Rig, camera_port: str, mirror_port: str) -> Iterator[tuple[Hub, NativeCamera, NativeMirror]]:
    """Open both ports, identify what is behind them, and check it against the rig file.

    Raises
    ------
    PortError
        A port cannot be opened.
    DeviceError
        No device answers, it is another one, speaks another protocol, or is not what the rig file says.
    """
    hub = Hub()
    try:
        camera_link = hub.connect("camera", SerialPort(camera_port))
        mirror_link = hub.connect("mirror", SerialPort(mirror_port))
        camera_identity = identify(hub, camera_link, secrets.randbits(48))
        check_kind(camera_link, camera_identity, wire.Identity.CAMERA)
        mirror_identity = identify(hub, mirror_link, secrets.randbits(48))
        check_kind(mirror_link, mirror_identity, wire.Identity.MIRROR)
        check_against_rig(rig, camera_identity, mirror_identity)
        if camera_identity.virtual_time:
            hub.go_virtual()
        for link in hub.links:
            link.reset_counts()
        yield hub, NativeCamera(hub, camera_link, camera_identity), NativeMirror(hub, mirror_link, mirror_identity)
    finally:
        hub.close()


def record(
    rig: Rig,
    camera_port: str,
    mirror_port: str,
    path: str | Path,
    *,
    estimators: Sequence[str] = (),
    exposures: int = 0,
    note: str = "",
    calibration: str = "",
    overwrite: bool = False,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda exposures: None,
) -> Report:
    """Record a session: play the rig's drive, record everything, run estimators on the way.

    Parameters
    ----------
    rig:
        What the devices are; checked against what they say of themselves.
    camera_port, mirror_port:
        Anything that pyserial opens: a device path, or an address such as socket://host:port.
    path:
        The recording; must not exist unless ``overwrite``.
    estimators:
        Names of estimators to run online; their results go into the recording.
    exposures:
        How many; 0 means until ``stop()``.
    calibration:
        What the camera is shown, of `aolink.calibration.KINDS`, if the frames are for `aolink calibrate`: the
        mirror then holds its parked input, whatever the rig's drive.
    stop, progress:
        Asked, and told the number of exposures so far, at least ten times a second.

    Raises
    ------
    AolinkError
        Of the kind that says what went wrong. The mirror is parked if it can be reached, and the
        recording is closed with what there is.
    """
    driver = Driver(rig, estimators)
    if calibration:
        rest = Drive(kind="none", amplitude=np.zeros(rig.n_inputs), period_s=1.0, offset=rig.mirror.park)
        rig = replace(rig, drive=rest)
    with open_devices(rig, camera_port, mirror_port) as (hub, camera, mirror):
        facts = {
            "aolink_version": version("aolink"),
            "rig": rig.name,
            "rig_digest": rig.digest,
            "camera": f"{camera.identity.model} {camera.identity.serial_number} ({camera.identity.firmware})",
            "mirror": f"{mirror.identity.model} {mirror.identity.serial_number} ({mirror.identity.firmware})",
            "virtual_time": str(hub.virtual),
            "estimators": " ".join(estimators),
            "note": note,
        }
        if calibration:
            facts[topics.CALIBRATION] = calibration
        writer = RecordingWriter(path, rig, facts, hub.now_ns(), overwrite=overwrite, deterministic=hub.virtual)
        session = _Session(rig, hub, camera, mirror, writer, driver)
        try:
            session.run(exposures, stop, progress)
        except BaseException as error:
            session.report.ended = f"error: {error}" if isinstance(error, AolinkError) else f"error: {error!r}"
            with contextlib.suppress(AolinkError):
                session.make_safe()
            with contextlib.suppress(AolinkError):
                writer.close(session.report.counts())
            raise
        writer.close(session.report.counts())
    return session.report


class _Session:
    """One session, from the first command to the last frame."""

    def __init__(
        self, rig: Rig, hub: Hub, camera: Camera, mirror: Mirror, writer: RecordingWriter, driver: Driver
    ) -> None:
        self.report = Report(virtual_time=hub.virtual)
        self._rig, self._hub, self._camera, self._mirror = rig, hub, camera, mirror
        self._writer, self._driver = writer, driver
        self._assembler = Assembler(rig)
        self._step_ns = rig.timing.fast_step_ns
        self._first_step = 0
        self._queued_until = 0
        """First fast step that no command was sent for."""
        self._newest_frame = 0
        self._asked: Camera | Mirror = camera
        """Whose clock is asked next."""
        self._next_query_ns = self._next_link_ns = 0
        self._last_frame_ns = 0
        self._latencies: dict[int, pb.Latency] = {}
        """Of frames whose first command is not acknowledged yet, by frame."""

    def run(self, exposures: int, stop: Callable[[], bool], progress: Callable[[int], None]) -> None:
        self._warm_up_clocks()
        timing, hub = self._rig.timing, self._hub
        self._first_step = self._queued_until = self._choose_first_step()
        end = self._first_step + (exposures - 1) * timing.frame_period_steps + timing.exposure_steps
        end_step = end if exposures else None
        self._camera.start(self._first_step, exposures)
        self._send_commands(end_step, self._first_step)  # queued before the first step is due
        self._receive(0.0)
        self._last_frame_ns = hub.now_ns()
        self._log(Log.INFO, f"session of {exposures or 'unlimited'} exposures from fast step {self._first_step}")
        self.report.ended = "interrupted"
        while not stop():
            self._receive(self._send_due(end_step))
            progress(self.report.exposures)
            if end_step is not None and self._is_over(exposures, end_step):
                self.report.ended = "complete"
                break
        self.make_safe()
        self._finish(exposures)

    def make_safe(self) -> None:
        """Park the mirror and stop the camera; try both even if one cannot be reached."""
        try:
            self._mirror.park()
        finally:
            self._camera.stop()

    def _receive(self, timeout_s: float) -> int:
        """Deal with what comes within ``timeout_s``; gives the number of clock queries that were answered."""
        answers = 0
        for link, received in self._hub.wait(timeout_s):
            events = self._device(link).handle(received)
            answers += sum(isinstance(event, ClockSampled) for event in events)
            self._take(link, events, received.receive_ns)
        return answers

    def _device(self, link: Link) -> Camera | Mirror:
        return self._camera if link is self._camera.link else self._mirror

    def _warm_up_clocks(self) -> None:
        for _ in range(2 * WARM_UP_QUERIES):
            self._query_next_clock(self._hub.now_ns())
            deadline_ns = self._hub.now_ns() + _ANSWER_NS
            while not self._receive(0.05) and not self._hub.virtual and self._hub.now_ns() < deadline_ns:
                pass
        for device in (self._camera, self._mirror):
            if not device.clock.ready:
                raise DeviceError(f"the {device.link.name} does not answer clock queries: is it still connected?")
        self._next_link_ns = self._hub.now_ns() + round(_LINK_PERIOD_S * 1e9)

    def _query_next_clock(self, now: int) -> None:
        """Camera and mirror in turn, so that the one's query does not wait for the other's."""
        self._asked, asked = (self._mirror if self._asked is self._camera else self._camera), self._asked
        asked.query_clock(now)
        self._next_query_ns = now + round(QUERY_PERIOD_S / 2 * 1e9)

    def _choose_first_step(self) -> int:
        if self._hub.virtual:
            return self._mirror.identity.next_step
        return self._device_step() + round(_START_DELAY_S * 1e9) // self._step_ns

    def _device_step(self) -> int:
        """The fast step that the device is in: by its clock, or on virtual time the one that it waits at."""
        if self._hub.virtual:
            return self._queued_until
        device_ns, _ = self._mirror.clock.device_ns(self._hub.now_ns())
        return (device_ns - self._mirror.identity.step_zero_ns) // self._step_ns

    def _send_due(self, end_step: int | None) -> float:
        """Send what is due; gives the time until the next thing is, s."""
        hub, now = self._hub, self._hub.now_ns()
        timeout_ns = self._mirror.next_timeout_ns()
        if timeout_ns is not None and hub.virtual:  # the rig has dealt with everything, so this one was lost
            hub.elapse_until(timeout_ns)
            now = hub.now_ns()
        if timeout_ns is not None and timeout_ns <= now:
            self._mirror.retransmit(now)
        if now >= self._next_query_ns:
            self._query_next_clock(now)
        if now >= self._next_link_ns:
            self._record_links(now)
            self._next_link_ns = now + round(_LINK_PERIOD_S * 1e9)
        if not (hub.virtual and self._mirror.in_flight):
            self._send_commands(end_step, self._device_step())
        if hub.virtual:
            return 0.0
        ahead = self._queued_until - self._device_step() - LEAD_BLOCKS * self._rig.mirror.block_steps
        due = [self._next_query_ns - now, max(ahead, 0) * self._step_ns]
        if (timeout_ns := self._mirror.next_timeout_ns()) is not None:
            due.append(timeout_ns - now)
        return max(0, min(due)) / 1e9

    def _send_commands(self, end_step: int | None, device_step: int) -> None:
        block_steps = self._rig.mirror.block_steps
        horizon = device_step + LEAD_BLOCKS * block_steps
        while self._queued_until < horizon and (end_step is None or self._queued_until < end_step):
            n_steps = block_steps if end_step is None else min(block_steps, end_step - self._queued_until)
            since_start = self._queued_until - self._first_step
            u = self._rig.drive.inputs(since_start, n_steps, self._rig.timing.fast_step_s)
            now = self._hub.now_ns()
            block = self._mirror.send_block(self._queued_until, u, self._newest_frame, now)
            self._assembler.add_command(block)
            self._record(topics.COMMAND, block, now)
            for frame_id, latency in self._latencies.items():
                if frame_id <= block.cause_frame_id and not latency.command_sent_ns:
                    latency.command_sent_ns = self._hub.now_ns()
            self._queued_until += n_steps
            self.report.steps_commanded += n_steps

    def _is_over(self, exposures: int, end_step: int) -> bool:
        if self._hub.virtual:
            return self._queued_until >= end_step and not self._mirror.in_flight
        now, timing = self._hub.now_ns(), self._rig.timing
        if self.report.exposures >= exposures or self._device_step() > end_step + _GRACE_S * 1e9 / self._step_ns:
            return True
        patience_ns = 3 * timing.frame_period_steps * self._step_ns + (_GRACE_S + _START_DELAY_S) * 1e9
        if now - self._last_frame_ns > patience_ns:
            raise DeviceError(
                f"the camera has sent no frame for {(now - self._last_frame_ns) / 1e9:.1f} s: is it still connected?"
            )
        return False

    def _finish(self, exposures: int) -> None:
        """What is still on its way when the last command has been applied."""
        now = self._hub.now_ns()
        self._receive(0.0)
        self._take(self._camera.link, list(self._camera.flush()), now)
        self._estimate(self._assembler.flush(), now)
        for latency in self._latencies.values():
            self._record(topics.LATENCY, latency, now)
        self.report.latencies.extend(self._latencies.values())
        if exposures and self.report.ended == "complete":
            self.report.frames_lost = exposures - self.report.frames_received
        self._record_links(now)
        self._log(Log.INFO, f"session {self.report.ended}: {self.report.exposures} exposures")

    def _take(self, link: Link, events: Sequence[Event], receive_ns: int) -> None:
        for event in events:
            if isinstance(event, Frame):
                self._take_frame(event, receive_ns)
            elif isinstance(event, wire.Applied):
                self._record(topics.APPLIED, event, receive_ns)
                self._count_applied(event)
                self._estimate(self._assembler.add_applied(event), receive_ns)
            elif isinstance(event, wire.Truth):
                self._record(topics.TRUTH, event, receive_ns)
            elif isinstance(event, ClockSampled):
                self._take_clock(link.name, event)
            elif isinstance(event, CommandAnswered):
                self._take_answer(event, receive_ns)
            else:
                level = {wire.Event.INFO: Log.INFO, wire.Event.WARNING: Log.WARNING}.get(event.level, Log.ERROR)
                self._log(level, f"{link.name}: {event.text}")

    def _take_frame(self, frame: Frame, receive_ns: int) -> None:
        host_start_ns, sigma_ns = self._camera.clock.host_ns(frame.device_start_ns)
        frame = replace(frame, host_start_ns=host_start_ns, clock_sigma_ns=sigma_ns)
        info, image = convert.frame_messages(frame)
        self._record(topics.EXPOSURE, info, receive_ns)
        self._record(topics.IMAGE, image, receive_ns)
        report = self.report
        report.frames_received += 1
        report.frames_incomplete += frame.chunks_lost > 0
        report.frames_lost += frame.frames_lost_before
        self._last_frame_ns = receive_ns
        if not self._hub.virtual:
            host_end_ns, _ = self._camera.clock.host_ns(frame.device_end_ns)
            self._latencies[frame.frame_id] = pb.Latency(
                frame_id=frame.frame_id,
                exposure_end_ns=host_end_ns,
                first_byte_ns=frame.host_first_byte_ns,
                complete_ns=frame.host_receive_ns,
            )
        self._estimate(self._assembler.add_frame(frame), receive_ns)

    def _estimate(self, exposures: Sequence[Exposure], log_time_ns: int) -> None:
        for exposure in exposures:
            for estimate in self._driver.step(exposure):
                self._record(topics.estimate_topic(estimate.estimator), convert.estimate_message(estimate), log_time_ns)
            self.report.exposures += 1
            self._newest_frame = exposure.frame_id
            if latency := self._latencies.get(exposure.frame_id):
                latency.estimated_ns = self._hub.now_ns()

    def _count_applied(self, applied: wire.Applied) -> None:
        report, end = self.report, min(applied.first_step + applied.n_steps, self._queued_until)
        n_steps = max(0, end - max(applied.first_step, self._first_step))  # of this session
        if applied.source == wire.Applied.PARKED:
            report.steps_parked += n_steps
        else:
            report.steps_applied += n_steps
        if applied.source == wire.Applied.CLIPPED:
            report.steps_clipped += n_steps

    def _take_answer(self, answer: CommandAnswered, receive_ns: int) -> None:
        self.report.steps_late += answer.ack.late_steps
        self.report.steps_superseded += answer.ack.superseded_steps
        informed = [i for i, v in self._latencies.items() if i <= answer.block.cause_frame_id and v.command_sent_ns]
        for frame_id in informed:
            latency = self._latencies.pop(frame_id)
            latency.command_acknowledged_ns = receive_ns
            self.report.latencies.append(latency)
            self._record(topics.LATENCY, latency, receive_ns)

    def _take_clock(self, device: str, sampled: ClockSampled) -> None:
        clock = (self._camera if device == "camera" else self._mirror).clock
        exchange, report = sampled.exchange, self.report
        sample = pb.ClockSample(
            device=device,
            host_send_ns=exchange.host_send_ns,
            device_receive_ns=exchange.device_receive_ns,
            device_send_ns=exchange.device_send_ns,
            host_receive_ns=exchange.host_receive_ns,
            round_trip_ns=exchange.round_trip_ns,
            accepted=sampled.accepted,
        )
        if clock.ready:
            _, sigma_ns = clock.device_ns(exchange.host_receive_ns)
            sample.offset_ns = clock.offset_ns(exchange.host_receive_ns)
            sample.frequency_ppm, sample.sigma_ns = clock.frequency_ppm, sigma_ns
            report.clock_offset_ns, report.clock_frequency_ppm = sample.offset_ns, sample.frequency_ppm
            report.clock_sigma_ns = sigma_ns
        self._record(topics.CLOCK, sample, exchange.host_receive_ns)

    def _record_links(self, now: int) -> None:
        report = self.report
        report.blocks_retransmitted = self._mirror.retransmits
        report.packets_bad_crc = report.packets_bad_framing = report.packets_missing = 0
        for link in self._hub.links:
            statistics = pb.LinkStatistics(device=link.name, **asdict(link.counts))
            if link is self._mirror.link:
                statistics.retransmits = self._mirror.retransmits
                statistics.commands_in_flight = self._mirror.in_flight
                statistics.round_trip_s = self._mirror.round_trip_s
            report.packets_bad_crc += link.counts.bad_crc
            report.packets_bad_framing += link.counts.bad_framing
            report.packets_missing += link.counts.sequence_gaps
            self._record(topics.LINK, statistics, now)

    def _log(self, level: Log.Level.ValueType, text: str) -> None:
        now = self._hub.now_ns()
        entry = Log(level=level, message=text, name="aolink")
        entry.timestamp.FromNanoseconds(now)
        self._record(topics.LOG, entry, now)

    def _record(self, topic: str, message: Message, log_time_ns: int) -> None:
        self._writer.write(topic, message, log_time_ns)
