"""The summary of a recording as plain data: rates, gaps, losses, estimates, the session's own facts."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from aolink.estimation import Status
from aolink.estimation.score import UnusedCounter
from aolink.recording import topics
from aolink.recording.account import STEPS, Account, Commands
from aolink.recording.convert import verdict_of
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import Estimate as EstimateMessage
from aolink.recording.schemas_pb2 import ExposureInfo

_LOSSES = (
    "frames_lost", "frames_incomplete", "scenes_lost", "scenes_incomplete", "connection_sequence_gaps",
    "connection_bad_crc", "connection_bad_framing", "connection_bad_payload", "chunks_refused", "steps_late",
    "steps_refused", "steps_not_reported", "steps_clipped", "steps_parked", "ports_vanished",
    "control_open_exposures", "control_late_exposures", "control_fall_back_exposures",
)  # fmt: skip
"""A session's counts of losses and faults."""


class Counted:
    """What a pass over all messages counts: gaps between frames, estimates, commands."""

    def __init__(self, recording: Recording) -> None:
        self._period = recording.rig.timing.frame_period_steps
        self._last: int | None = None
        self._gaps: list[int] = []
        names = recording.estimators
        self._counts, self._unused = dict.fromkeys(names, 0), {name: UnusedCounter() for name in names}
        self._verdicts: dict[str, dict[str, Any]] = {}
        self._account = Account()

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take the next message."""
        self._account.take(topic, time_ns, message)
        if isinstance(message, ExposureInfo) and topic == topics.EXPOSURE:
            if self._last is not None and message.first_step - self._last != self._period:
                self._gaps.append(message.first_step - self._last - self._period)
            self._last = message.first_step
        elif isinstance(message, EstimateMessage):
            name = topic.removeprefix(topics.ESTIMATE)
            self._counts[name] += 1
            if (verdict := verdict_of(message)) is not None and verdict.exposures:
                self._verdicts[name] = asdict(verdict) | {"text": verdict.text}
            with contextlib.suppress(ValueError):  # a status of a later aolink
                self._unused[name].add(Status(message.status), message.reason, message.frame_id)

    def result(self) -> tuple[dict[str, int], dict[str, Any], Commands]:
        """Number and longest length of the gaps between the camera's frames, in fast steps; the number of estimates of
        each estimator, and why some could not use their exposure; how the commands ended."""
        estimates: dict[str, Any] = {
            name: {
                "count": count,
                "unused": [asdict(each) for each in self._unused[name].result()],
                "verdict": self._verdicts.get(name),
            }
            for name, count in self._counts.items()
        }
        gaps = {"count": len(self._gaps), "longest_steps": max(self._gaps, default=0)}
        return gaps, estimates, self._account.close()


def recording_facts(recording: Recording, counted: Counted | None = None) -> dict[str, Any]:
    """The summary of a recording as plain data, which `aolink info --json` prints.

    ``counted`` has the counts of a pass over the recording that was made already; without it one is made.
    """
    duration_s = (recording.end_ns - recording.start_ns) / 1e9
    if counted is None:
        counted = Counted(recording)
        for recorded in recording.messages():  # all of them, because one that cannot be used is found when it is read
            counted.take(recorded.topic, recorded.log_time_ns, recorded.message)
    gaps, estimates, commands = counted.result()
    return {
        "file": str(recording.path),
        "bytes": recording.size,
        "complete": recording.complete,
        "damage": recording.damage,
        "start_ns": recording.start_ns,
        "start_utc": _date(recording.start_ns),
        "duration_s": duration_s,
        "messages": dict(sorted(recording.counts.items())),
        "rates_per_s": {
            topic: round((count - 1) / duration_s, 3)
            for topic, count in sorted(recording.counts.items())
            if duration_s and count > 1
        },
        "gaps": gaps,
        "estimates": estimates,
        "commands": asdict(commands)
        | {name: int(steps) for name in STEPS if (steps := recording.end_metadata.get(f"steps_{name}", "")).isdigit()},
        "losses": _losses(recording),
        "damaged_parts": [loss.text() for loss in recording.losses],
        "truth": topics.TRUTH in recording.counts,
        "session": {name: _typed(name, value) for name, value in recording.metadata.items()},
        "estimators": recording.estimators,
    }


def log_lines(recording: Recording) -> Iterator[dict[str, str | None]]:
    """What the session, or other software on ``/log``, said while it ran: time, level and text, in order."""
    for recorded in recording.messages(topics.LOG) if topics.LOG in recording.counts else ():
        entry: Any = recorded.message
        known = Log.Level.DESCRIPTOR.values_by_number
        level = known[entry.level].name if entry.level in known else str(entry.level)
        yield {"time_utc": _date(recorded.log_time_ns), "level": level, "text": " ".join(entry.message.split())}


def _date(time_ns: int) -> str | None:
    """A time on the host's clock as a date, ISO 8601; None for one outside the calendar."""
    try:
        return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None


def _losses(recording: Recording) -> dict[str, int]:
    known, counted = recording.metadata, {}
    values = {name: known.get(name, "") for name in _LOSSES}
    # Exposures, by the estimator that had no time for them.
    values |= {name: value for name, value in known.items() if name.startswith("skipped_")}
    for name, value in values.items():
        if value.isdigit() and int(value):
            counted[name] = int(value)
    if recording.losses:
        counted["parts_of_the_file"] = sum(loss.count for loss in recording.losses)
    return counted


def _typed(name: str, value: str) -> Any:
    """A value of the metadata, which holds text only, with its type."""
    if name in ("note", "rig", "rig_digest", "camera", "mirror", "controller", "control"):
        return value
    with contextlib.suppress(ValueError):
        if value.lstrip("-").isdigit():
            return int(value)
        return number if math.isfinite(number := float(value)) else None
    return {"True": True, "False": False}.get(value, value)
