"""Requests to a device that may take seconds, on a thread that the session does not wait for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any


class Requests:
    """Calls functions in their order, one at a time, on a thread that does not hold up the end of the program."""

    def __init__(self, name: str) -> None:
        self._waiting: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def send(self, request: Callable[[], Any]) -> Future[Any]:
        """Queue ``request``; the future has its result, or the exception that it raised."""
        future: Future[Any] = Future()
        self._waiting.put((future, request))
        return future

    def end(self) -> None:
        """Accept no more requests: those queued before are still called."""
        self._waiting.put(None)

    def _run(self) -> None:
        while (each := self._waiting.get()) is not None:
            future, request = each
            try:
                future.set_result(request())
            except BaseException as error:  # the future hands it to whoever asks for the result
                future.set_exception(error)
