"""Commands on recordings: info, estimate, compare, recover, cut, merge."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aolink.cli.common import (
    EstimatorOption,
    FileArgument,
    JsonOption,
    OverwriteOption,
    app,
    open_recording,
    stderr,
    stdout,
)
from aolink.terminal import progress_bar

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from aolink.estimation import Estimate
    from aolink.exposure import Exposure


@app.command(epilog="Example: aolink info session.mcap --json")
def info(file: FileArgument, as_json: JsonOption = False) -> None:
    """Say what a recording holds."""
    from aolink import tables

    recording = open_recording(file)
    facts = tables.recording_facts(recording)
    if as_json:
        print(json.dumps(facts, allow_nan=False))
    else:
        stdout.print(tables.facts(facts))


@app.command(epilog="Example: aolink estimate session.mcap --estimator o1 --estimator o3 -o again.mcap")
def estimate(
    file: FileArgument,
    estimator: EstimatorOption = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="A copy with the new estimates.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the motion inside each exposure of a recording, again or for the first time."""
    from aolink import tables
    from aolink.recording.reader import Recording
    from aolink.recording.reestimate import (
        recorded_estimates,
        reestimated,
        scored_and_compared,
        write_reestimated,
    )

    recording = open_recording(file)
    names = list(dict.fromkeys(estimator or recording.estimators or ["o3"]))
    total = recording.counts.get("/camera/image", 0)
    with progress_bar(stderr, total) as tell:
        if output is not None:
            write_reestimated(recording, names, output, overwrite=overwrite, progress=lambda n: tell("estimate", n))
            written = Recording(output)
            each = zip(*(recorded_estimates(written, name) for name in names), strict=True)
            series: Iterable[tuple[Exposure, Sequence[Estimate]]] = zip(recording.exposures(), each, strict=True)
        else:
            series = reestimated(recording, names, lambda n: tell("estimate", n))
        scores, differences = scored_and_compared(recording, series, names)
    if as_json:
        print(json.dumps({**tables.scores_as_json(scores), "differs_from_recorded": differences}, allow_nan=False))
        return
    stdout.print(tables.scores(scores))
    for name, difference in differences.items():
        stdout.print(f"{name}: {difference or 'the same as recorded, bit for bit'}")
    if output is not None:
        stdout.print(f"written: {output}", markup=False)
