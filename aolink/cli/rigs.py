"""Commands that run with devices: rig, devices, record, replay, calibrate, demo."""

from __future__ import annotations

import json
import math
from collections import Counter
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from aolink.cli.common import (
    EstimatorOption,
    FileArgument,
    JsonOption,
    OverwriteOption,
    RigArgument,
    app,
    check_measured,
    get_ready,
    load_checked,
    open_recording,
    program,
    stderr,
    stdout,
)
from aolink.cli.films import (
    AtOption,
    GammaOption,
    InvertOption,
    RateOption,
    SumOption,
    TopicOption,
    TrackOption,
    film_settings,
)
from aolink.cli.terminal import ask, input_ended, progress_bar
from aolink.errors import AolinkError, EstimatorError, RigError
from aolink.files import check_target, writing
from aolink.signals import Interrupted, StopRequest, stop_after

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from aolink.estimation import Estimate
    from aolink.exposure import Exposure
    from aolink.importing.exposures import Settings
    from aolink.recording.reader import Recording
    from aolink.rig import Rig
    from aolink.session import Report

MOST_EXPOSURES = 2**32 - 1


class Light(StrEnum):
    """The light in a recording for a calibration."""

    DARK = "dark"
    FLAT = "flat"
    STILL = "still"


@app.command(
    epilog="Example: aolink rig section-vi --check"
    "  |  aolink rig my.toml --from film.tif --rate 500 --track 3 --sum 8 (writes my.toml)"
)
def rig(
    rig: RigArgument,
    check: Annotated[bool, typer.Option("--check", help="Check the rig file, print the findings, and end.")] = False,
    exposure_scan: Annotated[
        bool, typer.Option("--exposure-scan", help="Print the error of o1 to expect at other exposure times, and end.")
    ] = False,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run in real time, not on virtual time.")] = False,
    seed: Annotated[int | None, typer.Option(help="Instead of the rig file's seed.", min=0)] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Serve TCP ports of this machine, not terminals.")
    ] = None,
    allow_remote: Annotated[
        bool,
        typer.Option("--allow-remote", help="Let --listen take an address that other machines can reach."),
    ] = False,
    light: Annotated[
        str | None,
        typer.Option(
            metavar="KIND,...",
            help="What the camera sees, start by start: dark, flat, flat:DENSITY, still, moving; the last stays.",
        ),
    ] = None,
    tied: Annotated[bool, typer.Option("--tied", help="End when standard input ends, for a parent process.")] = False,
    film: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILM", help="Write a first rig file for the objects of a film, and end."),
    ] = None,
    rate: RateOption = None,
    frames: SumOption = 1,
    track: TrackOption = 0,
    at: AtOption = None,
    invert: InvertOption = False,
    gamma: GammaOption = 1.0,
    topic: TopicOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a simulated rig: print its two ports and serve them until stopped (Ctrl-C)."""
    from aolink.rig import load_rig, parse_light

    if film is not None:
        _write_first_rig(Path(rig), film, topic, film_settings(rate, frames, track, at, invert, gamma), overwrite)
        return
    if check:
        _print_findings(load_rig(rig), as_json)
        return
    if exposure_scan:
        _print_scan(load_rig(rig), as_json)
        return
    loaded = load_checked(rig)
    if light is not None:
        loaded = replace(loaded, simulation=replace(loaded.simulation, light=parse_light(light, "--light")))
    from aolink.simulation.server import RigServer
    from aolink.simulation.streams import open_streams

    streams = open_streams(listen, allow_remote=allow_remote)
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
                f"  {program()} record --camera {ports['camera']} --mirror {ports['mirror']} --rig {rig}"
                " --estimator o3 --exposures 100 -o session.mcap\nCtrl-C stops it.",
                flush=True,
            )
        server.run(lambda: stop() or (tied and input_ended()))
        for stream in streams.values():
            stream.close()
    stop.raise_if_asked()


def _write_first_rig(path: Path, source: Path, topic: str | None, settings: Settings, overwrite: bool) -> None:
    from aolink.importing.first_rig import first_rig
    from aolink.importing.readers import open_film

    check_target(path, overwrite=overwrite, suffix=".toml", error=RigError)
    film = open_film(source, topic)
    with progress_bar(stderr, film.count) as tell:
        text = first_rig(film, settings, path.stem, lambda done: tell("follow", done))
    with writing(path, overwrite=overwrite, error=RigError) as partial:
        partial.write_text(text, encoding="utf-8")
    stdout.print(f"{path}: written from {film.name}; read it, then: {program()} rig {path} --check", markup=False)


def _print_scan(loaded: Rig, as_json: bool) -> None:
    from aolink.cli import tables
    from aolink.estimation.exposure_scan import best, exposure_scan

    errors = exposure_scan(loaded)
    if as_json:
        print(json.dumps([vars(each) for each in errors]))
        return
    stdout.print(tables.exposure_scan(loaded, errors))
    steps = best(errors).exposure_steps
    stdout.print(f"least error of the path: timing.exposure_steps = {steps}, {steps * loaded.timing.fast_step_s:g} s")


def _print_findings(loaded: Rig, as_json: bool) -> None:
    from aolink.jobs.check_rig import check_rig

    findings = check_rig(loaded)
    if as_json:
        print(json.dumps([vars(finding) for finding in findings]))
    else:
        for finding in findings:
            stdout.print(f"{finding.severity:>7}  {escape(finding.key)}: {escape(finding.message)}")
        counts = Counter(finding.severity for finding in findings)
        found = ", ".join(f"{counts[kind]} {kind}(s)" for kind in ("error", "warning") if counts[kind])
        stdout.print(f"{loaded.name}: {found or 'the rig file is good'}")
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(RigError.exit_code)


@app.command(epilog="Example: aolink devices /dev/ttyACM0 socket://192.168.1.5:5000")
def devices(
    ports: Annotated[
        list[str] | None, typer.Argument(metavar="[PORT]...", help="Ports whose devices to identify.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the serial ports and the drivers of this machine, or identify what is behind the given ports."""
    from aolink.devices.discovery import Found, identify_port, list_ports
    from aolink.devices.drivers import driver_names

    if not ports:
        listed = list_ports()
        if as_json:
            print(json.dumps([{"port": name, "description": text} for name, text in listed]))
        for name, text in [] if as_json else listed:
            stdout.print(f"{name}  {escape(text)}")
        if not listed and not as_json:
            stdout.print("no serial ports on this machine; `aolink rig section-vi` makes a simulated pair")
        if not as_json:
            stdout.print(f"camera drivers: {', '.join(driver_names('camera'))}")
            stdout.print(f"mirror drivers: {', '.join(driver_names('mirror'))}")
        return
    found: list[Found] = []
    failed: AolinkError | None = None
    for port in ports:
        try:
            found.append(identify_port(port))
        except AolinkError as error:
            failed = error
            stderr.print(f"{port}: {escape(str(error))}")
            continue
        if not as_json:
            stdout.print(f"{port}: {escape(found[-1].text())}")
    if as_json:
        print(json.dumps([vars(each) for each in found]))
    if failed:
        raise typer.Exit(failed.exit_code)


