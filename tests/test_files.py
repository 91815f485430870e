"""Every file that aolink writes: whole or not at all, its permissions kept, nothing followed, no two at once."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import AolinkError, RecordingError
from aolink.files import create, writing
from aolink.recording.editing import cut
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from tests.conftest import Session

Run = Callable[..., subprocess.CompletedProcess[str]]


def put(target: Path, text: str, *, overwrite: bool = False) -> None:
    with writing(target, overwrite=overwrite) as partial:
        partial.write_text(text)


def test_a_new_file_has_the_permissions_that_the_umask_leaves(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        put(tmp_path / "a", "new")
        create(tmp_path / "b").close()
    finally:
        os.umask(before)
    assert [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in "ab"] == [0o640, 0o640]


@pytest.mark.parametrize("mode", [0o600, 0o664, 0o440])
def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path: Path, mode: int) -> None:
    (target := tmp_path / "a").write_text("old")
    target.chmod(mode)
    with writing(target, overwrite=True) as partial:
        assert stat.S_IMODE(partial.stat().st_mode) == mode, "nor is it open to others while it is written"
    assert stat.S_IMODE(target.stat().st_mode) == mode


def test_what_is_planted_where_others_would_write_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name that a file has while it is written cannot be guessed; and if it is, nothing is written through it."""
    (victim := tmp_path / "victim").write_text("precious")
    (tmp_path / ".a.partial").symlink_to(victim)
    put(tmp_path / "a", "new")
    (planted := tmp_path / f".b.{'0' * 16}.partial").symlink_to(victim)
    monkeypatch.setattr("secrets.token_hex", lambda count: "0" * 2 * count)
    with pytest.raises(AolinkError):
        put(tmp_path / "b", "new")
    assert victim.read_text() == "precious"
    assert planted.is_symlink()
    assert not (tmp_path / "b").exists()


def test_a_file_that_somebody_exchanges_while_it_is_written_is_not_taken(tmp_path: Path) -> None:

    def exchange() -> None:
        with writing(tmp_path / "a") as partial:
            partial.unlink()
            partial.symlink_to(tmp_path / "b")

    with pytest.raises(AolinkError, match="another program has put a file in the place"):
        exchange()
    assert not [*tmp_path.iterdir()]


def kinds(folder: Path) -> dict[str, str]:
    """Names of what is there but is no plain file, and what is said of it."""
    (folder / "folder").mkdir()
    os.mkfifo(folder / "pipe")
    (folder / "file").write_text("precious")
    (folder / "link").symlink_to(folder / "file")
    (folder / "loose").symlink_to(folder / "nothing")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(folder / "socket"))
    return {
        "folder": "is a folder: give the name of a file in it",
        "pipe": "is a named pipe",
        "link": "is a symbolic link: give the name of the file",
        "loose": "is a symbolic link",
        "socket": "is a socket",
    }


@pytest.mark.parametrize("overwrite", [False, True])
def test_only_plain_files_are_written(tmp_path: Path, overwrite: bool) -> None:
    for name, message in kinds(tmp_path).items():
        with pytest.raises(AolinkError, match=message):
            put(tmp_path / name, "new", overwrite=overwrite)
        with pytest.raises(AolinkError, match=message):
            create(tmp_path / name, overwrite=overwrite)
    assert (tmp_path / "file").read_text() == "precious"
    assert not (tmp_path / "nothing").exists()


def test_a_command_does_not_wait_for_a_pipe(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    refused = aolink("copy", recorded.path, "-o", "a.mcap", "--overwrite")
    assert refused.returncode == 5
    assert refused.stderr.startswith("aolink: a.mcap is a named pipe")


def test_when_it_goes_wrong_the_target_stays_as_it_was_and_nothing_is_left(tmp_path: Path) -> None:
    (target := tmp_path / "a").write_text("old")

    def fail(problem: type[BaseException]) -> None:
        with writing(target, overwrite=True) as partial:
            partial.write_text("half")
            raise problem

    for problem in (ValueError, KeyboardInterrupt, SystemExit):
        with pytest.raises(problem):
            fail(problem)
    assert [each.name for each in tmp_path.iterdir()] == ["a"]
    assert target.read_text() == "old"


def test_what_came_into_being_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def write() -> None:
        with writing(tmp_path / "a") as partial:
            partial.write_text("mine")
            (tmp_path / "a").write_text("theirs")

    with pytest.raises(AolinkError, match="exists and is not overwritten"):
        write()
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("a", "theirs")]


