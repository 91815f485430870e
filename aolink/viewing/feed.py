"""A viewer that a recording feeds while it is read.

Rerun takes most of a second to load, and its viewer as long to start, so the viewer is started first.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from aolink.errors import ViewerError
from aolink.viewing.look import APPLICATION, Look, identity
from aolink.viewing.process import Server, serving, window

if TYPE_CHECKING:
    import rerun as rr

    from aolink.recording.reader import Recording

_FLUSH_S = 60.0
"""Longest wait at the end until the viewer has taken all data, s."""
_SLICE_S = 0.5
"""Longest wait at a time, in which no signal is handled, s."""


def show(
    recording: Recording | str | Path, look: Look | None = None, *, progress: Callable[[int], None] | None = None
) -> None:
    """Open a recording, or its file, in the native viewer while it is read, and wait until the window is closed.

    Parameters
    ----------
    look:
        A part of it, or another spot; by default the whole recording.
    progress:
        Called with the number of exposures that have been sent.

    Raises
    ------
    ViewerError
        There is no display, the viewer does not start or takes no more data, or the recording has nothing to show.
    """
    from aolink.recording.reader import opened

    recording = opened(recording)
    with window() as server:
        _feed(server, recording, look or Look(), progress)


def serve(
    recording: Recording, look: Look | None = None, *, on_ready: Callable[[str], None] | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:  # fmt: skip
    """Serve a recording with the web viewer on this machine's loopback until interrupted, already while it is read.

    Parameters are those of `show` and of `serve_web`. Raises `ViewerError`.
    """
    with serving() as server:
        _feed(server, recording, look or Look(), progress, on_ready)


def _feed(
    server: Server, recording: Recording, look: Look, progress: Callable[[int], None] | None,
    on_ready: Callable[[str], None] | None = None,
) -> None:  # fmt: skip
    import rerun as rr  # while the viewer starts

    from aolink.viewing.save import sent_parts

    stream = rr.RecordingStream(APPLICATION, recording_id=identity(recording, look))
    server.listen()
    stream.connect_grpc(server.data_address)
    try:
        if on_ready is not None:
            on_ready(server.address)
        for done in sent_parts(stream, recording, look, at_once=True):
            if server.process.poll() is not None:
                return  # its window was closed
            if progress:
                progress(done)
        _flush(stream, server)
        server.process.wait()
    finally:
        stream.disconnect()


def _flush(stream: rr.RecordingStream, server: Server) -> None:
    deadline_s = time.monotonic() + _FLUSH_S
    while server.process.poll() is None:
        try:
            stream.flush(timeout_sec=_SLICE_S)
            return
        except RuntimeError:
            if time.monotonic() > deadline_s:
                raise ViewerError(f"the viewer has taken nothing for {_FLUSH_S:g} s, and was ended") from None
