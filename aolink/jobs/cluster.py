"""The workers of a Dask scheduler as an executor: work that is lost with a worker is done again by another."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib.metadata import version

from aolink.errors import AolinkError
from aolink.extensions import install_command
from aolink.jobs.unit import aolink_version

_CONNECT_S = 5.0
AT_ONCE = 1000
"""The most jobs that a scheduler is given at once: to take them back costs a millisecond each."""


@contextmanager
def workers_of(address: str) -> Iterator[Executor]:
    """The executor of a scheduler, whose workers may come and go. At the end jobs that no worker has begun are taken
    back; workers finish those under way, but this does not wait for them.

    Recordings and results are where the workers find them: on a file system that all share.

    Raises
    ------
    AolinkError
        distributed is not installed, no scheduler answers, it has no workers or goes away, or a worker has another
        aolink.
    """
    try:
        from distributed import Client
    except ImportError:
        raise AolinkError(f"--scheduler needs Dask: {install_command('cluster')}") from None
    for name in ("distributed", "distributed.client", "distributed.core", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # the error is raised here, once
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise AolinkError(
            f"no Dask scheduler answers at {address}: give what `dask scheduler` says, as tcp://host:8786"
            f" ({str(error).splitlines()[0]})"
        ) from None
    with client:
        found = client.run(version, "aolink", on_error="return")
        if not found:
            raise AolinkError(f"the scheduler at {address} has no workers: start some with `dask worker {address}`")
        for worker, theirs in sorted(found.items()):
            if theirs != aolink_version():
                what = f"aolink {theirs}" if isinstance(theirs, str) else f"no aolink ({theirs!r})"
                raise AolinkError(
                    f"the worker at {worker} has {what}, this is aolink {aolink_version()}: install the same everywhere"
                )
        try:
            yield client.get_executor(pure=False)
        except Exception:
            if client.status == "running":
                raise
            raise AolinkError(
                f"the scheduler at {address} is gone; what was done stays done: give the same command again"
            ) from None
