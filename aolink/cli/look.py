"""Commands that show what a camera saw: view, slopes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from aolink.cli.common import JsonOption, OverwriteOption, app, open_recording, progress, stdout
from aolink.errors import FrameError, ViewerError
from aolink.files import check_target


@app.command(epilog="Example: aolink view session.mcap --screenshot session.png")
def view(
    recorded: Annotated[
        str, typer.Argument(metavar="FILE", help="A recording, or a Rerun file (.rrd) that --save has written.")
    ],
    side: Annotated[
        list[str] | None,
        typer.Argument(metavar="[SIDE...]", help="Its side files: their estimates instead of its own."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="X.rrd", help="Write a Rerun file instead of opening the viewer.")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="X.png", help="Write a picture of the viewer; needs no screen.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the web viewer on this machine (127.0.0.1) until Ctrl-C.")
    ] = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Open a recording in Rerun, or a Rerun file that was saved from one."""
    import tempfile

    from aolink import viewing
    from aolink.recording.remote import location, only_paths

    file, *sides = map(location, [recorded, *(side or ())])
    for target, suffix in ((save, ".rrd"), (screenshot, ".png")):
        if target is not None:
            check_target(target, overwrite=overwrite, sources=only_paths([file, *sides]), suffix=suffix)
    recording = None if file.suffix == ".rrd" else open_recording(file, side=sides)
    if recording is None and (save is not None or side):
        raise typer.BadParameter(f"{file} is a Rerun file already: --save and side files are for a recording")
    if not (web or save or screenshot):
        viewing.check_display()  # before the recording is read, which may take minutes
    with tempfile.TemporaryDirectory(prefix="aolink-") as folder:
        rrd = Path(recorded)
        if recording is not None:
            rrd = save or Path(folder) / f"{file.stem}.rrd"
            with progress("write .rrd", len(recording.estimators) + 2) as tell:
                viewing.save_rrd(recording, rrd, overwrite=overwrite, progress=tell)
        if save is not None:
            stdout.print(f"written: {save}", markup=False)
        if screenshot is not None:
            viewing.screenshot(rrd, screenshot)
            stdout.print(f"written: {screenshot}", markup=False)
        if web:
            viewing.serve_web(rrd, on_ready=lambda address: stdout.print(f"{address}\nCtrl-C stops it."))
        elif save is None and screenshot is None:
            viewing.open_viewer(rrd)


@app.command(epilog="Example: aolink slopes frame.fits --reference flat.fits --pitch-m 600e-6 --focal-m 0.04 -o s.npz")
def slopes(
    frame: Annotated[Path, typer.Argument(metavar="FRAME", help="A Shack-Hartmann frame: .fits, .fits.gz or .npy.")],
    reference: Annotated[Path, typer.Option(metavar="FILE", help="A frame of the same camera with a flat wavefront.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.npz", help="Write all results.")
    ] = None,
    rrd: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Write the results for Rerun.")] = None,
    pitch_m: Annotated[float | None, typer.Option(min=1e-9, help="Distance between neighbouring lenslets, m.")] = None,
    focal_m: Annotated[float | None, typer.Option(min=1e-9, help="Focal length of a lenslet, m.")] = None,
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
    inputs = [frame, reference]
    if output is not None:
        check_target(output, overwrite=overwrite, sources=inputs, suffix=".npz", error=FrameError)
    if rrd is not None:
        check_target(rrd, overwrite=overwrite, sources=inputs, suffix=".rrd", error=ViewerError)
    result = job.measure_files(frame, reference, pitch_m=pitch_m, focal_m=focal_m)
    if output is not None:
        job.save(result, output, overwrite=overwrite)
    if rrd is not None:
        from aolink.viewing.slopes import save_slopes

        save_slopes(result, rrd, overwrite=overwrite)
    if as_json:
        print(json.dumps(tables.slopes_as_json(result)))
    else:
        stdout.print(tables.slopes(result))
