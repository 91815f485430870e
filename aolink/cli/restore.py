"""Commands that take blur out of pictures: deblur."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from aolink.cli.common import JsonOption, OverwriteOption, app, stdout
from aolink.errors import RestorationError


@app.command(epilog="Example: aolink deblur --image moved.png --psf psf.csv -o sharp.png")
def deblur(
    image: Annotated[
        Path, typer.Option("--image", metavar="IN.png", help="A blurred picture: .png, .tif, .jpg, .npy.")
    ],
    psf: Annotated[
        Path,
        typer.Option(
            "--psf",
            metavar="PSF.csv",
            help="Its PSF: .npy, or rows of numbers; one row of n taps lies along the picture's rows. Tap n // 2"
            " is where the scene stays in place.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT.png", help="File to write, of the same type.")],
    method: Annotated[
        str,
        typer.Option(help="tv, gauss_markov, pnp (slow); on lines: smoother, lag, filter, predictor, inverse."),
    ] = "tv",
    noise_sd: Annotated[
        float | None, typer.Option(help="Of the picture's noise, in its own counts; found in it if not given.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Take a known motion's blur out of a picture."""
    from aolink.pictures import read_picture, read_psf, write_picture
    from aolink.restoration import restore

    if out.exists() and not overwrite:
        raise RestorationError(f"{out} exists: give --overwrite to replace it")
    restored = restore(read_picture(image), read_psf(psf), method=method, noise_sd=noise_sd)  # type: ignore[arg-type]
    write_picture(out, restored.image)
    if as_json:
        found = None if math.isnan(restored.noise_sd) else restored.noise_sd
        print(json.dumps({"out": str(out), "method": method, "noise_sd": found, "direction": restored.direction}))
    else:
        noise = "" if math.isnan(restored.noise_sd) else f", noise sd {restored.noise_sd:.3g}"
        stdout.print(f"{out}: {method}{noise}", markup=False)
