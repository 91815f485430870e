"""The time that a command takes from its start on, imports included, in a process of its own each time.

Its files are in the cache, and its modules compiled, as they are wherever a package is installed.
"""

from __future__ import annotations

import os
import pty
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from judging.films import resonance, spot_film

import aolink
from bench_rows.recording import hour
from bench_rows.row import Effort, Row, median_s, timed

_FIRST_PART = b"32/"
"""Text of the progress bar when the viewer has the first part of a long recording."""
_COMMAND = (sys.executable, "-m", "aolink")
_NOT_COMPILED = shutil.ignore_patterns("__pycache__")


@contextmanager
def _compiled() -> Iterator[None]:
    """A folder in which the processes started here keep their compiled code."""
    before = dict(os.environ)
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = folder
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)


def _run(*command: str | Path, **where: str) -> None:
    environment = os.environ | where
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)


def _row(what: str, command: Sequence[str | Path], peer: str, limit_s: float, effort: Effort) -> Row:
    theirs = (sys.executable, "-c", peer)
    with _compiled():
        for each in (command, theirs):
            _run(*each)
        took, other = median_s(lambda: _run(*command), effort.of(9), lambda: _run(*theirs))
    return Row(what, f"{took:.2f} s", f"limit {limit_s:g} s; `{peer}` {other:.2f} s", limit_s / took, 1.0)


def command_start(effort: Effort) -> list[Row]:
    """The start of the package and of the command alone."""
    return [
        _row("import aolink", (sys.executable, "-c", "import aolink"), "pass", 0.3, effort),
        _row("aolink --help", (*_COMMAND, "--help"), "import typer, rich.console", 0.3, effort),
    ]


_FIRST_PROFILE = """
import aolink
from aolink.estimation import make_estimator

rig = aolink.load_rig("section-vi-lively")
make_estimator(rig, "profile").step(next(iter(aolink.simulate(rig, 1, seed=1))))
"""


def first_profile(_: Effort) -> Row:
    """The first `profile` in a package that has not been used yet, after its installation has compiled."""
    with tempfile.TemporaryDirectory() as name:
        own = shutil.copytree(Path(aolink.__file__).parent, Path(name) / "aolink", ignore=_NOT_COMPILED)
        where = {"PYTHONPATH": str(own.parent), "PYTHONSAFEPATH": "1"}
        compiled = timed(lambda: _run(sys.executable, "-m", "aolink.estimation.compiled", **where))
        first = timed(lambda: _run(sys.executable, "-c", _FIRST_PROFILE, **where))
    return Row(
        "the first estimate of `profile`, from the start of Python, after an installation that compiles",
        f"{first:.2f} s", f"limit 5 s; compiling {compiled:.0f} s", 5 / first, 1.0,
    )  # fmt: skip


def view_start(effort: Effort) -> list[Row]:
    """Time from the start of `aolink view` of an hour to the first part in a web viewer, and its memory until then."""
    path = hour(effort)
    with _compiled():
        _until_first_part(path)
        took, memory = zip(*(_until_first_part(path) for _ in range(effort.of(5))), strict=True)
    ours, most = statistics.median(took), max(memory)
    what = "aolink view of an hour, from its start until the first part is with the viewer"
    return [
        Row(what, f"{ours:.2f} s", "limit 2 s", 2 / ours, 1.0),
        Row("its memory until then, at most", f"{most:.0f} MB", "limit 500 MB", 500 / most, 1.0),
    ]


def look_answer(effort: Effort) -> Row:
    """The whole of `aolink look` at 500 frames of 640 x 480 with two spots that shake."""
    rng, count = np.random.default_rng(1), effort.of(500, 40)
    motion = resonance(rng, count, 2, 1.5, 0.67)
    with tempfile.TemporaryDirectory() as name:
        film = Path(name) / "film.npy"
        np.save(film, spot_film(rng, motion, np.array([[200.3, 240.6], [440.8, 250.1]]), (480, 640)).frames)
        command = (*_COMMAND, "look", film, "--rate", "50", "--exposure", "0.018", "-o", Path(name) / "looked")
        took = timed(lambda: _run(*command))
    return Row(f"aolink look of {count} frames of 640 x 480", f"{took:.0f} s", "limit 20 s", 20 / took, 1.0)


def _until_first_part(path: Path) -> tuple[float, float]:
    """Time until the command, on a terminal, says that it has sent the first part, s, and its largest memory, MB."""
    terminal, its = pty.openpty()
    start = time.perf_counter()
    with subprocess.Popen((*_COMMAND, "view", path, "--web"), stdout=its, stderr=its, stdin=its) as process:
        os.close(its)
        said = b""
        try:
            while _FIRST_PART not in said:
                said += os.read(terminal, 4096)
            took = time.perf_counter() - start
            status = Path(f"/proc/{process.pid}/status").read_text()
            return took, int(status.partition("VmHWM:")[2].split()[0]) / 1e3
        finally:
            process.terminate()
            process.wait()
            os.close(terminal)
