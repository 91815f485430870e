"""Many recordings, many models: each recording is estimated again with each, and what came of it is one table."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from aolink.errors import AolinkError, RigError
from aolink.estimation import Engine, Scorer
from aolink.recording.reader import Recording
from aolink.recording.reestimate import recorded_estimates, write_reestimated
from aolink.rig import parse_rig
from aolink.workers import processes

COLUMNS = (
    "recording", "model", "estimator", "exposures", "path_rmse", "start_rmse", "end_rmse",
    "nis", "nis_low", "nis_high", "start_nees", "end_nees", "nees_low", "nees_high", "not_ok", "seconds", "output",
    "error",
)  # fmt: skip
"""Of the table: one row for each recording, model and estimator; what is not known is empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """The rig that recordings are estimated with: their own, or another, with some values changed."""

    name: str = ""
    """What was changed; empty for the recording's own."""
    rig_text: str | None = None
    """Instead of the rig file in the recording."""
    changes: tuple[tuple[str, Any], ...] = ()
    """Dotted keys of the rig file, with their new values."""

    def text_for(self, recorded: str) -> str:
        """The rig file to use for a recording that was made with ``recorded``. Raises RigError for a key it lacks."""
        text = recorded if self.rig_text is None else self.rig_text
        for key, value in self.changes:
            text = _with_value(text, key, value)
        return text


@dataclass(frozen=True, slots=True)
class Job:
    """One recording with one model."""

    source: Path
    model: Model
    estimators: tuple[str, ...]
    """Empty: those that the recording has."""
    output: Path
    engine: Engine = "aolink"

    @property
    def record(self) -> Path:
        """Where the job writes what came of it, when it is done."""
        return self.output.with_suffix(".json")

    def digest(self) -> str:
        """Of everything that the result depends on: a job with the same digest need not be done again."""
        status = self.source.stat()
        facts = [
            str(self.source.resolve()),
            status.st_size,
            status.st_mtime_ns,
            version("aolink"),
            self.estimators,
            self.engine,
        ]
        facts += [
            self.estimators,
            self.engine,
            self.model.rig_text,
            [[key, str(value)] for key, value in self.model.changes],
        ]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Done:
    """What came of a job."""

    job: Job
    rows: list[dict[str, Any]]
    """By `COLUMNS`."""
    error: str = ""
    skipped: bool = False
    """It had been done before."""


def models(rig_text: str | None, settings: Sequence[str]) -> list[Model]:
    """The models that ``--rig`` and ``--set KEY=VALUE,VALUE`` ask for: every combination of the values.

    Raises
    ------
    RigError
        A setting is not of that form.
    """
    axes = []
    for setting in settings:
        key, equals, values = setting.partition("=")
        if not equals or not key.strip() or not values.strip():
            raise RigError(f"--set {setting}: KEY=VALUE or KEY=VALUE,VALUE is needed, as plant.process_noise=0.2,0.4")
        axes.append([(key.strip(), value) for value in _values(values, setting)])
    return [
        Model(name=" ".join(f"{key}={_short(value)}" for key, value in each), rig_text=rig_text, changes=each)
        for each in itertools.product(*axes)
    ]


def jobs(
    sources: Sequence[Path],
    each: Sequence[Model],
    estimators: Sequence[str],
    folder: Path,
    engine: Engine = "aolink",
) -> list[Job]:
    """Every recording with every model. Raises RigError if two would write the same file."""
    made = []
    for source, model in itertools.product(sources, each):
        suffix = "".join(c if c.isalnum() or c in "=.-_" else "-" for c in model.name.replace("plant.", ""))
        name = f"{source.stem}-{suffix}" if suffix else source.stem
        made.append(Job(source, model, tuple(dict.fromkeys(estimators)), folder / f"{name}.mcap", engine))
    names = [job.output for job in made]
    if doubled := {name for name in names if names.count(name) > 1}:
        raise RigError(f"two recordings would be written as {doubled.pop().name}: give them different names")
    return made


def run(
    todo: Sequence[Job],
    workers: int,
    *,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda done: None,
) -> Iterator[Done]:
    """Do the jobs on ``workers`` processes; gives each when it is done, in no order. A failed one stops no other."""
    fresh: list[Job] = []
    for job in todo:
        before = _done_before(job)
        if before is None:
            fresh.append(job)
        else:
            yield before
    count = len(todo) - len(fresh)
    progress(count)
    if workers == 1 or len(fresh) < 2:
        for job in fresh:
            if stop():
                return
            yield _do(job)
            progress(count := count + 1)
        return
    with processes(workers) as pool:
        waiting = {pool.submit(_do, job) for job in fresh}
        while waiting and not stop():
            finished, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in finished:
                yield future.result()
                progress(count := count + 1)


