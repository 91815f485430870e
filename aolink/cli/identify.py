"""The command identify: recordings of blurred frames into a rig file with a model of what disturbs."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aolink.cli.common import JsonOption, OverwriteOption, app, open_recording, progress, stdout
from aolink.errors import IdentificationError
from aolink.files import check_target, writing

if TYPE_CHECKING:
    from aolink.jobs.identify import Found


class PlantKind(StrEnum):
    """What is known of the plant."""

    KNOWN = "known"
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
            help="What disturbs: random-walk, ornstein-uhlenbeck, second-order, resonance, ar3, ar4, or a sum of them."
            " Given several times, cross-validation chooses; without it, from nine.",
        ),
    ] = None,
    plant: Annotated[
        PlantKind,
        typer.Option(help="Whether the rig file's plant is right, or the kind of plant to fit to the inputs."),
    ] = PlantKind.KNOWN,
    noise: Annotated[bool, typer.Option("--noise", help="Fit the pixels' noise too.")] = False,
    kernel: Annotated[bool, typer.Option("--kernel", help="Fit the kernel's width too.")] = False,
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
    """Identify what disturbs the spots, and the plant if asked, from recordings of blurred frames.

    Each parameter has a set that holds the truth with a probability of 95 %. It may have several pieces: frequencies
    that the exposures cannot tell from each other.
    """
    from aolink.identification import CANDIDATES
    from aolink.jobs import identify as job
    from aolink.rig import load_rig

    check_target(output, overwrite=overwrite, sources=files, suffix=".toml", error=IdentificationError)
    kind = None if plant is PlantKind.KNOWN else plant.value
    wanted = job.Wanted(
        models=tuple(model) if model else () if kind else CANDIDATES, plant=kind, noise=noise, kernel=kernel,
        highest_hz=highest or None,
    )  # fmt: skip
    recordings = [open_recording(file) for file in files]
    with progress("identify", None) as tell:

        def told(what: str, done: int, of: int) -> None:
            tell(done, f"{what}: {done} of {of}")

        result = job.identify(recordings, load_rig(rig) if rig else None, wanted, told)
    sources = [*files, *([Path(rig)] if rig else [])]
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


def _as_json(found: "Found") -> dict[str, Any]:
    return {
        "output": found.output,
        "model": found.model.name,
        "exposures": found.exposures,
        "log_likelihood": found.log_likelihood,
        "tried": {each.name: each.score for each in found.tried},
        "parameters": {
            each.name: {
                "value": each.best,
                "set": [
                    [None if piece.open_low else piece.low, None if piece.open_high else piece.high]
                    for piece in each.pieces
                ],
            }
            for each in found.parameters
        },
    }
