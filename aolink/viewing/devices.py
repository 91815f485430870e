"""Series of devices and link: commands, latency, drops, clock, log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import rerun as rr

from aolink.colours import estimator_colour
from aolink.plotting.devices import LATENCY_STEPS
from aolink.recording import topics
from aolink.viewing.palette import APPLIED, COMMANDED, series_colour
from aolink.viewing.series import Style, send_axes, send_line, send_states
from aolink.viewing.timebase import Timebase
from aolink.wire.messages_pb2 import Applied

LINK_COUNTS = ("bad_crc", "bad_framing", "bad_payload", "sequence_gaps", "duplicates", "retransmits", "reports_asked")
"""Fields of LinkStatistics that count faults."""

_LEVELS = dict(enumerate(("TRACE", "DEBUG", "INFO", "WARN", "ERROR", "CRITICAL")))
"""Rerun's levels by the number of foxglove's."""


class Timed(Protocol):
    """A message with the host time at which it was recorded."""

    @property
    def log_time_ns(self) -> int: ...

    @property
    def message(self) -> Any: ...


def log_commands(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Commands as sent (CommandBlock), at every fast step: ``/mirror/command``, in the mirror's unit."""
    blocks = [r.message for r in records]
    _send_blocks(stream, "mirror/command", timebase, blocks, Style("commanded", COMMANDED, width=1.0, steps=True))


