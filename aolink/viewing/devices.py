"""Series of devices and their connections: commands, latency, drops, clock, log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import rerun as rr

from aolink.colours import estimator_colour
from aolink.gathered import LATENCY_STEPS, SLOPES, some_rows
from aolink.recording import schemas_pb2, topics
from aolink.viewing import entities
from aolink.viewing.entities import CLOCK, CONTROL, ESTIMATION, FAULTS, LATENCY, LOG, LOST, RECEIVED, ROUND_TRIP, STATUS
from aolink.viewing.palette import APPLIED, COMMANDED, series_colour
from aolink.viewing.series import Drawing, Style, send_axes, send_line, send_states
from aolink.viewing.timebase import Timebase
from aolink.wire.messages_pb2 import Applied

CONNECTION_COUNTS = (*topics.CONNECTION_FAULTS, "retransmits", "reports_asked")
"""Fields of ConnectionStatistics that count faults."""
CLOCKS = {
    "sigma": ("Clock offset sd (µs)", "offset sd", "sigma_ns", 1e-3),
    "offset": ("Clock offset change (µs)", "offset change", "offset_ns", 1e-3),
    "frequency": ("Clock rate (ppm)", "runs fast by", "frequency_ppm", 1.0),
    "round_trip": ("Clock round trip (µs)", "round trip", "round_trip_ns", 1e-3),
}
"""What is drawn of a ClockSample, by the name of its entity: title of the view, name of the line, field, and the length
of its unit in that of the view."""
CONTROLS: dict[str, tuple[str, str, Callable[[Any, Timebase], float]]] = {
    "slope_rms": (f"Loop: residual ({SLOPES})", "RMS of the slopes", lambda m, _: m.slope_rms),
    "path_rms": (f"Loop: residual ({SLOPES})", "RMS inside the exposure", lambda m, _: m.path_rms),
    "delay": ("Loop: delay (ms)", "exposure's end to first input", lambda m, t: m.delay_steps * t.fast_step_ns / 1e6),
    "clipped": ("Loop: steps clipped (count)", "steps that limits changed", lambda m, _: m.clipped_steps),
}
"""What is drawn of a Control: title, name of the line, value."""

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
    _send_blocks(drawing, entities.APPLIED, timebase, blocks, Style("applied", APPLIED, width=3.5, steps=True))
    states = [(b.first_step, _name(Applied.Source, b.source)) for b in blocks]
    send_states(drawing, f"{STATUS}/mirror", timebase, states)


def log_answers(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """What the mirror answered to its command blocks (CommandAnswer): ``/status/commands``."""
    answers = sorted((r.message for r in records), key=lambda m: m.first_step)
    kinds = schemas_pb2.CommandAnswer.Answer
    states = [(m.first_step, "LATE" if m.late_steps else _name(kinds, m.answer)) for m in answers]
    send_states(drawing, f"{STATUS}/commands", timebase, states)


def log_latency(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Time since the end of the exposure at which each step of the loop was done, ms: ``/latency/STEP``.

    The lines lie above each other in the order of the steps: the distance between two is one step's time.
    """
    latencies = [r.message for r in records]
    times = timebase.at_frames([m.frame_id for m in latencies])
    for i, (field, name) in enumerate(LATENCY_STEPS.items()):
        at = [getattr(m, field) for m in latencies]
        milliseconds = [(t - m.exposure_end_ns) / 1e6 if t else np.nan for t, m in zip(at, latencies, strict=True)]
        if any(at):
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
    lost = [drawing.lost, *((m.frames_lost_before, m.chunks_lost) for m in infos)]
    frames, chunks = np.cumsum(lost, axis=0)[1:].T
    drawing.lost = (int(frames[-1]), int(chunks[-1]))
    send_line(drawing, f"{LOST}/frames", times, frames, Style("frames lost", (240, 80, 80), width=2.5, steps=True))
    send_line(drawing, f"{LOST}/chunks", times, chunks, Style("chunks lost", (250, 170, 90), steps=True))


