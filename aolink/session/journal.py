"""The journal of a session: the messages that it records, and among them its log and facts about the devices' clocks
and connections."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Protocol, cast

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from aolink.devices.interfaces import Camera, ClockSampled, CommandAnswered, Device, Mirror, Time
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.writer import RecordingWriter
from aolink.session.report import Report
from aolink.timeouts import TIMEOUTS

_COUNTS = {each.name for each in pb.ConnectionStatistics.DESCRIPTOR.fields} - {"device"}
"""What a device may count."""
_NUMBER = re.compile(r"(?<![\w.:=-])[-+]?\d[\d.e+-]*")
"""A number, but not one that is part of a name, as in ``o3`` or ``theirs:order=10``."""
_AT_ONCE = 5
_MINUTE_NS = 60_000_000_000


@dataclass
class _Said:
    """Warnings of one kind."""

    times_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_AT_ONCE))
    """When the newest were said."""
    newest: str = ""
    """The newest that was said, and its place in the report."""
    place: int = 0
    left_out: int = 0
    """How many have come since."""


class Sink(Protocol):
    """Takes the messages of a session, or of a recording, in their order."""

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take the next message, with its topic and its log time, ns."""


class View(Sink, Protocol):
    """A sink that is no part of the session."""

    may_wait: bool
    """Whether it may take time; set by the session, or by a replay."""


class Journal:
    """The stream of a session's messages, which it hands to its sinks; warnings and counts go into its `Report` too."""

    def __init__(self, writer: RecordingWriter, report: Report, time: Time) -> None:
        self.report = report
        self.sinks: list[Sink] = []
        """The recorder comes before those that have more to record of a message."""
        self._writer, self._time = writer, time
        self._said: dict[str, _Said] = {}
        """The warnings by their kind."""

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Hand a message to all sinks."""
        for sink in self.sinks:
            sink.take(topic, time_ns, message)

    def shown_by(self, view: View) -> Sink:
        """A view as a sink of this session, which gets no more when it has failed."""
        view.may_wait = self._time.virtual
        return _Guarded(view, self)

    def log(self, text: str, level: Log.Level.ValueType = Log.INFO) -> None:
        """Record a sentence about the session."""
        now = self._time.now_ns()
        entry = Log(level=level, message=text, name="aolink")
        entry.timestamp.FromNanoseconds(now)
        self.take(topics.LOG, now, entry)

    def warn(self, text: str, level: Log.Level.ValueType = Log.WARNING) -> None:
        """Record a warning, which the report has as well. Of those that differ only in their numbers, `_AT_ONCE` are
        said in a minute; the report has the number of the others."""
        now, warnings = self._time.now_ns(), self.report.warnings
        said = self._said.setdefault(_NUMBER.sub("", text), _Said())
        if len(said.times_ns) < _AT_ONCE or now - said.times_ns[0] > _MINUTE_NS:
            said.times_ns.append(now)
            said.newest, said.place, said.left_out = text, len(warnings), 0
            warnings.append(text)
            self.log(text, level)
        else:
            said.left_out += 1
            warnings[said.place] = f"{said.newest} (and {said.left_out} more of this kind)"

    def clock(self, device: Device, sampled: ClockSampled) -> None:
        """Record the comparison of a device's clock with the host's."""
        clock, exchange, report = device.clock, sampled.exchange, self.report
        sample = pb.ClockSample(
            device=device.name, round_trip_ns=exchange.round_trip_ns, accepted=sampled.accepted, **asdict(exchange)
        )
        if clock.ready:
            _, sigma_ns = clock.device_ns(exchange.host_receive_ns)
            sample.offset_ns = clock.offset_ns(exchange.host_receive_ns)
            sample.frequency_ppm, sample.sigma_ns = clock.frequency_ppm, sigma_ns
            report.clock_offset_ns, report.clock_frequency_ppm = sample.offset_ns, sample.frequency_ppm
            report.clock_sigma_ns = sigma_ns
        self.take(topics.CLOCK, exchange.host_receive_ns, sample)
        if sampled.step is not None:
            size_s, period_s = sampled.step.size_ns / 1e9, (sampled.step.before_ns - sampled.step.after_ns) / 1e9
            direction = "forward" if size_s > 0 else "back"
            self.warn(
                f"the {device.name}'s clock was set {direction} by {abs(size_s):.6f} s: host times of its stamps"
                f" in the {period_s:.3f} s from {sampled.step.after_ns} ns on may be off by as much"
            )

    def disk(self) -> None:
        """Warn of a disk that is held up: what ends the session is a full queue."""
        if not self._time.virtual and (held_up_s := self._writer.held_up_s) > TIMEOUTS.disk_s:
            self.warn(
                f"the disk of {self._writer.path} has not taken a write for {held_up_s:.1f} s:"
                f" {self._writer.waiting_bytes} bytes wait"
            )

    def statistics(self, devices: Sequence[Camera | Mirror], now: int) -> None:
        """Record what each connection has counted."""
        counts = {device.name: device.statistics() for device in devices}
        for fault in topics.CONNECTION_FAULTS:
            self.report.connection_faults[fault] = sum(each.get(fault, 0) for each in counts.values())
        for name, each in counts.items():
            if unknown := sorted(each.keys() - _COUNTS):
                text = f"the {name} counts {', '.join(unknown)}, which recordings have no field for: not recorded"
                if text not in self.report.warnings:
                    self.warn(text)
            if known := {count: number for count, number in each.items() if count in _COUNTS}:
                self.take(topics.CONNECTION, now, pb.ConnectionStatistics(device=name, **known))


class _Guarded:
    """A view that may fail: a session must not end because its picture does."""

    def __init__(self, view: View, journal: Journal) -> None:
        self._view: View | None = view
        self._journal = journal

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        if self._view is not None:
            try:
                self._view.take(topic, time_ns, message)
            except Exception as error:
                self._view = None
                self._journal.warn(f"a sink of this session's messages failed, and gets no more: {error}")


def command_answer(mirror: Mirror, answered: CommandAnswered, receive_ns: int) -> pb.CommandAnswer:
    """The mirror's answer to a command block as it is recorded, or that none came."""
    block, ack, kind = answered.block, answered.ack, pb.CommandAnswer
    message = kind(
        block_id=block.block_id, first_step=block.first_step, n_steps=block.n_steps, answer=kind.NONE,
        tries=answered.tries, times_full=answered.times_full, sent_ns=answered.sent_ns,
    )  # fmt: skip
    if ack is not None:
        message.answer = cast(pb.CommandAnswer.Answer, ack.code)
        message.text, message.answered_ns = ack.text, receive_ns
        message.late_steps, message.superseded_steps = ack.late_steps, ack.superseded_steps
        message.queue_end_step = ack.queue_end_step
        message.device_ns = mirror.clock.device_ns(receive_ns)[0] if mirror.clock.ready else 0
    return message
