"""The command identify: it makes a rig file with a model of the disturbance from recordings of blurred frames."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aolink.cli.common import JsonOption, OverwriteOption, app, open_recording, progress, stdout
from aolink.errors import IdentificationError
from aolink.files import check_target, writing

if TYPE_CHECKING:
    from aolink.jobs.identify import IdentifiedModel


class Fitted(StrEnum):
    """The kinds of plants that can be fitted beside the disturbance."""

    FIRST_ORDER = "first-order"
    SECOND_ORDER = "second-order"


@app.command(
    epilog="Example: aolink identify session.mcap -o identified.toml --model resonance"
    "  |  aolink identify *.mcap -o rig.toml"
)
def identify(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings of one rig.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RIG.toml", help="The rig file to write.")],
    model: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            metavar="KIND+KIND...",
            help="Model of the disturbance: random-walk, ornstein-uhlenbeck, second-order, resonance, or a sum of"
            " them. Given several times, cross-validation chooses; without it, from seven.",
        ),
    ] = None,
    fit: Annotated[
        Fitted | None, typer.Option(help="Fit a plant of this kind too, by the inputs, instead of the rig file's.")
    ] = None,
    highest: Annotated[
        float | None,
        typer.Option(metavar="HZ", min=0.0, help="Highest frequency to search; without it 4 / exposure time."),
    ] = None,
    rig: Annotated[
        str | None, typer.Option(metavar="RIG.toml", help="Start from this rig file, not from the recording's own.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Identify the disturbance of the spots, and the plant if asked, from recordings of blurred frames.

    Each parameter has a set that holds the truth with a probability of 95 %. It may have several pieces: frequencies
    that the exposures cannot distinguish.
    """
    from aolink.identification import CANDIDATES
    from aolink.jobs import identify as job
    from aolink.rig import load_rig

    sources = [*files, *([Path(rig)] if rig else [])]
    check_target(output, overwrite=overwrite, sources=sources, suffix=".toml", error=IdentificationError)
    wanted = job.Wanted(
        models=tuple(model) if model else () if fit else CANDIDATES, plant=fit and fit.value, highest_hz=highest or None
    )
    recordings = [open_recording(file) for file in files]
    with progress("identify", None) as tell:

        def on_progress(what: str, done: int, of: int) -> None:
            tell(done, f"{what}: {done} of {of}")

        result = job.identify(recordings, load_rig(rig) if rig else None, wanted, on_progress)
    with writing(output, overwrite=overwrite, sources=sources, error=IdentificationError) as partial:
        partial.write_text(result.text, newline="")
    if as_json:
        print(json.dumps({"out": str(output), "outputs": [_as_json(each) for each in result.found]}))
        return
    from aolink.cli.tables import identification as tables

    for each in result.found:
        for table in tables.found(each):
            stdout.print(table)
        for note in each.notes:
            stdout.print(f"note: {note}", markup=False)
    stdout.print(f"wrote {output}", markup=False)


def _as_json(found: "IdentifiedModel") -> dict[str, Any]:
    parameters = {}
    for each in found.parameters:
        ends = [[None if p.open_low else p.low, None if p.open_high else p.high] for p in each.pieces]
        parameters[each.name] = {"value": each.best, "set": ends}
    return {
        "output": found.output, "model": found.model.name, "exposures": found.exposures,
        "log_likelihood": found.log_likelihood, "tried": {each.name: each.score for each in found.tried},
        "parameters": parameters, "notes": list(found.notes),
    }  # fmt: skip
