"""Ctrl-C, SIGTERM and SIGHUP end every command alike: one line, an exit code that says which, nothing half left."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import termios
import time
import zipfile
from collections.abc import Callable, Iterator
from io import TextIOBase
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

from aolink import files, signals
from aolink.cli.common import app
from aolink.files import writing
from aolink.recording.editing import cut
from aolink.recording.reader import Recording
from aolink.signals import ending_the_command
from tests.commands import simulated_rig
from tests.conftest import Session
from tests.jobs.test_look_spots import shaken
from tests.kinds import must_be

SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
_PATIENCE_S = 120.0

COMMANDS = {
    "sim": "sim section-vi --real-time",
    "rig": "rig section-vi --check",
    "devices": "devices {silent}",
    "record": "record --camera {camera} --mirror {mirror} --rig section-vi -o a.mcap",
    "replay": "replay {session} -e o1 --speed 0.01",
    "calibrate": "calibrate --camera {camera} --mirror {mirror} --rig section-vi -o a.toml",
    "demo": "demo --rig tip-tilt --exposures 5",
    "info": "info {session} --check",
    "estimate": "estimate {session} -e moments -o a.mcap",
    "compare": "compare {session}",
    "copy": "copy {first} {second} -o a.mcap",
    "deblur": "deblur {session} -e o1 -o a.mcap",
    "import": "import {session} -o a.mcap --rig section-vi-lively --overwrite",
    "export": "export {session} -o a.npz",
    "slopes": "slopes {frame} --reference {reference} -o a.npz",
    "view": "view {session} -o a.rrd",
    "report": "report {session} -o a.html",
    "identify": "identify {session} -o a.toml",
    "look": "look {film} -o looked",
}
"""A call of every command, for the places of files and ports."""


@pytest.fixture(scope="module")
def places(recorded: Session, tmp_path_factory: pytest.TempPathFactory, mmirs: Path) -> Iterator[dict[str, str]]:
    """What the commands are given: recordings, frames, a rig in real time, and a terminal where nobody answers."""
    folder = tmp_path_factory.mktemp("places")
    cut(recorded.path, folder / "first.mcap", 0.0, 1.0)
    cut(recorded.path, folder / "second.mcap", 1.0, 2.0)
    np.savez(folder / "film.npz", frames=np.stack(list(shaken().frames())), rate_hz=50.0, exposure_s=0.018)
    master, slave = pty.openpty()
    with simulated_rig("section-vi", "--real-time") as (camera, mirror):
        yield {
            "session": str(recorded.path),
            "first": str(folder / "first.mcap"),
            "second": str(folder / "second.mcap"),
            "frame": str(mmirs / "mmirs_wfs_0150.fits.gz"),
            "reference": str(mmirs / "mmirs_camera2_ref.fits.gz"),
            "camera": camera,
            "mirror": mirror,
            "film": str(folder / "film.npz"),
            "silent": os.ttyname(slave),
        }
    os.close(master)
    os.close(slave)


def test_there_is_a_case_for_every_command() -> None:
    names = {each.name or each.callback.__name__ for each in app.registered_commands if each.callback}
    assert {name.replace("_", "-") for name in names} == {*COMMANDS}


class Started:
    """A command as a process, in a folder of its own with a folder of its own for temporary files."""

    def __init__(self, folder: Path, words: str, **options: Any) -> None:
        self.temporary = folder / "temporary"
        self.temporary.mkdir(parents=True)
        (folder / "work").mkdir()
        self.folder = folder / "work"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "aolink", *shlex.split(words)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, cwd=self.folder,
            env={**os.environ, "TMPDIR": str(self.temporary), "PYTHONUNBUFFERED": "1"}, **options,
        )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def wait_until(self, true: Callable[[], bool]) -> bool:
        """Whether it came true before the process ended."""
        deadline = time.monotonic() + _PATIENCE_S
        while not true():
            if self.process.poll() is not None:
                return False
            assert time.monotonic() < deadline
            time.sleep(0.001)
        return True

    def hears_signals(self) -> bool:
        """Whether it has a handler for SIGHUP, the last of the three to get one."""
        with contextlib.suppress(OSError):
            status = Path(f"/proc/{self.process.pid}/status").read_text()
            caught = int(status.partition("SigCgt:")[2].split()[0], 16)
            return bool(caught >> (signal.SIGHUP - 1) & 1)
        return False

    def end(self, number: int) -> tuple[int, str]:
        """Send a signal; the exit code and what was said on stderr."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=_PATIENCE_S)
        return self.process.returncode, errors

    def unfinished(self) -> list[Path]:
        return [*self.folder.rglob(".*.partial")]

    def assert_nothing_half_is_left(self) -> None:
        assert not [*self.temporary.iterdir()]
        assert not self.unfinished()
        for path in self.folder.rglob("*.mcap"):
            assert Recording(path).complete


