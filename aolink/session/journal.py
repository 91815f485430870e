"""The journal of a session: the stream of its messages, and among them its log and facts about the devices'
connections."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from aolink.devices.interfaces import Device, Time
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
        self._sinks: list[tuple[Sink, tuple[str, ...]]] = []
        """Sinks in the order in which they get a message, and the topics that each wants; none stands for all."""
        self._takers: dict[str, list[Callable[[str, int, Message], None]]] = {}
        """What takes the messages of a topic, by topic."""
        self._writer, self._time = writer, time
        self._said: dict[str, _Said] = {}
        """The warnings by their kind."""

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Hand a message to the sinks that want it."""
        if (takers := self._takers.get(topic)) is None:
            takers = [sink.take for sink, wanted in self._sinks if not wanted or topic in wanted]
            self._takers[topic] = takers
        for take in takers:
            take(topic, time_ns, message)

    def add(self, sink: Sink, *wanted: str) -> None:
        """Hand a sink the messages of some topics (of all, if none is named), after the sinks that were added before:
        the recorder comes before those that have more to record of a message."""
        self._sinks.append((sink, wanted))
        self._takers.clear()

    def show(self, view: View) -> None:
        """Hand a view all messages, until it fails."""
        view.may_wait = self._time.virtual
        self.add(_Guarded(view, self))

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

    def disk(self) -> None:
        """Warn of a disk that is held up: what ends the session is a full queue."""
        if not self._time.virtual and (held_up_s := self._writer.held_up_s) > TIMEOUTS.disk_s:
            self.warn(
                f"the disk of {self._writer.path} has not taken a write for {held_up_s:.1f} s:"
                f" {self._writer.waiting_bytes} bytes wait"
            )

    def statistics(self, devices: Sequence[Device], now: int) -> None:
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
