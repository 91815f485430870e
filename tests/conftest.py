"""What several folders of tests share: a rig as a process, the command line as a process, a recorded session."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from hypothesis import settings

from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report, record
from tests.commands import TIMEOUT_S, command_server, simulated_rig

ESTIMATORS = ("open-loop", "o1", "o2", "o3")
EXPOSURES = 12
settings.register_profile("aolink", deadline=None)  # a machine that is held up proves nothing
settings.load_profile("aolink")
for each, heard in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(each) == signal.SIG_IGN:  # as under nohup: the commands of the tests would inherit it
        signal.signal(each, heard)


@dataclass(frozen=True)
class Session:
    """A recorded session and what it reported."""

    path: Path
    report: Report


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session with the lively rig over two real pseudo terminals, two processes, on virtual time."""
    path = tmp_path_factory.mktemp("recorded") / "session.mcap"
    with simulated_rig("section-vi-lively") as (camera, mirror):
        report = record(
            load_rig("section-vi-lively"), camera, mirror, path, estimators=ESTIMATORS, exposures=EXPOSURES
        )  # fmt: skip
    return Session(path, report)


@pytest.fixture
def aolink(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the command line in an empty folder."""

    def run(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
        if options.keys() <= {"input"}:
            return command_server().run([*map(str, arguments)], tmp_path, **options)
        command = [sys.executable, "-m", "aolink", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=TIMEOUT_S, **options)

    return run


@pytest.fixture(scope="session")
def with_example(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process in which tests/example_package is installed."""
    folder = tmp_path_factory.mktemp("installed")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=Path(__file__).parent / "example_package", capture_output=True, check=True)
    (wheel,) = folder.glob("*.whl")
    ZipFile(wheel).extractall(folder)
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(Path(__file__).parents[1])])}


@pytest.fixture
def start_aolink(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Start the command line in the background."""

    def start(*arguments: str | Path) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "aolink", *map(str, arguments)]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip

    return start


@pytest.fixture(scope="session")
def mmirs() -> Path:
    """Folder of a real telescope's frames, with their licence."""
    return Path(__file__).parent / "data" / "mmirs"


def without_pupil(rig: Rig) -> Rig:
    """sh-8x8 with all of its lenslets lit."""
    lines = rig.toml.splitlines(keepends=True)
    return parse_rig(
        "".join(each for each in lines if not each.startswith(("pupil_m = 2.4e-3      # d", "obstr", "least")))
    )
