"""The command that draws recordings on a page or on paper: report."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aolink.cli import common
from aolink.cli.common import EstimatorOption, LensletOption, OverwriteOption, app, open_recording, progress, stdout
from aolink.errors import ExportError, RecordingError
from aolink.files import check_target

if TYPE_CHECKING:
    from aolink.recording.reader import Recording


Figure = StrEnum("Figure", ["BLUR", "EXPOSURE", "NIS", "ERRORS", "LOSSES", "LATENCY", "PUPIL", "SCENE"])
"""The figures that can be drawn alone: those of `aolink.plotting.FIGURES`."""


@app.command(
    epilog="Example: aolink report session.mcap -o report.html"
    "  |  aolink report session.mcap results/session.o3.mcap -o report.html"
    "  |  aolink report session.mcap --figure exposure -o exposure.pdf --width-mm 88"
)
def report(
    context: typer.Context,
    files: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="Recordings, folders of them, and their side files.")
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="The page to write, X.html; of a figure X.png|svg|pdf."),
    ],
    figure: Annotated[Figure | None, typer.Option(help="Draw this figure alone, in a paper's size.")] = None,
    estimator: EstimatorOption = None,
    frame: Annotated[
        int | None,
        typer.Option(
            min=0, metavar="N", help="Exposure to draw, counted from 0; by default the one with the largest blur."
        ),
    ] = None,
    lenslet: LensletOption = None,
    width_mm: Annotated[
        float, typer.Option(min=30, max=1000, metavar="MM", help="Width on paper; 88 fits a column.")
    ] = 180.0,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a page about a session: how good the estimates are, the most telling exposures, what was lost.

    One file of HTML with everything in it. Two or three recordings stand side by side; for more there is a table. With
    --figure, one figure. blur: the camera's blur over the session, and the paths. exposure: one exposure's path over
    its blur, the path's histogram and the intensity profile. nis, errors, losses, latency: along the session. pupil:
    maps over the lenslets. scene: a picture as it came, restored, and at rest.
    """
    from aolink.plotting.report import write_report

    if figure is not None:
        _draw(files, output, figure, estimator, frame, lenslet, width_mm=width_mm, overwrite=overwrite)
        return
    for name in ("estimator", "frame", "lenslet", "width_mm"):
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise typer.BadParameter(f"--{name.replace('_', '-')} goes with --figure NAME")
    check_target(output, overwrite=overwrite, suffix=".html", error=ExportError)
    recordings = _with_sides(_in_folders(files))
    with progress("read", None) as tell:
        write_report(
            recordings, output, overwrite=overwrite,
            progress=lambda name, done: tell(done, name),
        )  # fmt: skip
    stdout.print(f"written: {output}", markup=False)


def _draw(
    files: list[str], output: Path, figure: Figure, estimators: list[str] | None, exposure: int | None,
    lenslet: str | None, *, width_mm: float, overwrite: bool,
) -> None:  # fmt: skip
    """Draw one figure of a recording, of its side files' estimates where some are given."""
    from aolink.plotting.files import FORMATS, save_figure

    if output.suffix.lower() not in FORMATS:
        raise ExportError(f"cannot write {output}: a figure is a {', '.join(FORMATS)} file; give such a name")
    recordings = _with_sides(_in_folders(files))
    if len(recordings) != 1:
        raise typer.BadParameter(f"--figure draws one recording, {len(recordings)} are given")
    (recording,) = recordings
    check_target(output, overwrite=overwrite, sources=recording.files, error=ExportError)
    spot = common.spot_of(recording.rig.sensor, lenslet) if lenslet else 0
    with progress("read", recording.n_frames) as tell:
        save_figure(
            recording, figure.value, output, estimators=estimators, exposure=exposure,
            output=2 * spot, spot=spot, width_mm=width_mm, overwrite=overwrite,
            progress=tell,
        )  # fmt: skip
    stdout.print(f"written: {output}", markup=False)


def _with_sides(files: list[str]) -> "list[Recording]":
    """The recordings, each with its side files among the others. Raises RecordingError for a side file of none of these
    recordings."""
    from aolink.recording.side_files import check_stands_alone

    opened = [open_recording(each) for each in files]
    alone, sides = [e for e in opened if not e.side_of], [e for e in opened if e.side_of]
    if not sides:
        return alone
    digests = {each.digest for each in alone}
    for each in sides:
        if each.side_of not in digests:
            check_stands_alone(each)
    beside = {each.digest: [side.path for side in sides if side.side_of == each.digest] for each in alone}
    return [open_recording(e.path, side=beside[e.digest]) if beside[e.digest] else e for e in alone]


def _in_folders(files: list[str]) -> list[str]:
    """Files as they are; for a folder, its recordings by name."""
    found: list[str] = []
    for each in files:
        if Path(each).is_dir():
            inside = sorted(str(path) for path in Path(each).glob("*.mcap"))
            if not inside:
                raise RecordingError(f"the folder {each} holds no recording (*.mcap)")
            found += inside
        else:
            found.append(each)
    return found
