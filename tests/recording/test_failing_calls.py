"""Every n-th call to the disk is made to fail while a recording is written: what is there can be read, or an error says
that it is not. The files are real, and so are all other calls."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from aolink.errors import RecordingError
from aolink.recording.editing import recover
from aolink.recording.mcap_file import WriteOptions
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from tests.recording.small import write_small

CALLS = ("open", "write", "pwrite", "ftruncate", "fsync", "link", "rename", "replace", "unlink", "close", "dup")
PRECIOUS = b"precious"


class Faults:
    """Makes calls of `CALLS` fail by their number, counted from 1."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.first = self.last = self.made = 0
        self.number = errno.EIO
        self._lock = threading.Lock()
        for name in CALLS:
            monkeypatch.setattr(os, name, self._failing(name, getattr(os, name)))

    def begin(self, first: int, last: int, number: int) -> None:
        self.made, self.first, self.last, self.number = 0, first, last, number

    def end(self) -> bool:
        """Make no more calls fail; gives whether any has."""
        self.first, failed = 0, 0 < self.first <= self.made
        return failed

    def _failing(self, name: str, call: Any) -> Any:
        def called(*arguments: Any, **options: Any) -> Any:
            with self._lock:
                self.made += 1
                fails = 0 < self.first <= self.made <= self.last
            if fails and name == "close":
                call(*arguments)  # Linux closes it all the same
            if fails:
                raise OSError(self.number, os.strerror(self.number))
            return call(*arguments, **options)

        return called


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small(tmp_path_factory.mktemp("source") / "s.mcap", 4)


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> Iterator[Faults]:
    faults = Faults(monkeypatch)
    yield faults
    faults.end()


def said(path: Path) -> list[tuple[str, int, bytes]]:
    return [(raw.topic, raw.log_time_ns, raw.data) for raw in Recording(path).raw_messages()]


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def write(source: Recording, target: Path, options: WriteOptions) -> str:
    """Write the messages of a recording into another; gives the error."""
    try:
        facts = {"session": "a"}
        with RecordingWriter(target, source.rig, facts, source.start_ns, overwrite=True, options=options) as writer:
            for each in source.messages():
                writer.take(each.topic, each.log_time_ns, each.message)
    except RecordingError as error:
        return str(error)
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC], ids=["EIO", "ENOSPC"])
@pytest.mark.parametrize("lasting", [False, True], ids=["once", "from then on"])
@pytest.mark.parametrize(("old", "split_s"), [(False, 0.0), (True, 0.0), (False, 0.3)], ids=["new", "old", "parts"])
def test_a_session_whose_nth_call_fails(
    source: Path, faults: Faults, tmp_path: Path, number: int, lasting: bool, old: bool, split_s: float
) -> None:
    whole, recording = said(source), Recording(source)
    for n in count(1):
        (folder := tmp_path / str(n)).mkdir()
        target, before = folder / "a.mcap", descriptors()
        if old:
            target.write_bytes(PRECIOUS)
        faults.begin(n, 1 << 30 if lasting else n, number)
        error = write(recording, target, WriteOptions(chunk_bytes=1 << 12, split_s=split_s))
        failed = faults.end()
        found: list[tuple[str, int, bytes]] = []
        for path in sorted(folder.glob("*.mcap")):
            # Without its beginning it is removed, unless that fails too.
            if path.read_bytes() != PRECIOUS and not (lasting and b"[timing]" not in path.read_bytes()):
                found += [each for each in said(path) if each not in found]
        assert found == whole[: len(found)], n
        assert error or found == whole, n
        assert descriptors() == before, n
        if not lasting:
            assert len([*folder.glob(".*")]) <= 1, n
        if not failed:
            assert not error
            break
    assert n > 20


@pytest.mark.slow
@pytest.mark.parametrize("lasting", [False, True], ids=["once", "from then on"])
def test_a_copy_whose_nth_call_fails(source: Path, faults: Faults, tmp_path: Path, lasting: bool) -> None:
    """It is whole, or the old file is as it was."""
    whole = said(source)
    for n in count(1):
        (target := tmp_path / f"{n}.mcap").write_bytes(PRECIOUS)
        before, error = descriptors(), ""
        faults.begin(n, 1 << 30 if lasting else n, errno.EIO)
        try:
            recover(source, target, overwrite=True)
        except RecordingError as why:
            error = str(why)
        failed = faults.end()
        assert descriptors() == before, n
        if target.read_bytes() != PRECIOUS:
            assert said(target) == whole, n
        else:
            assert error, n
        if not failed:
            assert not error
            break
    assert n > 5
