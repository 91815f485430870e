"""Live sessions: devices, recorder and estimators joined."""

from __future__ import annotations

import contextlib
import io
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aolink.devices.native import NativeCamera, NativeMirror, check_against_rig, check_kind, identify
from aolink.errors import AolinkError, DeviceError, PortError
from aolink.estimation import Driver
from aolink.recording import topics
from aolink.recording.mcap_file import WriteOptions
from aolink.recording.writer import RecordingWriter
from aolink.rig import Drive, Rig
from aolink.scene import framed, read_scene_picture
from aolink.session.loop import Inputs, SessionLoop, Watch
from aolink.session.report import Report
from aolink.wire import messages_pb2 as wire
from aolink.wire.hub import Hub
from aolink.wire.port import SerialPort

__all__ = ["Opened", "Report", "open_devices", "record"]


class Opened(NamedTuple):
    """Both devices of a rig, identified."""

    hub: Hub
    camera: NativeCamera
    mirror: NativeMirror
    warnings: list[str]
    """What is doubtful about them, in words."""


@contextlib.contextmanager
def open_devices(
    rig: Rig, camera_port: str, mirror_port: str, stop: Callable[[], bool] = lambda: False
) -> Iterator[Opened]:
    """Open both ports, identify what is behind them, and check it against the rig file.

    Raises
    ------
    PortError
        A port cannot be opened.
    DeviceError
        No device answers, it is another one, speaks another protocol, or is not what the rig file says.
    """
    hub = Hub(stop)
    try:
        camera_link = hub.connect("camera", SerialPort(camera_port))
        mirror_link = hub.connect("mirror", SerialPort(mirror_port))
        camera_identity = identify(hub, camera_link, secrets.randbits(48))
        check_kind(camera_link, camera_identity, wire.Identity.CAMERA)
        mirror_identity = identify(hub, mirror_link, secrets.randbits(48))
        check_kind(mirror_link, mirror_identity, wire.Identity.MIRROR)
        warnings = check_against_rig(rig, camera_identity, mirror_identity)
        if camera_identity.virtual_time:
            hub.go_virtual()
        for link in hub.links:
            link.reset_counts()
        yield Opened(
            hub,
            NativeCamera(hub, camera_link, camera_identity),
            NativeMirror(hub, mirror_link, mirror_identity),
            warnings,
        )
    finally:
        hub.close()


def _true_scene(rig: Rig, camera: NativeCamera) -> dict[str, bytes]:
    """The scene at rest as an attachment, where the camera was made from this rig file: a simulated one shows it."""
    if rig.scene is None or not rig.scene.picture or camera.identity.rig_digest != rig.digest:
        return {}
    data = io.BytesIO()
    np.save(data, rig.scene.to_counts(framed(rig.scene, read_scene_picture(rig.scene, rig.folder))))
    return {topics.TRUE_SCENE_ATTACHMENT: data.getvalue()}


def _saved(report: Report, paths: Sequence[Path]) -> str:
    """What a session that an error ended has left, in words."""
    where = str(paths[-1]) if len(paths) == 1 else f"{len(paths)} files, the last of them {paths[-1]}"
    if not report.exposures:
        return f"no exposure had come by then, {where} holds none"
    return f"the {report.exposures} exposure(s) that had come by then are saved in {where}"


def record(
    rig: Rig,
    camera_port: str,
    mirror_port: str,
    path: str | Path,
    *,
    estimators: Sequence[str] = (),
    exposures: int = 0,
    note: str = "",
    calibration: str = "",
    inputs: Inputs | None = None,
    watch: Watch | None = None,
    overwrite: bool = False,
    options: WriteOptions | None = None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda exposures: None,
) -> Report:
    """Record a session: play the rig's drive, record everything, run estimators on the way.

    Parameters
    ----------
    rig:
        What the devices are; checked against what they say of themselves.
    camera_port, mirror_port:
        Anything that pyserial opens: a device path, or an address such as socket://host:port.
    path:
        The recording; must not exist unless ``overwrite``.
    estimators:
        Names of estimators to run online; their results go into the recording.
    exposures:
        How many; 0 means until ``stop()``.
    calibration:
        What the camera is shown, of `aolink.calibration.KINDS`, if the frames are for `aolink calibrate`: the
        mirror then holds its parked input, whatever the rig's drive.
    inputs:
        What to command, instead of the rig's drive.
    watch:
        Told each exposure with its estimates, on the loop's own time.
    options:
        How the recording is cut into chunks and files.
    stop, progress:
        Asked, and told the number of exposures so far, at least ten times a second.

    Raises
    ------
    AolinkError
        Of the kind that says what went wrong. The mirror is parked if it can be reached, and the
        recording is closed with what there is.
    """
    estimators = list(dict.fromkeys(estimators))
    driver = Driver(rig, estimators)
    if calibration:
        rest = Drive(kind="none", amplitude=np.zeros(rig.n_inputs), period_s=1.0, offset=rig.mirror.park)
        rig = replace(rig, drive=rest)
    with open_devices(rig, camera_port, mirror_port, stop) as (hub, camera, mirror, warnings):
        start_ns = hub.now_ns()
        facts = {
            "session": f"{start_ns:x}",
            "aolink_version": version("aolink"),
            "rig": rig.name,
            "rig_digest": rig.digest,
            "camera": f"{camera.identity.model} {camera.identity.serial_number} ({camera.identity.firmware})",
            "mirror": f"{mirror.identity.model} {mirror.identity.serial_number} ({mirror.identity.firmware})",
            "virtual_time": str(hub.virtual),
            "estimators": " ".join(estimators),
            "note": note,
        }
        if calibration:
            facts[topics.CALIBRATION] = calibration
        attachments = _true_scene(rig, camera)
        writer = RecordingWriter(
            path, rig, facts, start_ns, overwrite=overwrite, deterministic=hub.virtual, attachments=attachments,
            options=options,
        )  # fmt: skip
        loop = SessionLoop(rig, hub, camera, mirror, writer, driver, inputs, watch)
        report = loop.report
        report.warnings += warnings
        try:
            loop.run(exposures, stop, progress)
        except BaseException as error:
            report.ended = f"error: {error}" if isinstance(error, AolinkError) else f"error: {error!r}"
            try:
                loop.make_safe()
            except AolinkError as unsafe:
                report.warnings.append(str(unsafe))
            if not (stop() and isinstance(error, PortError | DeviceError)):
                with contextlib.suppress(AolinkError):
                    writer.close(report.counts())
                if isinstance(error, PortError | DeviceError):
                    raise type(error)(f"{error}; {_saved(report, writer.paths)}") from None
                raise
            # It was to end anyway: that a device no longer answers is a warning.
            report.ended = "interrupted"
            report.warnings.append(str(error))
        writer.close(report.counts())
    report.files = [str(each) for each in writer.paths]
    return report