@app.command(
    epilog="Example: aolink record --camera /dev/pts/3 --mirror /dev/pts/4 --rig section-vi"
    " --estimator o3 --exposures 100 -o session.mcap"
)
def record(
    rig: Annotated[
        str, typer.Option(metavar="RIG.toml", help="A rig file, or the name of a rig that comes with aolink.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The recording to write.")],
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="PORT",
            help="Port of the camera: a device path or socket://host:port; by default the rig file names the driver.",
        ),
    ] = None,
    mirror: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the mirror, likewise.")] = None,
    estimator: EstimatorOption = None,
    exposures: Annotated[int | None, typer.Option(min=1, max=MOST_EXPOSURES, help="How many exposures.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="How long to record, s of device time.")] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="A text to keep in the recording.")] = "",
    calibration: Annotated[
        Light | None,
        typer.Option(help="Record frames of this light for `aolink calibrate`; the mirror stays parked."),
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show the session live in Rerun, which skips exposures if it is too slow.")
    ] = False,
    split_mib: Annotated[
        float, typer.Option(min=0, max=2**30, metavar="MIB", help="Begin another file at this size; 0 for one file.")
    ] = 0.0,
    split_s: Annotated[
        float, typer.Option(min=0, metavar="S", help="Begin another file after this time; 0 for one file.")
    ] = 0.0,
    compression: Annotated[str, typer.Option(help="lz4, zstd or none.")] = "lz4",
    chunk_kib: Annotated[int, typer.Option(metavar="KIB", help="Write a chunk to the file at this size.")] = 128,
    flush_s: Annotated[
        float, typer.Option(metavar="S", help="Write a chunk to the file at this age; a kill loses at most twice this.")
    ] = 0.1,
    fsync_s: Annotated[float, typer.Option(metavar="S", help="How often the file is synchronised to the disk.")] = 1.0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Record a session: play the rig's drive, record everything, estimate online.

    In real time an estimator that is slower than the camera skips exposures; the recording has them all.
    Without --exposures or --duration it records until Ctrl-C; the recording stays whole either way.
    """
    from aolink import session
    from aolink.recording.mcap_file import WriteOptions

    options = WriteOptions(
        compression=compression, chunk_bytes=chunk_kib << 10, flush_s=flush_s, fsync_s=fsync_s,
        split_bytes=round(split_mib * 2**20), split_s=split_s,
    )  # fmt: skip
    loaded = load_checked(rig)
    if exposures is not None and duration is not None:
        raise typer.BadParameter("give --exposures or --duration, not both")
    if duration is not None:
        periods = duration / (loaded.timing.frame_period_steps * loaded.timing.fast_step_s)
        if not 0 < periods <= MOST_EXPOSURES:
            raise typer.BadParameter(f"--duration {duration:g} is not a number of seconds above zero")
        exposures = math.ceil(periods)
    get_ready(loaded, estimator or [])
    report = session.Report()

    def progress(done: int) -> None:
        skipped = report.exposures_skipped.items()
        tell("exposures", done, "skipped: " + ", ".join(f"{name} {n}" for name, n in skipped) if skipped else "")

    with _live_view(loaded, estimator or [], shown=view) as watch:
        with StopRequest().installed() as stop, progress_bar(stderr, exposures) as tell:
            session.record(
                loaded, camera, mirror, output, estimators=estimator or [], exposures=exposures or 0, note=note,
                calibration=calibration or "", watch=watch, overwrite=overwrite, options=options, stop=stop,
                progress=progress, report=report,
            )  # fmt: skip
        _print_session(report, output, as_json)
    stop.raise_if_asked()
    if any(each.failed for each in report.estimation.values()):
        raise typer.Exit(EstimatorError.exit_code)


def _print_session(report: Report, output: Path, as_json: bool) -> None:
    from aolink.cli import tables

    for warning in report.warnings:
        stderr.print(f"aolink: warning: {escape(warning)}")
    if as_json:
        print(json.dumps(tables.session_as_json(report), allow_nan=False), flush=True)
    else:
        stdout.print(tables.session(report))
        written = report.files[0] if report.files else output
        parts = f" in {len(report.files)} files" if len(report.files) > 1 else ""
        text = f"{written}: {report.exposures} exposures{parts}, {report.ended}; look at it: {program()} view {written}"
        stdout.print(text, markup=False)


@contextmanager
def _live_view(
    rig: Rig, estimators: Sequence[str], *, shown: bool
) -> Iterator[Callable[[Exposure, Sequence[Estimate]], None] | None]:
    """A function that shows a session's exposures, or None."""
    if not shown:
        yield None
        return
    from aolink import viewing

    with viewing.live_viewer(rig, estimators) as live:
        yield live.show


@app.command(
    epilog="Example: aolink replay session.mcap --rate 1 --estimator moments --view"
    "  |  aolink replay session.mcap --to-rig --camera /dev/pts/3 --mirror /dev/pts/4 -o again.mcap"
)
def replay(
    file: FileArgument,
    estimator: EstimatorOption = None,
    rate: Annotated[
        float, typer.Option(min=0, metavar="X", help="X times as fast as it was recorded; 0 for as fast as it goes.")
    ] = 0.0,
    start: Annotated[float, typer.Option(metavar="S", help="Begin at this time, s from the first exposure.")] = 0.0,
    end: Annotated[float | None, typer.Option(metavar="S", help="End at this time.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Show it live in Rerun.")] = False,
    to_rig: Annotated[
        bool, typer.Option("--to-rig", help="Send its commands to a rig, and record a new session.")
    ] = False,
    camera: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the camera, with --to-rig.")] = None,
    mirror: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the mirror, with --to-rig.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="The new recording, with --to-rig.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Replay a recording through the estimators as if it were live, or send its commands to a rig.

    Exposures that an estimator skipped in the session are skipped again; `aolink estimate` skips none.
    """
    from aolink.estimation.registry import DEFAULT_ESTIMATOR

    recording = open_recording(file)
    names = list(dict.fromkeys(estimator or recording.estimators or [DEFAULT_ESTIMATOR]))
    get_ready(recording.rig, names)
    if to_rig:
        if not (output and _are_driven(recording.rig, camera, mirror)):
            raise typer.BadParameter(
                "--to-rig needs -o FILE, --camera PORT and --mirror PORT, or [devices] in its rig file"
            )
        _replay_to_rig(recording, names, camera, mirror, output, overwrite=overwrite, as_json=as_json)
        return
    if camera or mirror or output:
        raise typer.BadParameter("--camera, --mirror and -o are for --to-rig")
    from contextlib import nullcontext

    from aolink import viewing
    from aolink.cli import tables
    from aolink.estimation import Scorer
    from aolink.session.replay import replay as replay_recording

    scorers = {name: Scorer() for name in names}
    viewer = viewing.live_viewer(recording.rig, names, recording.true_scene) if view else nullcontext()
    with viewer as shown, StopRequest().installed() as stop:
        total = recording.n_frames
        with progress_bar(stderr, total if end is None and not start else None) as tell:
            series = replay_recording(
                recording, names, rate=rate, start_s=start, end_s=math.inf if end is None else end, stop=stop
            )
            for number, (exposure, estimates) in enumerate(series, 1):
                for estimate in estimates:
                    scorers[estimate.estimator].add(exposure, estimate)
                if shown is not None:
                    shown.show(exposure, estimates)
                tell("replay", number)
        scores = {name: scorer.result() for name, scorer in scorers.items()}
        if as_json:
            print(json.dumps(tables.scores_as_json(scores), allow_nan=False), flush=True)
        else:
            stdout.print(tables.scores(scores))
    stop.raise_if_asked()
    check_measured(file, scores)


def _are_driven(rig: Rig, camera: str | None, mirror: str | None) -> bool:
    """Whether a port or the rig file says what drives each of the devices."""
    return all(port or kind in rig.devices for kind, port in (("camera", camera), ("mirror", mirror)))


def _replay_to_rig(
    recording: Recording,
    names: list[str],
    camera: str | None,
    mirror: str | None,
    output: Path,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    from aolink import session
    from aolink.cli import tables
    from aolink.recording.compare import compare
    from aolink.recording.reader import Recording
    from aolink.recording.topics import TOPICS
    from aolink.session.replay import RecordedCommands

    commands = RecordedCommands(recording)
    with StopRequest().installed() as stop, progress_bar(stderr, commands.exposures) as tell:
        report = session.record(
            recording.rig, camera, mirror, output, estimators=names, exposures=commands.exposures,
            inputs=commands.inputs, note=f"commands of {recording.path.name}", overwrite=overwrite, stop=stop,
            progress=lambda done: tell("exposures", done),
        )  # fmt: skip
    for warning in report.warnings:
        stderr.print(f"aolink: warning: {escape(warning)}")
    only = [row.name for row in TOPICS if row.repeatable]
    found = compare(recording, Recording(output), only=only, relative_to_start=True)
    if as_json:
        print(json.dumps(tables.comparison_as_json(found, same_rig=True), allow_nan=False))
    else:
        stdout.print(tables.session(report))
        stdout.print(tables.comparison(found))
        stdout.print(f"{output}: {report.exposures} exposures, {report.ended}", markup=False)
    stop.raise_if_asked()


@app.command(epilog="Example: aolink calibrate dark.mcap flat.mcap still.mcap --rig my.toml -o calibrated.toml")
def calibrate(
    rig: Annotated[
        str,
        typer.Option(
            metavar="RIG.toml", help="The rig file to start from, or the name of a rig that comes with aolink."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The rig file to write.")],
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="Recordings made with `aolink record --calibration`."),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(metavar="PORT", help="Port of the camera, to record the frames now.")
    ] = None,
    mirror: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the mirror.")] = None,
    frames: Annotated[int, typer.Option(help="How many frames of each light to record.")] = 100,
    keep: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the recordings in this folder.")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure black level, noise, gain, scale and kernel width, and write them into a copy of the rig file.

    It takes recordings of dark, flat and still light, or records from the devices, asking for each in turn.
    """
    from shutil import rmtree
    from tempfile import mkdtemp

    from aolink.cli import tables
    from aolink.jobs import calibrate
    from aolink.rig import load_rig

    loaded = load_rig(rig)
    if (files and (camera or mirror)) or not (files or camera or "camera" in loaded.devices):
        raise typer.BadParameter("give recordings, or --camera, or [devices.camera] in the rig file")
    check_target(output, overwrite=overwrite, sources=files or [])
    folder = keep or Path(mkdtemp(prefix="aolink-"))
    try:
        if not files:
            files = calibrate.record_frames(
                loaded, camera, mirror, folder, frames=frames, overwrite=overwrite,
                ask=partial(ask, stderr), stoppable=stop_after, progress=partial(progress_bar, stderr, frames),
            )  # fmt: skip
        result = calibrate.calibrate_recordings(loaded, calibrate.rig_text(rig, loaded), files or [])
    except AolinkError as error:
        # Somebody has covered and lit the camera for them.
        if not keep and (made := sorted(map(str, folder.glob("*.mcap")))):
            keep = folder
            raise type(error)(f"{error}; `aolink calibrate` takes what was recorded: {' '.join(made)}") from None
        raise
    finally:
        if not keep:
            rmtree(folder, ignore_errors=True)
    with writing(output, overwrite=overwrite, sources=files or []) as unfinished:
        unfinished.write_text(result.text, newline="")  # with the line ends that the rig file had
    if as_json:
        print(json.dumps(tables.calibration_as_json(result)))
        return
    stdout.print(tables.calibration(result))
    for note in result.calibration.notes:
        stdout.print(f"note: {escape(note)}")
    stdout.print(f"written: {output}")


@app.command(epilog="Example: aolink demo --rig section-vi-lively --out /tmp")
def demo(
    rig: Annotated[str, typer.Option(help="Rig file or name.")] = "section-vi",
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder in which to make a new, dated one.")] = Path(),
    exposures: Annotated[int, typer.Option(min=2, help="How many exposures.")] = 300,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the rig file's seed.")] = None,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run in real time and measure latencies.")] = False,
) -> None:
    """Run everything with a simulated rig: record, estimate, estimate again, compare, draw."""
    from aolink.cli import tables
    from aolink.jobs.demo import new_folder, possible_estimators, run_demo
    from aolink.recording.reader import Recording

    loaded = load_checked(rig)
    folder = new_folder(out)
    get_ready(loaded, possible_estimators(loaded))
    stop = StopRequest()
    try:
        with progress_bar(stderr, exposures) as tell:
            result = run_demo(
                loaded, rig, folder, exposures=exposures, seed=seed, real_time=real_time, stoppable=stop.installed,
                progress=tell,
            )  # fmt: skip
    except Interrupted as interrupted:
        raise Interrupted(interrupted.number, f"what was made until then is in {folder}") from None
    if not stop():
        recording = Recording(result.recording)
        estimates = {name: recording.estimates(name) for name in recording.estimators}
        stdout.print(tables.scores(tables.score_all(recording, estimates)))
    stdout.print(tables.session(result.report))
    for line in tables.demo_summary(result, program()):
        stdout.print(line, markup=False)
    stop.raise_if_asked()
    if result.differences:
        raise typer.Exit(1)
