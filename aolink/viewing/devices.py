"""What a session's messages say of its devices, loop and connections: curves, inputs, states, the log."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import rerun as rr

from aolink.colours import estimator_colour
from aolink.gathered import some_rows
from aolink.numerics.arrays import FloatArray
from aolink.recording import schemas_pb2
from aolink.recording.topics import Curve, Topic
from aolink.viewing import entities
from aolink.viewing.entities import LOG, STATUS
from aolink.viewing.palette import APPLIED, COMMANDED, series_colour
from aolink.viewing.series import Drawing, Style, send_axes, send_line, send_states
from aolink.viewing.timebase import Timebase
from aolink.wire.messages_pb2 import Applied

_MOST_INPUTS = 2
"""Most inputs with lines of their own; where there are more, the first ones have them, and percentiles show all."""
_LEVELS = dict(enumerate(("TRACE", "DEBUG", "INFO", "WARN", "ERROR", "CRITICAL")))
"""Rerun's levels by the number of foxglove's."""


class Timed(Protocol):
    """A message with the host time at which it was recorded."""

    @property
    def topic(self) -> str: ...

    @property
    def log_time_ns(self) -> int: ...

    @property
    def message(self) -> Any: ...


def log_curves(drawing: Drawing, timebase: Timebase, row: Topic, records: Sequence[Timed]) -> None:
    """The curves of a topic: ``/TOPIC/FIELD``, or ``/TOPIC/FIELD/NAME`` for each device or estimator."""
    named: dict[str, list[Timed]] = {}
    is_prefix = row.name.endswith("/")
    for record in records:
        name = record.topic.removeprefix(row.name) if is_prefix else getattr(record.message, "device", "")
        named.setdefault(name, []).append(record)
    views = [curve.view for curve in row.curves]
    for name, some in named.items():
        number = drawing.names.setdefault(name, len(drawing.names))
        for k, curve in enumerate(row.curves):
            if shown := [each for each in some if curve.is_in(each.message)]:
                path = "/".join(filter(None, (entities.of(row.name), curve.field, name)))
                colour = series_colour(number if name and views.count(curve.view) == 1 else k)
                colour = estimator_colour(name) if is_prefix else colour
                style = Style(
                    f"{name} {curve.label}".strip(), colour, steps=row.belongs_to == "time" and not curve.zero
                )
                values = _since(drawing, path, curve, shown)
                if np.isfinite(values).any():
                    send_line(drawing, path, _times(timebase, row, shown[-len(values) :]), values, style)


def _times(timebase: Timebase, row: Topic, records: Sequence[Timed]) -> list[rr.TimeColumn]:
    """Where messages lie in time, by what they belong to."""
    messages = [each.message for each in records]
    if row.belongs_to == "time":
        return timebase.at_host([each.log_time_ns for each in records])
    if row.belongs_to == "steps" or row.message is schemas_pb2.ExposureInfo:
        frames = None if row.belongs_to == "steps" else [each.frame_id for each in messages]
        return timebase.at_steps([each.first_step for each in messages], frames)
    return timebase.at_frames([each.frame_id for each in messages])


def _since(drawing: Drawing, path: str, curve: Curve, records: Sequence[Timed]) -> FloatArray:
    """What a view shows of a curve's values, which a sum, a change or a rate goes on from; a rate has none with the
    first message."""
    values = np.array([curve.value(each.message) for each in records])
    if curve.shows == "sum":
        values = drawing.before.get(path, (0, 0.0))[1] + np.cumsum(values)
        drawing.before[path] = (0, float(values[-1]))
    elif curve.shows == "change" and np.isfinite(values).any():
        values -= drawing.before.setdefault(path, (0, float(values[np.isfinite(values)][0])))[1]
    elif curve.shows == "rate":
        points = [(each.log_time_ns, float(value)) for each, value in zip(records, values, strict=True)]
        points = [drawing.before[path], *points] if path in drawing.before else points
        drawing.before[path] = points[-1]
        values = np.array([(now - last) / max(at - then, 1) * 1e9 for (then, last), (at, now) in pairwise(points)])
    return np.asarray(values)


def log_commands(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Commands as sent (CommandBlock), at every fast step: ``/mirror/command``, in the mirror's unit."""
    blocks = [r.message for r in records]
    _send_blocks(drawing, entities.COMMAND, timebase, blocks, Style("commanded", COMMANDED, width=1.0, steps=True))


