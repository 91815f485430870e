"""What a session does with files that were there before it, and with other programs that move its own."""

from __future__ import annotations

import os
import resource
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from aolink.errors import RecordingError
from aolink.files import create
from aolink.recording import topics
from aolink.recording.editing import recover
from aolink.recording.mcap_file import WriteOptions
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from tests.conftest import EXPOSURES, Session

PARTS = WriteOptions(split_s=0.5)


class Writing:
    """A session that is being written from the messages of a recording."""

    def __init__(self, source: Path, target: Path, options: WriteOptions | None = None, session: str = "a") -> None:
        self.recording = Recording(source)
        facts, start_ns = {"session": session}, self.recording.start_ns
        self.writer = RecordingWriter(
            target, self.recording.rig, facts, start_ns, deterministic=True, options=options, overwrite=True
        )

    def write(self, until: str = "", wait: Callable[[], bool] = lambda: True) -> None:
        """Write the messages up to the first on a topic, and wait for what is to happen then."""
        for each in self.recording.messages():
            self.writer.take(each.topic, each.log_time_ns, each.message)
            if each.topic == until:
                break
        wait_until(wait)

    def write_on(self) -> None:
        """Write until the writer ends it with an error."""

        def written() -> bool:
            self.writer.take(topics.LOG, 0, Log())
            return False

        wait_until(written)


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(20_000):
        if condition():
            return
        time.sleep(0.001)
    pytest.fail("what was waited for has not happened")


def in_parts(source: Path, target: Path, session: str = "a") -> list[Path]:
    writing = Writing(source, target, PARTS, session)
    writing.write()
    writing.writer.close({"ended": "complete"})
    assert writing.writer.paths[-1] == target.with_name(f"{target.stem}-{len(writing.writer.paths):03d}.mcap")
    return writing.writer.paths


@pytest.fixture
def old(tmp_path: Path) -> Path:
    (path := tmp_path / "a.mcap").write_bytes(b"precious")
    path.chmod(0o640)
    return path


def test_the_old_recording_stays_until_the_first_exposure(recorded: Session, old: Path, tmp_path: Path) -> None:
    writing = Writing(recorded.path, old)
    writing.write(topics.EXPOSURE)
    assert old.read_bytes() == b"precious"
    assert writing.writer.paths == []
    with pytest.raises(RecordingError, match="another command"):
        create(old, overwrite=True, error=RecordingError)
    writing.write(topics.IMAGE, lambda: old.read_bytes() != b"precious")
    # The exposure is in the file already: whatever happens now, there is something in the place of the old one.
    shutil.copy(old, copy := tmp_path / "copy.mcap")
    assert Recording(copy).counts[topics.IMAGE] == 1
    assert old.stat().st_mode & 0o777 == 0o640
    writing.writer.close()
    assert writing.writer.paths == [old]
    assert {each.name for each in tmp_path.iterdir()} == {"a.mcap", "copy.mcap"}


@pytest.mark.parametrize("how", ["closed", "error", "full", "killed"])
def test_without_an_exposure_the_old_recording_is_as_it_was(
    recorded: Session, old: Path, tmp_path: Path, how: str
) -> None:
    writing, before = Writing(recorded.path, old), resource.getrlimit(resource.RLIMIT_FSIZE)
    writing.write(topics.EXPOSURE)
    if how == "killed":
        (left,) = (each for each in tmp_path.iterdir() if each != old)
        shutil.copy(left, tmp_path / "left")
    try:
        if how == "full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
            with pytest.raises(RecordingError, match=r"larger[^;]*$"):
                writing.writer.close({"ended": "x" * 1000})
        else:
            writing.writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (old.read_bytes(), writing.writer.paths) == (b"precious", [])
    if how == "killed":
        shutil.move(tmp_path / "left", left)
        create(old, overwrite=True).close()
    assert [*tmp_path.iterdir()] == [old]


