"""Many recordings and many models: each recording is estimated again with each model, by the processes of this machine
or the workers of a Dask scheduler."""

from __future__ import annotations

import csv
import itertools
import logging
import re
import tomllib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from aolink.batch import COLUMNS, Model, aolink_version, estimate_file
from aolink.errors import AolinkError, RecordingError, RigError
from aolink.exporting.common import Progress, no_progress
from aolink.extensions import install_command
from aolink.files import check_target, remove_unfinished, writing
from aolink.numerics.workers import processes

_POLL_S = 0.2
"""Time between two checks whether the user wants to stop, s."""
_CONNECT_S = 5.0
"""The longest time that a Dask scheduler may take to answer, s."""
MOST_AT_ONCE = 1000
"""The most jobs that a scheduler is given at once: to take them back costs a millisecond each."""
Row = dict[str, Any]
"""A row of the table of a batch, by `COLUMNS`."""


@dataclass(frozen=True, slots=True)
class Job:
    """One recording with one model and one estimator, whose result is a side file."""

    source: str
    output: Path
    estimator: str
    model: Model
    overwrite: bool

    def failed(self, error: str) -> Row:
        """The row of this job where it failed."""
        known = {"recording": self.source, "model": self.model.name, "estimator": self.estimator, "error": error}
        return dict.fromkeys(COLUMNS) | known


def models(rig_text: str | None, settings: Sequence[str], rig_name: str = "") -> list[Model]:
    """The models that ``--rig`` and ``--set KEY=VALUE,VALUE`` ask for: every combination of the different values.

    Raises
    ------
    RigError
        A setting is not of that form.
    """
    axes: dict[str, list[Any]] = {}
    for setting in settings:
        key, equals, values = map(str.strip, setting.partition("="))
        if not (key and equals and values):
            raise RigError(f"--set {setting}: KEY=VALUE or KEY=VALUE,VALUE is needed, as plant.process_noise=0.2,0.4")
        try:
            found = tomllib.loads(f"values = [{values}]")["values"]
        except tomllib.TOMLDecodeError:
            raise RigError(
                f"--set {setting}: {values} is no number, nor a text in quotation marks, as TOML has them"
            ) from None
        known = axes.setdefault(key, [])
        known += (value for value in found if value not in known)
    made = []
    for values_of_one in itertools.product(*axes.values()):
        changes = tuple(zip(axes, values_of_one, strict=True))
        name = " ".join([rig_name, *(f"{key}={value}".replace(" ", "") for key, value in changes)]).strip()
        made.append(Model(name=name, rig_text=rig_text, changes=changes))
    return made


def jobs(
    sources: Sequence[str], each: Sequence[Model], estimators: Sequence[str], folder: Path, *, overwrite: bool = False
) -> list[Job]:
    """Every recording with every model and every estimator. Raises RigError where two would write the same file."""
    made = {}
    for source, model, name in itertools.product(dict.fromkeys(sources), each, dict.fromkeys(estimators)):
        suffix = re.sub(r"[^\w=.-]", "-", model.name.replace("plant.", ""))
        output = folder / f"{'-'.join(filter(None, [Path(source).stem, suffix]))}.{name}.mcap"
        if output in made:
            raise RigError(f"two recordings would be written as {output.name}: give them different names")
        made[output] = Job(source, output, name, model, overwrite)
    return list(made.values())


def here(workers: int) -> AbstractContextManager[Executor]:
    """Processes of this machine that do jobs; for one worker this process itself does them."""
    return processes(workers) if workers > 1 else _Here()


class _Here(Executor):
    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Call the function at once."""
        future: Future[Any] = Future()
        future.set_result(function(*arguments, **options))
        return future


@contextmanager
def dask(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler, which may come and go; work that is lost with a worker is done by another. At
    the end jobs that no worker has begun are taken back; this does not wait for those under way.

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
    except (OSError, ValueError):
        raise AolinkError(
            f"no Dask scheduler answers at {address}: give what `dask scheduler` says, as tcp://host:8786"
        ) from None
    with client:
        found = client.run(version, "aolink", on_error="return")
        if not found:
            raise AolinkError(f"the scheduler at {address} has no workers: start some with `dask worker {address}`")
        for worker, theirs in found.items():
            if theirs != aolink_version():
                raise AolinkError(
                    f"the worker at {worker} has aolink {theirs}, this is aolink {aolink_version()}: install the same"
                    " everywhere"
                )
        try:
            yield client.get_executor(pure=False)
        except Exception:
            if client.status == "running":
                raise
            raise AolinkError(
                f"the scheduler at {address} is gone; what was done stays done: give the same command again"
            ) from None


def run(
    todo: Sequence[Job], executor: Callable[[], AbstractContextManager[Executor]], at_once: int, *,
    stop: Callable[[], bool] = lambda: False, progress: Progress = no_progress,
) -> Iterator[tuple[Job, Row]]:  # fmt: skip
    """Do jobs with an executor, each as a call of its own; gives each with its row when it is done, in no order.

    A failed job stops no other. When ``stop()`` gives True no other job is begun, those that wait in the executor are
    taken back, and those under way are waited for, except on Dask, which does not say which those are.

    Parameters
    ----------
    executor:
        Opens the executor, and does so again where one has broken because a process of it was lost.
    at_once:
        How many jobs to give to the executor at once. A local pool is given no more than it has processes: a job that
        waits in a pool cannot be taken back.

    Raises
    ------
    CancelledError
        The executor has given up a job.
    """
    queue, count = deque(todo), itertools.count(1)
    progress(0)
    while queue and not stop():
        running: dict[Future[Row], Job] = {}
        try:
            with executor() as pool, suppress(BrokenExecutor):
                while running or (queue and not stop()):
                    while queue and len(running) < at_once and not stop():
                        running[pool.submit(do, queue[0])] = queue[0]
                        queue.popleft()
                    if stop():
                        running = {future: job for future, job in running.items() if not future.cancel()}
                    for future in wait(running, _POLL_S, FIRST_COMPLETED).done:
                        job = running[future]
                        row = _row(future, job)
                        del running[future]
                        yield job, row
                        progress(next(count))
        finally:
            for job in running.values():
                remove_unfinished(job.output)
        for future, job in running.items():  # those that the executor had when it broke
            yield job, _row(future, job)
            progress(next(count))


def _row(future: Future[Row], job: Job) -> Row:
    try:
        return future.result()
    except CancelledError:
        raise
    except Exception as error:  # of the executor: the process was lost, or cannot load what it needs
        remove_unfinished(job.output)
        return job.failed(f"its process was lost, for want of memory or by a signal: {error}")


def do(job: Job) -> Row:
    """Do a job; any error becomes its row."""
    try:
        return estimate_file(job.source, job.output, job.estimator, model=job.model, overwrite=job.overwrite)
    except (AolinkError, OSError) as error:
        return job.failed(f"{error}")
    except Exception as error:  # an unforeseen error stops no other job
        return job.failed(f"it cannot be estimated with this model: {error!r}")


def check_table(path: Path, *, overwrite: bool = False) -> None:
    """Raise RecordingError where the table of a batch cannot be written, or another file has its name."""
    check_target(path, overwrite=True, error=RecordingError)
    if path.exists() and not overwrite:
        with path.open("rb") as file:
            if not file.readline().startswith(",".join(COLUMNS[:3]).encode()):
                raise RecordingError(
                    f"{path} exists and is no table of a batch: give another folder; --overwrite replaces it"
                )


def write_table(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the table of a batch as CSV; unknown values are empty. Raises AolinkError where that is not possible."""
    with writing(path, overwrite=True) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)
