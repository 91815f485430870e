"""The Rerun viewer as a process: on the screen, in a browser, or unseen for a picture.

All of them listen on the loopback interface only (Rerun's own default is every interface), and none outlives
the call that started it.
"""

from __future__ import annotations

import ctypes
import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import quote

import numpy as np
import rerun_cli  # type: ignore[import-untyped] # it has only its program
from numpy.typing import NDArray
from PIL import Image
from rerun.experimental import ViewerClient

from aolink.errors import RendererError, ViewerError
from aolink.files import check_target, writing
from aolink.viewing.timebase import FAST_STEP, TIME
from aolink.viewing.vulkan import has_vulkan

HOST = "127.0.0.1"
WEB_PORT = 9090
"""Port of the web viewer's page, where nothing else uses it."""
PICTURE_SIZE = (1920, 1200)
"""Size of a screenshot, pixels."""

_START_S = 30.0
"""How long a viewer may take to answer; a software renderer on a busy machine needs a few seconds."""
_SETTLE_S = 60.0
"""How long its picture may take to stop changing."""
_STOP_S = 5.0
"""How long it may take to end by itself."""
_EQUAL = 3
"""Pictures in a row that must be equal: views appear one by one while their data is loaded."""
_POLL_S = 0.05
_CORNER = 40
"""Pixels that hold the rounded corners of its window."""
_LEAST_COLOURS = 50
"""A picture with fewer is blank: an empty viewer has about a dozen."""

_LAST_WORDS_S = 2.0
"""How long a viewer that has failed may take to end."""
_MAGIC = b"RRF"
"""What every Rerun file begins with; the version of the format follows."""

_NO_DRIVER = (
    "this machine has no Vulkan driver, which the Rerun viewer needs to draw;"
    " on Debian: apt-get install mesa-vulkan-drivers"
)


def screenshot(
    rrd_path: str | Path, png_path: str | Path, *, step: int | None = None, size: tuple[int, int] = PICTURE_SIZE
) -> Path:
    """Take a picture of the viewer with a file in it; no display is needed.

    Parameters
    ----------
    rrd_path:
        A file of `save_rrd`.
    png_path:
        The picture to write; an older one is replaced.
    step:
        Fast step on which the time cursor stands, and which the axes then count; by default a time well inside the
        session.
    size:
        Width and height, pixels.

    Raises
    ------
    ViewerError
        Nothing was shown, or the picture cannot be written.
    RendererError
        The machine has no driver to draw with; the message names the package.
    """
    png_path = Path(png_path)
    check_target(png_path, overwrite=True, suffix=".png", error=ViewerError)
    with headless_viewer(rrd_path, step=step, size=size) as client:
        picture = settled_picture(client)
    # Headless too, the viewer keeps the place of its title bar free.
    inside = picture[:, _CORNER:-_CORNER]
    title_bar = int(np.argmax((inside != inside[:, :1]).any(axis=(1, 2))))
    with writing(png_path, overwrite=True, suffix=".png", error=ViewerError) as partial:
        Image.fromarray(picture[title_bar:]).save(partial, format="PNG")
    return png_path


@contextmanager
def headless_viewer(
    rrd_path: str | Path, *, step: int | None = None, size: tuple[int, int] = PICTURE_SIZE
) -> Iterator[ViewerClient]:
    """A viewer without a window that has a file open and stands at a fast step; it ends with the block.

    Raises
    ------
    ViewerError
        The viewer cannot show the file, or ended while the block used it.
    RendererError
        It did so because the machine has no driver to draw with.
    """
    path = _existing(rrd_path)
    port = free_port()
    options = ["--headless", "--port", str(port), "--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen"]
    with tempfile.TemporaryFile() as said, running_rerun(options, said) as process:
        try:
            client = _connected(process, port, said)
            client.open(str(path))
            timeline, inside = _inside_once_loaded(client)
            client.run_command("ui.toggle_top_panel")
            if step is None and timeline == TIME:
                client.set_time(TIME, duration=np.timedelta64(inside, "ns"), play_state="paused")
            else:
                client.set_time(FAST_STEP, sequence=inside if step is None else step, play_state="paused")
            yield client
        except (RuntimeError, ConnectionError, ViewerError) as error:
            # A viewer that cannot draw answers at first and ends with its first frame, during any of these calls;
            # what the call says then ("transport error") is not the cause.
            if _ended(process):
                raise _why_it_ended(said) from None
            if isinstance(error, ViewerError):
                raise
            raise ViewerError(f"the viewer cannot show {path}: {_one_line(error)}") from None


