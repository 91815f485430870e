"""The command line as processes, without the second that each of them takes to load the same modules.

A process that has loaded them forks one for each command. That has its own arguments, folder, environment, streams and
exit code, as `python -m aolink` has. A test that wants other limits starts `python -m aolink` itself; so do tests that
start a command in the background, other than a rig.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import runpy
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from tests.processor_time import spared

TIMEOUT_S = 300
_MODULES = (
    "aolink.cli",
    "aolink.exporting.files",
    "aolink.restoration.films",
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
    "aolink.estimation.pixels.profile",
    "typer._adapters",  # with which it reads options
)
"""What most commands load; nothing that starts threads."""


class CommandServer:
    """Runs commands, one after the other, and rigs beside them."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair()
        self._socket.settimeout(TIMEOUT_S)
        code = "import sys; from tests.commands import serve; serve(int(sys.argv[1]))"
        with spared():
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", code, str(theirs.fileno())],
                    pass_fds=[theirs.fileno()], cwd=Path(__file__).parent.parent, stdin=subprocess.DEVNULL,
                )  # fmt: skip
            _received(self._socket, 1)

    def start(self, arguments: Sequence[str], folder: Path, streams: Sequence[int]) -> int:
        """Start a command with these streams, out of reach of a Ctrl-C; gives its process."""
        return self._asked([True, dict(os.environ), str(folder), *arguments], streams)

    def wait(self, process: int) -> int:
        """The exit code of a command that was started."""
        return self._asked([process], [0, 1, 2])

    def run(
        self, arguments: Sequence[str], folder: Path, input: str = "", environment: Mapping[str, str] = os.environ
    ) -> subprocess.CompletedProcess[str]:
        """Run a command to its end, with ``input`` as its standard input."""
        with (
            tempfile.TemporaryFile("w+") as stdin,
            tempfile.TemporaryFile("w+") as stdout,
            tempfile.TemporaryFile("w+") as stderr,
        ):
            stdin.write(input)
            stdin.seek(0)
            streams = [each.fileno() for each in (stdin, stdout, stderr)]
            code = self.wait(self._asked([False, dict(environment), str(folder), *arguments], streams))
            stdout.seek(0)
            stderr.seek(0)
            return subprocess.CompletedProcess([*arguments], code, stdout.read(), stderr.read())

    def _asked(self, request: list[Any], streams: Sequence[int]) -> int:
        data = json.dumps(request).encode()
        socket.send_fds(self._socket, [len(data).to_bytes(4, "big")], [*streams])
        self._socket.sendall(data)
        return int.from_bytes(_received(self._socket, 4), "big", signed=True)

    def close(self) -> None:
        """End it, and what it still runs."""
        self._socket.close()
        self._process.wait()


@cache
def command_server() -> CommandServer:
    """Where the commands of all tests of this worker are run."""
    server = CommandServer()
    atexit.register(server.close)
    return server


@contextlib.contextmanager
def simulated_rig(rig: str | Path, *options: str) -> Iterator[tuple[str, str]]:
    """`aolink.jobs.demo.simulated_rig`, without the time that its process takes to load."""
    their_input, our_end = os.pipe()
    ours, their_output = os.pipe()
    arguments = ["sim", str(rig), "--json", "--tied", *options]
    process = command_server().start(arguments, Path.cwd(), [their_input, their_output, 2])
    os.close(their_input)
    os.close(their_output)
    with open(ours) as said:
        try:
            ports = json.loads(said.readline())
            yield ports["camera"], ports["mirror"]
        finally:
            os.close(our_end)  # which ends it
            command_server().wait(process)


def serve(fileno: int) -> None:
    """Fork a process for each request, and answer with its exit code, until the other end is closed."""
    for name in _MODULES:
        import_module(name)
    gc.freeze()  # a collection in a process that was forked would copy all of the memory
    with socket.socket(fileno=fileno) as requests:
        requests.sendall(b".")
        while True:
            size, streams, _, _ = socket.recv_fds(requests, 4, 3)
            if not size:
                return
            first, *rest = json.loads(_received(requests, int.from_bytes(size, "big")))
            if rest:
                answer = os.fork()
                if not answer:
                    if first:
                        os.setsid()
                    _become(rest, streams)
            else:
                answer = os.waitstatus_to_exitcode(os.waitpid(first, 0)[1])
            for each in streams:
                os.close(each)
            requests.sendall(answer.to_bytes(4, "big", signed=True))


def _become(command: list[Any], streams: Sequence[int]) -> NoReturn:
    """Be the process of a command, and end as that does."""
    environment, folder, *arguments = command
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
