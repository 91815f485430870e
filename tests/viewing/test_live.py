"""The view of a session while it goes on: it shows what a saved view shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

from aolink.errors import ViewerError
from aolink.recording import topics
from aolink.recording.messages import RecordedMessage
from aolink.recording.reader import Recording
from aolink.recording.topics import TOPICS, Curve, Topic
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.session import record
from aolink.viewing import live_process, save_rrd
from aolink.viewing.live import LiveView, drawn
from aolink.viewing.live_process import LiveSender
from tests.commands import simulated_rig
from tests.viewing.rrd import Entities, read_blueprint, read_rrd, scalars

NAMES = ["open-loop", "o1", "o3"]
RIG = "section-vi-lively"
PAGED = ("/camera/history", "/session", "/nis", "/profile", "/mirror")
"""Entities that depend on the parts in which a session is drawn: its page, constants, scales, and points left out."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, Entities]:
    """A session that has lost frames, and what its live view has drawn."""
    folder = tmp_path_factory.mktemp("live")
    with (
        simulated_rig(RIG, "--fault", "missing=0.2") as ports,
        drawn(str(folder / "live.rrd"), load_rig(RIG), NAMES) as live,
    ):
        record(load_rig(RIG), *ports, folder / "a.mcap", estimators=NAMES, exposures=12, sinks=[live])
    assert (live.left_out, live.failed) == (0, "")
    return Recording(folder / "a.mcap"), read_rrd(folder / "live.rrd")


def values(entity: dict[str, list[Any]], column: str) -> list[Any]:
    return [value for value in entity.get(column, []) if value is not None]


@pytest.mark.slow
def test_it_shows_what_a_saved_view_shows(recorded: tuple[Recording, Entities], tmp_path: Path) -> None:
    recording, ours = recorded
    theirs = read_rrd(save_rrd(recording, tmp_path / "saved.rrd"))
    assert ours.keys() == theirs.keys()
    for entity in ours:
        if not entity.startswith((*PAGED, "/__")):
            for column in ("Image:buffer", "Scalars:scalars", "StateChange:state", "TextLog:text"):
                mine, other = (values(each[entity], column) for each in (ours, theirs))
                assert str(mine) == str(other), (entity, column)
    for entity in ("/profile/path/o3", "/profile/predicted/o3", "/profile/measured"):
        assert len(values(ours[entity], "LineStrips2D:strips")) == len(recording)
    pages = [values(each["/camera/history"], "Image:buffer")[-1] for each in (ours, theirs)]
    assert np.shape(pages[0]) == np.shape(pages[1])
    assert f"{len(recording)} exposures so far" in str(ours["/session"])


def messages_of(messages: Sequence[RecordedMessage], frame_id: int) -> int:
    """Where the messages of a frame begin."""
    return next(
        k for k, each in enumerate(messages)
        if each.topic == topics.EXPOSURE and each.message.frame_id == frame_id  # type: ignore[attr-defined]
    )  # fmt: skip


@pytest.fixture
def sender(recorded: tuple[Recording, Entities], tmp_path: Path) -> Iterator[Callable[[], LiveSender]]:
    made: list[rr.RecordingStream] = []

    def make() -> LiveSender:
        stream = rr.RecordingStream("test")
        stream.save(tmp_path / f"{len(made)}.rrd")
        made.append(stream)
        return LiveSender(stream, recorded[0].rig, NAMES)

    yield make
    for each in made:
        each.disconnect()


def test_an_estimate_that_never_comes_holds_up_nothing(
    recorded: tuple[Recording, Entities], sender: Callable[[], LiveSender], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_process, "_PATIENCE", 1)
    live = sender()
    for each in recorded[0].messages():
        if each.topic != topics.estimate_topic("o3"):
            live.take(each.topic, each.log_time_ns, each.message)
    live.draw()
    assert 0 < live.sent < len(recorded[0])
    live.draw(ended=True)
    assert live.sent == len(recorded[0])


