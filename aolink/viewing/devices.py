"""Series of devices and their connections: commands, latency, drops, clock, log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import rerun as rr

from aolink.colours import estimator_colour
from aolink.plotting.overview import LATENCY_STEPS
from aolink.recording import schemas_pb2, topics
from aolink.viewing import entities
from aolink.viewing.entities import CLOCK, CONTROL, ESTIMATION, FAULTS, LATENCY, LOG, LOST, RECEIVED, ROUND_TRIP, STATUS
from aolink.viewing.palette import APPLIED, COMMANDED, series_colour
from aolink.viewing.series import Drawing, Style, send_axes, send_line, send_states, some_rows
from aolink.viewing.timebase import Timebase
from aolink.wire.messages_pb2 import Applied

CONNECTION_COUNTS = (*topics.CONNECTION_FAULTS, "retransmits", "reports_asked")
"""Fields of ConnectionStatistics that count faults."""

_MOST_INPUTS = 2
"""Most inputs with lines of their own; where there are more, the first ones have them, and percentiles show all."""
_LEVELS = dict(enumerate(("TRACE", "DEBUG", "INFO", "WARN", "ERROR", "CRITICAL")))
"""Rerun's levels by the number of foxglove's."""


class Timed(Protocol):
    """A message with the host time at which it was recorded."""

    @property
    def log_time_ns(self) -> int: ...

    @property
    def message(self) -> Any: ...


def log_commands(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Commands as sent (CommandBlock), at every fast step: ``/mirror/command``, in the mirror's unit."""
    blocks = [r.message for r in records]
    _send_blocks(drawing, entities.COMMAND, timebase, blocks, Style("commanded", COMMANDED, width=1.0, steps=True))


