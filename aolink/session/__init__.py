"""Live sessions: devices, recorder and estimators joined. The page is `aolink/pages/first_session.md`.

`received.Received` is the one place that tells the events of devices apart. A new count of a session is a field of
`report.Report`; where it counts losses, its name in ``_LOSSES`` of `aolink.recording.facts` shows it in `aolink info`.
A new kind of ``--input`` has its numbers in ``_NUMBERS`` of `excitation`, and its shape in ``_signal``.
"""

from __future__ import annotations

import contextlib
import gc
import io
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from aolink.arguments import names, whole_number
from aolink.control import check_stable, stability
from aolink.devices.interfaces import Camera
from aolink.devices.opening import open_devices
from aolink.errors import AolinkError, ControlError, DeviceError, PortError
from aolink.estimation import Driver
from aolink.optics.scene import framed
from aolink.recording import topics
from aolink.recording.mcap_file import WriteOptions
from aolink.recording.writer import RecordingWriter
from aolink.rig import Drive, Rig, rig_of
from aolink.rig.scene_table import read_scene_picture
from aolink.session.commanding import Inputs
from aolink.session.controlling import Controlling, facts, served
from aolink.session.estimating import BesideTheLoop
from aolink.session.excitation import Excitation
from aolink.session.journal import Sink, View
from aolink.session.loop import SessionLoop
from aolink.session.report import EstimatorReport, Report
from aolink.signals import Interrupted
from aolink.timeouts import TIMEOUTS

__all__ = ["EstimatorReport", "Report", "Sink", "View", "record"]


def controller(rig: Rig, control: str, estimators: Sequence[str], *, force: bool) -> tuple[Controlling, dict[str, str]]:
    """The controller of a session, and the metadata about it for the recording. Raises ControlError, as `record`."""
    controlling = Controlling(rig, control, estimators)
    found = stability(rig, control) if force else check_stable(rig, control)
    return controlling, facts(rig, controlling, found.text())


def at_rest(rig: Rig) -> Rig:
    """The same rig with a drive that holds the safe input."""
    rest = Drive(kind="none", amplitude=np.zeros(rig.n_inputs), period_s=1.0, offset=rig.mirror.park)
    return replace(rig, drive=rest)


def _true_scene(rig: Rig, camera: Camera) -> dict[str, bytes]:
    """The scene at rest as an attachment, if the camera is simulated from this rig file and shows it."""
    if rig.scene is None or not rig.scene.picture or camera.rig_digest != rig.digest:
        return {}
    data = io.BytesIO()
    np.save(data, rig.scene.to_counts(framed(rig.scene, read_scene_picture(rig.scene, rig.folder))))
    return {topics.TRUE_SCENE_ATTACHMENT: data.getvalue()}


def _saved(report: Report, writer: RecordingWriter) -> str:
    """The part of a session that was saved before an error ended it, in words."""
    paths = writer.paths
    if not paths:
        return f"no exposure had come by then: {writer.path} is as it was"
    where = str(paths[-1]) if len(paths) == 1 else f"{len(paths)} files, the last of them {paths[-1]}"
    exposures = max(report.exposures, report.frames_received)  # also those whose inputs were not reported any more
    if not exposures:
        return f"no exposure had come by then, {where} holds none"
    return f"the {exposures} exposure(s) that had come by then are saved in {where}"


