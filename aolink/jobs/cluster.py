"""The jobs of a batch on the workers of a Dask scheduler: work that is lost with a worker is done again by another."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from aolink.errors import AolinkError
from aolink.exporting.common import Progress, no_progress
from aolink.extensions import install_command
from aolink.jobs.batch import Done, Job, do
from aolink.jobs.unit import aolink_version

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_S = 5.0
_POLL_S = 0.02
"""Time between two checks whether the user wants to stop, s."""


def run_on(
    address: str, todo: Sequence[Job], *, stop: Callable[[], bool] = lambda: False,
    progress: Progress = no_progress,
) -> Iterator[Done]:  # fmt: skip
    """Do jobs on the workers of a scheduler; gives each when it is done, in no order. A failed one stops no other.

    Recordings and results are where the workers find them: on a file system that all share, or behind URLs. When
    ``stop()`` gives True, jobs that no worker has begun are taken back; workers finish those under way, but this does
    not wait for them.

    Raises
    ------
    AolinkError
        distributed is not installed, no scheduler answers, it has no workers or goes away, or a worker has another
        aolink.
    """
    with _connected(address) as client:
        _check_workers(client, address)
        from distributed import as_completed

        futures = client.map(_on_worker, todo, version=aolink_version(), pure=False)
        jobs = {future.key: job for future, job in zip(futures, todo, strict=True)}
        finished = as_completed(futures, loop=client.loop)
        del futures  # a result that was taken is forgotten by the cluster
        progress(0)
        while jobs:
            if stop():
                client.cancel(list(finished.futures))
                return
            some = finished.next_batch(block=False)
            for future in some:
                if future.cancelled():
                    raise AolinkError(
                        f"the scheduler at {address} is gone; what was done stays done: give the same command again"
                    )
                job = jobs.pop(future.key)
                error = future.exception()
                yield Done(job, error=_in_words(error)) if error else future.result()
                progress(len(todo) - len(jobs))
            if not some:
                time.sleep(_POLL_S)


def _on_worker(job: Job, version: str) -> Done:
    """Do a job on a worker. The version of aolink is checked here, because a worker that joined late was not asked
    before."""
    if aolink_version() != version:
        return Done(
            job, error=f"a worker has aolink {aolink_version()}, this is {version}: install the same everywhere"
        )
    return do(job)


def _in_words(error: BaseException) -> str:
    if type(error).__name__ == "KilledWorker":
        return "every worker that began it was lost: too little memory, or a signal"
    return f"its worker cannot do it: {error!r}"


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    try:
        from distributed import Client
    except ImportError:
        raise AolinkError(f"--scheduler needs Dask: {install_command('cluster')}") from None
    for name in ("distributed", "distributed.client", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # the error is raised here, once
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise AolinkError(
            f"no Dask scheduler answers at {address}: give what `dask scheduler` says, as tcp://host:8786"
            f" ({str(error).splitlines()[0]})"
        ) from None
    try:
        yield client
    finally:
        client.close()


def _check_workers(client: Client, address: str) -> None:
    found: dict[str, Any] = client.run(version, "aolink", on_error="return")
    if not found:
        raise AolinkError(f"the scheduler at {address} has no workers: start some with `dask worker {address}`")
    for worker, theirs in sorted(found.items()):
        if theirs != aolink_version():
            what = f"aolink {theirs}" if isinstance(theirs, str) else f"no aolink ({theirs!r})"
            raise AolinkError(
                f"the worker at {worker} has {what}, this is aolink {aolink_version()}: install the same everywhere"
            )