def log_connection(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Health of the connection to each device: faults by cause, command round trip and traffic.

    ``/connection/faults/DEVICE`` and, for causes that occurred, ``/connection/faults/DEVICE/CAUSE`` (since the start),
    ``/connection/round_trip/DEVICE`` (ms), ``/connection/received/DEVICE`` (kB/s).
    """
    for device, samples in _by_device(records).items():
        known, d = drawing.device(device), drawing.device(device).number
        host = np.array([r.log_time_ns for r in samples], dtype=np.int64)
        times, plain = timebase.at_host(host), series_colour(d)
        counts = np.array([[getattr(r.message, field) for field in CONNECTION_COUNTS] for r in samples])
        style = Style(f"{device} connection faults", plain, steps=True)
        send_line(drawing, f"{FAULTS}/{device}", times, counts.sum(axis=1), style)
        for i in np.flatnonzero(counts.any(axis=0)).tolist():
            field = CONNECTION_COUNTS[i]
            style = Style(f"{device} {field.replace('_', ' ')}", series_colour(i), width=2.5 - d, steps=True)
            send_line(drawing, f"{FAULTS}/{device}/{field}", times, counts[:, i], style)
        trip = np.array([r.message.round_trip_s for r in samples]) * 1e3
        if not np.isnan(trip).all():
            send_line(drawing, f"{ROUND_TRIP}/{device}", times, trip, Style(f"{device} round trip", plain))
        received = [*known.received, *((r.log_time_ns, r.message.bytes_received) for r in samples)]
        known.received = received[-1:]
        rate = [(now - before) / max(at - last, 1) * 1e6 for (last, before), (at, now) in pairwise(received)]
        times = timebase.at_host([at for at, _ in received[1:]])
        send_line(drawing, f"{RECEIVED}/{device}", times, rate, Style(f"{device} to host", plain))


def log_clock(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The regression of each device's clock on the host's: ``/clock/NAME/DEVICE`` for each of `CLOCKS`; the offset is
    that since the first sample."""
    for device, samples in _by_device(records).items():
        known = drawing.device(device)
        messages = [r.message for r in samples]
        times = timebase.at_host([m.host_receive_ns for m in messages])
        for name, (_, label, field, unit) in CLOCKS.items():
            values = np.array([getattr(m, field) for m in messages], dtype=np.float64)
            if name == "offset":
                if np.isnan(known.offset_ns):
                    known.offset_ns = next(iter(values[np.isfinite(values)]), np.nan)
                values -= known.offset_ns
            style = Style(f"{device} {label}", series_colour(known.number))
            send_line(drawing, f"{CLOCK}/{name}/{device}", times, unit * values, style)


def log_log(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The session's log: ``/log``."""
    times = timebase.at_host([r.log_time_ns for r in records])
    text = [f"{r.message.name}: {r.message.message}" if r.message.name else r.message.message for r in records]
    levels = [_LEVELS.get(r.message.level, "INFO") for r in records]
    drawing.send_columns(LOG, times, rr.TextLog.columns(text=text, level=levels))


def log_control(drawing: Drawing, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The results of a controller for each exposure: ``/control/NAME`` for each of `CONTROLS`, of the centroids
    (``slope_rms``) and inside the exposures (``path_rms``), the delay from the end of the exposure to the first step
    that it has changed, and the fast steps clipped; ``/status/loop``.
    """
    changes = [r.message for r in records]
    frames = [m.frame_id for m in changes]
    times = timebase.at_frames(frames)
    for k, (name, (_, label, value)) in enumerate(CONTROLS.items()):
        send_line(
            drawing, f"{CONTROL}/{name}", times, [value(m, timebase) for m in changes], Style(label, series_colour(k))
        )
    states = [
        _name(schemas_pb2.Control.State, m.state) + (" LATE" if m.late else "")
        + (f" {m.acting.upper()}" if m.acting not in ("", m.controller) else "")
        for m in changes
    ]  # fmt: skip
    send_states(
        drawing, f"{STATUS}/loop", timebase, list(zip(timebase.step_of_frame(frames).tolist(), states, strict=True))
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


def _by_device(records: Iterable[Timed]) -> dict[str, list[Timed]]:
    devices: dict[str, list[Timed]] = {}
    for record in records:
        devices.setdefault(record.message.device, []).append(record)
    return devices
