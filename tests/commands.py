"""The command line as processes, without the second that each of them takes to load the same modules.

A process that has loaded them forks one for each command. That has its own arguments, folder, environment, streams and
exit code, as `python -m aolink` has. A test that wants other limits starts `python -m aolink` itself; so do all tests
that start a command in the background.
"""

from __future__ import annotations

import json
import os
import runpy
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NoReturn

TIMEOUT_S = 300
_MODULES = (
    "aolink.cli",
    "aolink.exporting.files",
    "aolink.importing.bags",
    "aolink.importing.readers",
    "aolink.importing.recording",
    "aolink.jobs.batch",
    "aolink.jobs.calibrate",
    "aolink.jobs.demo",
    "aolink.jobs.check_rig",
    "aolink.session",
    "aolink.session.replay",
    "aolink.recording.compare",
    "aolink.recording.deblur",
    "aolink.recording.editing",
    "aolink.recording.reestimate",
    "aolink.simulation.server",
    "aolink.optics.slopes",
    "aolink.cli.tables.recordings",
    "aolink.cli.tables.scores",
    "aolink.cli.tables.sessions",
    "aolink.estimation.pixels.filter",
    "aolink.estimation.pixels.updates",
    "aolink.estimation.pixels.sampled",
    "pydantic.type_adapter",  # with which typer reads options
)
"""What most commands load; nothing that starts threads."""


class CommandServer:
    """Runs commands, one after the other."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair()
        self._socket.settimeout(TIMEOUT_S)
        code = "import sys; from tests.commands import serve; serve(int(sys.argv[1]))"
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, str(theirs.fileno())],
                pass_fds=[theirs.fileno()], cwd=Path(__file__).parent.parent, stdin=subprocess.DEVNULL,
            )  # fmt: skip

    def run(self, arguments: Sequence[str], folder: Path, input: str = "") -> subprocess.CompletedProcess[str]:
        """Run a command to its end, with ``input`` as its standard input."""
        request = json.dumps([dict(os.environ), str(folder), *arguments]).encode()
        with (
            tempfile.TemporaryFile("w+") as stdin,
            tempfile.TemporaryFile("w+") as stdout,
            tempfile.TemporaryFile("w+") as stderr,
        ):
            stdin.write(input)
            stdin.seek(0)
            streams = [each.fileno() for each in (stdin, stdout, stderr)]
            socket.send_fds(self._socket, [len(request).to_bytes(4, "big")], streams)
            self._socket.sendall(request)
            code = int.from_bytes(_received(self._socket, 4), "big", signed=True)
            stdout.seek(0)
            stderr.seek(0)
            return subprocess.CompletedProcess([*arguments], code, stdout.read(), stderr.read())

    def close(self) -> None:
        """End it, and what it still runs."""
        self._socket.close()
        self._process.wait()


def serve(fileno: int) -> None:
    """Fork a process for each request, and answer with its exit code, until the other end is closed."""
    for name in _MODULES:
        import_module(name)
    with socket.socket(fileno=fileno) as requests:
        while True:
            size, streams, _, _ = socket.recv_fds(requests, 4, 3)
            if not size:
                return
            environment, folder, *arguments = json.loads(_received(requests, int.from_bytes(size, "big")))
            process = os.fork()
            if not process:
                _become(arguments, folder, environment, streams)
            for each in streams:
                os.close(each)
            _, status = os.waitpid(process, 0)
            requests.sendall(os.waitstatus_to_exitcode(status).to_bytes(4, "big", signed=True))


def _become(arguments: Sequence[str], folder: str, environment: Mapping[str, str], streams: Sequence[int]) -> NoReturn:
    """Be the process of a command, and end as that does."""
    for stream, fileno in enumerate(streams):
        os.dup2(fileno, stream)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path[0] = folder
    sys.argv = ["aolink", *arguments]
    runpy.run_module("aolink", run_name="__main__", alter_sys=True)
    sys.exit()


def _received(source: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        more = source.recv(size - len(data))
        if not more:
            raise ConnectionError("the process of the commands has ended")
        data += more
    return data
