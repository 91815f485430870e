"""The Rerun viewer without a screen, for a picture of it."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rerun.experimental import ViewerClient

from aolink.errors import ViewerError
from aolink.files import check_target, writing
from aolink.viewing.process import POLL_S, Server, existing, is_free, running_rerun
from aolink.viewing.timebase import FAST_STEP, TIME

PICTURE_SIZE = (1920, 1200)
"""Size of a screenshot, pixels."""

_SETTLE_S = 60.0
"""How long the viewer's picture may take to stop changing, s."""
_EQUAL = 3
"""Pictures in a row that must be equal: views appear one by one while their data is loaded."""
_TIMELESS_S = 2.0
"""A file that has been loaded for as long, and has no time yet, has none, s."""
_CORNER = 40
"""Pixels along each side that hold a rounded corner of the window."""
_LEAST_COLOURS = 50
"""A picture with fewer is blank: an empty viewer has about a dozen."""


def screenshot(
    rrd_path: str | Path, png_path: str | Path, *, size: tuple[int, int] = PICTURE_SIZE, at_ns: int | None = None
) -> Path:
    """Take a picture of the viewer with a file in it; no display is needed.

    Parameters
    ----------
    rrd_path:
        A file of `save_rrd`.
    png_path:
        The picture to write; an older one is replaced.
    size:
        Width and height, pixels.
    at_ns:
        The time that is shown, ns since the first exposure began; by default one well inside the session.

    Raises
    ------
    ViewerError
        The viewer showed nothing, or the picture cannot be written.
    RendererError
        The machine has no driver to draw with; the message names the package.
    """
    png_path = Path(png_path)
    check_target(png_path, overwrite=True, suffix=".png", error=ViewerError)
    with headless_viewer(rrd_path, size) as client:
        if at_ns is not None:
            client.set_time(TIME, duration=np.timedelta64(at_ns, "ns"), play_state="paused")
        picture = settled_picture(client)
    # Headless too, the viewer keeps the place of its title bar free.
    inside = picture[:, _CORNER:-_CORNER]
    title_bar = int(np.argmax((inside != inside[:, :1]).any(axis=(1, 2))))
    with writing(png_path, overwrite=True, suffix=".png", error=ViewerError) as partial:
        Image.fromarray(picture[title_bar:]).save(partial, format="PNG")
    return png_path


@contextmanager
def headless_viewer(rrd_path: str | Path, size: tuple[int, int] = PICTURE_SIZE) -> Iterator[ViewerClient]:
    """A viewer without a window that has a file open at a time well inside the session; it ends with the block.

    Raises
    ------
    ViewerError
        The viewer cannot show the file, or ended while the block used it.
    RendererError
        The viewer ended because the machine has no driver to draw with.
    """
    path = existing(rrd_path)
    more = ["--headless", "--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen"]
    with running_rerun(more) as server:
        try:
            client = _connected(server)
            client.open(str(path))
            timeline, inside = _inside_once_loaded(client)
            client.run_command("ui.toggle_top_panel")
            if timeline == TIME:
                client.set_time(TIME, duration=np.timedelta64(inside, "ns"), play_state="paused")
            elif timeline:
                client.set_time(FAST_STEP, sequence=inside, play_state="paused")
            yield client
        except (RuntimeError, OSError, ViewerError) as error:
            # A viewer that cannot draw answers at first and ends with its first frame, during any of these calls;
            # the call's own error then ("transport error") is not the cause.
            if server.has_ended():
                raise server.why_it_ended() from None
            if isinstance(error, ViewerError):
                raise
            raise ViewerError(f"the viewer cannot show {path}: {_one_line(error)}") from None


def settled_picture(client: ViewerClient) -> NDArray[np.uint8]:
    """Picture of the whole viewer, once it has stopped changing, (rows, columns, 3).

    Raises `ViewerError` if it is blank.
    """
    deadline = time.monotonic() + _SETTLE_S
    last, equal = b"", 0
    while equal < _EQUAL:
        if time.monotonic() > deadline:
            raise ViewerError(f"the viewer's picture did not come to rest within {_SETTLE_S:g} s")
        try:
            picture = client.take_screenshot()
        except TimeoutError:  # a busy machine draws slowly
            continue
        except (RuntimeError, OSError) as error:
            raise ViewerError(f"the viewer gave no picture: {_one_line(error)}") from None
        equal = equal + 1 if picture == last else 1
        last = picture
    pixels = np.asarray(Image.open(io.BytesIO(last)).convert("RGB"))
    if len(np.unique(pixels.reshape(-1, 3), axis=0)) < _LEAST_COLOURS:
        raise ViewerError("the viewer's picture is blank: the machine renders nothing")
    return pixels


def _connected(server: Server) -> ViewerClient:
    """A client of a viewer, once that answers."""
    clients: list[ViewerClient] = []

    def answers() -> bool:
        # A connection to a port on which no program listens yet may block for seconds.
        if is_free(server.data_port):
            return False
        try:
            client = ViewerClient.connect(server.data_address)
            client.get_state()
        except (RuntimeError, OSError):
            return False
        clients.append(client)
        return True

    server.wait_for(answers)
    return clients[0]


def _inside_once_loaded(client: ViewerClient) -> tuple[str, int]:
    """A time at which everything has begun and nothing has ended, with its timeline before it: ns since the first
    exposure began or, in a file of an older aolink, a fast step. The timeline is empty for a file without time, such as
    `aolink slopes` writes.
    """
    deadline, timeless = time.monotonic() + _SETTLE_S, 0
    while True:
        state = client.get_state()
        timelines = {t.name: t for r in state.recordings for t in r.timelines}
        name = TIME if TIME in timelines else FAST_STEP
        if name in timelines and not state.loading:
            start, end = timelines[name].start or 0, timelines[name].end or 0
            return name, start + round(0.6 * (end - start))
        timeless = timeless + 1 if state.recordings and not state.loading and not timelines else 0
        if timeless * POLL_S > _TIMELESS_S:
            return "", 0
        if time.monotonic() > deadline:
            raise ViewerError("the viewer shows no recording with fast steps: give a file that aolink wrote")
        time.sleep(POLL_S)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
