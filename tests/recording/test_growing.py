"""A recording that is read while it is written gives the exposures that it has when it is finished."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aolink import files
from aolink.errors import RecordingError
from aolink.exposure import Exposure
from aolink.recording import topics
from aolink.recording.growing import GrowingRecording
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.writer import begin_recording
from tests.conftest import EXPOSURES, Session


def same(ours: Exposure, theirs: Exposure) -> bool:
    names = ("pixels", "mask", "inputs", "lead_inputs")
    return (ours.frame_id, ours.first_step) == (theirs.frame_id, theirs.first_step) and all(
        np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in names
    )


def never() -> None:
    raise AssertionError("it waited for a file that nobody writes")


def by_messages(source: Path, target: Path) -> Iterator[bool]:
    """Write a recording anew with what a session writes it with; gives False for each part, True when it is closed."""
    recording = Recording(source)
    file = McapFile(target, WriteOptions())
    facts = {"session": "again", "estimators": " ".join(recording.estimators)}
    begin_recording(file, recording.rig, facts, recording.start_ns, {})
    yield False
    for number, each in enumerate(recording.messages()):
        data = each.message.SerializeToString()
        file.add(each.topic, schema_of(type(each.message)), data, each.log_time_ns, each.sequence)
        if number % 7 == 0:
            file.flush()
            yield False
    file.add_metadata(topics.END_METADATA, {"ended": "complete"})
    file.finish()
    yield True


def by_bytes(source: Path, target: Path, end: int | None = None) -> Iterator[bool]:
    """The same, some bytes at a time: records are torn, as the operating system may tear them."""
    data, descriptor = source.read_bytes()[:end], files.create(target).descriptor
    for begin in range(0, len(data), 997):
        os.write(descriptor, data[begin : begin + 997])
        yield False
    os.close(descriptor)
    yield True


@pytest.mark.parametrize("how", [by_messages, by_bytes])
def test_exposures_come_while_the_recording_is_written(
    recorded: Session, tmp_path: Path, how: Callable[[Path, Path], Iterator[bool]]
) -> None:
    parts = how(recorded.path, tmp_path / "growing.mcap")
    closed = [next(parts)]
    growing = GrowingRecording(tmp_path / "growing.mcap", lambda: closed.append(next(parts)))
    came = [(exposure, closed[-1]) for exposure in growing.exposures()]
    theirs = list(Recording(recorded.path).exposures())
    assert len(came) == len(theirs) == EXPOSURES
    assert all(same(ours, other) for (ours, _), other in zip(came, theirs, strict=True))
    assert not any(at_end for _, at_end in came[: EXPOSURES // 2])
    assert growing.complete
    assert growing.end_metadata["ended"] == "complete"


@pytest.mark.parametrize("how", [by_messages, by_bytes])
def test_estimates_come_with_their_exposures(
    recorded: Session, tmp_path: Path, how: Callable[[Path, Path], Iterator[bool]]
) -> None:
    parts = how(recorded.path, tmp_path / "growing.mcap")
    closed = [next(parts)]
    growing, whole = (
        GrowingRecording(tmp_path / "growing.mcap", lambda: closed.append(next(parts))),
        Recording(recorded.path),
    )
    assert growing.estimators == whole.estimators != []
    came = [(found, closed[-1]) for _, found in growing.walk()]
    assert not any(at_end for _, at_end in came[: EXPOSURES // 2])
    for (ours, _), (_, theirs) in zip(came, whole.walk(), strict=True):
        assert ours.keys() == theirs.keys()
        assert all(ours[name].path.tobytes() == theirs[name].path.tobytes() for name in theirs)


def test_a_finished_one_goes_through_at_once(recorded: Session) -> None:
    growing = GrowingRecording(recorded.path, never)
    assert sum(1 for _ in growing.exposures()) == EXPOSURES


def test_one_that_its_session_did_not_finish_ends_with_what_is_whole(recorded: Session, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    parts = by_bytes(recorded.path, path, recorded.path.stat().st_size // 2)
    next(parts)

    def go_on() -> None:
        next(parts)

    growing = GrowingRecording(path, go_on)
    ours = list(growing.exposures())
    theirs = list(Recording(path).exposures())
    assert 0 < len(ours) == len(theirs) < EXPOSURES
    assert all(map(same, ours, theirs))
    assert "it was cut off" in growing.damage


def test_what_cannot_be_followed_is_one_error(recorded: Session, tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("not a recording, although it is long enough")
    for name, says in (
        (tmp_path / "none.mcap", "no such file"),
        (tmp_path / "empty.mcap", "empty or too short"),
        (tmp_path / "text.mcap", "not an MCAP file"),
    ):
        with pytest.raises(RecordingError, match=says):
            GrowingRecording(name, never)


def test_a_file_that_makes_no_sense_or_is_replaced_is_one_error(recorded: Session, tmp_path: Path) -> None:
    data, path = recorded.path.read_bytes(), tmp_path / "damaged.mcap"
    end = data.rindex(b"\x0f\x04" + bytes(7))  # the end of the data
    path.write_bytes(data[:end] + b"\xc8\x04" + data[end + 2 :])
    with pytest.raises(RecordingError, match="aolink copy"):
        list(GrowingRecording(path, never).exposures())
    parts = by_bytes(recorded.path, tmp_path / "short.mcap")
    next(parts)

    def shorten() -> None:
        next(parts)
        if (tmp_path / "short.mcap").stat().st_size > len(data) // 2:
            os.truncate(tmp_path / "short.mcap", 100)

    with pytest.raises(RecordingError, match="begin again"):
        list(GrowingRecording(tmp_path / "short.mcap", shorten).exposures())