def exchanged(path: Path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


@pytest.mark.parametrize("what", ["old", "new", "link", "folder"])
def test_what_another_program_has_put_there_meanwhile_is_not_replaced(
    recorded: Session, old: Path, tmp_path: Path, what: str
) -> None:
    writing = Writing(recorded.path, old)
    (aside,) = (each for each in tmp_path.iterdir() if each != old)
    if what == "link":
        old.unlink()
        old.symlink_to("elsewhere")
    elif what == "folder":
        old.unlink()
        old.mkdir()
    else:
        exchanged(old if what == "old" else aside, b"theirs")
    writing.write(topics.IMAGE)
    with pytest.raises(RecordingError, match=r"another program|symbolic link|folder"):
        writing.write_on()
    there = old if what != "new" else aside
    assert there.is_symlink() or there.is_dir() or there.read_bytes() == b"theirs"


def test_the_same_messages_give_the_same_bytes_over_an_old_file(recorded: Session, old: Path, tmp_path: Path) -> None:
    for target in (old, tmp_path / "b.mcap"):
        writing = Writing(recorded.path, target)
        writing.write()
        writing.writer.close()
    assert old.read_bytes() == (tmp_path / "b.mcap").read_bytes()


def names(folder: Path) -> set[str]:
    return {each.name for each in folder.iterdir()}


def test_only_parts_of_the_session_of_that_name_are_removed(recorded: Session, tmp_path: Path) -> None:
    """Dated recordings, parts of other names, of other sessions, and what is no recording stay as they are."""
    (elsewhere := tmp_path / "elsewhere").mkdir()
    parts = in_parts(recorded.path, tmp_path / "s.mcap")
    assert len(parts) == 5
    in_parts(recorded.path, elsewhere / "s.mcap", "another session")
    in_parts(recorded.path, elsewhere / "t.mcap")
    kept = {
        "s-20261126.mcap": recorded.path, "s-0002.mcap": parts[1], "s-006.mcap": elsewhere / "s-002.mcap",
        "s-007.mcap": elsewhere / "t-003.mcap", "s-008.mcap": parts[2],
    }  # fmt: skip
    for name, source in kept.items():
        shutil.copy(source, tmp_path / name)
    (tmp_path / "s-009.mcap").write_bytes(b"no recording")
    os.mkfifo(tmp_path / "s-010.mcap")
    was = {name: (tmp_path / name).read_bytes() for name in kept}
    with pytest.raises(RecordingError, match="all 5 parts"):
        RecordingWriter(tmp_path / "s.mcap", Recording(parts[0]).rig, {}, 0, options=PARTS)
    writing = Writing(recorded.path, tmp_path / "s.mcap", WriteOptions(split_s=1e6))
    assert [each for each in parts if each.exists()] == parts
    writing.write()
    writing.writer.close()
    assert writing.writer.paths == parts[:1]
    assert names(tmp_path) == {*kept, "s-001.mcap", "s-009.mcap", "s-010.mcap", "elsewhere"}
    assert {name: (tmp_path / name).read_bytes() for name in kept} == was
    (note,) = writing.writer.notes
    assert note == f"parts of an older session were removed: {', '.join(map(str, parts[1:]))}"


def test_parts_go_round_what_is_in_their_way(recorded: Session, tmp_path: Path) -> None:
    for number in (2, 3):
        (tmp_path / f"s-00{number}.mcap").write_bytes(b"theirs")
    writing = Writing(recorded.path, tmp_path / "s.mcap", PARTS)
    writing.write()
    writing.writer.close()
    assert [each.name for each in writing.writer.paths] == [f"s-{k:03d}.mcap" for k in (1, 4, 5, 6, 7)]
    assert Recording(tmp_path / "s-004.mcap").metadata[topics.PART] == "4"
    assert (tmp_path / "s-002.mcap").read_bytes() == b"theirs"
    assert ["s-002.mcap was there already" in writing.writer.notes[0], len(writing.writer.notes)] == [True, 2]


def test_a_first_part_that_is_another_file_is_refused(recorded: Session, tmp_path: Path) -> None:
    shutil.copy(recorded.path, tmp_path / "s-001.mcap")
    with pytest.raises(RecordingError, match="no part"):
        Writing(recorded.path, tmp_path / "s.mcap", PARTS)
    assert (tmp_path / "s-001.mcap").read_bytes() == recorded.path.read_bytes()


HAPPENS: dict[str, Callable[[Path], object]] = {
    "removed": Path.unlink,
    "renamed": lambda path: path.rename(path.with_name("b.mcap")),
    "replaced": lambda path: exchanged(path, b"theirs"),
    "folder renamed": lambda path: path.parent.rename(path.parent.with_name("other")),
    "folder removed": lambda path: shutil.rmtree(path.parent),
}


@pytest.fixture
def seconds(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The clock of the writer's thread alone, whose last element is the time."""
    clock, session, begin = [0.0], threading.current_thread(), time.monotonic()
    monkeypatch.setattr(
        time, "monotonic", lambda: begin + (0.0 if threading.current_thread() is session else clock[-1])
    )
    return clock


@pytest.mark.parametrize("at_the_end", [False, True])
@pytest.mark.parametrize("what", HAPPENS)
def test_a_file_whose_name_is_no_longer_its_own_ends_the_session_and_is_kept(
    recorded: Session, tmp_path: Path, seconds: list[float], what: str, at_the_end: bool
) -> None:
    (folder := tmp_path / "folder").mkdir()
    writing = Writing(recorded.path, folder / "a.mcap")
    writing.write()
    HAPPENS[what](folder / "a.mcap")
    seconds.append(0.0 if at_the_end else 2.0)
    if not at_the_end:
        with pytest.raises(RecordingError, match="renamed"):
            writing.write_on()
    with pytest.raises(RecordingError) as caught:
        writing.writer.close({"ended": "complete"})
    said = str(caught.value)
    if what == "folder removed":
        assert "is lost" in said
        return
    before = "saved as " if what in ("removed", "replaced") else "the recording is "
    place = Path(said.partition(before)[2].split(" now")[0])
    found = Recording(place, check=True)
    assert found.complete
    assert found.metadata["ended"] == "complete"
    assert len(list(found)) == EXPOSURES
    if what == "replaced":
        assert (folder / "a.mcap").read_bytes() == b"theirs"


@pytest.mark.parametrize("at_the_end", [False, True])
@pytest.mark.parametrize("left", [0, 60_000])
def test_a_file_that_is_emptied_or_shortened_ends_the_session_and_has_what_came_afterwards(
    recorded: Session, tmp_path: Path, seconds: list[float], left: int, at_the_end: bool
) -> None:
    writing = Writing(recorded.path, path := tmp_path / "a.mcap")
    for _ in range(3):
        writing.write()
    wait_until(lambda: path.stat().st_size > 2 * 60_000)
    os.truncate(path, left)
    writing.write()
    if not at_the_end:
        seconds.append(2.0)
        with pytest.raises(RecordingError, match="shortened"):
            writing.write_on()
    with pytest.raises(RecordingError, match="shortened"):
        writing.writer.close({"ended": "complete"})
    found = Recording(path)
    assert found.metadata["ended"] == "complete"
    frames = [each.frame_id for each in found]
    assert frames[-EXPOSURES:] == list(range(1, EXPOSURES + 1))
    assert len(frames) < 4 * EXPOSURES
    assert found.losses


def test_a_copy_that_is_shortened_while_it_is_written_is_an_error(recorded: Session, tmp_path: Path) -> None:
    def empty(done: int) -> None:
        if done == EXPOSURES:
            for path in (tmp_path / "copy").iterdir():
                os.truncate(path, 0)

    (tmp_path / "copy").mkdir()
    one = WriteOptions(flush_s=0.001, chunk_bytes=1 << 10)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("aolink.recording.editing.AT_LEISURE", one)  # so that something is written until then
        with pytest.raises(RecordingError, match="shortened"):
            recover(recorded.path, tmp_path / "copy/a.mcap", progress=empty)
    assert not list((tmp_path / "copy").iterdir())