def log_applied(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """What the mirror held (Applied), at every fast step: ``/mirror/applied``; and why: ``/status/mirror``."""
    # A report that was asked for again came out of order; what was never reported shows only in the status.
    blocks = sorted((r.message for r in records if r.message.source != Applied.AWAITED), key=lambda b: b.first_step)
    if not blocks:
        return
    _send_blocks(stream, "mirror/applied", timebase, blocks, Style("applied", APPLIED, width=3.5, steps=True))
    changes = [
        b for before, b in zip([None, *blocks], blocks, strict=False) if before is None or before.source != b.source
    ]
    sources = Applied.Source.DESCRIPTOR.values_by_number
    names = [sources[b.source].name if b.source in sources else f"UNKNOWN {b.source}" for b in changes]
    send_states(stream, "status/mirror", timebase.at_steps([b.first_step for b in changes]), names)


def log_latency(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Time since the end of the exposure at which each step of the loop was done, ms: ``/latency/STEP``.

    The lines lie above each other in the order of the steps: the distance between two is one step's time.
    """
    latencies = [r.message for r in records]
    times = timebase.at_frames([m.frame_id for m in latencies])
    for i, (field, name) in enumerate(LATENCY_STEPS):
        at = [getattr(m, field) for m in latencies]
        milliseconds = [(t - m.exposure_end_ns) / 1e6 if t else np.nan for t, m in zip(at, latencies, strict=True)]
        if not np.isnan(milliseconds).all():
            send_line(
                stream, f"latency/{field.removesuffix('_ns')}", times, milliseconds, Style(name, series_colour(i))
            )


def log_estimation(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """What an estimator had time for: ``/latency/estimation/NAME``, ms for each estimate; ``/status/NAME`` where it
    skipped an exposure.
    """
    accounts = [r.message for r in records]
    name = accounts[0].estimator
    made, skipped = [m for m in accounts if not m.skipped], [m for m in accounts if m.skipped]
    if made:
        times = timebase.at_frames([m.frame_id for m in made])
        style = Style(f"{name} takes", estimator_colour(name))
        send_line(stream, f"latency/estimation/{name}", times, [m.took_ns / 1e6 for m in made], style)
    if skipped:
        times = timebase.at_frames([m.frame_id for m in skipped])
        send_states(stream, f"status/{name}", times, ["SKIPPED"] * len(skipped))


def log_drops(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Frames and chunks lost since the start, from ExposureInfo: ``/link/lost/frames``, ``/link/lost/chunks``."""
    infos = [r.message for r in records]
    times = timebase.at_steps([m.first_step for m in infos], [m.frame_id for m in infos])
    frames = np.cumsum([m.frames_lost_before for m in infos])
    chunks = np.cumsum([m.chunks_lost for m in infos])
    send_line(stream, "link/lost/frames", times, frames, Style("frames lost", (240, 80, 80), width=2.5, steps=True))
    send_line(stream, "link/lost/chunks", times, chunks, Style("chunks lost", (250, 170, 90), steps=True))


def log_link(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """Health of each device's link: faults by cause, command round trip and traffic.

    ``/link/faults/DEVICE`` and ``/link/faults/DEVICE/CAUSE`` (since the start), ``/link/round_trip/DEVICE`` (ms),
    ``/link/received/DEVICE`` (kB/s).
    """
    for d, (device, samples) in enumerate(_by_device(records).items()):
        host = np.array([r.log_time_ns for r in samples], dtype=np.int64)
        times = timebase.at_host(host)
        total = [sum(getattr(r.message, field) for field in LINK_COUNTS) for r in samples]
        send_line(
            stream, f"link/faults/{device}", times, total, Style(f"{device} link faults", series_colour(d), steps=True)
        )
        for i, field in enumerate(LINK_COUNTS):
            counts = [getattr(r.message, field) for r in samples]
            style = Style(f"{device} {field.replace('_', ' ')}", series_colour(i), width=2.5 - d, steps=True)
            send_line(stream, f"link/faults/{device}/{field}", times, counts, style)
        trip = np.array([r.message.round_trip_s for r in samples]) * 1e3
        if not np.isnan(trip).all():
            send_line(stream, f"link/round_trip/{device}", times, trip, Style(f"{device} round trip", series_colour(d)))
        if len(samples) > 1:
            rate = np.diff([r.message.bytes_received for r in samples]) / np.maximum(np.diff(host), 1) * 1e6
            style = Style(f"{device} to host", series_colour(d))
            send_line(stream, f"link/received/{device}", timebase.at_host(host[1:]), rate, style)


def log_clock(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
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
            send_line(stream, f"clock/{name}/{device}", times, values, Style(f"{device} {label}", series_colour(d)))


def log_log(stream: rr.RecordingStream, timebase: Timebase, records: Sequence[Timed]) -> None:
    """The session's log: ``/log``."""
    times = timebase.at_host([r.log_time_ns for r in records])
    text = [f"{r.message.name}: {r.message.message}" if r.message.name else r.message.message for r in records]
    levels = [_LEVELS.get(r.message.level, "INFO") for r in records]
    stream.send_columns("log", times, rr.TextLog.columns(text=text, level=levels))


LOGS: dict[str, Callable[[rr.RecordingStream, Timebase, Sequence[Timed]], None]] = {
    topics.COMMAND: log_commands,
    topics.APPLIED: log_applied,
    topics.EXPOSURE: log_drops,
    topics.LATENCY: log_latency,
    topics.ESTIMATION: log_estimation,
    topics.LINK: log_link,
    topics.CLOCK: log_clock,
    topics.LOG: log_log,
}
"""What shows the messages of a topic, of which there is one at least."""


def _send_blocks(
    stream: rr.RecordingStream, path: str, timebase: Timebase, blocks: Sequence[Any], style: Style
) -> None:
    """Send (first_step, n_steps, u) blocks as one value a fast step and input."""
    blocks = [b for b in blocks if len(b.u)]
    if not blocks:
        return
    steps = np.concatenate([np.arange(b.first_step, b.first_step + b.n_steps, dtype=np.int64) for b in blocks])
    inputs = np.concatenate([np.reshape(b.u, (b.n_steps, -1)) for b in blocks])
    send_axes(stream, path, timebase.every_step(steps), inputs, style)


def _by_device(records: Iterable[Timed]) -> dict[str, list[Timed]]:
    devices: dict[str, list[Timed]] = {}
    for record in records:
        devices.setdefault(record.message.device, []).append(record)
    return devices
