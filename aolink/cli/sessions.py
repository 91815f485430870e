"""Commands that run sessions: record, replay, demo."""

import json
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from aolink.cli import common
from aolink.cli.common import EstimatorOption, JsonOption, app, get_ready, program, progress, stdout, warn
from aolink.cli.terminal import progress_bar
from aolink.errors import EstimatorError
from aolink.signals import Interrupted, StopRequest
from aolink.units import counted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from aolink.recording.reader import Recording
    from aolink.rig import Rig
    from aolink.session import Report
    from aolink.session.dry_run import DryRun
    from aolink.viewing import LiveView

MOST_EXPOSURES = 2**32 - 1


CalibrationLight = StrEnum("CalibrationLight", ["DARK", "FLAT", "STILL"])
"""The light in a recording for a calibration."""


@app.command(
    epilog="Example: aolink record --camera /dev/pts/3 --mirror /dev/pts/4 --rig section-vi"
    " --estimator moments --exposures 100 -o session.mcap"
)
def record(
    rig: Annotated[
        str, typer.Option(metavar="RIG.toml", help="A rig file, or the name of a rig that comes with aolink.")
    ],
    output: common.OutputOption,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="PORT",
            help="Port of the camera: a device path or socket://host:port; by default the rig file names the driver.",
        ),
    ] = None,
    mirror: Annotated[str | None, typer.Option(metavar="PORT", help="Port of the mirror, likewise.")] = None,
    estimator: EstimatorOption = None,
    exposures: Annotated[
        int | None, typer.Option(min=1, max=MOST_EXPOSURES, metavar="N", help="How many exposures.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", parser=common.as_seconds, help="How long to record, s of device time; also 10min."),
    ] = None,
    note: Annotated[str, typer.Option(metavar="TEXT", help="A text to keep in the recording.")] = "",
    calibration: Annotated[
        CalibrationLight | None,
        typer.Option(help="Record frames of this light for `aolink calibrate`; the mirror stays parked."),
    ] = None,
    control: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Close the loop with this controller, integrator, lqg or another package's; the first -e serves it,"
            " moments where there is none.",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="With --control: close the loop even if it is unstable by the model.")
    ] = False,
    view: Annotated[
        bool,
        typer.Option(
            "--view",
            help="Show the session live in Rerun, all that a saved view shows; what it is too slow for is left out.",
        ),
    ] = False,
    inputs: Annotated[
        list[str] | None,
        typer.Option(
            "--input",
            metavar="INPUT|FILE",
            help="Play this, not the rig's drive; or inputs from a .npy or .mcap file.",
        ),
    ] = None,
    reconnect: Annotated[
        float,
        typer.Option(
            min=0, metavar="S", help="Wait this long for a native device's port that has vanished, then go on with it."
        ),
    ] = 0.0,
    split_s: Annotated[
        float, typer.Option(min=0, metavar="S", help="Begin another file after this time; 0 for one file.")
    ] = 0.0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything, with the devices, but send the mirror no input.")
    ] = False,
    overwrite: common.OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Record a session: play the rig's drive, or close the loop; record everything, estimate online.

    In real time an estimator that is slower than the camera skips exposures; the recording has them all.
    Without --exposures or --duration it records until Ctrl-C; the recording stays whole either way.
    An INPUT is sine:amplitude=0.2,frequency=5 or chirp:amplitude=0.2,from=1,to=40 or prbs:amplitude=0.2,to=40,seed=3
    or step:amplitude=0.2,at=1; with column=0 it is for one input only.
    """
    from aolink import session
    from aolink.recording.mcap_file import WriteOptions
    from aolink.session.controlling import served

    options = WriteOptions(split_s=split_s)
    loaded = common.load_checked(rig)
    if force and not control:
        raise typer.BadParameter("--force is for --control")
    if exposures is not None and duration is not None:
        raise typer.BadParameter("give --exposures or --duration, not both")
    if duration is not None:
        periods = duration / (loaded.timing.frame_period_steps * loaded.timing.fast_step_s)
        if not 0 < periods <= MOST_EXPOSURES:
            raise typer.BadParameter(f"--duration {duration:g} is not a number of seconds above zero")
        exposures = math.ceil(periods)
    played = None
    if inputs:
        from aolink.session.excitation import excitation

        if control or calibration:
            raise typer.BadParameter("--input is not for --control or --calibration, which give the inputs themselves")
        played = excitation(inputs, loaded)
        exposures = exposures or played.exposures or None
    names = served(loaded, control or "", estimator or [])
    get_ready(loaded, names)
    asked: dict[str, Any] = {
        "estimators": names, "exposures": exposures or 0, "calibration": calibration or "", "inputs": played,
        "control": control or "", "force": force, "overwrite": overwrite,
    }  # fmt: skip
    if dry_run:
        from aolink.session.dry_run import dry_run as checked

        with StopRequest().installed() as stop:
            found = checked(loaded, camera, mirror, output, **asked, stop=stop)
        stop.raise_if_asked()
        _print_dry_run(found, as_json)
        return
    report = session.Report()

    def on_progress(done: int) -> None:
        tell(done, report.note())

    with _live_view(loaded, names, shown=view) as live:
        with StopRequest().installed() as stop, progress("exposures", exposures) as tell:
            session.record(
                loaded, camera, mirror, output, **asked, note=note, sinks=[live] if live else (), options=options,
                reconnect_s=reconnect, stop=stop, progress=on_progress, report=report,
            )  # fmt: skip
        if live and live.left_out:
            warn(f"the view was too slow for this session: {live.left_out} messages were not shown")
        _print_session(report, output, as_json)
    stop.raise_if_asked()
    if any(each.failed for each in report.estimation.values()):
        raise typer.Exit(EstimatorError.exit_code)


def _print_dry_run(found: "DryRun", as_json: bool) -> None:
    for warning in found.warnings:
        warn(warning)
    if as_json:
        print(json.dumps(found.facts | {"warnings": found.warnings}))
        return
    for name, text in found.facts.items():
        stdout.print(f"{name:<12}{text}", markup=False)
    stdout.print("dry run: all of this is good; no input was sent to the mirror, and nothing was recorded")


def _print_session(report: "Report", output: Path, as_json: bool) -> None:
    from aolink.cli.tables import sessions as tables

    for warning in report.warnings:
        warn(warning)
    if as_json:
        print(json.dumps(tables.session_as_json(report), allow_nan=False), flush=True)
    else:
        stdout.print(tables.session(report))
        if not report.files:
            stdout.print(f"{output}: nothing is written, {report.ended}", markup=False)
            return
        written = report.files[0]
        parts = f" in {len(report.files)} files" if len(report.files) > 1 else ""
        what = f"{counted(report.exposures, 'exposure')}{parts}, {report.ended}"
        stdout.print(f"{written}: {what}; view it: {program()} view {written}", markup=False)


def _live_view(
    rig: "Rig", estimators: Sequence[str], true_scene: "NDArray[np.uint16] | None" = None, *, shown: bool
) -> "AbstractContextManager[LiveView | None]":
    if not shown:
        return nullcontext()
    from aolink import viewing

    return viewing.live_viewer(rig, estimators, true_scene)


@app.command(
    epilog="Example: aolink replay session.mcap --speed 1 --estimator moments --view"
    "  |  aolink replay session.mcap -e moments --control integrator"
)
def replay(
    file: common.FileArgument,
    estimator: EstimatorOption = None,
    speed: Annotated[
        float, typer.Option(min=0, metavar="X", help="Pace relative to the recording's; 0 for as fast as possible.")
    ] = 0.0,
    control: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Compute what this controller would have commanded, served by the first -e; on a simulated rig, also"
            " the slopes that it would have left.",
        ),
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show it live in Rerun.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Replay a recording through the estimators as if it were live.

    Exposures that an estimator skipped in the session are skipped again; `aolink estimate` skips none.
    """
    from aolink.estimation.registry import DEFAULT_ESTIMATOR

    recording = common.open_recording(file)
    names = list(dict.fromkeys(estimator or recording.estimators or [DEFAULT_ESTIMATOR]))
    get_ready(recording.rig, names)
    if control:
        if view or speed:
            raise typer.BadParameter("--control takes the whole recording at once: leave out --view and --speed")
        _replay_control(recording, control, names[0], as_json=as_json)
        return
    from aolink.cli.tables import scores as tables
    from aolink.estimation import Scorer
    from aolink.session.replay import replay as replay_recording

    scorers = {name: Scorer() for name in names}
    live_view = _live_view(recording.rig, names, recording.true_scene, shown=view)
    with live_view as live, StopRequest().installed() as stop:
        total = recording.n_frames
        with progress("replay", total) as tell:
            series = replay_recording(recording, names, rate=speed, stop=stop, sinks=[live] if live else ())
            for number, (exposure, estimates) in enumerate(series, 1):
                for estimate in estimates:
                    scorers[estimate.estimator].add(exposure, estimate)
                tell(number)
        scores = {name: scorer.result() for name, scorer in scorers.items()}
        if as_json:
            print(json.dumps(tables.scores_as_json(scores), allow_nan=False), flush=True)
        else:
            stdout.print(tables.scores(scores))
    stop.raise_if_asked()
    common.check_measured(file, scores)