def log_applied(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Inputs that the mirror held (Applied), at every fast step: ``/mirror/applied``; and their source:
    ``/status/mirror``."""
    # A report that was requested again came out of order; steps that were never reported show only in the status.
    blocks = sorted((r.message for r in records if r.message.source != Applied.AWAITED), key=lambda b: b.first_step)
    if not blocks:
        return
    _send_blocks(drawing, entities.APPLIED, timebase, blocks, Style("applied", APPLIED, width=3.5, steps=True))
    sources = Applied.Source.DESCRIPTOR.values_by_number
    names = [sources[b.source].name if b.source in sources else f"UNKNOWN {b.source}" for b in blocks]
    send_states(drawing, f"{STATUS}/mirror", timebase, [b.first_step for b in blocks], names)


def log_answers(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """What the mirror answered to its command blocks (CommandAnswer): ``/status/commands``."""
    answers = sorted((r.message for r in records), key=lambda m: m.first_step)
    known = schemas_pb2.CommandAnswer.Answer.DESCRIPTOR.values_by_number
    names = [known[m.answer].name if m.answer in known else f"UNKNOWN {m.answer}" for m in answers]
    names = ["LATE" if m.late_steps else name for m, name in zip(answers, names, strict=True)]
    send_states(drawing, f"{STATUS}/commands", timebase, [m.first_step for m in answers], names)


def log_latency(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Time since the end of the exposure at which each step of the loop was done, ms: ``/latency/STEP``.

    The lines lie above each other in the order of the steps: the distance between two is one step's time.
    """
    latencies = [r.message for r in records]
    times = timebase.at_frames([m.frame_id for m in latencies])
    for i, (field, name) in enumerate(LATENCY_STEPS):
        at = [getattr(m, field) for m in latencies]
        milliseconds = [(t - m.exposure_end_ns) / 1e6 if t else np.nan for t, m in zip(at, latencies, strict=True)]
        if not np.isnan(milliseconds).all():
            style = Style(name, series_colour(i))
            send_line(drawing, f"{LATENCY}/{field.removesuffix('_ns')}", times, milliseconds, style)


def log_estimation(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Time that an estimator took for each estimate, ms: ``/latency/estimation/NAME``."""
    name, made = records[0].message.estimator, [r.message for r in records if not r.message.skipped]
    if made:
        times = timebase.at_frames([m.frame_id for m in made])
        style = Style(f"{name} takes", estimator_colour(name))
        send_line(drawing, f"{ESTIMATION}/{name}", times, [m.took_ns / 1e6 for m in made], style)


def log_drops(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Frames and chunks lost since the start: ``/connection/lost/frames``, ``/connection/lost/chunks``."""
    infos = [r.message for r in records]
    times = timebase.at_steps([m.first_step for m in infos], [m.frame_id for m in infos])
    frames = np.cumsum([m.frames_lost_before for m in infos])
    chunks = np.cumsum([m.chunks_lost for m in infos])
    send_line(drawing, f"{LOST}/frames", times, frames, Style("frames lost", (240, 80, 80), width=2.5, steps=True))
    send_line(drawing, f"{LOST}/chunks", times, chunks, Style("chunks lost", (250, 170, 90), steps=True))


def log_connection(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Health of the connection to each device: faults by cause, command round trip and traffic.

    ``/connection/faults/DEVICE`` and, for causes that occurred, ``/connection/faults/DEVICE/CAUSE`` (since the start),
    ``/connection/round_trip/DEVICE`` (ms), ``/connection/received/DEVICE`` (kB/s).
    """
    for d, (device, samples) in enumerate(_by_device(records).items()):
        host = np.array([r.log_time_ns for r in samples], dtype=np.int64)
        times = timebase.at_host(host)
        total = [sum(getattr(r.message, field) for field in CONNECTION_COUNTS) for r in samples]
        style = Style(f"{device} connection faults", series_colour(d), steps=True)
        send_line(drawing, f"{FAULTS}/{device}", times, total, style)
        for i, field in enumerate(CONNECTION_COUNTS):
            counts = [getattr(r.message, field) for r in samples]
            if not any(counts):
                continue
            style = Style(f"{device} {field.replace('_', ' ')}", series_colour(i), width=2.5 - d, steps=True)
            send_line(drawing, f"{FAULTS}/{device}/{field}", times, counts, style)
        trip = np.array([r.message.round_trip_s for r in samples]) * 1e3
        if not np.isnan(trip).all():
            send_line(drawing, f"{ROUND_TRIP}/{device}", times, trip, Style(f"{device} round trip", series_colour(d)))
        if len(samples) > 1:
            rate = np.diff([r.message.bytes_received for r in samples]) / np.maximum(np.diff(host), 1) * 1e6
            style = Style(f"{device} to host", series_colour(d))
            send_line(drawing, f"{RECEIVED}/{device}", timebase.at_host(host[1:]), rate, style)


def log_clock(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The regression of each device's clock on the host's.

    ``/clock/sigma/DEVICE`` (standard deviation of the offset, us), ``/clock/offset/DEVICE`` (change of the offset
    since the first sample, us), ``/clock/frequency/DEVICE`` (ppm) and ``/clock/round_trip/DEVICE`` (us).
    """
    for d, (device, samples) in enumerate(_by_device(records).items()):
        messages = [r.message for r in samples]
        times = timebase.at_host([m.host_receive_ns for m in messages])
        offset = np.array([m.offset_ns for m in messages])
        for name, label, values in (
            ("sigma", "offset sd", np.array([m.sigma_ns for m in messages]) / 1e3),
            ("offset", "offset change", (offset - next(iter(offset[np.isfinite(offset)]), np.nan)) / 1e3),
            ("frequency", "runs fast by", np.array([m.frequency_ppm for m in messages])),
            ("round_trip", "round trip", np.array([m.round_trip_ns for m in messages]) / 1e3),
        ):
            send_line(drawing, f"{CLOCK}/{name}/{device}", times, values, Style(f"{device} {label}", series_colour(d)))


def log_log(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The session's log: ``/log``."""
    times = timebase.at_host([r.log_time_ns for r in records])
    text = [f"{r.message.name}: {r.message.message}" if r.message.name else r.message.message for r in records]
    levels = [_LEVELS.get(r.message.level, "INFO") for r in records]
    drawing.send_columns(LOG, times, rr.TextLog.columns(text=text, level=levels))


def log_control(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The results of a controller for each exposure: ``/control/slope_rms`` of the centroids and ``/control/path_rms``
    inside the exposures (slope units), ``/control/delay`` from the end of the exposure to the first step that it has
    changed (ms), ``/control/clipped`` (fast steps), ``/status/loop``.
    """
    changes = [r.message for r in records]
    times = timebase.at_frames([m.frame_id for m in changes])
    delay = [m.delay_steps * timebase.fast_step_ns / 1e6 for m in changes]
    for k, (name, label, values) in enumerate((
        ("slope_rms", "RMS of the slopes", [m.slope_rms for m in changes]),
        ("path_rms", "RMS inside the exposure", [m.path_rms for m in changes]),
        ("delay", "exposure's end to first input", delay),
        ("clipped", "steps that limits changed", [m.clipped_steps for m in changes]),
    )):  # fmt: skip
        send_line(drawing, f"{CONTROL}/{name}", times, values, Style(label, series_colour(k)))
    states = [
        f"{schemas_pb2.Control.State.Name(m.state)}{' LATE' if m.late else ''}"
        f"{f' {m.acting.upper()}' if m.acting not in ('', m.controller) else ''}"
        if m.state in schemas_pb2.Control.State.values()
        else f"UNKNOWN {m.state}"
        for m in changes
    ]
    send_states(drawing, f"{STATUS}/loop", timebase, timebase.step_of_frame([m.frame_id for m in changes]), states)


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


def _by_device(records: Iterable[Timed]) -> dict[str, list[Timed]]:
    devices: dict[str, list[Timed]] = {}
    for record in records:
        devices.setdefault(record.message.device, []).append(record)
    return devices
