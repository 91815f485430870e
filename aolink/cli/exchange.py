"""Commands that exchange recordings with other programs: export."""

from pathlib import Path
from typing import Annotated

import typer

from aolink.cli.common import FileArgument, OverwriteOption, app, open_recording, progress, stdout


@app.command(epilog="Example: aolink export session.mcap -o session.parquet -e moments")
def export(
    file: FileArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="What to write: .npz, .csv, .parquet, .nc (NetCDF) or .fits (AOT)."
        ),
    ],
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator",
            "-e",
            metavar="NAME",
            help="Estimators whose estimates are written; may be given several times; all by default.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write exposures, inputs, estimates and truth of a recording in formats that other programs read.

    NumPy, NetCDF and AOT telemetry hold the frames and the paths; a table has a row for each exposure and axis.
    """
    from aolink.exporting.files import export as export_series
    from aolink.recording.side_files import check_stands_alone

    recording = open_recording(file)
    check_stands_alone(recording)
    with progress("export", recording.n_frames) as tell:
        export_series(recording, output, estimator, overwrite=overwrite, progress=tell)
    stdout.print(f"written: {output}", markup=False)
