"""Processes and threads that share the cores.

A process of a pool has one thread for its linear algebra, so that numbers do not depend on how many cores there are.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""What tells the libraries of linear algebra how many threads to have."""
_PATIENCE_S = 3.0
"""For a process that was told to end."""


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """A function of each item, on as many threads as there are cores for this process; for what lets go of the lock."""
    threads = min(thread_count(), len(items))
    if threads < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


def thread_count() -> int:
    """Cores that this process may use; one in a process of a pool, which shares them with the others."""
    if multiprocessing.parent_process() is not None:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of ``count`` processes, whose linear algebra has one thread. Ctrl-C is for this process alone.

    Whatever is raised in the block ends the processes at once.
    """
    environment = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
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