def test_the_file_is_on_the_disk_before_it_has_its_name_and_the_name_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut between the two would otherwise leave an empty file in the place of the old one."""
    seen: list[str] = []

    def spy(name: str) -> None:
        real = getattr(os, name)

        def watched(first: int | Path, *rest: Path) -> None:
            folder = isinstance(first, int) and stat.S_ISDIR(os.fstat(first).st_mode)
            seen.append(f"{name} folder" if folder else name)
            real(first, *rest)

        monkeypatch.setattr(os, name, watched)

    for name in ("fsync", "replace", "link"):
        spy(name)
    put(tmp_path / "a", "new")
    put(tmp_path / "a", "newer", overwrite=True)
    assert seen == ["fsync", "link", "fsync folder", "fsync", "replace", "fsync folder"]


def test_of_several_at_the_same_instant_one_writes_and_the_others_are_refused(tmp_path: Path) -> None:
    """Each opens the files by itself, so that threads are to these locks what processes are."""
    target, count = tmp_path / "a", 4
    together, out = threading.Barrier(count), threading.Semaphore(0)
    ended: list[str] = []

    def write(number: int) -> None:
        together.wait()
        try:
            with writing(target, overwrite=True) as partial:
                partial.write_text(str(number) * 1000)
                for _ in range(count - 1):
                    assert out.acquire(timeout=30)
            ended.append(str(number))
        except AolinkError as error:
            ended.append(str(error))
        finally:
            out.release()

    threads = [threading.Thread(target=write, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    refused = [each for each in ended if "is being written by another command" in each]
    assert len(refused) == count - 1, ended
    assert target.read_text() == ended[-1] * 1000
    assert [*tmp_path.iterdir()] == [target]


def test_a_name_that_is_the_beginning_of_another_is_another(tmp_path: Path) -> None:
    with writing(tmp_path / "a.mcap") as one, writing(tmp_path / "a") as other:
        one.write_text("1")
        other.write_text("2")
    assert ((tmp_path / "a.mcap").read_text(), (tmp_path / "a").read_text()) == ("1", "2")


def test_the_longest_name_that_there_can_be(tmp_path: Path) -> None:
    put(tmp_path / ("n" * 255), "new")
    with pytest.raises(AolinkError, match="file name too long"):
        put(tmp_path / ("n" * 256), "new")


def test_what_a_killed_command_left_is_removed_by_the_next(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib; from aolink.files import writing\n"
        "with writing(pathlib.Path('a')) as partial:\n"
        "    partial.write_text('half'); print(partial, flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        assert process.stdout is not None
        left = tmp_path / process.stdout.readline().strip()
        with pytest.raises(AolinkError, match="is being written by another command"):
            put(tmp_path / "a", "new")
        assert left.read_text() == "half", "a living command keeps what it writes"
        process.kill()
        process.communicate()
    assert left.exists()
    put(tmp_path / "a", "new")
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("a", "new")]


def test_a_recording_that_a_session_writes_is_not_taken_away(recorded: Session, tmp_path: Path) -> None:
    target = tmp_path / "a.mcap"
    with RecordingWriter(target, load_rig("section-vi"), {}, 0) as writer:
        with pytest.raises(RecordingError, match="is being written by another command"):
            cut(recorded.path, target, 0.0, 1.0, overwrite=True)
        with pytest.raises(RecordingError, match="is being written by another command"):
            RecordingWriter(target, load_rig("section-vi"), {}, 0, overwrite=True)
        with pytest.raises(RecordingError, match="exists and is not overwritten"):
            RecordingWriter(target, load_rig("section-vi"), {}, 0)
        assert writer.paths == [target]
    assert Recording(target).complete
    cut(recorded.path, target, 0.0, 1.0, overwrite=True)


def test_a_session_does_not_begin_where_a_command_is_writing(tmp_path: Path) -> None:
    target = tmp_path / "a.mcap"
    for overwrite in (False, True):
        with writing(target, overwrite=overwrite) as partial:
            partial.write_text("mine")
            with pytest.raises(RecordingError, match="is being written by another command"):
                RecordingWriter(target, load_rig("section-vi"), {}, 0, overwrite=overwrite)
        assert target.read_text() == "mine"


@pytest.fixture(scope="module")
def sources(recorded: Session, tmp_path_factory: pytest.TempPathFactory, mmirs: Path) -> dict[str, Path]:
    """Something to read for each command that writes."""
    folder = tmp_path_factory.mktemp("sources")
    cut(recorded.path, folder / "first.mcap", 0.0, 1.0)
    cut(recorded.path, folder / "second.mcap", 1.0, 2.0)
    np.save(folder / "picture.npy", np.random.default_rng(1).random((16, 16)))
    (folder / "psf.csv").write_text("1,1,1")
    return {
        "session": recorded.path,
        "frame": mmirs / "mmirs_wfs_0150.fits.gz",
        "reference": mmirs / "mmirs_camera2_ref.fits.gz",
        **{path.stem: path for path in folder.iterdir()},
    }


WRITING = {
    "copy": "copy {session} -o {target}.mcap",
    "join": "copy {first} {second} -o {target}.mcap",
    "estimate": "estimate {session} -e o1 -o {target}.mcap",
    "deblur": "deblur {session} -e o1 -o {target}.mcap",
    "deblur --psf": "deblur {picture} --psf {psf} --noise-sd 0.1 -o {target}.npy",
    "view": "view {session} -o {target}.rrd",
    "import": "import {session} --rig section-vi-lively -o {target}.mcap",
    "export": "export {session} -o {target}.npz",
    "slopes -o": "slopes {frame} --reference {reference} -o {target}.npz",
    "slopes of Rerun": "slopes {frame} --reference {reference} -o {target}.rrd",
}
"""Commands that write a file, by what they do."""


def arguments(command: str, sources: dict[str, Path], target: str) -> list[str]:
    return WRITING[command].format(target=target, **sources).split()


@pytest.mark.slow
@pytest.mark.parametrize("command", WRITING)
def test_a_target_that_another_command_writes_is_refused(
    aolink: Run, sources: dict[str, Path], tmp_path: Path, command: str
) -> None:
    words = arguments(command, sources, "a")
    target = tmp_path / words[-1]
    with writing(target) as partial:
        partial.write_text("mine")
        refused = aolink(*words)
    assert refused.returncode not in (0, 1), refused.stderr
    assert refused.stderr.startswith(f"aolink: {target.name} is being written by another command")
    assert refused.stderr.count("\n") == 1
    again = aolink(*words)
    assert again.returncode != 0
    assert "exists and is not overwritten" in again.stderr
    assert target.read_text() == "mine"
    assert aolink(*words, "--overwrite").returncode == 0
    assert target.read_bytes() != b"mine"
    assert [*tmp_path.iterdir()] == [target]


@pytest.fixture
def in_read_only_folder(tmp_path: Path) -> Iterator[Run]:
    """Run the command line where the folder ``ro`` cannot be written: a file system mounted read-only, or without
    rights to mount one a folder without the right to write, which holds for everybody but root."""
    (folder := tmp_path / "ro").mkdir()
    within = ["unshare", "-m", "sh", "-c", 'mount -t tmpfs tmpfs ro && mount -o remount,ro ro && exec "$@"', "sh"]
    if os.geteuid():
        within = []
        folder.chmod(0o555)
    elif not shutil.which("unshare") or subprocess.run([*within, "true"], cwd=tmp_path, capture_output=True).returncode:
        pytest.skip("root writes everywhere, and this root may not mount a read-only file system (unshare -m)")

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        command = [*within, sys.executable, "-m", "aolink", *words]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)

    yield run
    folder.chmod(0o755)


@pytest.mark.slow
@pytest.mark.parametrize("command", WRITING)
def test_a_read_only_file_system_is_one_clear_line(
    in_read_only_folder: Run, sources: dict[str, Path], command: str
) -> None:
    words = arguments(command, sources, "ro/a")
    refused = in_read_only_folder(*words)
    why = "(read-only file system|permission denied)"
    assert refused.returncode not in (0, 1), refused.stderr
    assert re.fullmatch(rf"aolink: cannot write {words[-1]}: {why}\n", refused.stderr), refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["demo", "--rig", "tip-tilt", "-o", "ro"], ["estimate", "{0}", "-e", "o1", "-o", "ro/out/"]]
)
def test_a_folder_that_cannot_be_made_is_one_clear_line(
    in_read_only_folder: Run, recorded: Session, words: list[str]
) -> None:
    refused = in_read_only_folder(*[word.format(recorded.path) for word in words])
    assert refused.returncode in (1, 2)
    assert refused.stderr.startswith("aolink: ")
    assert refused.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("view {session} -o a.mcap", "cannot write a.mcap: what is written is a .rrd file"),
        ("slopes {frame} --reference {reference} -o a.txt", "cannot write a.txt: what is written is a .npz file"),
    ],
)
def test_a_name_that_says_another_kind_of_file_is_refused(
    aolink: Run, sources: dict[str, Path], tmp_path: Path, words: str, message: str
) -> None:
    refused = aolink(*words.format(**sources).split())
    assert refused.returncode != 0
    assert message in refused.stderr
    assert not [*tmp_path.iterdir()]


def test_a_signal_during_the_last_moments_leaves_all_or_nothing(tmp_path: Path) -> None:
    """Ended at a random moment again and again, the target is the old file or the new one, and nothing is beside it."""
    program = (
        "import pathlib, sys; from aolink.files import writing; from aolink.signals import ending_the_command\n"
        "with ending_the_command():\n"
        "    print('begun', flush=True)\n"
        "    while True:\n"
        "        for text in 'xy':\n"
        "            with writing(pathlib.Path('a'), overwrite=True) as partial: partial.write_text(text * 10000)"
    )
    for number in range(6):
        with subprocess.Popen(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            while not (tmp_path / "a").exists():
                assert process.poll() is None
            for _ in range(137 * number):
                (tmp_path / "a").stat()
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=60)
        assert (process.returncode, errors) == (143, "aolink: interrupted by SIGTERM\n")
        assert (tmp_path / "a").read_text() in ("x" * 10000, "y" * 10000)
        assert [each.name for each in tmp_path.iterdir()] == ["a"]
