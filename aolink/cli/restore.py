"""Commands that take blur out of pictures: deblur."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aolink.cli import common
from aolink.cli.common import OverwriteOption, app, as_seconds, check_measured, open_recording, stdout
from aolink.errors import RestorationError
from aolink.files import check_target

if TYPE_CHECKING:
    from aolink.restoration.films import PathClock


@app.command(
    epilog="Example: aolink deblur session.mcap -e moments -o sharp.mcap"
    "  |  aolink deblur moved.png --psf psf.csv -o sharp.png",
)
def deblur(
    out: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help="The recording to write, or the picture."),
    ],
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE",
            help="A recording, all of whose exposures are restored; or with --psf or --path a blurred picture, or a"
            " stack of them, of any kind that `aolink import` reads. Pixels that are not numbers, or saturated, are"
            " left out.",
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            "--estimator",
            "-e",
            metavar="NAME",
            help="The estimator whose path is used, by default moments; it is run if it was not.",
        ),
    ] = None,
    psf: Annotated[
        Path | None,
        typer.Option(
            "--psf",
            metavar="PSF.csv",
            help="The picture's PSF: a picture, .npy, or rows of numbers; one row of n taps lies along the picture's"
            " rows, one column along its columns. Tap n // 2 is where the scene stays in place.",
        ),
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG.csv",
            help="Instead of a PSF, the motion as something else measured it (a gyro, an encoder): rows of time (s), x"
            " and y (pixels along columns and rows).",
        ),
    ] = None,
    offset: Annotated[
        float,
        typer.Option(
            metavar="S", parser=as_seconds, help="Seconds by which the log's clock is behind that of the pictures."
        ),
    ] = 0.0,
    exposure: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            parser=as_seconds,
            help="With --path: exposure time of the pictures, where their file lacks it.",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="tv keeps edges; pnp is the best, and slow; gauss_markov is for smooth scenes; smoother, lag, inverse,"
            " filter and predictor are for motion along lines; or another package's.",
        ),
    ] = "tv",
    noise_sd: Annotated[
        float | None,
        typer.Option(
            metavar="COUNTS", help="With --psf or --path: noise of the picture, in its counts; without it, estimated."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Remove the motion blur from every picture of a recording, or from a single picture with a known PSF."""
    from aolink.estimation.registry import DEFAULT_ESTIMATOR
    from aolink.restoration.films import PathClock

    blur = psf or path
    if file is None or (psf and path) or (noise_sd and not blur):
        raise typer.BadParameter("give a recording alone, or a picture with --psf or --path (--noise-sd is for these)")
    if blur is None:
        _deblur_recording(file, out, estimator or DEFAULT_ESTIMATOR, method, overwrite=overwrite)
    else:
        clock = PathClock(offset, exposure) if psf is None else None
        _deblur_pictures(file, blur, clock, out, method, noise_sd, overwrite=overwrite)


def _deblur_recording(file: Path, out: Path, estimator: str, method: str, *, overwrite: bool) -> None:
    from aolink.cli.tables import sessions as tables
    from aolink.recording.deblur import write_deblurred

    recording = open_recording(file)
    with common.progress("deblur", recording.n_frames) as tell:
        summary = write_deblurred(
            recording, out, estimator=estimator, method=method, overwrite=overwrite,
            workers=os.cpu_count() or 1, progress=tell,
        )  # fmt: skip
    for line in tables.deblurred_lines(summary, estimator, method):
        stdout.print(line, markup=False)
    stdout.print(f"written: {out}", markup=False)
    check_measured(file, {estimator: summary.motion.result()})


def _deblur_pictures(
    image: Path, blur: Path, clock: "PathClock | None", out: Path, method: str, noise_sd: float | None, *,
    overwrite: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables.sessions import adds_error
    from aolink.films.pictures import read_film
    from aolink.restoration import find_method
    from aolink.restoration.films import path_psfs, restored_film, write_pictures
    from aolink.restoration.texts import read_psf

    check_target(out, overwrite=overwrite, sources=[image, blur], error=RestorationError)
    film = read_film(image, RestorationError)
    notes: tuple[str, ...] = ()
    if clock is None:
        psf, notes = read_psf(blur)
        psfs: Sequence[Any] = [psf] * film.count
    else:
        psfs = path_psfs(blur, clock, film)
    done = restored_film(film, psfs, method, noise_sd)
    write_pictures(out, done.pictures, film, overwrite=overwrite, sources=[image, blur])
    last = done.last
    noise = "" if math.isnan(last.noise_sd) else f", noise sd {last.noise_sd:.3g}"
    scanned = f", scanned {last.direction}s" if "direction" in find_method(method).parameters else ""
    filled = f", {done.missing} pixels that are not numbers filled in" if done.missing else ""
    filled += f", {done.saturated} saturated pixels left out" if done.saturated else ""
    several = f", {len(done.pictures)} pictures" if len(done.pictures) > 1 else ""
    stdout.print(f"{out}: {method}{several}{noise}{scanned}{filled}", markup=False)
    for note in notes:
        stdout.print(f"warning: {note}", markup=False)
    for line in adds_error(method, last.expected_gain_db):
        stdout.print(line, markup=False)
