"""Many recordings and many models: each recording is estimated again with each model, and the results are one table."""

from __future__ import annotations

import itertools
import re
import tomllib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError, RigError
from aolink.exporting.common import Progress, no_progress
from aolink.files import remove_unfinished
from aolink.jobs.tables import COLUMNS
from aolink.jobs.unit import Model, Settings, aolink_version, estimated
from aolink.numerics.workers import processes

_POLL_S = 0.2
"""Time between two checks whether the user wants to stop, s."""
_LOST = "its process was ended from outside: too little memory, or a signal"


@dataclass(frozen=True, slots=True)
class Job:
    """One recording with one model and one estimator, whose result is a side file."""

    source: str
    output: Path
    settings: Settings


@dataclass(frozen=True, slots=True)
class Done:
    """The result of a job."""

    job: Job
    row: dict[str, Any] = field(default_factory=dict)
    """The row, by `COLUMNS`; empty for a job that failed."""
    error: str = ""
    skipped: bool = False
    """Whether the job had been done before."""

    @property
    def nothing_measured(self) -> bool:
        """Whether the estimator could not use a single exposure."""
        return bool(self.row.get("nothing_measured"))

    @property
    def warnings(self) -> list[str]:
        """Warnings about the result, in words: the parts of the recording that could not be read or estimated."""
        damage, why = self.row.get("damage"), self.row.get("nothing_measured")
        return [
            *([str(damage)] if damage else []),
            *([f"{self.row['estimator']} only predicted: {why}"] if why else []),
        ]


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
    sources: Sequence[str], each: Sequence[Model], estimators: Sequence[str], folder: Path, *,
    table: bool = False, overwrite: bool = False,
) -> list[Job]:  # fmt: skip
    """Every recording with every model and every estimator; parameters as for `Settings`.

    Raises
    ------
    RigError
        Two would write the same file.
    """
    made = {}
    for source, model, name in itertools.product(dict.fromkeys(sources), each, dict.fromkeys(estimators)):
        suffix = re.sub(r"[^\w=.-]", "-", model.name.replace("plant.", ""))
        output = folder / f"{'-'.join(filter(None, [Path(source).stem, suffix]))}.{name}.mcap"
        if output in made:
            raise RigError(f"two recordings would be written as {output.name}: give them different names")
        settings = Settings(estimator=name, model=model, table=table, overwrite=overwrite)
        made[output] = Job(source, output, settings)
    return list(made.values())


def shard(sources: Sequence[str], part: str) -> list[str]:
    """The recordings of one part of several, ``i/n`` with i from 1 to n: the same for any order of the recordings.

    The parts' sizes differ by one recording at most, they have none in common, and together they are all recordings.

    Raises
    ------
    AolinkError
        ``part`` is not of that form.
    """
    if not (found := re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", part)) or not 1 <= int(found[1]) <= int(found[2]):
        raise AolinkError(f"--shard {part}: I/N is needed, with I from 1 to N, as 1/100 to 100/100")
    return sorted(set(sources))[int(found[1]) - 1 :: int(found[2])]


def here(workers: int) -> AbstractContextManager[Executor]:
    """Processes of this machine that do jobs; for one worker this process itself does them."""
    return processes(workers) if workers > 1 else _Here()


class _Here(Executor):
    def submit(self, function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        """Call the function at once."""
        future: Future[Any] = Future()
        future.set_result(function(*arguments, **options))
        return future


def run(
    todo: Sequence[Job], executor: Callable[[], AbstractContextManager[Executor]], at_once: int, *,
    stop: Callable[[], bool] = lambda: False, progress: Progress = no_progress,
) -> Iterator[Done]:  # fmt: skip
    """Do jobs with an executor, each as a call of its own; gives each when it is done, in no order.

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
        running: dict[Future[Done], Job] = {}
        try:
            with executor() as pool, suppress(BrokenExecutor):
                while running or (queue and not stop()):
                    while queue and len(running) < at_once and not stop():
                        running[pool.submit(do, queue[0], aolink_version())] = queue[0]
                        queue.popleft()
                    if stop():
                        running = {future: job for future, job in running.items() if not future.cancel()}
                    for future in wait(running, _POLL_S, FIRST_COMPLETED).done:
                        done = _result(future, running[future])
                        del running[future]
                        yield done
                        progress(next(count))
        finally:
            for job in running.values():
                remove_unfinished(job.output)
        for future, job in running.items():  # those that the executor had when it broke
            yield Done(job, error=_LOST) if future.exception() else future.result()
            progress(next(count))


def _result(future: Future[Done], job: Job) -> Done:
    try:
        return future.result()
    except (BrokenExecutor, CancelledError):
        raise
    except Exception as error:
        lost = type(error).__name__ == "KilledWorker"  # Dask's: every worker that began the job was lost
        return Done(job, error=_LOST if lost else f"its worker cannot do it: {error!r}")


def table_rows(done: Sequence[Done]) -> list[dict[str, Any]]:
    """Rows by `COLUMNS` of these jobs, sorted. A failed job has a row with its error."""
    rows = []
    for each in done:
        failed = {"recording": each.job.source, "model": each.job.settings.model.name, "error": each.error}
        rows.append(dict.fromkeys(COLUMNS) | (each.row or failed))
    return sorted(rows, key=lambda row: (_numerically(row["recording"]), _numerically(row["model"])))


# A sign belongs to a number only where a value begins: "session-2" comes after "session-1".
_NUMBERS = re.compile(r"((?:(?<=[=,\[])[-+])?\d+(?:\.\d+)?(?:e[-+]?\d+)?)")


def _numerically(text: str) -> list[tuple[str, float]]:
    """A key that sorts texts with numbers in them by the numbers: 5 before 10, and 1e-05 before both."""
    parts = _NUMBERS.split(text)
    return [(words, float(number)) for words, number in zip(parts[::2], [*parts[1::2], "-inf"], strict=True)]


def do(job: Job, version: str) -> Done:
    """Do a job; any error becomes its result.

    ``version`` is that of the aolink which asks: a worker of another machine may have another one.
    """
    if aolink_version() != version:
        return Done(
            job, error=f"a worker has aolink {aolink_version()}, this is {version}: install the same everywhere"
        )
    try:
        row, before = estimated(job.source, job.output, job.settings)
    except (AolinkError, OSError) as error:
        return Done(job, error=f"{error}")
    except Exception as error:  # an unforeseen error stops no other job
        return Done(job, error=f"it cannot be estimated with this model: {error!r}")
    return Done(job, row, skipped=before)