def settled_picture(client: ViewerClient, view_id: str | None = None) -> NDArray[np.uint8]:
    """Picture of the whole viewer, or of one view, once it has stopped changing, (rows, columns, 3).

    Raises `ViewerError` if it is blank.
    """
    deadline = time.monotonic() + _SETTLE_S
    last, equal = b"", 0
    while equal < _EQUAL:
        if time.monotonic() > deadline:
            raise ViewerError(f"the viewer's picture did not come to rest within {_SETTLE_S:g} s")
        try:
            picture = client.take_screenshot(view_id)
        except (RuntimeError, ConnectionError) as error:
            raise ViewerError(f"the viewer gave no picture: {_one_line(error)}") from None
        equal = equal + 1 if picture == last else 1
        last = picture
    pixels = np.asarray(Image.open(io.BytesIO(last)).convert("RGB"))
    if len(np.unique(pixels.reshape(-1, 3), axis=0)) < _LEAST_COLOURS:
        raise ViewerError("the viewer's picture is blank: the machine renders nothing")
    return pixels


def has_display() -> bool:
    """Whether a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_display() -> None:
    """Raise `ViewerError` where a window cannot be opened."""
    if not has_display():
        raise ViewerError("there is no display: use `aolink view --web` for a browser, or --screenshot for a picture")


def open_viewer(rrd_path: str | Path) -> None:
    """Open the native viewer and wait until its window is closed. Raises `ViewerError` where there is no display."""
    path = _existing(rrd_path)
    check_display()
    with tempfile.TemporaryFile() as said, running_rerun([str(path), "--port", "auto"], said) as process:
        if process.wait() != 0:
            raise _why_it_ended(said)


def serve_web(
    rrd_path: str | Path, port: int | None = None, *, on_ready: Callable[[str], None] | None = None
) -> None:  # fmt: skip
    """Serve a file with the web viewer on this machine's loopback until interrupted.

    Parameters
    ----------
    port:
        Of the page; by default `WEB_PORT`, or a free one where that is in use. The data goes over a second, free one.
    on_ready:
        Called once with the address to open.
    """
    with serving([str(_existing(rrd_path))], port) as server:
        if on_ready is not None:
            on_ready(server.address)
        server.wait()


@dataclass(frozen=True)
class Server:
    """Rerun's program as it listens for data, and shows it."""

    process: subprocess.Popen[bytes]
    said: IO[bytes]
    data_port: int
    """Where data comes in and, for a web page, goes out."""
    address: str = ""
    """Of the web page."""

    @property
    def data_address(self) -> str:
        return f"rerun+http://{HOST}:{self.data_port}/proxy"

    def wait(self) -> None:
        """Until it ends. Raises `ViewerError` where nobody has ended it."""
        if self.process.wait() != 0:
            raise _why_it_ended(self.said)


@contextmanager
def serving(files: Sequence[str] = (), port: int | None = None) -> Iterator[Server]:
    """The web viewer's page on this machine's loopback, which shows files, or what comes to its data's address.

    Raises `ViewerError` where the port that is asked for is in use, or nothing answers.
    """
    if port is None:
        port = WEB_PORT if _is_free(WEB_PORT) else free_port()
    elif not _is_free(port):
        raise ViewerError(f"port {port} is in use: stop what uses it or choose another one")
    data_port = free_port()
    options = [*files, "--serve-web", "--web-viewer-port", str(port), "--port", str(data_port)]
    with tempfile.TemporaryFile() as said, running_rerun(options, said) as process:
        for listening in (port, data_port):
            wait_for_server(listening, process, said)
        data = quote(f"rerun+http://{HOST}:{data_port}/proxy", safe="")
        yield Server(process, said, data_port, f"http://{HOST}:{port}/?url={data}")


@contextmanager
def window() -> Iterator[Server]:
    """The native viewer, empty, on the screen. Raises `ViewerError` where there is none, or nothing answers."""
    check_display()
    port = free_port()
    with tempfile.TemporaryFile() as said, running_rerun(["--port", str(port)], said) as process:
        wait_for_server(port, process, said)
        yield Server(process, said, port)