def record(
    rig: Rig | str | Path,
    camera_port: str | None,
    mirror_port: str | None,
    path: str | Path,
    *,
    estimators: Sequence[str] = (),
    exposures: int = 0,
    note: str = "",
    calibration: str = "",
    inputs: Inputs | None = None,
    control: str = "",
    force: bool = False,
    sinks: Sequence[View] = (),
    overwrite: bool = False,
    options: WriteOptions | None = None,
    reconnect_s: float = 0.0,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda exposures: None,
    report: Report | None = None,
) -> Report:
    """Record a session: play the rig's drive, record everything, run estimators on the way.

    In real time nothing stands between the wire and the file. Each estimator runs in a process of its own, beside the
    recording, and skips the exposures that it has no time for: those are counted, and recorded as skipped. So are
    those that come after an estimator has failed. On virtual time the rig waits, and nothing is skipped.

    Parameters
    ----------
    rig:
        The description of the devices, a rig file or the name of one that comes with aolink. It is compared with the
        identities that the devices report.
    camera_port, mirror_port:
        Anything that pyserial opens: a device path, or an address such as socket://host:port. Where None, the rig
        file's table ``[devices]`` names the device's driver. Where that names no mirror either, the camera alone is
        recorded: nothing is commanded, and every exposure has the rig's safe input.
    path:
        The recording; must not exist unless ``overwrite``.
    estimators:
        Names of estimators to run online; their results go into the recording.
    exposures:
        Number of exposures; 0 means until ``stop()``.
    calibration:
        The light that the camera sees, one of `aolink.calibration.KINDS`, if the frames are for `aolink calibrate`: the
        mirror then holds its parked input, whatever the rig's drive.
    inputs:
        Function that gives the inputs to command, instead of the rig's drive. The loop calls it, and sends the next
        commands when it returns. The recording's metadata (``input``) have the text of an
        `aolink.session.excitation.Excitation`.
    control:
        Name of the controller that closes the loop, one of `aolink.control.controller_names`: it gives the inputs,
        instead of the rig's drive. The first of the estimators serves it, or ``moments`` where there are none. On
        virtual time an exposure changes the inputs ``control.delay_s`` after its end; in real time as soon after that
        as possible.
    force:
        Whether to close a loop even if it is unstable by the model.
    sinks:
        What gets each message when it is recorded, beside the recording. In real time the loop waits for them, so they
        must not take time. One that fails gets no more, which is a warning.
    options:
        How the recording is divided into chunks and files.
    reconnect_s:
        How long to wait for the port of a native device that vanishes, s. The session goes on with the device that
        returns if it is the same one and has not been restarted; exposures and inputs that are missing are counted.
        With 0 a port that vanishes ends the session.
    stop, progress:
        Called at least ten times a second: ``stop()`` says whether the session is to end, ``progress(exposures)`` is
        given the number of exposures so far. In real time the latter is called on a thread of its own.
    report:
        The report to fill in during the session, which is also returned; a new one if None.

    Raises
    ------
    AolinkError
        A device, a port, the disk or an estimator failed, by the error's class. The mirror is parked if it can be
        reached, and the recording is closed with the data so far.
    """
    rig, exposures = rig_of(rig), whole_number(exposures, "exposures")
    estimators = served(rig, control, names(estimators, "estimators"))
    driver = Driver(rig, estimators)
    controlling, of_control = None, dict[str, str]()
    if control:
        if calibration or inputs is not None:
            raise ControlError("a controller gives the inputs itself: leave out the calibration, or the inputs")
        controlling, of_control = controller(rig, control, estimators, force=force)
    if calibration:
        rig = at_rest(rig)
    report = report or Report()
    with (
        open_devices(rig, camera_port, mirror_port, stop, reconnect_s) as (clock, camera, mirror, warnings),
        contextlib.ExitStack() as aside,
    ):
        if control and not mirror.commanded:
            raise ControlError("there is no mirror to close the loop with: give --mirror PORT, or [devices.mirror]")
        start_ns = clock.now_ns()
        session_facts = {
            "session": f"{start_ns:x}",
            "aolink_version": version("aolink"),
            "rig": rig.name,
            "rig_digest": rig.digest,
            "camera": camera.description,
            "mirror": mirror.description,
            "camera_lacks": "; ".join(camera.lacks),
            "mirror_lacks": "; ".join(mirror.lacks),
            "virtual_time": str(clock.virtual),
            "estimators": " ".join(estimators),
            "note": note,
        } | of_control
        if isinstance(inputs, Excitation):
            session_facts["input"] = inputs.text
        if calibration:
            session_facts[topics.CALIBRATION] = calibration
        attachments = _true_scene(rig, camera)
        writer = RecordingWriter(
            path, rig, session_facts, start_ns, overwrite=overwrite, deterministic=clock.virtual,
            attachments=attachments, options=options,
        )  # fmt: skip
        aside.enter_context(_closed_at_last(writer, report))
        report.warnings += warnings
        beside = None
        if not clock.virtual:
            aside.enter_context(_progress_aside(progress, report))
            beside = aside.enter_context(BesideTheLoop(rig, estimators, controlling.estimator if controlling else ""))
            clock.beside = beside.processes
            aside.enter_context(_spared_collections())
        loop = SessionLoop(rig, clock, camera, mirror, writer, driver, inputs, sinks, beside, report, controlling)
        try:
            loop.run(exposures, stop, progress if clock.virtual else lambda exposures: None)
        except BaseException as error:
            report.ended = f"error: {error}" if isinstance(error, AolinkError) else f"error: {error!r}"
            clock.hurry()
            try:
                _make_safe(loop)
                if isinstance(error, ControlError):
                    error.args = (f"{error}; the mirror is parked",)
                    report.ended = f"error: {error}"
            except Exception as unsafe:  # also one of a driver
                report.warnings.append(str(unsafe))
                if isinstance(error, AolinkError):
                    error.args = (f"{error}; the mirror may not be parked: {unsafe}",)
            with contextlib.suppress(Exception):
                loop.close_account()
            with contextlib.suppress(Exception):
                loop.finish_estimates(TIMEOUTS.estimates_s if isinstance(error, PortError | DeviceError) else 0.0)
            if not (isinstance(error, PortError | DeviceError) and stop()):
                with contextlib.suppress(AolinkError):
                    writer.close(report.counts())
                said = list(writer.notes)
                if isinstance(error, PortError | DeviceError) or not writer.paths:
                    said.insert(0, _saved(report, writer))
                if isinstance(error, AolinkError):
                    error.args = ("; ".join([str(error), *said]),)
                raise
            # The session was to end anyway, so a device that no longer answers is only a warning.
            report.ended = "interrupted"
            report.warnings.append(str(error))
        writer.close(report.counts())
    report.files = [str(each) for each in writer.paths if each.exists()]
    report.warnings += writer.notes
    report.warnings += [
        f"{each} was removed or moved after it was complete" for each in writer.paths if not each.exists()
    ]
    if not writer.paths:
        report.warnings.append(f"no exposure came: {path} is as it was")
    return report


