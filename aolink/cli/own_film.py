"""The command look: from a film of spots to what moves in it, without a rig file."""

import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from aolink.cli.common import JsonOption, OverwriteOption, app, program, progress, stderr, stdout
from aolink.cli.films import ExposureOption, FilmOfLook, RateOption, film_file, film_settings
from aolink.errors import ExportError, ImportingError, RecordingError
from aolink.files import writing
from aolink.signals import Interrupted


@app.command(
    epilog="Example: aolink look film.tif --rate 50 --exposure 0.018"
    "  |  aolink look film.avi --exposure 0.02 --film gamma=2.2"
)
def look(
    source: Annotated[
        Path,
        typer.Argument(metavar="FILM", help="A film of spots, as `aolink import` takes."),
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
    quick: Annotated[
        bool, typer.Option("--quick", help="End before sums of processes are tried for blurred frames.")
    ] = False,
    film: FilmOfLook = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Say what moves in a film of up to four spots, and how well its blur tells the path inside each exposure.

    Writes a rig file to go on with, a recording with estimates, and a page with pictures. The first answer comes in
    about a minute; where it leaves something of blurred frames unexplained, sums of processes are then tried, which may
    take minutes. Ctrl-C keeps what there is.
    """
    from aolink.importing.recording import import_film
    from aolink.jobs.look import ESTIMATOR, Looked, heeding
    from aolink.jobs.look import look as look_at
    from aolink.jobs.look_page import write_page
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
    rig_file, recording, page = folder / "rig.toml", folder / "film.mcap", folder / "page.html"
    if not overwrite and (there := [each for each in (rig_file, recording, page) if each.exists()]):
        raise RecordingError(f"{there[0]} exists already: give another -o DIR, or --overwrite")
    looked: Looked | None = None
    interrupted: Interrupted | None = None
    for thorough in (False, True)[: 1 if quick else 2]:
        try:
            with progress("look", None) as tell:
                said = look_at(
                    shown, settings, source.stem, kernel=kernel, thorough=thorough, before=looked,
                    tell=lambda what, done, of: tell(done, f"{what}: {done} of {of}"),
                )  # fmt: skip
        except Interrupted as stopped:
            if looked is None:
                raise
            stderr.print("stopped: the first answer is kept and written", markup=False)
            interrupted = stopped
            break
        first, looked = looked, said
        if not as_json and (first is None or paragraph(first) != paragraph(looked)):
            stdout.print(f"{'' if first is None else 'After more models: '}{paragraph(looked)}", markup=False)
        if not looked.moves:
            break
    assert looked is not None
    folder.mkdir(parents=True, exist_ok=True)
    rig = parse_rig(looked.text)
    with writing(rig_file, overwrite=overwrite, sources=[source], error=ImportingError) as partial:
        partial.write_text(looked.text, encoding="utf-8")
    with TemporaryDirectory(dir=folder, prefix=".look-") as place:
        imported = Path(place) / recording.name
        import_film(looked.cut, rig, looked.settings, imported, sources=[source])
        with progress("estimate", len(looked.spots.light)) as tell:
            if looked.moves:
                scores = write_reestimated(
                    Recording(imported), [ESTIMATOR], recording, overwrite=overwrite, progress=tell
                )  # fmt: skip
                looked = heeding(looked, scores[ESTIMATOR])
            else:
                imported.replace(recording)
    commands = [
        f"{program()} view {recording}",
        f"{program()} info {recording}",
        f"{program()} report {recording} -o {folder / 'report.html'}",
    ]
    drawn = f"{page}: the pictures"
    try:
        write_page(looked, page, source.name, commands, overwrite=overwrite)
    except ExportError as error:  # the answer does not need it
        drawn = f"no page with pictures: {error}"
    if as_json:
        files = {"rig": str(rig_file), "recording": str(recording), "page": str(page) if page.exists() else None}
        print(json.dumps({"text": paragraph(looked), **numbers(looked), **files}, allow_nan=False))
    else:
        lines = [*(f"{each}." for each in looked.caveats), "Assumed:", *(f"  {each}." for each in looked.assumed)]
        lines += [f"{drawn}. To go on:", *(f"  {each}" for each in commands)]
        stdout.print("\n".join(lines), markup=False)
    if interrupted is not None:
        raise interrupted
