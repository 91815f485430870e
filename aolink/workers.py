"""Processes that share the cores: one thread each, so that numbers do not depend on how many cores there are."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_PATIENCE_S = 3.0
"""For a process that was told to end."""


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of ``count`` processes, whose linear algebra has one thread. Ctrl-C is for this process alone.

    Whatever is raised in the block ends the processes at once.
    """
    environment = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        with ProcessPoolExecutor(
            count, mp_context=get_context("spawn"), initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)
        ) as pool:
            try:
                yield pool
            except BaseException:
                _end(pool)
                raise
            if pool._broken:  # a process that began while the pool broke would be waited for without end
                _end(pool)
    finally:
        for name, value in environment.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _end(pool: ProcessPoolExecutor) -> None:
    running = list((pool._processes or {}).values())
    for process in running:
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)
    for process in running:
        process.join(_PATIENCE_S)
        process.kill()
        process.join(_PATIENCE_S)
