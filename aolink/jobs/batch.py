"""Many recordings and many models: each recording is estimated again with each model, and the results are one table."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import time
import tomllib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError, RecordingError, RigError
from aolink.estimation import Engine
from aolink.estimation.registry import DEFAULT_ESTIMATOR
from aolink.exporting.common import Progress, no_progress
from aolink.files import remove_unfinished, writing
from aolink.jobs.tables import COLUMNS
from aolink.jobs.unit import Model, Settings, estimated, score_row
from aolink.numerics.workers import processes
from aolink.recording.reader import Recording
from aolink.recording.reestimate import check_has_exposures, fill_reestimated, own_estimators, scored
from aolink.recording.remote import Url, location

_IN_EVERY_ROW = {"recording", "model", "estimator", "exposures", "output"}


@dataclass(frozen=True, slots=True)
class Job:
    """One recording with one model."""

    source: Path
    model: Model
    estimators: tuple[str, ...]
    """The estimators to run; where empty, those that the recording has."""
    output: Path
    engine: Engine = "aolink"
    overwrite: bool = False
    """Whether to do the job even if it was done before."""
    only: bool = False
    """Whether to leave the estimates of other estimators out of the output."""

    @property
    def record(self) -> Path:
        """The file to which the job writes its result when it is done."""
        return self.output.with_suffix(".json")

    def digest(self) -> str:
        """Digest of everything that the result depends on: a job with the same digest need not be done again."""
        status = self.source.stat()
        facts = [
            str(self.source.resolve()), status.st_size, status.st_mtime_ns, version("aolink"), self.estimators,
            self.engine, self.only, self.model.rig_text, [[key, str(value)] for key, value in self.model.changes],
        ]  # fmt: skip
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()

    def done_before(self) -> Done | None:
        """The result of the job if it was done before, and nothing has changed since."""
        record = None if self.overwrite else _record(self.record)
        try:
            if record and record["digest"] == self.digest() and self.output.exists():
                return Done(self, record["rows"], skipped=True)
        except OSError:  # there is no such recording: the job will say so
            pass
        return None

    def rows(self) -> tuple[list[dict[str, Any]], bool]:
        """Do the job; gives the rows, and whether it had been done before."""
        with writing(self.output, overwrite=True, sources=[self.source], error=RecordingError) as partial:
            rows = _estimated(self, partial)
            # A result is never there without the record that has its job and what it depends on.
            self.output.unlink(missing_ok=True)
            with writing(self.record, overwrite=True) as record:
                record.write_text(json.dumps({"digest": self.digest(), "rows": rows}))
        return rows, False


@dataclass(frozen=True, slots=True)
class SideJob:
    """One recording with one model and one estimator, whose result is a side file."""

    source: str
    """A file or a URL."""
    output: Path
    settings: Settings

    @property
    def model(self) -> Model:
        """The model that the recording is estimated with."""
        return self.settings.model

    def done_before(self) -> Done | None:
        """None: the worker that would do the job finds out whether it was done, with the recording at hand."""
        return None

    def rows(self) -> tuple[list[dict[str, Any]], bool]:
        """Do the job; gives the row, and whether it had been done before."""
        row, before = estimated(self.source, self.output, self.settings)
        return [row], before


@dataclass(frozen=True, slots=True)
class Done:
    """The result of a job."""

    job: Job | SideJob
    rows: list[dict[str, Any]]
    """The rows, by `COLUMNS`."""
    error: str = ""
    skipped: bool = False
    """Whether the job had been done before."""

    @property
    def nothing_measured(self) -> list[str]:
        """Estimators that could not use a single exposure, with the reason, in words."""
        whole = [(row["estimator"], row.get("nothing_measured")) for row in self.rows]
        return [f"{name} only predicted: {why}" for name, why in whole if why]

    @property
    def warnings(self) -> list[str]:
        """Warnings about the result, in words: the parts of the recording that could not be read or estimated."""
        damage = self.rows[0].get("damage") if self.rows else ""
        return [*([str(damage)] if damage else []), *self.nothing_measured]


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
    sources: Sequence[Path], each: Sequence[Model], estimators: Sequence[str], folder: Path, engine: Engine = "aolink",
    *, only: bool = False, overwrite: bool = False,
) -> list[Job]:  # fmt: skip
    """Every recording with every model; with ``overwrite`` also those that were done before.

    With ``only`` the outputs have no other estimates than the new ones.

    Raises
    ------
    RigError
        Two jobs would write the same file.
    RecordingError
        An output would take the place of a recording that is read, or, without ``overwrite``, of a file that no
        job has written.
    """
    made = []
    for source, model in itertools.product(sources, each):
        output = folder / f"{_name(source.stem, model)}.mcap"
        made.append(Job(source, model, tuple(dict.fromkeys(estimators)), output, engine, overwrite, only))
    _check_all_differ(job.output for job in made)
    there = {(status.st_dev, status.st_ino) for source in sources if source.exists() for status in [source.stat()]}
    for job in made:
        if not job.output.exists():
            continue
        if ((status := job.output.stat()).st_dev, status.st_ino) in there:
            raise RecordingError(f"{job.output} is one of the recordings: give another folder for the results")
        if not overwrite and _record(job.record) is None:
            raise RecordingError(
                f"{job.output} exists and is no result of a batch: give another folder, or --overwrite to replace it"
            )
    return made


def side_jobs(
    sources: Sequence[str], each: Sequence[Model], estimators: Sequence[str], folder: Path, engine: Engine = "aolink",
    *, table: bool = False, overwrite: bool = False,
) -> list[SideJob]:  # fmt: skip
    """Every recording with every model and every estimator; parameters as for `jobs` and `Settings`.

    Raises
    ------
    RigError
        Two would write the same file.
    """
    made = []
    for source, model, name in itertools.product(dict.fromkeys(sources), each, dict.fromkeys(estimators)):
        settings = Settings(estimator=name, model=model, engine=engine, table=table, overwrite=overwrite)
        made.append(SideJob(source, folder / f"{_name(location(source).stem, model)}.{name}.mcap", settings))
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
    todo: Sequence[Job | SideJob], workers: int, *, stop: Callable[[], bool] = lambda: False,
    progress: Progress = no_progress,
) -> Iterator[Done]:  # fmt: skip
    """Do the jobs on ``workers`` processes; gives each when it is done, in no order. A failed one stops no other.

    When ``stop()`` gives True no other job is begun, and those under way are ended in good order.
    """
    fresh: list[Job | SideJob] = []
    for job in todo:
        before = job.done_before()
        if before is None:
            fresh.append(job)
        else:
            yield before
    count = len(todo) - len(fresh)
    progress(count)
    each = map(do, itertools.takewhile(lambda job: not stop(), fresh))
    for done in each if workers == 1 or len(fresh) < 2 else _in_parallel(fresh, workers, stop):
        yield done
        progress(count := count + 1)


def _in_parallel(todo: Sequence[Job | SideJob], workers: int, stop: Callable[[], bool]) -> Iterator[Done]:
    queue = deque(todo)
    while queue and not stop():  # again, if a process was lost and its pool with it
        running: dict[Future[Done], Job | SideJob] = {}
        lost, broken = False, list[Job | SideJob]()
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
                            done = Done(job, [], "its process was ended from outside: too little memory, or a signal")
                        yield done
        finally:
            for job in [*running.values(), *broken]:
                remove_unfinished(job.output)


def table_rows(done: Sequence[Done], folder: Path | None = None) -> list[dict[str, Any]]:
    """Rows by `COLUMNS` of these jobs, and of those whose results are in the folder from before, sorted.

    A failed job has one row, with its error.
    """
    rows = []
    for each in done:
        failed = {"recording": str(each.job.source), "model": each.job.model.name, "error": each.error}
        rows += [dict.fromkeys(COLUMNS) | row for row in (each.rows or [failed])]
    known = {each.job.record.resolve() for each in done if isinstance(each.job, Job)}
    for path in folder.glob("*.json") if folder else ():
        if path.resolve() not in known and path.with_suffix(".mcap").exists() and (record := _record(path)):
            rows += [dict.fromkeys(COLUMNS) | row for row in record["rows"]]
    return sorted(rows, key=lambda row: (_numerically(row["recording"]), _numerically(row["model"])))


# A sign belongs to a number only where a value begins: "session-2" comes after "session-1".
_NUMBERS = re.compile(r"((?:(?<=[=,\[])[-+])?\d+(?:\.\d+)?(?:e[-+]?\d+)?)")


def _numerically(text: str) -> list[tuple[str, float]]:
    """A key that sorts texts with numbers in them by the numbers: 5 before 10, and 1e-05 before both."""
    parts = _NUMBERS.split(text)
    return [(words, float(number)) for words, number in zip(parts[::2], [*parts[1::2], "-inf"], strict=True)]


def _record(path: Path) -> dict[str, Any] | None:
    """The record that a job has written; None if there is none, or another file."""
    try:
        record = json.loads(path.read_text())
        rows = record["rows"]
        if isinstance(record["digest"], str) and rows and all(_IN_EVERY_ROW <= {*row} <= {*COLUMNS} for row in rows):
            return dict(record)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None


def do(job: Job | SideJob) -> Done:
    """Do a job; any error becomes its result."""
    try:
        rows, before = job.rows()
    except (AolinkError, OSError) as error:
        return Done(job, [], f"{error}")
    except Exception as error:  # an unforeseen error stops no other job
        return Done(job, [], f"it cannot be estimated with this model: {error!r}")
    return Done(job, rows, skipped=before)


def _estimated(job: Job, target: Path) -> list[dict[str, Any]]:
    begin = time.perf_counter()
    recording = job.model.applied_to(Recording(job.source))
    check_has_exposures(recording)
    left_out: list[str] = []
    names = list(job.estimators or own_estimators(recording, left_out.append) or [DEFAULT_ESTIMATOR])
    fill_reestimated(recording, names, target, only=job.only, engine=job.engine)
    seconds = time.perf_counter() - begin
    return [
        {"recording": str(job.source), "model": job.model.name, "estimator": name, "output": job.output.name}
        | score_row(score)
        | {"seconds": round(seconds, 3), "damage": "; ".join(filter(None, [recording.damage, *left_out])) or None}
        for name, score in scored(Recording(target), names).items()
    ]


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