def log_applied(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Inputs that the mirror held (Applied), at every fast step: ``/mirror/applied``; and their source:
    ``/status/mirror``."""
    # A report that was requested again came out of order; steps that were never reported show only in the status.
    blocks = sorted((r.message for r in records if r.message.source != Applied.AWAITED), key=lambda b: b.first_step)
    _send_blocks(drawing, entities.APPLIED, timebase, blocks, Style("applied", APPLIED, width=3.5, steps=True))
    states = [(b.first_step, _name(Applied.Source, b.source)) for b in blocks]
    send_states(drawing, f"{STATUS}/mirror", timebase, states)


def log_answers(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """What the mirror answered to its command blocks (CommandAnswer): ``/status/commands``."""
    answers = sorted((r.message for r in records), key=lambda m: m.first_step)
    kinds = schemas_pb2.CommandAnswer.Answer
    states = [(m.first_step, "LATE" if m.late_steps else _name(kinds, m.answer)) for m in answers]
    send_states(drawing, f"{STATUS}/commands", timebase, states)


def log_log(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The session's log: ``/log``."""
    times = timebase.at_host([r.log_time_ns for r in records])
    text = [f"{r.message.name}: {r.message.message}" if r.message.name else r.message.message for r in records]
    levels = [_LEVELS.get(r.message.level, "INFO") for r in records]
    drawing.send_columns(LOG, times, rr.TextLog.columns(text=text, level=levels))


def log_control(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """How the loop stands with each exposure: ``/status/loop``."""
    changes = [r.message for r in records]
    states = [
        _name(schemas_pb2.Control.State, m.state) + (" LATE" if m.late else "")
        + (f" {m.acting.upper()}" if m.acting not in ("", m.controller) else "")
        for m in changes
    ]  # fmt: skip
    send_states(
        drawing,
        f"{STATUS}/loop",
        timebase,
        list(zip(timebase.step_of_frame([m.frame_id for m in changes]).tolist(), states, strict=True)),
    )


def _name(kinds: Any, number: int) -> str:
    """The name of an enumeration's value; other software may have written one that is not known here."""
    return kinds.Name(number) if number in kinds.values() else f"UNKNOWN {number}"


def _send_blocks(drawing: Drawing, path: str, timebase: Timebase, blocks: Sequence[Any], style: Style) -> None:
    """Send (first_step, n_steps, u) blocks as one value a fast step and input."""
    blocks = [b for b in blocks if len(b.u)]
    if not blocks:
        return
    steps = np.concatenate([np.arange(b.first_step, b.first_step + b.n_steps, dtype=np.int64) for b in blocks])
    inputs = np.concatenate([np.reshape(b.u, (b.n_steps, -1)) for b in blocks])
    shown = range(min(inputs.shape[1], _MOST_INPUTS))
    if drawing.points is not None:
        changed = np.flatnonzero(np.any(np.diff(inputs, axis=0, prepend=np.nan, append=np.nan)[:-1] != 0, axis=1))
        kept = np.unique([*changed, len(inputs) - 1])
        most = -(-len(steps) * drawing.points // timebase.frame_period_steps)
        kept = kept[some_rows(inputs[kept][:, list(shown)], most)]
        steps, inputs = steps[kept], inputs[kept]
    labels = [f" {k + 1}" for k in shown] if len(shown) > 1 else [""]
    send_axes(drawing, path, timebase.every_step(steps), inputs, style, shown, labels)
