"""The command `estimate`: one recording, or many."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aolink.cli import common
from aolink.cli.common import EstimatorOption, JsonOption, OverwriteOption, app, progress, stderr, stdout, warn
from aolink.errors import AolinkError, EstimatorError
from aolink.signals import StopRequest

if TYPE_CHECKING:
    from aolink.batch import Model
    from aolink.jobs.batch import Job


@app.command(
    epilog="Example: aolink estimate session.mcap -e o1 -e moments -o again.mcap"
    "  |  aolink estimate *.mcap -e moments --set plant.process_noise=0.2,0.4 --jobs 2 -o results/"
)
def estimate(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="One recording or many.")],
    estimator: EstimatorOption = None,
    target: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE|DIR/",
            help="Write a copy with the new estimates beside those of other estimators; with many files or models, or"
            " into a folder, side files: estimates alone, one file for each -e, and their table.",
        ),
    ] = None,
    rig: Annotated[
        str | None, typer.Option(metavar="RIG.toml", help="Estimate with this rig file instead of the recording's own.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE,...", help="Change a key of the rig file; each value makes a model."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, metavar="N", help="How many recordings to estimate at once.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="With a folder: on the workers of this Dask scheduler.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the motion inside each exposure of recordings, again or for the first time.

    Without -e it runs the estimators that one recording has estimates of, or moments; with many files, moments.
    With many files or models it skips work that was done before and has not changed.
    A file that fails does not stop the others (exit code 1). Exit code 6 if no exposure gave a measurement.
    """
    from aolink.estimation.registry import DEFAULT_ESTIMATOR
    from aolink.jobs import batch
    from aolink.rig import load_rig

    output, is_folder = (Path(target), target.endswith("/") or Path(target).is_dir()) if target else (None, False)
    if scheduler and jobs > 1:
        raise typer.BadParameter("--jobs is for this machine: with --scheduler its workers do the work")
    _check_names(estimator or [])
    models = batch.models(load_rig(rig).toml if rig else None, settings or [], Path(rig).stem if rig else "")
    if not (is_folder or scheduler or jobs > 1 or len(files) > 1 or len(models) > 1):
        _estimate_one(files[0], models[0], estimator, output, overwrite=overwrite, as_json=as_json)
        return
    if output is None or (output.suffix == ".mcap" and not is_folder):
        raise typer.BadParameter("many files or models, --jobs and --scheduler need -o DIR/: a folder for the results")
    if scheduler:  # the workers run in other folders
        files, output = [str(Path(each).absolute()) for each in files], output.absolute()
    todo = batch.jobs(files, models, estimator or [DEFAULT_ESTIMATOR], output, overwrite=overwrite)
    at_once = batch.MOST_AT_ONCE if scheduler else min(jobs, len(todo))
    executor = partial(batch.dask, scheduler) if scheduler else partial(batch.here, at_once)
    _estimate_many(todo, executor, at_once, output, overwrite=overwrite, as_json=as_json)


def _check_names(estimators: Sequence[str]) -> None:
    """Raise EstimatorError before anything is opened, so that a misspelt name does not fail once for each recording."""
    from aolink.estimation.options import with_options
    from aolink.estimation.registry import estimator_row

    for each in estimators:
        with_options(each)
        estimator_row(each)


def _estimate_many(
    todo: "Sequence[Job]", executor: "Callable[[], AbstractContextManager[Executor]]", at_once: int, folder: Path, *,
    overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables import recordings as tables
    from aolink.jobs import batch

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AolinkError(f"cannot make the folder {folder}: {(error.strerror or str(error)).lower()}") from None
    table, done = folder / "results.csv", {}
    batch.check_table(table, overwrite=overwrite)
    with StopRequest().installed() as stop, progress("estimate", len(todo)) as tell:
        for job, row in batch.run(todo, executor, at_once, stop=stop, progress=tell):
            done[job.output] = row
            of = f"{job.source} {job.model.name}".strip()
            if row["error"]:
                stderr.print(f"aolink: {of}: {row['error']}", markup=False)
            if row["damage"]:
                warn(f"{of}: {row['damage']}")
            if row["nothing_measured"]:
                warn(f"{of}: {job.estimator} only predicted: {row['nothing_measured']}")
    rows = [done[job.output] for job in todo if job.output in done]
    batch.write_table(table, rows)
    if as_json:
        print(json.dumps(rows, allow_nan=False))
    else:
        if len(rows) <= _MOST_ROWS_SHOWN:
            stdout.print(tables.batch(rows))
        before, failed = (sum(bool(row[each]) for row in rows) for each in ("done_before", "error"))
        text = f"{len(rows)} of {len(todo)} done, {before} of them before, {failed} failed; table: {table}"
        stdout.print(text, markup=False)
    stop.raise_if_asked()
    if any(row["error"] for row in rows):
        raise typer.Exit(1)
    if any(row["nothing_measured"] for row in rows):
        raise typer.Exit(EstimatorError.exit_code)


_MOST_ROWS_SHOWN = 40


def _estimate_one(
    file: str, model: "Model", estimator: Sequence[str] | None, output: Path | None, *,
    overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables import scores as tables
    from aolink.estimation.registry import DEFAULT_ESTIMATOR
    from aolink.recording.reader import Recording
    from aolink.recording.reestimate import (
        check_has_exposures,
        kept_estimators,
        scored_anew,
        write_reestimated,
    )

    recording = common.say_damage(model.applied_to(Recording(file)))
    check_has_exposures(recording)
    names = list(dict.fromkeys(estimator or recording.estimators or [DEFAULT_ESTIMATOR]))
    try:
        common.get_ready(recording.rig, names)
        with progress("estimate", recording.n_frames) as tell:
            if output is not None:
                scores = write_reestimated(recording, names, output, overwrite=overwrite, progress=tell)
            else:
                scores = scored_anew(recording, names, tell)
    except (ArithmeticError, ValueError) as error:
        if recording.rig_is_recorded:
            raise
        raise EstimatorError(f"{file} cannot be estimated with this rig: {error!r}; check its numbers") from None
    if as_json:
        print(json.dumps(tables.scores_as_json(scores), allow_nan=False))
    else:
        stdout.print(tables.scores(scores))
        if output is not None:
            there = ", ".join(kept_estimators(recording, names))
            beside = f", beside the estimates of {there} that were there" if there else ""
            if recording.estimators and not recording.rig_is_recorded:
                beside = "; the recording's own estimates were made with another rig file and are left out"
            stdout.print(f"written: {output}{beside}", markup=False)
        else:
            stdout.print("These estimates are not kept: -o FILE writes them.")
    common.check_measured(recording.path, scores)
