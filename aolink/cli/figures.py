"""The command that draws recordings on a page or on paper: report."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from aolink.cli import common
from aolink.cli.common import EstimatorOption, LensletOption, OverwriteOption, app, open_recording, progress, stdout

Figure = StrEnum("Figure", ["EXPOSURE", "PUPIL", "SCENE"])
"""The figures that can be drawn alone: those of `aolink.plotting.FIGURES`."""


@app.command(
    epilog="Example: aolink report session.mcap -o report.html"
    "  |  aolink report session.mcap --figure exposure -o exposure.pdf --width-mm 88"
)
def report(
    context: typer.Context,
    recorded: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="The page to write, X.html; of a figure X.png|svg|pdf."),
    ],
    side: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[SIDE...]", help="Its side files: their estimates instead of its own."),
    ] = None,
    figure: Annotated[Figure | None, typer.Option(help="Draw this figure alone, in a paper's size.")] = None,
    estimator: EstimatorOption = None,
    frame: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="Exposure to draw, counted from 0; by default the most blurred."),
    ] = None,
    lenslet: LensletOption = None,
    witness: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG.csv",
            help="What another instrument saw, as time_s, x [um] or gyro [rad/s] ...: it serves as the truth.",
        ),
    ] = None,
    width_mm: Annotated[
        float, typer.Option(min=30, max=1000, metavar="MM", help="Width on paper; 88 fits a column.")
    ] = 180.0,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a page about a session: how good the estimates are, the most blurred exposure, what was lost.

    One file of HTML with everything in it. With --figure, one figure. exposure: one exposure's path over its blur, the
    path's histogram and the intensity profile. pupil: maps over the lenslets. scene: a picture as it came, restored,
    and at rest.
    """
    from aolink.jobs.witness import align, read_log
    from aolink.plotting.files import save_figure
    from aolink.plotting.report import write_report

    for name in ("estimator", "frame", "lenslet", "width_mm") if figure is None else ():
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise typer.BadParameter(f"--{name.replace('_', '-')} goes with --figure NAME")
    if figure is not None and witness is not None:
        raise typer.BadParameter("--witness goes without --figure")
    recording = open_recording(recorded, side=side or [])
    spot = common.spot_of(recording.rig.sensor, lenslet) if lenslet else 0
    with progress("read", recording.n_frames) as tell:
        aligned = None if witness is None else align(recording, read_log(witness))
        if figure is None:
            write_report(recording, output, witness=aligned, overwrite=overwrite, progress=tell)
        else:
            save_figure(
                recording, figure.value, output, estimators=estimator, exposure=frame, spot=spot, width_mm=width_mm,
                overwrite=overwrite, progress=tell,
            )  # fmt: skip
    if aligned is not None:
        stdout.print(aligned.text, markup=False)
    stdout.print(f"written: {output}", markup=False)
