"""Waiting for files and sockets, however many are open: ``select`` takes no descriptor above 1,023."""

from __future__ import annotations

import select
from collections.abc import Collection
from typing import Protocol


class HasFileno(Protocol):
    """An object that the operating system can wait for."""

    def fileno(self) -> int: ...


def wait_readable(
    some: Collection[HasFileno | int], timeout_s: float, writable: Collection[HasFileno | int] = ()
) -> bool:
    """Wait until one of ``some`` can be read or one of ``writable`` can be written, or for ``timeout_s``; gives whether
    one can."""
    poll = select.poll()
    for each in {*some, *writable}:
        poll.register(each, (each in some and select.POLLIN) | (each in writable and select.POLLOUT))
    return bool(poll.poll(max(0.0, timeout_s) * 1000))