def test_what_is_left_out_is_named_and_was_not_lost(
    recorded: tuple[Recording, Entities], sender: Callable[[], LiveSender], tmp_path: Path
) -> None:
    live, recording = sender(), recorded[0]
    messages, frames = list(recording.messages()), [each.frame_id for each in recording]
    gap = next(k for k, (a, b) in enumerate(pairwise(frames)) if b - a > 1)
    # All messages between the pictures of the exposures before and after the frames that were lost.
    low, high = (messages_of(messages, frames[k]) for k in (gap - 1, gap + 2))
    for each in messages[:low]:
        live.take(each.topic, each.log_time_ns, each.message)
    live.leave_out(high - low)
    for each in messages[high:]:
        live.take(each.topic, each.log_time_ns, each.message)
    live.draw(ended=True)
    live.drawing.stream.disconnect()
    entities = read_rrd(tmp_path / "0.rrd")
    assert f"{high - low} messages were left out" in str(entities["/session"])
    assert "LOST" not in str(values(entities["/status/exposure"], "StateChange:state"))


def test_a_view_that_takes_nothing_leaves_out_and_never_waits(recorded: tuple[Recording, Entities]) -> None:
    """In real time; where it may wait, nothing is left out."""

    class Stuck:
        def write(self, data: bytes) -> int:
            raise BrokenPipeError(32, "Broken pipe")

        flush = close = lambda self: None

    live = LiveView(Stuck())  # type: ignore[arg-type]
    for each in recorded[0].messages():
        live.take(each.topic, each.log_time_ns, each.message)
    live.close()
    assert "Broken pipe" in live.failed
    for each in recorded[0].messages():
        live.take(each.topic, each.log_time_ns, each.message)


def test_a_view_that_fails_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ViewerError, match="failed"), drawn(str(tmp_path / "no" / "a.rrd"), load_rig(RIG), ["o1"]):
        pass


def made_message() -> type[Message]:
    """A message that other software might add: the temperature of a mirror."""
    file = descriptor_pb2.FileDescriptorProto(name="temperature.proto", package="tests", syntax="proto3")
    message = file.message_type.add(name="Temperature")
    kinds = descriptor_pb2.FieldDescriptorProto
    message.field.add(name="device", number=1, type=kinds.TYPE_STRING, label=kinds.LABEL_OPTIONAL)
    message.field.add(name="kelvin", number=2, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("tests.Temperature"))


@pytest.fixture
def temperature(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The message, with a row in the table."""
    kind = made_message()
    row = Topic("/temperature", kind, "time", curves=(Curve("kelvin", "housing", "Temperature (mK)", 1e3),))
    topics.named.cache_clear()
    with monkeypatch.context() as changed:
        changed.setattr(topics, "TOPICS", (*TOPICS, row))
        changed.setitem(topics.SCHEMAS, "tests.Temperature", kind)
        yield kind
    topics.named.cache_clear()


def test_a_quantity_is_a_message_and_a_row(
    recorded: tuple[Recording, Entities], sender: Callable[[], LiveSender], temperature: Any, tmp_path: Path
) -> None:
    """With them it is recorded, and drawn live and saved, in a view of its own."""
    recording, live, told = recorded[0], sender(), 0
    with RecordingWriter(tmp_path / "t.mcap", recording.rig, recording.metadata, 0, deterministic=True) as writer:
        for each in recording.messages():
            writer.take(each.topic, each.log_time_ns, each.message)
            if each.topic == topics.EXPOSURE:
                message = temperature(device="mirror", kelvin=293.0 + 0.01 * told)
                writer.take("/temperature", each.log_time_ns, message)
                told += 1
    warm = Recording(tmp_path / "t.mcap")
    for each in warm.messages():
        live.take(each.topic, each.log_time_ns, each.message)
    live.draw(ended=True)
    live.drawing.stream.disconnect()
    expected = [293e3 + 10 * k for k in range(len(recording))]
    saved = save_rrd(warm, tmp_path / "saved.rrd")
    for path in (tmp_path / "0.rrd", saved):
        np.testing.assert_allclose(scalars(read_rrd(path)["/temperature/kelvin/mirror"])[:, 0], expected)
    assert "Temperature (mK)" in str(read_blueprint(saved))
