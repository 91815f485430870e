"""Commands that bring other people's data in: import, and the film options that `aolink look` shares."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from aolink.cli.common import OutputOption, OverwriteOption, app, as_rate, as_seconds, progress, stdout
from aolink.errors import ImportingError
from aolink.units import counted, quantity

if TYPE_CHECKING:
    from aolink.films.film import Film
    from aolink.importing.frames import FilmSettings


RateOption = Annotated[
    float | None,
    typer.Option(
        "--rate", metavar="HZ", parser=as_rate, help="Frames a second, also as 30000/1001; it goes before the film's."
    ),
]

ExposureOption = Annotated[
    float | None,
    typer.Option(
        "--exposure", metavar="S", parser=as_seconds, help="Exposure time of a frame, s, also as 1/250 or 4ms."
    ),
]
_FILM = {
    "gamma=2.2": ("gamma", "undo a gamma curve, which most JPEG and video have"),
    "invert": ("invert", "dark objects on a bright ground"),
    "topic=NAME": ("topic", "channel of an MCAP file or a bag, wavefront sensor of AO telemetry"),
    "pixels=signed": ("pixels", "or unsigned, swapped: how whole numbers were meant"),
    "colour=red": ("colour", "or green, blue, all, which is the mean of a mosaic's colours"),
    "row_time=S": (
        "row_time_s", "from the start of a row's exposure to the next row's, 0 for all at once; `look` finds what is"
        " unknown",
    ),
    "sum=8": ("frames_per_exposure", "make one exposure of this many frames, the mean of their light"),
    "background": ("subtract_median", "subtract each frame's median"),
    "scale=COUNTS": (
        "scale", "for a pixel value of one, for slopes slope units; without it 8 bits, or floats up to 1.0, are the"
        " full range of the camera and 16 bits are counts",
    ),
    "start=DATE": ("start_ns", "when the film begins, such as 2026-11-22T09:30, in UTC"),
}  # fmt: skip
"""The options of --film: the field of `FilmSettings` or `FilmFile` where each goes, and its help."""
_TAKEN = {"look": 6, "import": len(_FILM)}
"""How many of them, from the first on, a command takes."""
_COLOURS = ("red", "green", "blue", "all")


def _film_option(command: str) -> Any:
    said = "; ".join(f"{form}: {text}" for form, (_, text) in list(_FILM.items())[: _TAKEN[command]])
    return typer.Option("--film", metavar="NAME[=VALUE],...", help=f"How the file is read. {said}.")


FilmOfLook = Annotated[list[str] | None, _film_option("look")]
FilmOfImport = Annotated[list[str] | None, _film_option("import")]

_DARK = 0.01
"""Share of the pixels below zero that is worth a word."""


class FilmFile(NamedTuple):
    """What --film says."""

    settings: "dict[str, Any]"
    """Fields of `FilmSettings`."""
    topic: str | None
    colour: str | None
    pixels: str | None

    def open(self, source: Path) -> "Film":
        """The whole frames of the film, of one colour where one is asked for."""
        from aolink.films.film import one_colour, other_pixels
        from aolink.films.formats import open_film
        from aolink.films.whole import whole_frames

        film = open_film(source, self.topic)
        film = film if self.pixels is None else other_pixels(film, self.pixels)
        return whole_frames(film if self.colour is None else one_colour(film, self.colour))


def film_file(options: list[str] | None, command: str) -> FilmFile:
    """What the options --film of a command say. Raises ImportingError for what they cannot say."""
    forms = {form.partition("=")[0]: form for form in list(_FILM)[: _TAKEN[command]]}
    found: dict[str, Any] = {"frames_per_exposure": 1}
    for each in (part for text in options or () for part in text.split(",")):
        name, equals, value = each.partition("=")
        if name not in forms:
            raise ImportingError(f"--film {name}: there is no such option, but {', '.join(forms)}")
        if bool(equals) != ("=" in forms[name]):
            raise ImportingError(f"--film {each}: write --film {forms[name]}")
        if each == "row_time=unknown" and command == "import":
            raise ImportingError(f"--film {each} is for `aolink look`: leave it out, or measure the row time")
        found[_FILM[forms[name]][0]] = _value(name, value) if equals else True
    return FilmFile(found, found.pop("topic", None), found.pop("colour", None), found.pop("pixels", None))


def _value(name: str, text: str) -> Any:
    if name == "start":
        return _start_ns(text)
    if name == "colour" and text not in _COLOURS:
        raise ImportingError(f"--film colour={text} is no colour: give {', '.join(_COLOURS[:3])} or {_COLOURS[3]}")
    if name == "pixels" and text not in ("signed", "unsigned", "swapped"):
        raise ImportingError(f"--film pixels={text}: give signed, unsigned or swapped")
    if name in ("topic", "colour", "pixels"):
        return text
    if (name, text) == ("row_time", "unknown"):
        return math.nan
    try:
        value = quantity(text, "s") if name == "row_time" else float(text)
    except ValueError as error:
        if name == "row_time":
            raise ImportingError(f"--film row_time: {error}") from None
        value = math.nan
    if name == "gamma" and not 0.1 <= value <= 10:
        raise ImportingError(f"--film gamma={text}: give a number from 0.1 to 10")
    if name == "sum" and not (value >= 1 and value.is_integer()):
        raise ImportingError(f"--film sum={text}: give a whole number from 1")
    if name == "scale" and not 0 < abs(value) < math.inf:
        raise ImportingError(f"--film scale={text} must be a finite number other than 0")
    if not math.isfinite(value):
        raise ImportingError(f"--film {name}={text} is no number")
    return int(value) if name == "sum" else value


def _start_ns(text: str) -> int:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ImportingError(f"--film start={text} is no date: give one such as 2026-11-22T09:30:00") from None
    return round((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000


def film_settings(
    rate: float | None, exposure: float | None, film: FilmFile, at: list[str] | None = None
) -> "FilmSettings":
    """The options of a command as settings. Raises ImportingError for an invalid place, rate or time."""
    from aolink.importing.frames import FilmSettings

    if exposure is not None and exposure <= 0:
        raise ImportingError(f"--exposure {exposure:g} must be above 0")
    if rate is not None and rate <= 0:
        raise ImportingError(f"--rate {rate:g} must be above 0")
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
        rate_hz=rate, places=tuple(places), exposure_s=exposure, **film.settings,
    )  # fmt: skip


@app.command(
    "import",
    epilog="Example: aolink import film.tif -o film.mcap --rig my.toml --rate 500"
    "  |  aolink import film.npz -o film.mcap --rig spheres.toml --rate 24 --film invert,sum=8 --at 24,31",
)
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A film: .npy, .npz, HDF5, SER, TIFF, FITS, video, MCAP, ROS bag, AOT telemetry, or a folder of"
            " pictures or stacks.",
        ),
    ],
    output: OutputOption,
    rig: Annotated[str, typer.Option(metavar="RIG.toml", help="What camera and plant the film shows.")],
    rate: RateOption = None,
    exposure: ExposureOption = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y", help="Cut a window of the rig's out of the frames, about this pixel; one for each spot."
        ),
    ] = None,
    film: FilmOfImport = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make a recording of a film: then estimate, replay, compare, deblur and view it like any other."""
    from aolink.importing.recording import import_film
    from aolink.rig import load_rig

    how = film_file(film, "import")
    settings, loaded, shown = film_settings(rate, exposure, how, at), load_rig(rig), how.open(source)
    with progress("import", shown.count // settings.frames_per_exposure) as tell:
        account = import_film(
            shown, loaded, settings, output, overwrite=overwrite, sources=[source, Path(rig)],
            progress=tell,
        )  # fmt: skip
    for note in account.notes:
        stdout.print(f"note: {note}", markup=False)
    for count, what in (
        (account.saturated, "saturated in the film, hot or dead, or no numbers"),
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
            " dark level was subtracted: --film background puts the ground at the rig's black level",
            markup=False,
        )
    stdout.print(f"{output}: {counted(account.exposures, 'exposure')} of {account.said}", markup=False)