@pytest.mark.parametrize(
    ("command", "number"),
    [*zip(COMMANDS, itertools.cycle(SIGNALS), strict=False), ("record", signal.SIGINT), ("record", signal.SIGTERM)],
    ids=lambda each: getattr(each, "name", each),
)
def test_a_signal_ends_a_command_that_has_just_begun(
    tmp_path: Path, places: dict[str, str], command: str, number: signal.Signals
) -> None:
    """From the instant on in which it hears them: most of it is not even loaded then."""
    with Started(tmp_path, COMMANDS[command].format(**places)) as started:
        assert started.wait_until(started.hears_signals)
        assert started.end(number) == (SIGNALS[number], f"aolink: interrupted by {number.name}\n")
        started.assert_nothing_half_is_left()


# What the program does when the interruption has just been lost: nothing else; a session begins; one has just ended.
AFTERWARDS = {
    "waits": "    del it\n",
    "begins a session": "    del it\n    StopRequest().installed().__enter__()\n",
    "ends a session": "    with StopRequest(at_once=True).installed():\n        del it\n",
}


@pytest.mark.parametrize("afterwards", AFTERWARDS.values(), ids=AFTERWARDS)
def test_a_signal_that_comes_where_nothing_can_be_caught_is_not_lost(tmp_path: Path, afterwards: str) -> None:
    program = (
        "import os, signal, time\n"
        "from aolink.signals import StopRequest, ending_the_command\n"
        "class Finalised:\n"
        "    def __del__(self):\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        time.sleep(0.1)\n"
        "with ending_the_command():\n"
        "    it = Finalised()\n"
        f"{afterwards}"
        "    for _ in range(600):\n"
        "        time.sleep(0.1)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=50)
    assert (done.returncode, done.stderr) == (143, "aolink: interrupted by SIGTERM\n")


MIDST: dict[str, Callable[[Started], bool]] = {
    "sim": lambda it: "camera" in must_be(TextIOBase, it.process.stdout).readline(),
    "record": lambda it: (it.folder / "a.mcap").exists() and (it.folder / "a.mcap").stat().st_size > 30_000,
    "calibrate": lambda it: "dark: cover the camera" in must_be(TextIOBase, it.process.stderr).read(30),
    "demo": lambda it: bool(it.unfinished()) and any("session.rrd" in each.name for each in it.unfinished()),
    **dict.fromkeys(("estimate", "copy", "slopes", "view"), lambda it: bool(it.unfinished())),
}
"""What shows that a command is in the midst of its work; that of the others shows nowhere."""


@pytest.mark.slow
@pytest.mark.parametrize("command", MIDST)
def test_a_signal_in_the_midst_leaves_nothing_half(tmp_path: Path, places: dict[str, str], command: str) -> None:
    for number in range(8):  # a short job may be done before the signal comes
        with Started(tmp_path / str(number), COMMANDS[command].format(**places)) as started:
            begun = started.wait_until(lambda: MIDST[command](started))
            code, errors = started.end(signal.SIGTERM)
            started.assert_nothing_half_is_left()
            if code == 0:
                continue
            assert begun
            assert code == 143
            # A rig in real time may have been late; and the question that calibrate has put may be half read.
            said = [line for line in errors.splitlines() if re.match("aolink: (?!warning|compiling)", line)]
            assert len(said) == 1, errors
            assert "Traceback" not in errors
            assert said[0].startswith("aolink: interrupted by SIGTERM")
            return
    pytest.fail("it was done before the signal each time")


@pytest.mark.rare
def test_a_demo_that_ends_after_recording_says_where_the_recording_is(tmp_path: Path, places: dict[str, str]) -> None:
    with Started(tmp_path, COMMANDS["demo"]) as started:
        assert started.wait_until(lambda: MIDST["demo"](started))
        code, errors = started.end(signal.SIGINT)
        (folder,) = started.folder.iterdir()
        assert code == 130
        assert errors == f"aolink: interrupted by SIGINT; the files made until then are in {folder.name}\n"
        assert sorted(each.name for each in folder.iterdir()) == ["rig.toml", "session.mcap"]
        started.assert_nothing_half_is_left()


@pytest.mark.slow
def test_a_batch_ends_in_good_order_with_its_processes(tmp_path: Path, places: dict[str, str]) -> None:
    models = ",".join(str(1 + k) for k in range(200))
    with Started(
        tmp_path, f"estimate {places['session']} -e o1 --set plant.process_noise={models} --jobs 2 -o out"
    ) as started:
        assert started.wait_until(lambda: bool([*started.folder.glob("out/*.mcap")]))
        code, errors = started.end(signal.SIGTERM)
        assert (code, errors) == (143, "aolink: interrupted by SIGTERM\n")
        started.assert_nothing_half_is_left()
        results = [*started.folder.glob("out/*.mcap")]
        assert 0 < len(results) < 200


@pytest.mark.slow
def test_a_terminal_that_closes_ends_a_command(tmp_path: Path) -> None:
    """Its output fails from then on; the exit code tells all the same."""
    master, slave = pty.openpty()

    def take_terminal() -> None:
        os.setsid()
        fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

    with subprocess.Popen(
        [sys.executable, "-m", "aolink", "sim", "section-vi", "--real-time"], stdin=slave, stdout=slave, stderr=slave,
        cwd=tmp_path, preexec_fn=take_terminal,
    ) as process:  # fmt: skip
        os.close(slave)
        said = b""
        while b"Ctrl-C stops it" not in said:
            said += os.read(master, 1024)
        os.close(master)
        assert process.wait(_PATIENCE_S) == 129


@pytest.mark.slow
def test_nohup_is_respected(tmp_path: Path, places: dict[str, str]) -> None:
    ignore = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)}
    with Started(tmp_path, COMMANDS["record"].format(**places), **ignore) as started:
        assert started.wait_until(lambda: MIDST["record"](started))
        started.process.send_signal(signal.SIGHUP)
        size = (started.folder / "a.mcap").stat().st_size
        assert started.wait_until(lambda: (started.folder / "a.mcap").stat().st_size > size + 30_000), "it goes on"
        assert started.end(signal.SIGTERM) == (143, "aolink: interrupted by SIGTERM\n")


