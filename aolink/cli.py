"""The command line: parse, call, print; nothing else."""

from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from enum import StrEnum
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from aolink.errors import AolinkError, RestorationError, RigError
from aolink.rig import Rig, load_rig, parse_light
from aolink.terminal import StopRequest, ask, input_ended, progress_bar

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from aolink.estimation import Estimate
    from aolink.exposure import Exposure
    from aolink.recording.reader import Recording

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="A logged hardware-in-the-loop pipeline for adaptive optics and any loop closed through a slow camera.",
)
_out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 120)
_err = Console(stderr=True, highlight=False, soft_wrap=True)

RigArgument = Annotated[str, typer.Argument(help="A rig file, or the name of a rig that comes with aolink.")]
FileArgument = Annotated[Path, typer.Argument(help="A recording.", metavar="FILE")]
EstimatorOption = Annotated[
    list[str] | None, typer.Option("--estimator", "-e", help="Estimator to run; may be given several times.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the target file if it exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]


_MOST_EXPOSURES = 2**32 - 1


class Light(StrEnum):
    """What a recording for a calibration shows."""

    DARK = "dark"
    FLAT = "flat"
    STILL = "still"


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"aolink {version('aolink')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None: ...


def main() -> None:
    """Entry point of the command ``aolink``."""
    try:
        app()
    except AolinkError as error:
        _err.print(f"aolink: {escape(str(error))}")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)


def _load_checked(path_or_name: str) -> Rig:
    """Load a rig file that something is about to run on: refuse what cannot work, print what is doubtful."""
    from aolink.plant import check_rig

    loaded = load_rig(path_or_name)
    for finding in check_rig(loaded):
        if finding.severity == "error":
            raise RigError(f"{path_or_name}: {finding.key}: {finding.message}")
        if finding.severity == "warning":
            _err.print(f"aolink: warning: {escape(finding.key)}: {escape(finding.message)}")
    return loaded


def _open(file: Path) -> Recording:
    """Open a recording, and say so where it is not whole."""
    from aolink.recording.reader import Recording

    recording = Recording(file)
    if recording.damage:
        _err.print(f"aolink: warning: {file}: {recording.damage}", markup=False)
    return recording


def _command() -> str:
    """What the user types for this program: its name where the shell finds it, else its path."""
    return "aolink" if shutil.which("aolink") else str(Path(sys.executable).with_name("aolink"))


@app.command(epilog="Example: aolink rig section-vi --check")
def rig(
    rig: RigArgument,
    check: Annotated[bool, typer.Option("--check", help="Check the rig file, say what was found, and end.")] = False,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run with the clock, not with the commands.")] = False,
    seed: Annotated[int | None, typer.Option(help="Instead of the rig file's seed.", min=0)] = None,
    listen: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Serve TCP ports, not terminals.")] = None,
    light: Annotated[
        str | None,
        typer.Option(
            metavar="KIND,...",
            help="What the camera sees, start after start: dark, flat, flat:DENSITY, still, moving; the last stays.",
        ),
    ] = None,
    tied: Annotated[bool, typer.Option("--tied", help="End when standard input does: for a parent process.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a simulated rig: print its two ports and serve them until stopped (Ctrl-C)."""
    if check:
        _print_findings(load_rig(rig), as_json)
        return
    loaded = _load_checked(rig)
    if light is not None:
        loaded = replace(loaded, simulation=replace(loaded.simulation, light=parse_light(light, "--light")))
    from aolink.simulation.server import RigServer, open_streams

    streams = open_streams(listen)
    with StopRequest().installed() as stop:
        server = RigServer(loaded, streams, seed=seed, real_time=real_time)
        ports = {line: stream.name for line, stream in streams.items()}
        if as_json:
            print(json.dumps(ports), flush=True)
        else:
            for line, name in ports.items():
                print(f"{line}  {name}")
            print(
                f"rig {loaded.name}, {'real' if real_time else 'virtual'} time; to record 100 exposures from it:\n"
                f"  {_command()} record --camera {ports['camera']} --mirror {ports['mirror']} --rig {rig}"
                " --estimator o3 --exposures 100 -o session.mcap\nCtrl-C stops it.",
                flush=True,
            )
        server.run(lambda: stop() or (tied and input_ended()))
        for stream in streams.values():
            stream.close()


def _print_findings(loaded: Rig, as_json: bool) -> None:
    from aolink.plant import check_rig

    findings = check_rig(loaded)
    if as_json:
        print(json.dumps([vars(finding) for finding in findings]))
    else:
        for finding in findings:
            _out.print(f"{finding.severity:>7}  {escape(finding.key)}: {escape(finding.message)}")
        errors = sum(finding.severity == "error" for finding in findings)
        _out.print(f"{loaded.name}: {'the rig file is good' if not errors else f'{errors} error(s)'}")
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(RigError.exit_code)


@app.command(epilog="Example: aolink devices /dev/ttyACM0 socket://192.168.1.5:5000")
def devices(
    ports: Annotated[list[str] | None, typer.Argument(metavar="[PORT]...", help="Ports to ask who is there.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List the serial ports of this machine, or identify what is behind the given ones."""
    from aolink.devices.discovery import Found, identify_port, list_ports

    if not ports:
        listed = list_ports()
        if as_json:
            print(json.dumps([{"port": name, "description": text} for name, text in listed]))
        for name, text in [] if as_json else listed:
            _out.print(f"{name}  {escape(text)}")
        if not listed and not as_json:
            _out.print("no serial ports on this machine; `aolink rig section-vi` makes a simulated pair")
        return
    found: list[Found] = []
    failed: AolinkError | None = None
    for port in ports:
        try:
            found.append(identify_port(port))
        except AolinkError as error:
            failed = error
            _err.print(f"{port}: {escape(str(error))}")
            continue
        if not as_json:
            _out.print(f"{port}: {escape(found[-1].text())}")
    if as_json:
        print(json.dumps([vars(each) for each in found]))
    if failed:
        raise typer.Exit(failed.exit_code)


@app.command(
    epilog="Example: aolink record --camera /dev/pts/3 --mirror /dev/pts/4 --rig section-vi"
    " --estimator o3 --exposures 100 -o session.mcap"
)
def record(
    camera: Annotated[
        str, typer.Option(metavar="PORT", help="Port of the camera: a device path or socket://host:port.")
    ],
    mirror: Annotated[str, typer.Option(metavar="PORT", help="Port of the mirror driver.")],
    rig: Annotated[str, typer.Option(metavar="RIG.toml", help="What the devices are: a rig file or the name of one.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The recording to write.")],
    estimator: EstimatorOption = None,
    exposures: Annotated[int | None, typer.Option(min=1, max=_MOST_EXPOSURES, help="How many exposures.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="How long, in seconds of device time.")] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="Goes into the recording.")] = "",
    calibration: Annotated[
        Light | None,
        typer.Option(help="Frames of this for `aolink calibrate`: the mirror stays parked, whatever the rig's drive."),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Record a session: play the rig's drive, record everything, estimate on the way.

    Without --exposures or --duration it records until Ctrl-C; the recording stays whole either way.
    """
    from aolink import session

    loaded = _load_checked(rig)
    if exposures is not None and duration is not None:
        raise typer.BadParameter("give --exposures or --duration, not both")
    if duration is not None:
        periods = duration / (loaded.timing.frame_period_steps * loaded.timing.fast_step_s)
        if not 0 < periods <= _MOST_EXPOSURES:
            raise typer.BadParameter(f"--duration {duration:g} is not a number of seconds above zero")
        exposures = math.ceil(periods)
    with StopRequest().installed() as stop, progress_bar(_err, exposures) as tell:
        report = session.record(
            loaded,
            camera,
            mirror,
            output,
            estimators=estimator or [],
            exposures=exposures or 0,
            note=note,
            calibration=calibration or "",
            overwrite=overwrite,
            stop=stop,
            progress=lambda done: tell("exposures", done),
        )
    from aolink import tables

    for warning in report.warnings:
        _err.print(f"aolink: warning: {escape(warning)}")
    if as_json:
        print(json.dumps(tables.session_as_json(report), allow_nan=False))
    else:
        _out.print(tables.session(report))
        text = f"{output}: {report.exposures} exposures, {report.ended}; look at it: {_command()} view {output}"
        _out.print(text, markup=False)
    stop.exit_if_asked()


@app.command(epilog="Example: aolink calibrate dark.mcap flat.mcap still.mcap --rig my.toml -o calibrated.toml")
def calibrate(
    rig: Annotated[str, typer.Option(metavar="RIG.toml", help="The rig file to begin with, or the name of one.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The rig file to write.")],
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="Recordings made with `aolink record --calibration`."),
    ] = None,
    camera: Annotated[str | None, typer.Option(metavar="PORT", help="Record from this camera instead.")] = None,
    mirror: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the mirror driver.")] = None,
    frames: Annotated[int, typer.Option(help="How many of each kind to record.")] = 100,
    keep: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the recordings in this folder.")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure black level, noise, gain, scale and kernel width, and write them into a copy of the rig file.

    From recordings of dark, flat and still light; or with --camera and --mirror, asking for each in turn.
    """
    from tempfile import TemporaryDirectory

    from aolink import calibrating, tables

    loaded = load_rig(rig)
    if bool(files) == bool(camera) or bool(camera) != bool(mirror):
        raise typer.BadParameter("give recordings, or --camera and --mirror")
    calibrating.check_target(output, overwrite=overwrite)
    with TemporaryDirectory(prefix="aolink-") as temporary:
        if camera and mirror:
            files = calibrating.record_frames(
                loaded, camera, mirror, keep or Path(temporary), frames=frames, overwrite=overwrite,
                ask=partial(ask, _err), progress=partial(progress_bar, _err, frames),
            )  # fmt: skip
        result = calibrating.calibrate_recordings(loaded, calibrating.rig_text(rig, loaded), files or [])
    calibrating.write_text(output, result.text, overwrite=overwrite)
    if as_json:
        print(json.dumps(tables.calibration_as_json(result)))
        return
    _out.print(tables.calibration(result))
    for note in result.calibration.notes:
        _out.print(f"note: {escape(note)}")
    _out.print(f"written: {output}")


@app.command(epilog="Example: aolink info session.mcap --json")
def info(file: FileArgument, as_json: JsonOption = False) -> None:
    """Say what a recording holds."""
    from aolink import tables

    recording = _open(file)
    facts = tables.recording_facts(recording)
    if as_json:
        print(json.dumps(facts, allow_nan=False))
    else:
        _out.print(tables.facts(facts))


@app.command(epilog="Example: aolink estimate session.mcap --estimator o1 --estimator o3 -o again.mcap")
def estimate(
    file: FileArgument,
    estimator: EstimatorOption = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="A copy with the new estimates.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the motion inside each exposure of a recording, again or for the first time."""
    from aolink import tables
    from aolink.recording.reader import Recording
    from aolink.recording.reestimate import (
        recorded_estimates,
        reestimated,
        scored_and_compared,
        write_reestimated,
    )

    recording = _open(file)
    names = list(dict.fromkeys(estimator or recording.estimators or ["o3"]))
    total = recording.counts.get("/camera/image", 0)
    with progress_bar(_err, total) as tell:
        if output is not None:
            write_reestimated(recording, names, output, overwrite=overwrite, progress=lambda n: tell("estimate", n))
            written = Recording(output)
            each = zip(*(recorded_estimates(written, name) for name in names), strict=True)
            series: Iterable[tuple[Exposure, Sequence[Estimate]]] = zip(recording.exposures(), each, strict=True)
        else:
            series = reestimated(recording, names, lambda n: tell("estimate", n))
        scores, differences = scored_and_compared(recording, series, names)
    if as_json:
        print(json.dumps({**tables.scores_as_json(scores), "differs_from_recorded": differences}, allow_nan=False))
        return
    _out.print(tables.scores(scores))
    for name, difference in differences.items():
        _out.print(f"{name}: {difference or 'the same as recorded, bit for bit'}")
    if output is not None:
        _out.print(f"written: {output}", markup=False)


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
        _out.print(f"{out}: {method}{noise}", markup=False)


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
    recording = _open(file)
    with tempfile.TemporaryDirectory(prefix="aolink-") as folder:
        rrd = save or Path(folder) / f"{file.stem}.rrd"
        viewing.save_rrd(recording, rrd, overwrite=overwrite)
        if save is not None:
            _out.print(f"written: {save}", markup=False)
        if screenshot is not None:
            viewing.screenshot(rrd, screenshot)
            _out.print(f"written: {screenshot}", markup=False)
        if web:
            viewing.serve_web(rrd, on_ready=lambda address: _out.print(f"{address}\nCtrl-C stops it."))
        elif save is None and screenshot is None:
            viewing.open_viewer(rrd)


@app.command(epilog="Example: aolink demo --rig section-vi-lively --out /tmp")
def demo(
    rig: Annotated[str, typer.Option(help="Rig file or name.")] = "section-vi",
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to make the new dated folder.")] = Path(),
    exposures: Annotated[int, typer.Option(min=2, help="How many exposures.")] = 300,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the rig file's seed.")] = None,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run with the clock and measure latencies.")] = False,
) -> None:
    """Do the main job with a simulated rig: record, estimate, estimate again, compare, draw."""
    from aolink import tables
    from aolink.demo import new_folder, run_demo
    from aolink.recording.reader import Recording

    loaded = _load_checked(rig)
    folder = new_folder(out)
    with StopRequest().installed() as stop, progress_bar(_err, exposures) as tell:
        result = run_demo(
            loaded, folder, exposures=exposures, seed=seed, real_time=real_time, stop=stop, progress=tell
        )  # fmt: skip
    if not stop():
        recording = Recording(result.recording)
        estimates = {name: recording.estimates(name) for name in recording.estimators}
        _out.print(tables.scores(tables.score_all(recording, estimates)))
    _out.print(tables.session(result.report))
    for line in tables.demo_summary(result, _command()):
        _out.print(line, markup=False)
    stop.exit_if_asked()
    if result.differences:
        raise typer.Exit(1)