@contextlib.contextmanager
def _closed_at_last(writer: RecordingWriter, report: Report) -> Iterator[None]:
    """Whatever ends the session, its recording gets its index and facts."""
    try:
        yield
    except BaseException as error:
        report.ended = report.ended if report.ended.startswith("error") else f"error: {error!r}"
        with contextlib.suppress(AolinkError):
            writer.close(report.counts())  # this does nothing where it was closed
        raise


def _make_safe(loop: SessionLoop) -> None:
    """Park the mirror, again after each interruption, until it has confirmed that or an error says that it cannot be
    reached."""
    while True:
        with contextlib.suppress(Interrupted, KeyboardInterrupt):
            return loop.make_safe()


@contextlib.contextmanager
def _spared_collections() -> Iterator[None]:
    """Leave all objects that exist by now out of Python's garbage collections until the session's end: to go through
    them stops every thread for longer than a block of commands lasts. For the same reason none is made before."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextlib.contextmanager
def _progress_aside(progress: Callable[[int], None], report: Report) -> Iterator[None]:
    """Report the progress on a thread of its own: a terminal that takes no output would hold up the loop."""
    ended, failed = threading.Event(), list[Exception]()

    def run() -> None:
        try:
            while not ended.wait(TIMEOUTS.progress_s):
                progress(report.exposures)
            progress(report.exposures)
        except Exception as error:  # a session must not end because its picture fails
            failed.append(error)

    thread = threading.Thread(target=run, name="aolink-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(TIMEOUTS.last_progress_s)
        report.warnings += [f"the progress of this session could not be shown: {error}" for error in failed]
