"""A view of a session while it goes on: a sink of its messages, drawn by a process of its own.

Drawing in the session's process would hold Python's lock, which the loop waits for. All that happens there is that
messages become bytes, which a thread writes to the other process.
"""

from __future__ import annotations

import pickle
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING, Any

from google.protobuf.message import Message

from aolink.errors import ViewerError
from aolink.numerics.workers import beside
from aolink.recording.messages import RawMessage
from aolink.viewing.process import check_display, window

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from aolink.rig import Rig

_PERIOD_S = 0.05
"""Time between two looks at what waits: for each message a thread would hold up the loop."""
_MOST_BYTES = 64 << 20
"""The most bytes that may wait for the view."""
_MOST_BEHIND_S = 2.0
"""In real time, how long messages may wait for the view."""
_END_S = 60.0
"""Longest wait at the end until the viewer has all data, s."""
_NICENESS = 15
"""Below the estimators: where all cores are busy, the view is what comes late."""


class LiveView:
    """A sink of a session's messages that shows them.

    In real time it never waits: where the view is too slow, it goes on with new messages, and those that are left out
    are counted and named in the view. Where it ``may_wait``, as on virtual time, nothing is left out.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self.may_wait = False
        self.left_out = 0
        """Messages that were not shown."""
        self.failed = ""
        """Why nothing more is shown; empty while something is."""
        self._pipe, self._waiting, self._bytes = pipe, list[RawMessage](), 0
        self._missing = 0
        """Messages left out that the view does not know of."""
        self._since_s = 0.0
        """When the oldest that waits came."""
        self._changed, self._closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._run, name="aolink-view", daemon=True)
        self._thread.start()

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take the next message."""
        raw = RawMessage(topic, message.DESCRIPTOR.full_name, time_ns, 0, message.SerializeToString())
        with self._changed:
            while self.may_wait and self._bytes > _MOST_BYTES and not self.failed:
                self._changed.wait(_PERIOD_S)
            now_s = time.monotonic()
            if not self._waiting:
                self._since_s = now_s
            elif not self.may_wait and (now_s - self._since_s > _MOST_BEHIND_S or self._bytes > _MOST_BYTES):
                self.left_out, self._missing = self.left_out + len(self._waiting), self._missing + len(self._waiting)
                self._waiting, self._bytes, self._since_s = [], 0, now_s
            if not self.failed:
                self._waiting.append(raw)
                self._bytes += len(raw.data)

    def close(self) -> None:
        """Write what waits, and say that this was all."""
        self._closed = True
        self._thread.join(_END_S)

    def _run(self) -> None:
        try:
            ending = False
            while not ending:
                time.sleep(_PERIOD_S)
                ending = self._closed  # read first: nothing comes after it is set
                with self._changed:
                    batch, self._waiting, self._bytes = (self._missing, self._waiting), [], 0
                    self._missing = 0
                    self._changed.notify_all()
                if batch[1]:
                    pickle.dump(batch, self._pipe, protocol=pickle.HIGHEST_PROTOCOL)
                    self._pipe.flush()
            self._pipe.close()
        except OSError as error:
            self.failed = f"its process has ended: {error.strerror}"


@contextmanager
def live_viewer(
    rig: Rig, estimators: Sequence[str], true_scene: NDArray[np.uint16] | None = None
) -> Iterator[LiveView]:
    """Open the native viewer and give a `LiveView` that feeds it; the viewer stays open until its window is closed.

    Raises
    ------
    ViewerError
        There is no display, or the viewer does not start.
    """
    check_display("there is no display for --view: record or replay without it, then `aolink view --web`")
    with window() as server:
        server.listen()
        with drawn(server.data_address, rig, estimators, true_scene) as live:
            yield live
        server.process.wait()


@contextmanager
def drawn(
    address: str, rig: Rig, estimators: Sequence[str], true_scene: NDArray[np.uint16] | None = None
) -> Iterator[LiveView]:
    """A `LiveView` whose process sends what it draws to a viewer at an address, or into a file of that name.

    Raises `ViewerError` at the end where the process has failed.
    """
    main = "aolink.viewing.live_process"  # not imported here: Rerun takes a second
    with (
        tempfile.TemporaryFile() as said,
        beside(main, niceness=_NICENESS, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said) as process,
    ):
        pipe: Any = process.stdin
        answers: Any = process.stdout
        try:
            pickle.dump((address, rig, list(estimators), true_scene), pipe)
            pipe.flush()
            answers.readline()  # it is ready, or has ended
            live = LiveView(pipe)
            yield live
            live.close()
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            raise ViewerError(f"the viewer has taken nothing for {_END_S:g} s, and was ended") from None
        finally:
            process.kill()
            with suppress(OSError):
                pipe.close()
        said.seek(0)
        if process.returncode and (lines := said.read().decode(errors="replace").strip().splitlines()):
            raise ViewerError(f"the view of the session failed: {lines[-1]}")
