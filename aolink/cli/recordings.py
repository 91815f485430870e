"""Commands on recordings: info, estimate, compare, recover, cut, merge."""

import json
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aolink.cli.common import (
    EstimatorOption,
    FileArgument,
    JsonOption,
    OutputOption,
    OverwriteOption,
    app,
    check_measured,
    get_ready,
    open_recording,
    progress,
    stderr,
    stdout,
    warn,
)
from aolink.errors import AolinkError, EstimatorError, RecordingError
from aolink.files import check_target, writing
from aolink.signals import StopRequest

if TYPE_CHECKING:
    from aolink.estimation import Estimate
    from aolink.exposure import Exposure
    from aolink.jobs.batch import Done, Job, SideJob
    from aolink.jobs.unit import Model
    from aolink.recording.editing import Edited


class Engine(StrEnum):
    """The implementation of o1 to o3."""

    AOLINK = "aolink"
    FILTERPY = "filterpy"


@app.command(epilog="Example: aolink info session.mcap --json")
def info(
    file: Annotated[str, typer.Argument(help="A recording: a file, or a URL.", metavar="FILE")],
    check: Annotated[bool, typer.Option("--check", help="Read every byte, not the index alone.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Summarise a recording. Exit code 1 if a part of it cannot be read."""
    from aolink.cli.tables import recordings as tables
    from aolink.recording.facts import recording_facts

    recording = open_recording(file, check=check)
    facts = recording_facts(recording)
    if as_json:
        print(json.dumps(facts, allow_nan=False))
    else:
        stdout.print(tables.facts(facts))
    if recording.damage:
        raise typer.Exit(1)


@app.command(
    epilog="Example: aolink estimate session.mcap -e o1 -e o3 -o again.mcap"
    "  |  aolink estimate *.mcap -e moments --set plant.process_noise=0.2,0.4 --jobs 2 -o results/"
)
def estimate(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="One recording or many, or their URLs.")],
    estimator: EstimatorOption = None,
    target: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE|DIR/",
            help="Write a copy with the new estimates beside those of other estimators; with many files or models, a"
            " folder for the copies and their table.",
        ),
    ] = None,
    rig: Annotated[
        str | None, typer.Option(metavar="RIG.toml", help="Estimate with this rig file instead of the recording's own.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE,...", help="Change a key of the rig file; each value makes a model."),
    ] = None,
    engine: Annotated[
        Engine,
        typer.Option(help="Implementation of the filters; filterpy runs o1 to o3 on a plant of one axis, slowly."),
    ] = Engine.AOLINK,
    only: Annotated[bool, typer.Option("--only", help="Leave the recording's own estimates out of the copy.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="How many recordings to estimate at once.")] = 1,
    parquet: Annotated[bool, typer.Option("--parquet", help="Write the table as Parquet, not as CSV.")] = False,
    side: Annotated[
        bool,
        typer.Option("--side", help="Write side files into DIR: estimates alone, one file for each -e, no copies."),
    ] = False,
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="X.parquet",
            help="With --side: the table of the recordings, and X.exposures.parquet with a row for each exposure.",
        ),
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="With --side: part I of N of the recordings, for a job array.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="With --side: on the workers of this Dask scheduler.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the motion inside each exposure of recordings, again or for the first time.

    Without -e it runs the estimators that the recording has estimates of, or o3.
    With many files or models it skips work that was done before and has not changed.
    A file that fails does not stop the others (exit code 1). Exit code 6 if no exposure gave a measurement.
    """
    output, is_folder = (Path(target), target.endswith("/") or Path(target).is_dir()) if target else (None, False)
    if side and (output is None or only or parquet):
        raise typer.BadParameter("--side needs -o DIR, and goes with --table X.parquet, not with --only or --parquet")
    if not side and (table or shard or scheduler):
        raise typer.BadParameter("--table, --shard and --scheduler are for side files: give --side too")
    if scheduler and jobs > 1:
        raise typer.BadParameter("--jobs is for this machine: with --scheduler its workers do the work")
    if only and output is None:
        raise typer.BadParameter("--only is for the copy that -o writes: give -o too")
    _check_names(estimator or [])
    models = batch_models(rig, settings)
    if not side and len(files) == 1 and len(models) == 1 and not is_folder:
        if parquet or jobs > 1:
            raise typer.BadParameter("--parquet and --jobs are for many files or models, with -o DIR/")
        _estimate_one(
            files[0], models[0], estimator, output, engine, only=only, overwrite=overwrite, as_json=as_json
        )  # fmt: skip
        return
    if output is None or (output.suffix == ".mcap" and not is_folder and not side):
        raise typer.BadParameter("many files or models need -o DIR: a folder for the results")
    from aolink.jobs import batch
    from aolink.jobs.tables import parquet as load_parquet
    from aolink.recording.remote import location

    if side:
        if table is not None:
            check_target(table, overwrite=True, suffix=".parquet")
            load_parquet()
        sources = batch.shard(files, shard) if shard else files
        if scheduler:  # the workers run in other folders
            sources, output = [batch.absolute(each) for each in sources], output.absolute()
        todo: Sequence[Job | SideJob] = batch.side_jobs(
            sources, models, estimator or ["o3"], output, engine.value, table=table is not None, overwrite=overwrite
        )
        part = f"-{shard.replace('/', '-of-')}" if shard else ""
        results = table.with_stem(table.stem + part) if table else output / f"results{part}.csv"
        _estimate_many(todo, output, results, jobs, scheduler, side=True, overwrite=overwrite, as_json=as_json)
        return
    if urls := [each for each in map(location, files) if not isinstance(each, Path)]:
        raise typer.BadParameter(f"{urls[0]} is a URL: of many recordings behind URLs --side makes side files")
    todo = batch.jobs(
        [*map(Path, files)], models, estimator or [], output, engine.value, only=only, overwrite=overwrite
    )  # fmt: skip
    name = "results.parquet" if parquet else "results.csv"
    _estimate_many(todo, output, output / name, jobs, None, side=False, overwrite=overwrite, as_json=as_json)


def batch_models(rig: str | None, settings: Sequence[str] | None) -> "list[Model]":
    """The models that --rig and --set ask for."""
    from aolink.jobs import batch
    from aolink.rig import load_rig

    return batch.models(load_rig(rig).toml if rig else None, settings or [], Path(rig).stem if rig else "")


def _check_names(estimators: Sequence[str]) -> None:
    """Raise EstimatorError before anything is opened, so that a misspelt name does not fail once for each recording."""
    from aolink.estimation.options import with_options
    from aolink.estimation.registry import estimator_row

    for each in estimators:
        with_options(each)
        estimator_row(each)


def _estimate_many(
    todo: "Sequence[Job | SideJob]", folder: Path, table: Path, workers: int, scheduler: str | None, *, side: bool,
    overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables import recordings as tables
    from aolink.jobs import batch
    from aolink.jobs.tables import check_table, fill_table, join_tables, table_beside

    of_exposures = table.with_suffix(".exposures.parquet") if side and table.suffix == ".parquet" else None
    places = [table]
    if of_exposures is not None:
        places += [of_exposures, *(table_beside(job.output) for job in todo)]
    for each in () if overwrite else places:
        check_table(each)

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AolinkError(f"cannot make the folder {folder}: {(error.strerror or str(error)).lower()}") from None
    # The table's file is locked from the start, so that the same part, if begun twice, is refused.
    with writing(table, overwrite=True) as partial:
        with StopRequest().installed() as stop, progress("estimate", len(todo)) as tell:
            if scheduler:
                from aolink.jobs.cluster import run_on

                done = _printed(run_on(scheduler, todo, stop=stop, progress=tell))
            else:
                done = _printed(batch.run_here(todo, workers, stop=stop, progress=tell))
        rows = batch.table_rows(done, None if side else folder)
        fill_table(partial, rows, table.suffix)
        if of_exposures is not None:
            parts = [table_beside(each.job.output) for each in done if not each.error]
            join_tables(sorted(parts), of_exposures)
    if as_json:
        print(json.dumps(rows, allow_nan=False))
    else:
        if not side or len(rows) <= _MOST_ROWS_SHOWN:
            stdout.print(tables.batch(rows))
        if not side:
            _draw(rows, folder / "results.png")
        failed, skipped = sum(bool(each.error) for each in done), sum(each.skipped for each in done)
        text = f"{len(done)} of {len(todo)} done, {skipped} of them before, {failed} failed; table: {table}"
        stdout.print(text, markup=False)
    stop.raise_if_asked()
    if any(each.error for each in done):
        raise typer.Exit(1)
    if any(each.nothing_measured for each in done):
        raise typer.Exit(EstimatorError.exit_code)


_MOST_ROWS_SHOWN = 40


def _printed(each_done: "Iterable[Done]") -> "list[Done]":
    """The results of jobs; errors and warnings are printed as they come."""
    done = []
    for each in each_done:
        done.append(each)
        of = f"{each.job.source} {each.job.model.name}".strip()
        if each.error:
            stderr.print(f"aolink: {of}: {each.error}", markup=False)
        for warning in each.warnings:
            warn(f"{of}: {warning}")
    return done


def _draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    from aolink.cli.plotting import batch_picture

    try:
        batch_picture(rows, path)
    except AolinkError as error:
        stderr.print(f"aolink: no picture: {error}", markup=False)
    else:
        stdout.print(f"picture: {path}", markup=False)


def _estimate_one(
    file: str, model: "Model", estimator: Sequence[str] | None, output: Path | None, engine: Engine, *,
    only: bool, overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables import scores as tables
    from aolink.estimation.registry import DEFAULT_ESTIMATOR
    from aolink.recording.reader import Recording
    from aolink.recording.reestimate import (
        check_has_exposures,
        kept_estimators,
        reestimated,
        scored_and_compared,
        write_reestimated,
    )

    recording = model.applied_to(open_recording(file))
    check_has_exposures(recording)
    names = list(dict.fromkeys(estimator or recording.estimators or [DEFAULT_ESTIMATOR]))
    total, known = recording.n_frames, recording.damage
    try:
        get_ready(recording.rig, names)
        with progress("estimate", total) as tell:
            if output is not None:
                write_reestimated(
                    recording, names, output,
                    only=only, overwrite=overwrite, progress=tell, engine=engine.value,
                )  # fmt: skip
                written = Recording(output)
                each = zip(*(written.iter_estimates(name) for name in names), strict=True)
                series: Iterable[tuple[Exposure, Sequence[Estimate]]] = zip(recording.exposures(), each, strict=True)
            else:
                series = reestimated(recording, names, tell, engine.value)
            scores, differences = scored_and_compared(recording, series, names)
    except (ArithmeticError, ValueError) as error:
        if recording.rig_is_recorded:
            raise
        raise EstimatorError(f"{file} cannot be estimated with this rig: {error!r}; check its numbers") from None
    if recording.damage != known:
        warn(f"{file}: {recording.damage}")
    if as_json:
        print(json.dumps({**tables.scores_as_json(scores), "differs_from_recorded": differences}, allow_nan=False))
    else:
        stdout.print(tables.scores(scores))
        begun_late = "cut" in recording.metadata or recording.metadata.get("part", "1") != "1"
        why = " (the recording begins in the middle of its session, where estimators begin anew)" if begun_late else ""
        for name, difference in differences.items():
            text = difference + why if difference else "the same as recorded, bit for bit"
            stdout.print(f"{name}: {text}", markup=False)
        if output is not None:
            there = ", ".join(kept_estimators(recording, names, only=only))
            beside = f", beside the estimates of {there} that were there" if there else ""
            if recording.estimators and not recording.rig_is_recorded:
                beside = "; the recording's own estimates were made with another rig file and are left out"
            stdout.print(f"written: {output}{beside}", markup=False)
    check_measured(recording.path, scores)


CutTime = Annotated[float | None, typer.Option(metavar="S", help="Seconds from the recording's start.")]


@app.command(epilog="Example: aolink compare session.mcap again.mcap --topic /estimate/")
def compare(
    first: Annotated[str, typer.Argument(metavar="A", help="A recording.")],
    second: Annotated[
        str | None,
        typer.Argument(
            metavar="[B]",
            help="Another, or a side file of A; without it, A with its estimates made again by this aolink.",
        ),
    ] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", "-t", help="Only this topic, or with a / at its end all below it; may be repeated."),
    ] = None,
    relative: Annotated[float, typer.Option(min=0, help="Relative tolerance of numbers.")] = 1e-9,
    absolute: Annotated[float, typer.Option(min=0, help="Tolerance in a number's own unit, added.")] = 1e-12,
    accept: Annotated[
        bool, typer.Option("--accept", help="Where they differ, put B (or the new estimates) in A's place.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List field by field how two recordings differ. Exit code 1 if they do.

    A side file is compared with the recording's own estimates by the same names.
    """
    from tempfile import TemporaryDirectory

    from aolink.cli.tables import recordings as tables
    from aolink.recording import topics
    from aolink.recording.compare import compare as compare_recordings
    from aolink.recording.reestimate import write_reestimated
    from aolink.recording.side_files import check_is_side_of

    one = open_recording(first)
    if accept and topic:
        raise typer.BadParameter(f"--accept would replace the whole of {first}, other topics too: leave --topic out")
    if second is None and not one.estimators:
        raise RecordingError(f"{first} holds no estimates to make again: give a second recording")
    with TemporaryDirectory(prefix="aolink-") as folder:
        if second is None:
            second = f"{folder}/{one.path.name}"
            with progress("estimate", one.n_frames) as tell:
                write_reestimated(one, one.estimators, second, progress=tell, as_recorded=True)
        two = open_recording(second)
        if two.side_of and not one.side_of:
            check_is_side_of(two, one)
            if accept:
                raise typer.BadParameter(f"{second} is a side file, which cannot take the place of {first}")
            topic = topic or [topics.estimate_topic(name) for name in two.estimators]
        total = sum(one.counts.values()) + sum(two.counts.values())
        with progress("compare", total) as tell:
            found = compare_recordings(
                one, two, relative=relative, absolute=absolute, only=topic or (), progress=tell
            )  # fmt: skip
        same_rig = one.rig.digest == two.rig.digest
        same = same_rig and all(each.same for each in found.values())
        if as_json:
            print(json.dumps(tables.comparison_as_json(found, same_rig=same_rig), allow_nan=False))
        else:
            stdout.print(tables.comparison(found))
            if not same_rig:
                stdout.print("the rig files differ")
        damage = [f"{each.path}: {each.damage}" for each in (one, two) if each.damage]
        for text in damage:
            warn(text)
        if accept and not same:
            if damage:
                raise RecordingError(f"{damage[0]}: a damaged recording is not accepted; `aolink recover` it first")
            if not (isinstance(one.path, Path) and isinstance(two.path, Path)):
                raise typer.BadParameter("--accept is for files of this machine, not for URLs")
            with writing(one.path, overwrite=True, sources=[two.path], error=RecordingError) as partial:
                shutil.copyfile(two.path, partial)
            stdout.print(f"accepted: {first} is replaced", markup=False)
            return
    if not as_json:
        stdout.print("the same" if same else "they differ")
    if not same:
        raise typer.Exit(1)


@app.command(epilog="Example: aolink recover broken.mcap -o whole.mcap")
def recover(
    file: FileArgument,
    output: OutputOption,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Save the undamaged part of a damaged or unfinished recording. Exit code 1 if something was lost."""
    from aolink.recording.editing import recover as recover_recording

    with progress("exposures", None) as tell:
        edited = recover_recording(file, output, overwrite=overwrite, progress=tell)
    _print_edited(edited, as_json)
    if edited.losses:
        raise typer.Exit(1)


@app.command(epilog="Example: aolink cut session.mcap --start 10 --end 20 -o part.mcap")
def cut(
    file: FileArgument,
    output: OutputOption,
    start: CutTime = None,
    end: CutTime = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Copy the exposures between two times, with the commands that belong to them."""
    from aolink.recording.editing import cut as cut_recording

    with progress("exposures", None) as tell:
        edited = cut_recording(
            file, output, start or 0.0, math.inf if end is None else end,
            overwrite=overwrite, progress=tell,
        )  # fmt: skip
    _print_edited(edited, as_json)


@app.command(epilog="Example: aolink merge session-001.mcap session-002.mcap -o session.mcap")
def merge(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="The parts of one session.")],
    output: OutputOption,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Join the parts of one session; messages that several of them hold are written once."""
    from aolink.recording.editing import merge as merge_recordings

    with progress("exposures", None) as tell:
        edited = merge_recordings(files, output, overwrite=overwrite, progress=tell)
    _print_edited(edited, as_json)


def _print_edited(edited: "Edited", as_json: bool) -> None:
    if as_json:
        print(json.dumps({**asdict(edited), "path": str(edited.path)}))
        return
    for loss in edited.losses:
        stdout.print(f"lost: {loss.text()}", markup=False)
    stdout.print(
        f"written: {edited.path}: {edited.messages} messages, {edited.exposures} exposures"
        + (f"; {len(edited.losses)} part(s) of the source lost" if edited.losses else ""),
        markup=False,
    )
