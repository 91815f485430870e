"""Many recordings and many models: each recording is estimated again with each model, and the results are one table."""

from __future__ import annotations

import itertools
import json
import re
import tomllib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError, RecordingError, RigError
from aolink.estimation import Engine
from aolink.exporting.common import Progress, no_progress
from aolink.files import remove_unfinished
from aolink.jobs.tables import COLUMNS
from aolink.jobs.unit import Model, Settings, estimated
from aolink.numerics.workers import processes
from aolink.recording.remote import Url, location


@dataclass(frozen=True, slots=True)
class Job:
    """One recording with one model and one estimator, whose result is a side file."""

    source: str
    """A file or a URL."""
    output: Path
    settings: Settings

    @property
    def model(self) -> Model:
        """The model that the recording is estimated with."""
        return self.settings.model


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
        key, equals, values = setting.partition("=")
        if not equals or not key.strip() or not values.strip():
            raise RigError(f"--set {setting}: KEY=VALUE or KEY=VALUE,VALUE is needed, as plant.process_noise=0.2,0.4")
        known = axes.setdefault(key.strip(), [])
        for value in _values(values, setting):
            if value not in known:
                known.append(value)
    made = []
    for values_of_one in itertools.product(*axes.values()):
        changes = tuple(zip(axes, values_of_one, strict=True))
        name = " ".join([rig_name, *(f"{key}={_short(value)}" for key, value in changes)]).strip()
        made.append(Model(name=name, rig_text=rig_text, changes=changes))
    return made


def jobs(
    sources: Sequence[str], each: Sequence[Model], estimators: Sequence[str], folder: Path, engine: Engine = "aolink",
    *, table: bool = False, overwrite: bool = False,
) -> list[Job]:  # fmt: skip
    """Every recording with every model and every estimator; parameters as for `Settings`.

    Raises
    ------
    RigError
        Two would write the same file.
    RecordingError
        The folder has the copies that batches of earlier versions wrote.
    """
    if any(map(_is_record_of_a_copy, folder.glob("*.json"))):
        raise RecordingError(
            f"{folder} has copies of recordings from a batch of an earlier aolink: give another folder, and the same"
            " command estimates them again, into side files"
        )
    made = []
    for source, model, name in itertools.product(dict.fromkeys(sources), each, dict.fromkeys(estimators)):
        settings = Settings(estimator=name, model=model, engine=engine, table=table, overwrite=overwrite)
        made.append(Job(source, folder / f"{_name(location(source).stem, model)}.{name}.mcap", settings))
    _check_all_differ(job.output for job in made)
    return made


def _name(stem: str, model: Model) -> str:
    suffix = "".join(c if c.isalnum() or c in "=.-_" else "-" for c in model.name.replace("plant.", ""))
    return f"{stem}-{suffix}" if suffix else stem


def _check_all_differ(outputs: Iterable[Path]) -> None:
    for output, count in Counter(outputs).items():
        if count > 1:
            raise RigError(f"two recordings would be written as {output.name}: give them different names")


def shard(sources: Sequence[str], part: str) -> list[str]:
    """The recordings of one part of several, ``i/n`` with i from 1 to n: the same for any order of the recordings.

    The parts' sizes differ by one recording at most, they have none in common, and together they are all recordings.

    Raises
    ------
    AolinkError
        ``part`` is not of that form.
    """
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", part)
    number, count = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= number <= count:
        raise AolinkError(f"--shard {part}: I/N is needed, with I from 1 to N, as 1/100 to 100/100")
    return sorted(set(sources))[number - 1 :: count]


def absolute(source: str) -> str:
    """A path as a process in another folder needs it; a URL as it is."""
    return source if isinstance(location(source), Url) else str(Path(source).absolute())


def run_here(
    todo: Sequence[Job], workers: int, *, stop: Callable[[], bool] = lambda: False,
    progress: Progress = no_progress,
) -> Iterator[Done]:  # fmt: skip
    """Do the jobs on ``workers`` processes; gives each when it is done, in no order. A failed one stops no other.

    When ``stop()`` gives True no other job is begun, and those under way are ended in good order.
    """
    progress(0)
    each = map(do, itertools.takewhile(lambda job: not stop(), todo))
    for count, done in enumerate(each if workers == 1 or len(todo) < 2 else _in_parallel(todo, workers, stop), 1):
        yield done
        progress(count)


def _in_parallel(todo: Sequence[Job], workers: int, stop: Callable[[], bool]) -> Iterator[Done]:
    queue = deque(todo)
    while queue and not stop():  # again, if a process was lost and its pool with it
        running: dict[Future[Done], Job] = {}
        lost, broken = False, list[Job]()
        try:
            with processes(workers) as pool:
                while running or (queue and not lost and not stop()):
                    # No more than can run: a job that waits in a pool cannot be taken back.
                    while queue and not lost and len(running) < workers and not stop():
                        try:
                            running[pool.submit(do, queue[0])] = queue[0]
                        except BrokenProcessPool:
                            lost = True
                        else:
                            queue.popleft()
                    finished, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                    for future in finished:
                        job = running.pop(future)
                        try:
                            done = future.result()
                        except BrokenProcessPool:
                            lost = True
                            broken.append(job)
                            done = Done(job, error="its process was ended from outside: too little memory, or a signal")
                        yield done
        finally:
            for job in [*running.values(), *broken]:
                remove_unfinished(job.output)


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


def _is_record_of_a_copy(path: Path) -> bool:
    """Whether a file is what batches of earlier versions wrote beside each copy."""
    try:
        return bool({"digest", "rows"} <= json.loads(path.read_text()).keys())
    except (OSError, ValueError, AttributeError):
        return False


def do(job: Job) -> Done:
    """Do a job; any error becomes its result."""
    try:
        row, before = estimated(job.source, job.output, job.settings)
    except (AolinkError, OSError) as error:
        return Done(job, error=f"{error}")
    except Exception as error:  # an unforeseen error stops no other job
        return Done(job, error=f"it cannot be estimated with this model: {error!r}")
    return Done(job, row, skipped=before)


def _values(text: str, setting: str) -> list[Any]:
    """Values divided by commas that are not inside brackets, as TOML reads them."""
    try:
        return list(tomllib.loads(f"values = [{text}]")["values"])
    except tomllib.TOMLDecodeError:
        raise RigError(
            f"--set {setting}: {text} is no number, nor a text in quotation marks, as TOML has them"
        ) from None


def _short(value: Any) -> str:
    return str(value).replace(" ", "")
