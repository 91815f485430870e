"""Processes and threads that share the cores.

A process of a pool has one thread for its linear algebra, so that numbers do not depend on how many cores there are.
It ends with the process that made it, however that ends.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from types import FrameType
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""The environment variables that set the number of threads of linear algebra libraries."""
_PATIENCE_S = 3.0
"""How long a process may take to end in good order when it has been asked to."""
_CALLS_MS = 50
"""How long to wait at a time for calls that no process will take any more."""
_PIECE = 1 << 20
_FOR_THE_PARENT = {signal.SIGINT, signal.SIGHUP}
"""A terminal sends these to every process of a command. The parent decides what they mean for its workers."""
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_PR_SET_PDEATHSIG = 1


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Apply a function to each item, on one thread for each core of this process; for functions that release the
    GIL."""
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
    """A pool of ``count`` processes, whose linear algebra has one thread, and which import no modules of the current
    folder. Ctrl-C goes to this process alone.

    Any exception in the block ends the processes at once. They also end when this process does, even if it is killed;
    their work is then given up in good order, so that nothing half written stays.
    """
    environment = {name: os.environ.get(name) for name in (*THREAD_VARIABLES, "PYTHONSAFEPATH")}
    os.environ.update(dict.fromkeys(environment, "1"))
    # Start the standard library's resource tracker here, out of reach of the terminal's signals.
    with _apart():
        resource_tracker.ensure_running()
    try:
        with _Pool(count, mp_context=get_context("spawn"), initializer=_begin_to_watch) as pool:
            calls = os.dup(_inside(pool)._call_queue._reader.fileno())
            try:
                yield pool
            except BaseException:
                _end(pool, calls)
                raise
            else:
                if pool._broken:  # otherwise the pool would wait for ever for a process that began while the pool broke
                    _end(pool, calls)
            finally:
                os.close(calls)
    finally:
        for name, value in environment.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def end_with(parent: int) -> None:
    """Make this process end at once when the process ``parent``, which has started it, is gone, however that ends.

    On systems other than Linux it ends only if its parent is gone by now. It may run between fork and exec.
    """
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before this
        os._exit(1)


def beside(module: str, *arguments: int, niceness: int, **streams: Any) -> subprocess.Popen[bytes]:
    """Run ``main(*arguments)`` of a module in a process of its own, for as long as this process lives.

    Its linear algebra has one thread, because the cores are for this process as well. It imports modules from where
    this process has found them, except the current folder, and gets no signal from a terminal. ``streams`` are those
    of `subprocess.Popen`.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))}
    environment |= dict.fromkeys(THREAD_VARIABLES, "1")
    begin = f"from aolink.numerics.workers import begin_beside; begin_beside({os.getpid()}, {niceness})"
    program = f"{begin}; from {module} import main; main(*{arguments})"
    command = [sys.executable, "-P", "-c", program]
    return subprocess.Popen(command, start_new_session=True, env=environment, **streams)


def begin_beside(parent: int, niceness: int) -> None:
    """Begin a process of `beside`: it ends with its parent, and comes after it where all cores are busy."""
    end_with(parent)
    if sys.platform == "linux":  # a session runs at real-time priority for its loop's sake only
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(niceness)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _begin_to_watch() -> None:
    threading.Thread(target=_watch_parent, name="aolink-parent", daemon=True).start()


def _exit(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def _watch_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)  # the main thread handles it, and gives up its work
    time.sleep(_PATIENCE_S)
    os._exit(128 + signal.SIGTERM)


class _Pool(ProcessPoolExecutor):
    """A pool whose processes get no signal from a terminal, from their first instant on."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Submit a call, which may start a process: that inherits which signals are blocked, and where modules lie."""
        with _apart():
            return super().submit(_until_ended, function, *arguments, **options)


@contextmanager
def _apart() -> Iterator[None]:
    """Block a terminal's signals; a process that is started meanwhile never gets them, and this one gets them a moment
    later. Nor does it get the current folder among those where modules lie, as a notebook has it."""
    before, path = signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_THE_PARENT), sys.path[:]
    sys.path[:] = filter(os.path.isabs, path)
    try:
        yield
    finally:
        sys.path[:] = path
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _until_ended(function: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """Call a function in a worker, which ends if a signal asks it to; the pool itself would only note an error.

    Between calls the signal ends the worker at once: where it interrupts an import, of what a call needs, the worker
    would print an error.
    """
    signal.signal(signal.SIGTERM, _exit)
    try:
        return function(*arguments, **options)
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else 1)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _inside(pool: ProcessPoolExecutor) -> Any:
    """The pool with those of its parts that the standard library does not declare."""
    return pool


def _end(pool: ProcessPoolExecutor, calls: int) -> None:
    """End the processes of a pool, whose calls wait in the pipe ``calls``."""
    running, manager = list((pool._processes or {}).values()), _inside(pool)._executor_manager_thread
    results = _inside(pool)._result_queue
    for process in running:
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)
    deadline = time.monotonic() + _PATIENCE_S
    for process in running:
        process.join(max(0.0, deadline - time.monotonic()))
        process.kill()
        process.join(_PATIENCE_S)
    results._writer.close()  # or the pool waits for ever for the rest of a result whose sender has ended
    # The pool's own threads end when all calls are in the pipe. One that is larger than the pipe would keep them from
    # that for ever, for nobody reads (Python before 3.11.5): so it is read here, by a descriptor that only we close.
    deadline, poll = time.monotonic() + _PATIENCE_S, select.poll()
    poll.register(calls, select.POLLIN)
    while manager is not None and manager.is_alive() and time.monotonic() < deadline:
        if poll.poll(_CALLS_MS) and os.read(calls, _PIECE):
            deadline = time.monotonic() + _PATIENCE_S
