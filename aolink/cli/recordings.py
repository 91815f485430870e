"""Commands on recordings: info, compare, copy."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aolink.cli.common import (
    FileArgument,
    JsonOption,
    OutputOption,
    OverwriteOption,
    app,
    as_seconds,
    open_recording,
    progress,
    stdout,
)
from aolink.errors import RecordingError
from aolink.units import counted

if TYPE_CHECKING:
    from aolink.recording.reader import Recording


CutTime = Annotated[
    float | None, typer.Option(metavar="S", parser=as_seconds, help="Seconds from the recording's start; also 2min.")
]


@app.command(epilog="Example: aolink info session.mcap --json")
def info(
    file: FileArgument,
    check: Annotated[bool, typer.Option("--check", help="Read every byte, not the index alone.")] = False,
    log: Annotated[bool, typer.Option("--log", help="Print what the session said while it ran, line by line.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Summarise a recording; --json has all facts. Exit code 1 if a part of it cannot be read."""
    from aolink.cli.tables import recordings as tables
    from aolink.recording.facts import log_lines, recording_facts

    recording = open_recording(file, check=check)
    if log:
        for line in log_lines(recording):
            print(json.dumps(line) if as_json else f"{line['time_utc']}  {line['level']:<7}  {line['text']}")
        return
    facts = recording_facts(recording)
    if as_json:
        print(json.dumps(facts, allow_nan=False))
    else:
        stdout.print(tables.summary(facts))
    if recording.damage:
        raise typer.Exit(1)


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
        typer.Option(
            "--topic",
            "-t",
            metavar="NAME",
            help="Only this topic, or with a / at its end all below it; may be repeated.",
        ),
    ] = None,
    tolerance: Annotated[
        str,
        typer.Option(
            metavar="RELATIVE[,ABSOLUTE]",
            help="Of numbers; the absolute one, by default 1e-12 of their unit, is added.",
        ),
    ] = "1e-9",
    as_json: JsonOption = False,
) -> None:
    """Say where two recordings differ first, topic by topic. Exit code 1 if they differ.

    A side file is compared with the recording's own estimates by the same names.
    """
    from aolink.cli.tables import recordings as tables
    from aolink.recording import topics
    from aolink.recording.compare import compare as compare_recordings
    from aolink.recording.compare import is_wanted
    from aolink.recording.reestimate import Reestimated
    from aolink.recording.side_files import check_is_side_of

    relative, absolute = _tolerances(tolerance)
    one = open_recording(first)
    if second is None:
        two: Recording = Reestimated(one, one.estimators)
        if not (topic := [each for each in two.counts if is_wanted(each, topic or ())]):
            raise RecordingError(f"{first} holds no such estimates to make again: give a second recording")
    else:
        two = open_recording(second)
        if two.side_of and not one.side_of:
            check_is_side_of(two, one)
            topic = topic or [topics.estimate_topic(name) for name in two.estimators]
    total = sum(count for side in (one, two) for name, count in side.counts.items() if is_wanted(name, topic or ()))
    with progress("compare", total) as tell:
        found = compare_recordings(one, two, relative=relative, absolute=absolute, only=topic or (), progress=tell)
    same_rig = one.rig.digest == two.rig.digest
    same = same_rig and all(each.same for each in found.values())
    if as_json:
        by_topic = {name: asdict(each) for name, each in found.items()}
        print(json.dumps({"same": same, "same_rig": same_rig, "topics": by_topic}))
    else:
        stdout.print(tables.comparison(found))
        if not same_rig:
            stdout.print("the rig files differ")
        stdout.print("the same" if same else "they differ")
    if not same:
        raise typer.Exit(1)


def _tolerances(text: str) -> tuple[float, float]:
    try:
        relative, absolute = (float(each) for each in (*text.split(","), "1e-12")[:2])
    except ValueError:
        relative = absolute = math.nan
    if not (relative >= 0 and absolute >= 0 and text.count(",") <= 1):
        raise typer.BadParameter(
            f"--tolerance {text}: give a relative and, after a comma, an absolute one, both from 0"
        )
    return relative, absolute


@app.command(
    epilog="Example: aolink copy session.mcap --start 10 --end 20 -o part.mcap"
    "  |  aolink copy session-001.mcap session-002.mcap -o session.mcap  |  aolink copy broken.mcap -o whole.mcap"
)
def copy(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="A recording, or the parts of one session."),
    ],
    output: OutputOption,
    start: CutTime = None,
    end: CutTime = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Copy what is whole of a recording, a part of it between two times, or the parts of a session joined to one.

    Of a damaged or unfinished recording the undamaged part is copied; exit code 1 if something was lost. Messages that
    several parts hold are written once.
    """
    from aolink.recording import editing

    timed = start is not None or end is not None
    if timed and len(files) > 1:
        raise typer.BadParameter("--start and --end cut one recording: join the parts first")
    with progress("exposures", None) as tell:
        if len(files) > 1:
            edited = editing.merge(files, output, overwrite=overwrite, progress=tell)
        elif timed:
            until = math.inf if end is None else end
            edited = editing.cut(files[0], output, start or 0.0, until, overwrite=overwrite, progress=tell)
        else:
            edited = editing.recover(files[0], output, overwrite=overwrite, progress=tell)
    for loss in edited.losses:
        stdout.print(f"lost: {loss.text()}", markup=False)
    stdout.print(
        f"written: {edited.path}: {counted(edited.messages, 'message')}, {counted(edited.exposures, 'exposure')}"
        + (f"; {sum(loss.count for loss in edited.losses)} part(s) of the source lost" if edited.losses else ""),
        markup=False,
    )
    if edited.losses:
        raise typer.Exit(1)