def test_a_signal_while_an_entry_of_a_zip_file_is_opened_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The ZIP file then cannot be closed, and raises an error of its own."""
    opened = zipfile.ZipFile.open

    def interrupted(*arguments: Any, **options: Any) -> Any:
        entry = opened(*arguments, **options)
        os.kill(os.getpid(), signal.SIGTERM)
        return entry

    monkeypatch.setattr(zipfile.ZipFile, "open", interrupted)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # it is another one when a command has ended
    with pytest.raises(SystemExit) as ended, ending_the_command():
        np.savez(tmp_path / "a.npz", a=np.arange(5))
    assert ended.value.code == 128 + signal.SIGTERM
    del ended
    gc.collect()
    assert capsys.readouterr().err == "aolink: interrupted by SIGTERM\n"


def test_a_signal_at_any_line_of_saving_arrays_leaves_nothing_half(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also while a ZIP file is being closed, or the unfinished file is being removed."""
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr(signals, "_is_interrupted", False)
    at, ended = 1, False
    while not ended:
        passed = 0
        (folder := tmp_path / str(at)).mkdir()  # what was interrupted may stay locked in this process

        def trace(frame: Any, event: str, argument: Any, at: int = at) -> Any:
            nonlocal passed
            passed += event in ("line", "return")
            if passed == at:
                sys.settrace(None)
                os.kill(os.getpid(), signal.SIGTERM)
            return trace if passed < at else None

        with contextlib.suppress(SystemExit), ending_the_command():
            sys.settrace(trace)
            try:
                with writing(folder / "a.npz") as partial, partial.open("wb") as file:
                    np.savez(file, a=np.arange(50.0))
            finally:
                sys.settrace(None)
        files._remove_left()
        ended = passed < at
        assert capsys.readouterr().err == ("" if ended else "aolink: interrupted by SIGTERM\n"), at
        assert [each.name for each in folder.iterdir()] in ([], ["a.npz"]), at
        at += 13
    gc.collect()  # what Python could not close is reported while the command's hook is there
    assert at > 500
    with np.load(folder / "a.npz") as saved:
        assert saved["a"].shape == (50,)
