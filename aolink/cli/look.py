"""Commands that show what a camera saw: view, slopes."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aolink.cli import common
from aolink.cli.common import JsonOption, LensletOption, OverwriteOption, app, open_recording, progress, stdout
from aolink.errors import FrameError, ViewerError
from aolink.files import check_target

if TYPE_CHECKING:
    from aolink.recording.reader import Recording


@app.command(epilog="Example: aolink view session.mcap  |  aolink view session.mcap --frame 7 -o one.rrd")
def view(
    recorded: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording, or a Rerun file (.rrd) that -o has written.")
    ],
    side: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[SIDE...]", help="Its side files: their estimates instead of its own."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="X.rrd", help="Write a Rerun file instead of opening it."),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the web viewer on this machine (127.0.0.1) until Ctrl-C.")
    ] = False,
    frame: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Show one exposure alone, counted from 0.")
    ] = None,
    lenslet: LensletOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Open a recording in Rerun, or a Rerun file that was saved from one.

    For five exposures or fewer, paths are shown at every fast step; for more, at 32 places of each exposure.
    """
    from aolink import viewing

    choices = (frame, lenslet)
    sides = side or []
    if output is not None:
        check_target(output, overwrite=overwrite, sources=[recorded, *sides], suffix=".rrd")
    recording = None if recorded.suffix == ".rrd" else open_recording(recorded, side=sides)
    if recording is None and (output is not None or side or any(each is not None for each in choices)):
        raise typer.BadParameter(f"{recorded} is a Rerun file: -o X.rrd, side files and choices need a recording")
    if not (web or output):
        viewing.check_display()
    if recording is None:
        if web:
            viewing.serve_web(recorded, on_ready=_address)
        else:
            viewing.open_viewer(recorded)
        return
    exposures = None if frame is None else _number(recording, frame)
    spot = common.spot_of(recording.rig.sensor, lenslet) if lenslet else 0
    look = viewing.Look(exposures=exposures, spot=spot)
    total = len(exposures) if exposures is not None else recording.n_frames
    with progress("read", total) as tell:
        if output is not None:
            viewing.save_rrd(recording, output, look=look, overwrite=overwrite, progress=tell)
            stdout.print(f"written: {output}", markup=False)
        if web:
            viewing.serve(recording, look, on_ready=_address, progress=tell)
        elif output is None:
            viewing.show(recording, look, progress=tell)


def _targets(output: list[Path] | None) -> tuple[Path | None, Path | None]:
    """What is to be written: the results, and a Rerun file."""
    others = [each for each in output or () if each.suffix.lower() == ".rrd"]
    usual = [each for each in output or () if each not in others]
    if len(usual) > 1 or len(others) > 1:
        raise typer.BadParameter(f"one file of a kind can be written: {', '.join(map(str, output or ()))}")
    return next(iter(usual), None), next(iter(others), None)


def _address(address: str) -> None:
    stdout.print(f"{address}\nCtrl-C stops it.")


def _number(recording: "Recording", exposure: int) -> range:
    """The exposure with that number. Raises ViewerError where there is none."""
    if exposure >= (count := recording.n_frames):
        there = f"has {count}, counted from 0" if count else "holds none"
        raise ViewerError(f"there is no exposure {exposure}: {recording.path} {there}")
    return range(exposure, exposure + 1)


_WIDEST_M, _LONGEST_M = 0.1, 10.0
"""Pitch and focal length of no lenslet."""


@app.command(epilog="Example: aolink slopes frame.fits --reference flat.fits --pitch-m 600e-6 --focal-m 0.04 -o s.npz")
def slopes(
    frame: Annotated[
        Path,
        typer.Argument(metavar="FRAME", help="A Shack-Hartmann frame: .fits, .fits.gz or .npy."),
    ],
    reference: Annotated[Path, typer.Option(metavar="FILE", help="A frame of the same camera with a flat wavefront.")],
    written: Annotated[
        list[Path] | None,
        typer.Option("--output", "-o", metavar="X.npz|X.rrd", help="Write all results, or what Rerun shows; or both."),
    ] = None,
    bad: Annotated[
        Path | None, typer.Option("--bad", metavar="FILE", help="A picture that is not zero where pixels are bad.")
    ] = None,
    pitch_m: Annotated[
        float | None, typer.Option(min=1e-9, metavar="M", help="Distance between neighbouring lenslets, m.")
    ] = None,
    focal_m: Annotated[float | None, typer.Option(min=1e-9, metavar="M", help="Focal length of a lenslet, m.")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure slopes, wavefront and Zernike modes of a Shack-Hartmann frame against its reference.

    The lenslet grid is found in the frames: square or hexagonal, turned by any angle, with spots missing.
    Without --pitch-m and --focal-m slopes are in pixels.
    """
    from aolink.cli.tables import rigs as tables
    from aolink.optics import slopes as job

    if (pitch_m is None) != (focal_m is None):
        raise typer.BadParameter("give --pitch-m and --focal-m, or neither")
    if (pitch_m or 0) > _WIDEST_M or (focal_m or 0) > _LONGEST_M:
        raise typer.BadParameter("--pitch-m and --focal-m are in metres: 600 um are 600e-6, 40 mm are 0.04")
    inputs = [frame, reference]
    output, rrd = _targets(written)
    if output is not None:
        check_target(output, overwrite=overwrite, sources=inputs, suffix=".npz", error=FrameError)
    if rrd is not None:
        check_target(rrd, overwrite=overwrite, sources=inputs, suffix=".rrd", error=ViewerError)
    result = job.measure_files(frame, reference, pitch_m=pitch_m, focal_m=focal_m, bad=bad)
    if output is not None:
        job.save(result, output, overwrite=overwrite)
    if rrd is not None:
        from aolink.viewing.slopes import save_slopes

        save_slopes(result, rrd, overwrite=overwrite)
    if as_json:
        print(json.dumps(tables.slopes_as_json(result)))
    else:
        stdout.print(tables.slopes(result))