def free_port() -> int:
    """A port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@contextmanager
def running_rerun(options: Sequence[str], said: IO[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's program, ended with the block."""
    # It leaves its own temporary files behind when it is ended.
    with tempfile.TemporaryDirectory(prefix="aolink-", ignore_cleanup_errors=True) as temporary:
        process = subprocess.Popen(
            [str(_program()), "--bind", HOST, *options],
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            env={**os.environ, "NO_COLOR": "1", "TMPDIR": temporary},
            start_new_session=True,  # Ctrl-C comes to us alone, and we end it
            preexec_fn=_end_with_parent,
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _program() -> Path:
    """The program itself: the `rerun` command is a wrapper whose child outlives it."""
    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "Rerun.app/Contents/MacOS/Rerun"):
        if (folder / name).is_file():
            return folder / name
    raise ViewerError("the Rerun viewer is missing: install rerun-sdk again")


_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_PR_SET_PDEATHSIG = 1


def _end_with_parent() -> None:
    """In the child: end when the parent does, however that comes about. Linux only."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _connected(process: subprocess.Popen[bytes], port: int, said: IO[bytes]) -> ViewerClient:
    """A client of a viewer, once that answers."""
    clients: list[ViewerClient] = []

    def answers() -> bool:
        # A connection to a port on which nobody listens yet may block for seconds.
        if _is_free(port):
            return False
        try:
            client = ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy")
            client.get_state()
        except (RuntimeError, ConnectionError):
            return False
        clients.append(client)
        return True

    _wait_for(answers, process, said)
    return clients[0]


def _wait_for(ready: Callable[[], bool], process: subprocess.Popen[bytes], said: IO[bytes]) -> None:
    deadline = time.monotonic() + _START_S
    while not ready():
        if process.poll() is not None:
            raise _why_it_ended(said)
        if time.monotonic() > deadline:
            raise ViewerError(f"Rerun did not answer within {_START_S:g} s")
        time.sleep(_POLL_S)


def wait_for_server(port: int, process: subprocess.Popen[bytes], said: IO[bytes]) -> None:
    """Wait until a viewer listens. Raises `ViewerError` if it does not."""
    _wait_for(lambda: not _is_free(port), process, said)


def _inside_once_loaded(client: ViewerClient) -> tuple[str, int]:
    """A place at which everything has begun and nothing has ended: ns since the first exposure began or, in a file of
    an older aolink, a fast step; before it the timeline.
    """
    deadline = time.monotonic() + _SETTLE_S
    while True:
        state = client.get_state()
        timelines = {t.name: t for r in state.recordings for t in r.timelines}
        name = TIME if TIME in timelines else FAST_STEP
        if name in timelines and not state.loading:
            start, end = timelines[name].start or 0, timelines[name].end or 0
            return name, start + round(0.6 * (end - start))
        if time.monotonic() > deadline:
            raise ViewerError("the viewer shows no recording with fast steps: give a file that aolink wrote")
        time.sleep(_POLL_S)


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((HOST, port)) != 0


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise ViewerError(f"there is no file {path}: `aolink view RECORDING --save FILE.rrd` writes one")
    try:
        with path.open("rb") as file:
            magic = file.read(len(_MAGIC))
    except OSError as error:
        raise ViewerError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    if magic != _MAGIC:
        raise ViewerError(f"{path} is not a Rerun file: `aolink view RECORDING --save FILE.rrd` writes one")
    return path.resolve()


def _ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether a viewer has ended, or does so now: one that fails writes where it failed before it ends."""
    try:
        process.wait(_LAST_WORDS_S)
    except subprocess.TimeoutExpired:
        return False
    return True


def _why_it_ended(said: IO[bytes]) -> ViewerError:
    """Why a viewer ended that nobody stopped: the machine's lack of a driver, or else Rerun's own first words."""
    if sys.platform == "linux" and not has_vulkan():
        return RendererError(_NO_DRIVER)
    said.seek(0)
    lines = [line.strip() for line in said.read().decode(errors="replace").splitlines() if line.strip()]
    causes = [line for line in lines if "panicked at" in line or "ERROR" in line or line.startswith("Error")]
    return ViewerError(f"Rerun ended: {(causes or lines)[0]}" if lines else "Rerun ended without saying why")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
