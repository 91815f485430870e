"""The command that measures a camera, or the interaction matrix of a mirror."""

import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from aolink.cli.common import JsonOption, OverwriteOption, app, progress, stderr, stdout
from aolink.cli.terminal import ask, progress_bar
from aolink.errors import AolinkError, CalibrationError
from aolink.files import check_target, writing
from aolink.signals import stop_after
from aolink.units import counted

if TYPE_CHECKING:
    from aolink.rig import Rig


@app.command(
    epilog="Example: aolink calibrate dark.mcap flat.mcap still.mcap --rig my.toml -o calibrated.toml"
    "  |  aolink calibrate --measure interaction --camera PORT --mirror PORT --rig my.toml -o interaction.npz"
)
def calibrate(
    rig: Annotated[
        str,
        typer.Option(
            metavar="RIG.toml", help="The rig file to start from, or the name of a rig that comes with aolink."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="The rig file to write; of an interaction a .npz file."),
    ],
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FILE]...",
            help="Recordings made with `aolink record --calibration`, or with pokes.",
        ),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(metavar="PORT", help="Port of the camera, to record the frames now.")
    ] = None,
    mirror: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the mirror.")] = None,
    measure: Annotated[
        str,
        typer.Option(
            metavar="WHAT",
            help="frames:count=100, frames of each light; interaction:poke=0.1,repeats=2,hold_s=0, the mirror's"
            " interaction matrix, by pokes of a share of each input's range that rest before they are measured; or"
            " row-time:blink_hz=HZ, the time between the camera's rows, from a film of even light that blinks.",
        ),
    ] = "frames",
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure black level, noise, gain, scale and kernel width, and write them into a copy of the rig file.

    It takes recordings of dark, flat and still light, or records from the devices, asking for each in turn; what it
    records stays in a folder beside the output. An interaction pushes and pulls each of the mirror's inputs, and is
    where the spots went. A row time is measured from one film.
    """
    from aolink.jobs import calibrate
    from aolink.rig import load_rig

    loaded = load_rig(rig)
    what, given = _measured(measure)
    interaction = what == "interaction"
    if what == "row-time":
        if not files or len(files) != 1 or camera or mirror:
            raise typer.BadParameter("--measure row-time takes one film of blinking light, and no devices")
        check_target(output, overwrite=overwrite, sources=files, error=AolinkError)
        _write_row_time(loaded, rig, files[0], given["blink_hz"], output, overwrite=overwrite, as_json=as_json)
        return
    if (files and (camera or mirror)) or not (files or camera or "camera" in loaded.devices):
        raise typer.BadParameter("give recordings, or --camera, or [devices.camera] in the rig file")
    suffix, kind = (".npz", CalibrationError) if interaction else ("", AolinkError)
    check_target(output, overwrite=overwrite, sources=files or [], suffix=suffix, error=kind)
    folder, hold = output.with_name(f"{output.stem}-frames"), given.get("hold_s", 0.0)
    try:
        if files:
            paths = files
        elif interaction:
            paths = [folder / "pokes.mcap"]
            folder.mkdir(parents=True, exist_ok=True)
            with stop_after() as stop, progress("exposures", None) as tell:
                calibrate.record_pokes(
                    loaded, camera, mirror, paths[0], share=given["poke"], repeats=round(given["repeats"]),
                    overwrite=overwrite, stop=stop, progress=tell, hold_s=hold,
                )  # fmt: skip
        else:
            frames = round(given["count"])
            paths = calibrate.record_frames(
                loaded, camera, mirror, folder, frames=frames, overwrite=overwrite,
                ask=partial(ask, stderr), stoppable=stop_after, progress=partial(progress_bar, stderr, frames),
            )  # fmt: skip
        if interaction:
            _write_interaction(loaded, paths, output, hold_s=hold, overwrite=overwrite, as_json=as_json)
        else:
            _write_calibrated(loaded, rig, paths, output, overwrite=overwrite, as_json=as_json)
    except AolinkError as error:
        # A person has covered and lit the camera for these recordings.
        if not files and (made := sorted(map(str, folder.glob("*.mcap")))):
            raise type(error)(f"{error}; `aolink calibrate` takes what was recorded: {' '.join(made)}") from None
        raise
    if not as_json:
        stdout.print(f"written: {output}{'' if files else f'; the recordings are in {folder}'}", markup=False)


_MEASURES: dict[str, dict[str, tuple[float, float, float]]] = {
    "frames": {"count": (100, 1, 10**6)},
    "interaction": {"poke": (0.1, 1e-6, 1.0), "repeats": (2, 1, 1000), "hold_s": (0.0, 0.0, 60.0)},
    "row-time": {"blink_hz": (math.nan, 1e-3, 1e6)},
}
"""What can be measured: its options with their defaults, least and largest values."""


def _measured(text: str) -> tuple[str, dict[str, float]]:
    """What --measure asks for, and its options."""
    what, _, options = text.partition(":")
    if what not in _MEASURES:
        raise typer.BadParameter(f"--measure {what} is none of {', '.join(_MEASURES)}")
    given = {name: default for name, (default, _, _) in _MEASURES[what].items()}
    for each in filter(None, options.split(",")):
        name, _, value = each.partition("=")
        if name not in given:
            raise typer.BadParameter(f"--measure {what} has no option {name}: it has {', '.join(given)}")
        try:
            given[name] = float(value)
        except ValueError:
            raise typer.BadParameter(f"--measure {what}: {each} is no number") from None
    for name, number in given.items():
        default, least, most = _MEASURES[what][name]
        if not least <= number <= most or (isinstance(default, int) and number % 1):
            kind = "a whole number" if isinstance(default, int) else "a number"
            raise typer.BadParameter(f"--measure {what}: give {name} {kind} from {least:g} to {most:g}")
    return what, given


def _write_calibrated(
    loaded: "Rig", rig: str, paths: Sequence[Path], output: Path, *, overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables import rigs as tables
    from aolink.jobs.calibrate import calibrate_recordings, rig_text

    result = calibrate_recordings(loaded, rig_text(rig, loaded), paths)
    with writing(output, overwrite=overwrite, sources=paths) as unfinished:
        unfinished.write_text(result.text, newline="")  # with the rig file's own line ends
    if as_json:
        print(json.dumps(tables.calibration_as_json(result)))
        return
    stdout.print(tables.calibration(result))
    for note in result.calibration.notes:
        stdout.print(f"note: {escape(note)}")


def _write_row_time(
    loaded: "Rig", rig: str, film: Path, blink_hz: float, output: Path, *, overwrite: bool, as_json: bool
) -> None:
    from aolink.jobs.calibrate import film_row_time, rig_text, with_row_time

    found = film_row_time(loaded, film, blink_hz)
    text = with_row_time(rig_text(rig, loaded), found, film.name)
    with writing(output, overwrite=overwrite, sources=[film]) as unfinished:
        unfinished.write_text(text, newline="")
    if as_json:
        print(json.dumps(vars(found)))
        return
    stdout.print(
        f"sensor.row_time_s = {found.row_time_s:.6g} +- {found.sd_s:.2g} s, from {found.frames} frames with"
        f" {found.bands:.2g} bands each\nwritten: {output}",
        markup=False,
    )


def _write_interaction(
    loaded: "Rig", paths: Sequence[Path], output: Path, *, hold_s: float, overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    import numpy as np

    from aolink.jobs.calibrate import interaction

    if len(paths) != 1:
        raise typer.BadParameter(f"an interaction matrix is of one recording, not of {len(paths)}")
    found = interaction(loaded, paths[0], hold_s)
    measured = found.measured
    with writing(output, overwrite=overwrite, sources=paths) as unfinished, unfinished.open("wb") as file:
        np.savez(
            file, matrix=measured.matrix, offset=measured.offset, singular_values=measured.singular_values,
            sd=measured.sd, residual_rms=measured.residual_rms, exposures=measured.exposures,
            plant_matrix=found.modelled.matrix,
        )  # fmt: skip
    outputs, inputs = measured.matrix.shape
    if as_json:
        facts = {
            "outputs": outputs, "inputs": inputs, "exposures": measured.exposures,
            "singular_values": measured.singular_values.tolist(), "condition": measured.condition,
            "residual_rms": measured.residual_rms, "difference_from_plant": found.difference,
            "noise": None if np.isnan(found.noise) else found.noise,
        }  # fmt: skip
        print(json.dumps(facts))
        return
    largest, smallest = measured.singular_values[0], measured.singular_values[-1]
    off = ": a sign, the order of the inputs or a scale is wrong" if found.difference > 0.3 + 3 * found.noise else ""
    stdout.print(
        f"{outputs} slopes for {counted(inputs, 'input')} from {measured.exposures} exposures; singular values"
        f" {largest:.4g} to {smallest:.4g}, condition {measured.condition:.3g}; residual {measured.residual_rms:.3g}"
        f" slope units (rms)\nthe rig file's plant is off by {100 * found.difference:.3g} % of the matrix, noise"
        f" explains {100 * found.noise:.3g} %{off}"
    )