def _replay_control(recording: "Recording", controller: str, estimator: str, *, as_json: bool) -> None:
    from aolink.cli.tables import control as tables
    from aolink.jobs.closed_loop import replayed

    with StopRequest().installed() as stop, progress("replay", None) as tell:
        result = replayed(recording, controller, estimator, stop, tell)
    stop.raise_if_asked()
    if as_json:
        print(json.dumps(tables.replayed_as_json(result), allow_nan=False))
    else:
        stdout.print(tables.replayed(result))


@app.command(epilog="Example: aolink demo  |  aolink demo --rig section-vi-lively -e o1 -e o3 -e profile -o /tmp")
def demo(
    rig: Annotated[str, typer.Option(metavar="RIG.toml", help="Rig file or name.")] = "moving-scene",
    out: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="The folder in which to make a new one.")
    ] = Path(),
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator", "-e", metavar="NAME", help="Estimator to run; by default open-loop, o1 and moments."
        ),
    ] = None,
    exposures: Annotated[int, typer.Option(min=2, metavar="N", help="How many exposures.")] = 40,
    control: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Close the loop, served by the first -e, and compare with the open one and the integrator.",
        ),
    ] = None,
) -> None:
    """Run everything with a simulated rig: record, estimate, estimate again, compare, deblur, draw."""
    from aolink.cli.tables import scores, sessions
    from aolink.jobs.demo import new_folder, run_demo, usual_estimators

    loaded = common.load_checked(rig)
    names = list(dict.fromkeys(estimator or usual_estimators(loaded, control or "")))
    get_ready(loaded, names)
    folder = new_folder(out)
    stop = StopRequest()
    try:
        with progress_bar(common.stderr, exposures) as tell:
            result = run_demo(
                loaded, rig, folder, estimators=names, exposures=exposures,
                control=control or "", stoppable=stop.installed, progress=tell,
            )  # fmt: skip
    except Interrupted as interrupted:
        raise Interrupted(interrupted.number, f"the files made until then are in {folder}") from None
    if result.scores:
        stdout.print(scores.scores(result.scores, ("RMSE path", "NIS", "NEES end")))
    stdout.print(sessions.session(result.report))
    for line in sessions.demo_summary(result, program()):
        stdout.print(line, markup=False)
    stop.raise_if_asked()
    if result.differences:
        raise typer.Exit(1)
