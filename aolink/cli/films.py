"""Commands that bring other people's data in: import, and the film options that `aolink rig --from` shares."""

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from aolink.cli.common import JsonOption, OutputOption, OverwriteOption, app, local_file, progress, stdout
from aolink.errors import ImportingError

if TYPE_CHECKING:
    from aolink.importing.frames import FilmSettings

RateOption = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="Frames a second, where the film does not state them.")
]
SumOption = Annotated[
    int, typer.Option("--sum", metavar="K", min=1, help="Make one exposure of K frames: the mean of their light.")
]
TrackOption = Annotated[
    int,
    typer.Option(
        "--track", metavar="N", min=0, help="Follow N objects, each in a window of its own: the brightest, or --at."
    ),
]
AtOption = Annotated[
    list[str] | None,
    typer.Option("--at", metavar="X,Y", help="Where an object to follow is in the first frame, pixels; repeatable."),
]
InvertOption = Annotated[
    bool, typer.Option("--invert", help="Dark objects on a bright ground: light is how far a pixel is below it.")
]
GammaOption = Annotated[
    float, typer.Option("--gamma", min=0.1, max=10.0, help="Undo a gamma curve; most JPEG and video have 2.2.")
]
TopicOption = Annotated[
    str | None,
    typer.Option(
        "--topic",
        help="Channel of an MCAP file or a bag that has several with pictures; wavefront sensor of AO telemetry.",
    ),
]

ColourOption = Annotated[
    str | None,
    typer.Option(
        "--colour",
        metavar="red|green|blue|all",
        help="One colour of pictures in colour or under a Bayer mosaic; all: the mean of a mosaic's colours.",
    ),
]

_DARK = 0.01
"""Share of the pixels below zero that is worth a word."""


def film_settings(
    rate: float | None, frames: int, track: int, at: list[str] | None, invert: bool, gamma: float, **more: object
) -> "FilmSettings":
    """The options of a command as settings. Raises ImportingError for an invalid place."""
    from aolink.importing.frames import FilmSettings

    if rate is not None and not 0 < rate < math.inf:
        raise ImportingError(f"--rate {rate:g} must be above 0{' and finite' if rate > 0 else ''}")
    places = []
    for text in at or []:
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            x = y = math.nan
        if not math.isfinite(x + y):
            raise ImportingError(f"--at {text} is no place: give X,Y in pixels, such as --at 12.5,40")
        places.append((x, y))
    return FilmSettings(
        rate_hz=rate, frames_per_exposure=frames, track=track or len(places), places=tuple(places), invert=invert,
        gamma=gamma, **more,  # type: ignore[arg-type] # fields of FilmSettings
    )  # fmt: skip


@app.command(
    "import",
    epilog="Example: aolink import film.tif -o film.mcap --rig my.toml --rate 500"
    "  |  aolink import film.npz -o film.mcap --rig spheres.toml --rate 24 --invert --track 6 --sum 8",
)
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            parser=local_file,
            help="A film: .npy, .npz, HDF5, SER, TIFF, FITS, video, MCAP, ROS bag, AOT telemetry, or a folder of"
            " pictures or stacks.",
        ),
    ],
    output: OutputOption,
    rig: Annotated[str, typer.Option(metavar="RIG.toml", help="What camera and plant the film shows.")],
    rate: RateOption = None,
    exposure: Annotated[
        float | None, typer.Option(metavar="S", help="Exposure time of a frame, s, where the film lacks it.")
    ] = None,
    row_time: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="Time from the start of a row's exposure to the next row's, s; 0: all at once (global)."
        ),
    ] = None,
    start: Annotated[
        str | None, typer.Option(metavar="DATE", help="Start of the film, such as 2026-11-22T09:30, in UTC.")
    ] = None,
    frames: SumOption = 1,
    track: TrackOption = 0,
    at: AtOption = None,
    invert: InvertOption = False,
    background: Annotated[
        bool, typer.Option("--background", help="Subtract each frame's median, which is background.")
    ] = False,
    gamma: GammaOption = 1.0,
    scale: Annotated[
        float | None,
        typer.Option(
            metavar="COUNTS",
            help="Counts for a pixel value of one. Without it 8 bits, or floats up to 1.0, are the full range of the"
            " camera and 16 bits are counts; floats above 1.0 need it. For slopes: slope units for one of the file's"
            " units.",
        ),
    ] = None,
    topic: TopicOption = None,
    colour: ColourOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make a recording of a film: then estimate, replay, compare, deblur and view it like any other."""
    from aolink.films.film import one_colour
    from aolink.films.formats import open_film
    from aolink.importing.recording import import_film
    from aolink.rig import load_rig

    start_ns = None
    if start is not None:
        try:
            moment = datetime.fromisoformat(start)
        except ValueError:
            raise ImportingError(f"--start {start} is no date: give one such as 2026-11-22T09:30:00") from None
        start_ns = round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000
    if exposure is not None and not 0 < exposure < math.inf:
        raise ImportingError(f"--exposure {exposure:g} must be above 0{' and finite' if exposure > 0 else ''}")
    if scale is not None and not 0 < abs(scale) < math.inf:
        raise ImportingError(f"--scale {scale:g} must be a finite number other than 0")
    settings = film_settings(
        rate, frames, track, at, invert, gamma, exposure_s=exposure, start_ns=start_ns,
        subtract_median=background, scale=scale, row_time_s=row_time,
    )  # fmt: skip
    loaded = load_rig(rig)
    film = open_film(source, topic)
    if colour is not None:
        if colour not in ("red", "green", "blue", "all"):
            raise ImportingError(f"--colour {colour} is no colour: give red, green, blue or all")
        film = one_colour(film, colour)
    with progress("import", film.count // frames) as tell:
        account = import_film(
            film, loaded, settings, output, overwrite=overwrite, sources=[source, Path(rig)],
            progress=tell,
        )  # fmt: skip
    if as_json:
        print(json.dumps({"out": str(output), **vars(account)}))
        return
    for note in account.notes:
        stdout.print(f"note: {note}", markup=False)
    for count, what in (
        (account.saturated, "saturated in the film, hot or dead, no numbers, or shared by two objects"),
        (account.clipped, "beyond the range of the rig's camera"),
    ):
        if count:
            share = count / account.pixels
            subject, they = ("pixel", "it is") if count == 1 else ("pixels", "they are")
            verb = "is" if count == 1 else "are"
            stdout.print(f"warning: {count} {subject} ({share:.2%}) {verb} {what}: {they} masked", markup=False)
    if account.below > account.pixels * _DARK:
        stdout.print(
            f"warning: {account.below / account.pixels:.0%} of the pixels are below zero, as in a film from which the"
            " dark level was subtracted: --background puts the ground at the rig's black level",
            markup=False,
        )
    missing = f", {account.missing} frames are missing" if account.missing else ""
    stdout.print(f"{output}: {account.exposures} exposures of {account.frames} frames{missing}", markup=False)
