"""A copy has each message of its sources, or a loss is named: of joined recordings, and of the pieces of one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.wrappers_pb2 import StringValue
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_protobuf.writer import Writer

from aolink.errors import RecordingError
from aolink.recording import topics
from aolink.recording.editing import Edited, cut, merge, recover
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import ClockSample, ExposureInfo, Latency
from aolink.rig import load_rig
from aolink.wire.messages_pb2 import Applied

RIG = load_rig("section-vi")
Contents = Counter[tuple[str, int, bytes]]


class Line(NamedTuple):
    """A message of a recording."""

    topic: str
    message: Message
    time_ns: int


def write(path: Path, lines: Sequence[Line]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.add_attachment(0, 0, topics.RIG_ATTACHMENT, "application/toml", RIG.toml.encode())
        for number, line in enumerate(lines, 1):
            writer.write_message(line.topic, line.message, line.time_ns, line.time_ns, number)
        writer.finish()
    return path


def contents(path: Path) -> Contents:
    """How often each message that can be used is in a recording."""
    return Counter((raw.topic, raw.log_time_ns, raw.data) for raw, _ in Recording(path).sound_messages())


def lost(edited: Edited) -> int:
    return sum(loss.count for loss in edited.losses)


def is_bad(line: Line) -> bool:
    return isinstance(line.message, Applied) and len(line.message.u) != line.message.n_steps * RIG.n_inputs


@st.composite
def sessions(draw: st.DrawFn) -> list[Line]:
    """Messages of all kinds in the order of their times: also of lost frames, of other software, and bad ones."""
    kinds = ("frame", "log", "clock", "latency", "applied", "bad", "foreign")
    lines, now, frame = [Line(topics.LOG, Log(message="begin"), 10**18)], 10**18, 0
    for kind in draw(st.lists(st.sampled_from(kinds), max_size=20)):
        now += draw(st.sampled_from((0, 1, 10**9, 3 * 10**9)))
        frame += kind == "frame"
        step = 200 * frame
        lines += {
            "frame": [
                Line(topics.EXPOSURE, ExposureInfo(frame_id=frame, first_step=step, last_step=step + 199), now),
                Line(topics.IMAGE, RawImage(width=40, height=1, encoding="mono16", step=80, data=bytes(80)), now),
            ],
            "log": [Line(topics.LOG, Log(message="retry"), now)] * draw(st.integers(1, 3)),
            "clock": [Line(topics.CLOCK, ClockSample(device="camera"), now)],
            "latency": [Line(topics.LATENCY, Latency(frame_id=draw(st.integers(0, 4))), now)],
            "applied": [Line(topics.APPLIED, Applied(first_step=step, n_steps=2, u=[0.0] * 2 * RIG.n_inputs), now)],
            "bad": [Line(topics.APPLIED, Applied(first_step=step, n_steps=1000, u=[0.0]), now)],
            "foreign": [Line("/mine", StringValue(value="x"), now)],
        }[kind]
    return lines


@pytest.mark.slow
@settings(max_examples=40)
@given(sessions(), st.data())
def test_joined_recordings_have_each_message_of_both(session: list[Line], data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        a, b, both = (Path(folder, name) for name in ("a.mcap", "b.mcap", "both.mcap"))
        picked = [
            [line for line, keep in zip(session, data.draw(flags), strict=True) if keep]
            for flags in [st.lists(st.booleans(), min_size=len(session), max_size=len(session))] * 2
        ]
        for path, lines in zip((a, b), picked, strict=True):
            write(path, lines)
        edited = merge([a, b], both)
        assert contents(both) == contents(a) | contents(b)
        assert lost(edited) == sum(map(is_bad, picked[0] + picked[1]))


@pytest.mark.slow
@settings(max_examples=40)
@given(sessions(), st.sampled_from((1e-9, 1.0, 4.0)))
def test_the_pieces_of_a_recording_have_each_message_of_it(session: list[Line], at_s: float) -> None:
    with TemporaryDirectory() as folder:
        source, found, bad = write(Path(folder, "source.mcap"), session), Contents(), sum(map(is_bad, session))
        recovered = recover(source, Path(folder, "recovered.mcap"))
        assert (contents(recovered.path), lost(recovered)) == (contents(source), bad)
        if not recovered.exposures:
            with pytest.raises(RecordingError, match="no exposure"):
                cut(source, Path(folder, "whole.mcap"), 0, 1e6)
            return
        whole = cut(source, Path(folder, "whole.mcap"), 0, 1e6)
        assert (contents(whole.path), lost(whole)) == (contents(source), bad)
        for name, span in (("before", (0, at_s)), ("after", (at_s, 1e6))):
            try:
                found |= contents(cut(source, Path(folder, f"{name}.mcap"), *span).path)
            except RecordingError:  # there is no exposure in this piece
                return
        assert found == contents(source)
