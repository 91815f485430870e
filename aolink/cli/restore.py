"""Commands that take blur out of pictures: deblur."""

import json
import math
import os
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperOption

from aolink.cli import common
from aolink.cli.common import JsonOption, OverwriteOption, app, check_measured, local_file, open_recording, stdout
from aolink.errors import RestorationError
from aolink.files import check_target


class _NamingMethods(TyperCommand):
    """An option whose help names all methods: installed packages are searched for them when the help is shown."""

    def format_help(self, *arguments: Any, **named: Any) -> None:
        from aolink.restoration import METHODS, find_method
        from aolink.restoration.registry import DEFAULT_METHOD

        def described(name: str) -> str:
            try:
                return f"{name} ({find_method(name).summary})"
            except RestorationError as error:
                return f"{name} ({error})"

        for each in self.params:
            if isinstance(each, TyperOption) and each.name == "method":
                each.help, each.default = f"{'; '.join(map(described, METHODS))}.", DEFAULT_METHOD
        super().format_help(*arguments, **named)


@app.command(
    cls=_NamingMethods,
    epilog="Example: aolink deblur session.mcap -e moments -o sharp.mcap"
    "  |  aolink deblur --image moved.png --psf psf.csv -o sharp.png",
)
def deblur(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="File to write: a recording, or a picture of its type.")
    ],
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A recording, all of whose exposures are restored.", parser=local_file),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            "--estimator", "-e", help="The estimator whose path is used, by default moments; it is run if it was not."
        ),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option(
            "--image",
            metavar="IN.png",
            help="A blurred picture: .png, .tif, .jpg, .npy. Pixels that are not numbers are filled in.",
        ),
    ] = None,
    psf: Annotated[
        Path | None,
        typer.Option(
            "--psf",
            metavar="PSF.csv",
            help="Its PSF: .npy, or rows of numbers; one row of n taps lies along the picture's rows. Tap n // 2"
            " is where the scene stays in place.",
        ),
    ] = None,
    method: Annotated[str | None, typer.Option(help="The restoration method.")] = None,
    noise_sd: Annotated[
        float | None, typer.Option(help="Noise of --image, in its own counts; estimated from it by default.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Remove the motion blur from every picture of a recording, or from a single picture with a known PSF."""
    from aolink.estimation.registry import DEFAULT_ESTIMATOR
    from aolink.restoration.registry import DEFAULT_METHOD

    method = method or DEFAULT_METHOD
    if file is not None and not (image or psf or noise_sd):
        _deblur_recording(file, out, estimator or DEFAULT_ESTIMATOR, method, overwrite=overwrite, as_json=as_json)
    elif file is None and image is not None and psf is not None:
        _deblur_picture(image, psf, out, method, noise_sd, overwrite=overwrite, as_json=as_json)
    else:
        raise typer.BadParameter("give a recording alone, or --image and --psf (and --noise-sd with these)")


def _deblur_recording(
    file: Path, out: Path, estimator: str, method: str, *, overwrite: bool, as_json: bool,
) -> None:  # fmt: skip
    from aolink.cli.tables import sessions as tables
    from aolink.recording.deblur import write_deblurred

    recording = open_recording(file)
    with common.progress("deblur", recording.n_frames) as tell:
        summary = write_deblurred(
            recording, out, estimator=estimator, method=method, overwrite=overwrite,
            workers=os.cpu_count() or 1, progress=tell,
        )  # fmt: skip
    if as_json:
        print(json.dumps({"out": str(out), "estimator": estimator, "method": method, **tables.deblurred(summary)}))
    else:
        for line in tables.deblurred_lines(summary, estimator, method):
            stdout.print(line, markup=False)
        stdout.print(f"written: {out}", markup=False)
    check_measured(file, {estimator: summary.motion.result()})


def _deblur_picture(
    image: Path, psf: Path, out: Path, method: str, noise_sd: float | None, *, overwrite: bool, as_json: bool
) -> None:
    import numpy as np

    from aolink.cli.tables.sessions import adds_error
    from aolink.optics.pictures import finite_pixels, read_picture, read_psf, write_picture
    from aolink.restoration import find_method, restore

    check_target(out, overwrite=overwrite, sources=[image, psf], error=RestorationError)
    whole = read_picture(image)
    # Transparency is not light: it stays as it is.
    picture = whole[..., :3] if whole.ndim == 3 and whole.shape[2] == 4 else whole
    seen = finite_pixels(picture)
    missing = 0 if seen is None else int((~seen).sum())
    restored = restore(picture, read_psf(psf), method=method, noise_sd=noise_sd, mask=seen)
    made = restored.image if picture is whole else np.dstack([restored.image, whole[..., 3]])
    write_picture(out, made, overwrite=overwrite, sources=[image, psf])
    if as_json:
        found = None if math.isnan(restored.noise_sd) else restored.noise_sd
        gain = None if math.isnan(restored.expected_gain_db) else restored.expected_gain_db
        facts = {"method": method, "noise_sd": found, "direction": restored.direction, "pixels_filled": missing}
        facts["expected_gain_db"] = gain
        print(json.dumps({"out": str(out), **facts}))
    else:
        noise = "" if math.isnan(restored.noise_sd) else f", noise sd {restored.noise_sd:.3g}"
        scanned = f", scanned {restored.direction}s" if "direction" in find_method(method).parameters else ""
        filled = f", {missing} pixels that are not numbers filled in" if missing else ""
        stdout.print(f"{out}: {method}{noise}{scanned}{filled}", markup=False)
        for line in adds_error(method, restored.expected_gain_db):
            stdout.print(line, markup=False)
