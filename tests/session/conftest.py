"""The devices that sessions in real time are tried with: the simulated rig, and the reference device in C."""

from __future__ import annotations

import contextlib
import select
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from tests.commands import simulated_rig
from tests.needs import missing

DEVICE = Path(__file__).parents[2] / "tools" / "device"
SANITISED = "-std=c99 -O1 -g -Wall -Wextra -Werror -pedantic -fsanitize=address,undefined -fno-sanitize-recover=all"
Ports = Callable[[], AbstractContextManager[tuple[str, str]]]


@contextlib.contextmanager
def served_by(program: Path) -> Iterator[tuple[str, str]]:
    """The C program behind two pseudo terminals; it must end without a word from a sanitiser."""
    process = subprocess.Popen([program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1)
    assert process.stdout is not None
    try:
        select.select([process.stdout], [], [], 20)
        ports = dict(process.stdout.readline().split() for _ in range(2))
        yield ports["camera"], ports["mirror"]
    finally:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=20)
    assert "runtime error" not in said
    assert "Sanitizer" not in said


@pytest.fixture(scope="session")
def reference_device(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, built from C with sanitisers."""
    build = tmp_path_factory.mktemp("device")
    command = ["make", "-s", "-C", str(DEVICE), f"BUILD={build}", f"CFLAGS={SANITISED}"]
    try:
        made = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError as error:
        missing("make", error)
    if made.returncode:
        missing("a C compiler with sanitisers", RuntimeError(made.stderr))
    return build / "device"


@pytest.fixture(params=["simulated rig", "reference device"])
def serve(request: pytest.FixtureRequest) -> Ports:
    """Either of them in real time, as a process of its own; gives the ports of camera and mirror."""
    if request.param == "simulated rig":
        return lambda: simulated_rig("section-vi", "--real-time")
    program = request.getfixturevalue("reference_device")
    return lambda: served_by(program)
