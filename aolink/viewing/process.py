"""Rerun's program as a process: its viewer on the screen, or the server of its web page.

All of them listen on the loopback interface only (Rerun's own default is every interface), and none outlives
the call that started it. Nothing here loads Rerun itself, which takes most of a second.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO
from urllib.parse import quote

import rerun_cli  # type: ignore[import-untyped] # it has only its program

from aolink.errors import ViewerError
from aolink.numerics.workers import end_with

HOST = "127.0.0.1"
WEB_PORT = 9090
"""Port of the web viewer's page, if no other program uses it."""

_POLL_S = 0.05
_START_S = 30.0
"""How long a viewer may take to answer; a software renderer on a busy machine needs a few seconds."""
_STOP_S = 5.0
"""How long a viewer may take to end by itself, s."""
_MAGIC = b"RRF"
"""The first bytes of every Rerun file; the version of the format follows."""


def check_display(
    instead: str = "there is no display: use `aolink view --web` for a browser, or `aolink report`",
) -> None:
    """Raise `ViewerError` where a window cannot be opened."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(instead)


def open_viewer(rrd_path: str | Path) -> None:
    """Open the native viewer and wait until its window is closed. Raises `ViewerError` where there is no display."""
    path = existing(rrd_path)
    with window(str(path)) as server:
        server.wait()


def serve_web(
    rrd_path: str | Path, port: int | None = None, *, on_ready: Callable[[str], None] | None = None,
) -> None:  # fmt: skip
    """Serve a file with the web viewer on this machine's loopback until interrupted.

    Parameters
    ----------
    port:
        Port of the page; by default `WEB_PORT`, or a free one if that is in use. The data goes over a second, free one.
    on_ready:
        Called once with the address to open.
    """
    with serving([str(existing(rrd_path))], port) as server:
        server.listen()
        if on_ready is not None:
            on_ready(server.address)
        server.wait()


@dataclass(frozen=True)
class Server:
    """Rerun's program, which listens for data and shows it."""

    process: subprocess.Popen[bytes]
    said: IO[bytes]
    data_port: int
    """The port at which data comes in and, for a web page, goes out."""
    page_port: int | None = None
    """The port of the web page."""

    @property
    def data_address(self) -> str:
        return f"rerun+http://{HOST}:{self.data_port}/proxy"

    @property
    def address(self) -> str:
        """Address of the web page."""
        return f"http://{HOST}:{self.page_port}/?url={quote(self.data_address, safe='')}"

    def listen(self) -> None:
        """Wait until it listens, which takes some time after its start. Raises `ViewerError` if it never does."""
        deadline = time.monotonic() + _START_S
        while any(is_free(port) for port in (self.page_port, self.data_port) if port is not None):
            if self.process.poll() is not None:
                raise self.why_it_ended()
            if time.monotonic() > deadline:
                raise ViewerError(f"Rerun did not answer within {_START_S:g} s")
            time.sleep(_POLL_S)

    def wait(self) -> None:
        """Wait until it ends. Raises `ViewerError` if it ends by itself."""
        if self.process.wait() != 0:
            raise self.why_it_ended()

    def why_it_ended(self) -> ViewerError:
        """The reason why it ended by itself: Rerun's own first error; most often a driver that the machine lacks."""
        self.said.seek(0)
        lines = [line.strip() for line in self.said.read().decode(errors="replace").splitlines() if line.strip()]
        causes = [line for line in lines if "panicked at" in line or "ERROR" in line or line.startswith("Error")]
        why = f"Rerun ended: {(causes or lines)[0]}" if lines else "Rerun ended without saying why"
        driver = "; its window needs a Vulkan driver, on Debian mesa-vulkan-drivers" if self.page_port is None else ""
        return ViewerError(why + driver)


@contextmanager
def serving(files: Sequence[str] = (), port: int | None = None) -> Iterator[Server]:
    """The web viewer's page on this machine's loopback, which shows files, or the data that comes to its data port.

    Raises `ViewerError` where the requested port is in use.
    """
    if port is not None and not is_free(port):
        raise ViewerError(f"port {port} is in use: stop what uses it or choose another one")
    with free_port() as another:
        port = port or (WEB_PORT if is_free(WEB_PORT) else another)
        with running_rerun([*files, "--serve-web", "--web-viewer-port", str(port)], port) as server:
            yield server


@contextmanager
def window(*files: str) -> Iterator[Server]:
    """The native viewer on the screen, empty or with files. Raises `ViewerError` where there is none."""
    check_display()
    with running_rerun(files) as server:
        yield server


@contextmanager
def free_port() -> Iterator[int]:
    """A port on which no program listens, and which no other is given until the block ends.

    It is bound, and Linux lets Rerun listen there all the same, because both allow its reuse.
    """
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind((HOST, 0))
        port = int(held.getsockname()[1])
        if sys.platform != "linux":
            held.close()
        yield port


@contextmanager
def running_rerun(options: Sequence[str], page_port: int | None = None) -> Iterator[Server]:
    """Rerun's program, which ends with the block."""
    # It leaves its own temporary files behind when it is ended.
    with (
        tempfile.TemporaryDirectory(prefix="aolink-", ignore_cleanup_errors=True) as temporary, free_port() as port,
        tempfile.TemporaryFile() as said,
    ):  # fmt: skip
        environment = {**os.environ, "NO_COLOR": "1", "TMPDIR": temporary}
        # With a session of its own: Ctrl-C comes to this process alone, which ends Rerun's.
        process = subprocess.Popen(
            [str(_program()), "--bind", HOST, "--port", str(port), *options], stdin=subprocess.DEVNULL, stdout=said,
            stderr=said, env=environment, start_new_session=True, preexec_fn=partial(end_with, os.getpid()),
        )  # fmt: skip
        try:
            yield Server(process, said, port, page_port)
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _program() -> Path:
    """The path of the program itself: the `rerun` command is a wrapper whose child outlives it."""
    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "Rerun.app/Contents/MacOS/Rerun"):
        if (folder / name).is_file():
            return folder / name
    raise ViewerError("the Rerun viewer is missing: install rerun-sdk again")


def is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((HOST, port)) != 0


def existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise ViewerError(f"there is no file {path}: `aolink view RECORDING -o FILE.rrd` writes one")
    try:
        with path.open("rb") as file:
            magic = file.read(len(_MAGIC))
    except OSError as error:
        raise ViewerError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    if magic != _MAGIC:
        raise ViewerError(f"{path} is not a Rerun file: `aolink view RECORDING -o FILE.rrd` writes one")
    return path.resolve()