def write_table(path: Path, done: Sequence[Done]) -> None:
    """Write all rows as CSV, or as Parquet if the name ends with .parquet, in the order of recording and model.

    Raises
    ------
    AolinkError
        It cannot be written, or pyarrow is missing for Parquet.
    """
    rows = table_rows(done)
    partial = path.with_name(f".{path.name}.new")
    try:
        if path.suffix == ".parquet":
            try:
                import pyarrow as pa
                import pyarrow.parquet as pq
            except ImportError:
                raise AolinkError("Parquet needs pyarrow: pip install 'aolink[parquet]', or write .csv") from None
            pq.write_table(pa.Table.from_pylist(rows), partial)
        else:
            with partial.open("w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                writer.writerows(rows)
        partial.replace(path)
    except OSError as error:
        raise AolinkError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from None
    finally:
        partial.unlink(missing_ok=True)


def table_rows(done: Sequence[Done]) -> list[dict[str, Any]]:
    """Rows of all jobs by `COLUMNS`, sorted; a failed job has one with its error."""
    rows = []
    for each in done:
        failed = {"recording": str(each.job.source), "model": each.job.model.name, "error": each.error}
        rows += [dict.fromkeys(COLUMNS) | row for row in (each.rows or [failed])]
    return sorted(rows, key=lambda row: (row["recording"], row["model"]))


def _do(job: Job) -> Done:
    """Estimate a recording again; whatever goes wrong is the result."""
    partial = job.output.with_suffix(".mcap.partial")
    try:
        rows = _estimated(job, partial)
        partial.replace(job.output)
        job.record.write_text(json.dumps({"digest": job.digest(), "rows": rows}))
    except (AolinkError, OSError) as error:
        return Done(job, [], f"{error}")
    finally:
        partial.unlink(missing_ok=True)
    return Done(job, rows)


def _estimated(job: Job, target: Path) -> list[dict[str, Any]]:
    begin = time.perf_counter()
    recording = Recording(job.source)
    text = job.model.text_for(recording.rig.toml)
    if text != recording.rig.toml:
        recording = Recording(job.source, rig=parse_rig(text))
    names = list(job.estimators or recording.estimators or ["o3"])
    write_reestimated(recording, names, target, overwrite=True, engine=job.engine)
    seconds = time.perf_counter() - begin
    written = Recording(target)
    scorers, not_ok = {name: Scorer() for name in names}, dict.fromkeys(names, 0)
    each = zip(*(recorded_estimates(written, name) for name in names), strict=True)
    count = 0
    for exposure, estimates in zip(written.exposures(), each, strict=True):
        count += 1
        for estimate in estimates:
            scorers[estimate.estimator].add(exposure, estimate)
            not_ok[estimate.estimator] += estimate.status.name not in ("OK", "PREDICTED")
    rows = []
    for name, scorer in scorers.items():
        score = scorer.result()
        values = {
            "path_rmse": score.path_rmse, "start_rmse": score.start_rmse, "end_rmse": score.end_rmse,
            "nis": score.nis.mean, "nis_low": score.nis.low, "nis_high": score.nis.high,
            "start_nees": score.start_nees.mean, "end_nees": score.end_nees.mean,
            "nees_low": score.end_nees.low, "nees_high": score.end_nees.high,
        }  # fmt: skip
        known = {key: value if value == value else None for key, value in values.items()}
        rows.append(
            {
                "recording": str(job.source), "model": job.model.name, "estimator": name, "exposures": count,
                **known, "not_ok": not_ok[name], "seconds": round(seconds, 3), "output": job.output.name,
            }
        )  # fmt: skip
    return rows


def _done_before(job: Job) -> Done | None:
    try:
        before = json.loads(job.record.read_text())
        if before["digest"] == job.digest() and job.output.exists():
            return Done(job, before["rows"], skipped=True)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None


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


def _with_value(text: str, key: str, value: Any) -> str:
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise RigError(f"not valid TOML: {error}") from None
    table: Any = document
    *path, name = key.split(".")
    for part in path:
        table = table.get(part) if hasattr(table, "get") else None
    if not hasattr(table, "get") or name not in table:
        raise RigError(f"--set {key}: the rig file has no such key")
    table[name] = value
    return tomlkit.dumps(document)
