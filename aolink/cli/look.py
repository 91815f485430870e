"""The command that shows a recording: view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aolink.cli.common import FileArgument, OverwriteOption, app, open_recording, stdout
from aolink.errors import AolinkError


@app.command(epilog="Example: aolink view session.mcap --screenshot session.png")
def view(
    file: FileArgument,
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
    """Look at a recording in Rerun."""
    import tempfile

    from aolink import viewing

    for target in (save, screenshot):
        if target is not None and target.exists() and not overwrite:
            raise AolinkError(
                f"{target} exists and is not overwritten: give another name, or --overwrite to replace it"
            )
    recording = open_recording(file)
    with tempfile.TemporaryDirectory(prefix="aolink-") as folder:
        rrd = save or Path(folder) / f"{file.stem}.rrd"
        viewing.save_rrd(recording, rrd, overwrite=overwrite)
        if save is not None:
            stdout.print(f"written: {save}", markup=False)
        if screenshot is not None:
            viewing.screenshot(rrd, screenshot)
            stdout.print(f"written: {screenshot}", markup=False)
        if web:
            viewing.serve_web(rrd, on_ready=lambda address: stdout.print(f"{address}\nCtrl-C stops it."))
        elif save is None and screenshot is None:
            viewing.open_viewer(rrd)
