"""Small recordings as other software writes them (pages/recording_format.md), and copies with changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap_protobuf.writer import Writer

from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import ExposureInfo
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from aolink.wire.messages_pb2 import Applied, Truth

Pixels = Literal["spot", "nothing", "black", "below black", "full"]


def write_small(
    path: Path, exposures: int, pixels: Pixels = "spot", *, rig: str = "section-vi", applied: bool = True,
    truth: bool = False, missing: bool = False, shape: tuple[int, int] | None = None,
) -> Path:  # fmt: skip
    """Write a recording with so many exposures of a rig, 200 ms apart from 2023-11-14 22:13:20 UTC on.

    Parameters
    ----------
    pixels:
        What is in the frames; ``black`` is the sensor's black level.
    missing:
        Whether all pixels are said to be missing.
    shape:
        Rows and columns of the frames, if not those of the rig.
    """
    known = load_rig(rig)
    sensor, steps = known.sensor, known.timing.exposure_steps
    levels = {"nothing": 0, "black": sensor.black_level, "below black": sensor.black_level / 2, "full": 65535}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.add_attachment(0, 0, "rig.toml", "application/toml", known.toml.encode())
        sequence = 0
        for number, made in enumerate(simulate(known, exposures, 1)):
            now, first = 1_700_000_000_000_000_000 + number * 200_000_000, number * steps
            counts = made.pixels if pixels == "spot" else np.full(shape or sensor.shape, levels[pixels])
            rows, columns = counts.shape
            info = ExposureInfo(frame_id=number + 1, first_step=first, last_step=first + steps - 1, host_start_ns=now)
            if missing:
                info.missing_offset.append(0)
                info.missing_length.append(2 * counts.size)
            data = counts.astype("<u2").tobytes()
            image = RawImage(width=columns, height=rows, encoding="mono16", step=2 * columns, data=data)
            messages = [("/camera/exposure", info), ("/camera/image", image)]
            if applied:
                run = Applied(first_step=first, n_steps=steps, u=[0.0] * (steps * known.n_inputs))
                messages.append(("/mirror/applied", run))
            if truth and made.truth is not None:
                truth_message = Truth(frame_id=number + 1, axes=known.plant.axes, n_outputs=known.n_outputs)
                truth_message.start_state.extend(made.truth.start_state.ravel())
                truth_message.end_state.extend(made.truth.end_state.ravel())
                truth_message.path.extend(made.truth.path.ravel())
                messages.append(("/truth", truth_message))
            for topic, message in messages:
                sequence += 1
                writer.write_message(topic, message, now, now, sequence)
        writer.finish()
    return path


def copied(
    source: Path, target: Path, change: Callable[[str, Message], list[Message]] = lambda topic, message: [message],
    **options: Any,
) -> list[Path]:  # fmt: skip
    """A copy whose messages went through ``change``; gives its files, of which there are several if it is split."""
    recording = Recording(source)
    with RecordingWriter(
        target, recording.rig, recording.metadata, recording.start_ns, deterministic=True, **options
    ) as writer:
        for each in recording.messages():
            for message in change(each.topic, each.message):
                writer.take(each.topic, each.log_time_ns, message)
    return writer.paths
