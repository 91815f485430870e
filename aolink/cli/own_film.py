"""The command look: from a film to what moves in it, without a rig file."""

import json
import math
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from aolink.cli.common import JsonOption, OverwriteOption, app, program, progress, stdout
from aolink.cli.films import ExposureOption, FilmOfLook, RateOption, film_file, film_settings
from aolink.errors import ExportError, ImportingError, RecordingError
from aolink.files import writing


@app.command(
    epilog="Example: aolink look film.tif --rate 50 --exposure 0.018"
    "  |  aolink look film.avi --exposure 0.02 --film gamma=2.2"
)
def look(
    source: Annotated[
        Path,
        typer.Argument(metavar="FILM", help="A film, as `aolink import` takes."),
    ],
    rate: RateOption = None,
    exposure: ExposureOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for rig file, recording and page. [FILM-look]"),
    ] = None,
    kernel: Annotated[
        float | None,
        typer.Option(metavar="PIXELS", help="Standard deviation of a resting spot; without it the frames tell."),
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="X,Y", help="Middle of the part to look at. [what moves most]")
    ] = None,
    size: Annotated[int, typer.Option(min=8, metavar="PIXELS", help="Side of that part.")] = 40,
    film: FilmOfLook = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Say what moves in a film, at what frequency, and whether to believe it.

    Spots on a dark ground or anything else that has edges: the blur inside the exposures tells frequencies above the
    frame rate from their aliases. Writes a page with pictures, the path, the motion as a tone, a rig file to go on
    with, and a recording with estimates.
    """
    from aolink.importing.recording import import_film
    from aolink.jobs.look import look as look_at
    from aolink.jobs.look_page import write_page, write_path, write_tone
    from aolink.jobs.look_words import as_json as numbers
    from aolink.jobs.look_words import paragraph
    from aolink.recording.reader import Recording
    from aolink.recording.reestimate import write_reestimated
    from aolink.rig import parse_rig

    if kernel is not None and not 0 < kernel < math.inf:
        raise ImportingError(f"--kernel {kernel:g} must be above 0{' and finite' if kernel > 0 else ''}")
    how = film_file(film, "look")
    settings, shown = film_settings(rate, exposure, how), how.open(source)
    folder = output or Path(f"{source.stem}-look")
    names = ("page.html", "path.csv", "tone.wav", "rig.toml", "film.mcap")
    page, path, tone, rig_file, recording = (folder / each for each in names)
    if not overwrite and (there := [folder / each for each in names if (folder / each).exists()]):
        raise RecordingError(f"{there[0]} exists already: give another -o DIR, or --overwrite")
    made = not folder.exists()
    try:  # before anything is computed
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder, prefix=".look-"):
            pass
    except OSError as error:
        raise ImportingError(f"{folder} cannot be written: {error.strerror}") from None
    place = None if at is None else _place(at)
    with ExitStack() as failing, progress("look", None) as tell:
        if made:
            failing.callback(folder.rmdir)
        looked = look_at(
            shown, settings, source.stem, kernel=kernel, at=place, size=size,
            tell=lambda what, done, of: tell(done, f"{what}: {done} of {of}"),
        )  # fmt: skip
        failing.pop_all()
    if not as_json:
        stdout.print(paragraph(looked), markup=False)
    commands, written = [], {"page": page, "path": None, "tone": None, "rig": None, "recording": None}
    if looked.recorded is not None:
        rig = parse_rig(looked.text)
        with writing(rig_file, overwrite=overwrite, sources=[source], error=ImportingError) as partial:
            partial.write_text(looked.text, encoding="utf-8")
        with TemporaryDirectory(dir=folder, prefix=".look-") as temporary:
            imported = Path(temporary) / recording.name
            import_film(looked.recorded[0], rig, looked.recorded[1], imported, sources=[source])
            if looked.moves:
                with progress("estimate", looked.frames) as tell:
                    write_reestimated(
                        Recording(imported), [looked.estimator], recording, overwrite=overwrite, progress=tell
                    )
            else:
                imported.replace(recording)
        written |= {"rig": rig_file, "recording": recording}
        about = ",".join(f"{each:g}" for each in looked.recorded[1].places[0]) if looked.recorded[1].places else ""
        again = f"{program()} import {source} --rig {rig_file} --at {about} -o again.mcap"
        commands = [
            f"{program()} view {recording}",
            f"{program()} info {recording}",
            f"{program()} report {recording} -o {folder / 'report.html'}",
            *([again] if about else []),
        ]
    if looked.found.lines:
        write_path(looked, path, overwrite=overwrite)
        written["path"] = path
        if write_tone(looked, tone, overwrite=overwrite):
            written["tone"] = tone
    drawn = f"{page}: the pictures"
    try:
        write_page(looked, page, source.name, commands, overwrite=overwrite)
    except ExportError as error:  # the answer does not need it
        drawn, written["page"] = f"no page with pictures: {error}", None
    if as_json:
        files = {name: None if each is None else str(each) for name, each in written.items()}
        print(json.dumps({"text": paragraph(looked), **numbers(looked), **files}, allow_nan=False))
        return
    lines = [*(f"{each}." for each in looked.doubts), "Assumed:", *(f"  {each}." for each in looked.assumed)]
    lines += [drawn, *(["To go on:"] if commands else []), *(f"  {each}" for each in commands)]
    stdout.print("\n".join(lines), markup=False)


def _place(text: str) -> tuple[float, float]:
    """X,Y in pixels."""
    try:
        x, y = (float(each) for each in text.split(","))
    except ValueError:
        raise ImportingError(f"--at {text} is no place: give its column and row, as --at 320,120") from None
    return x, y
