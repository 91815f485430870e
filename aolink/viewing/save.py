"""A whole recording as a Rerun file, with its layout inside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from aolink.colours import by_rank
from aolink.errors import ViewerError
from aolink.estimation.estimate import Estimate
from aolink.estimation.score import score
from aolink.exposure import Exposure
from aolink.optics.sensor import SpotSensor
from aolink.recording import topics
from aolink.recording.reader import check_stands_alone
from aolink.rig import Rig
from aolink.viewing import camera, devices, motion, scene
from aolink.viewing.blueprint import Contents, blueprint
from aolink.viewing.rrd_file import new_rrd
from aolink.viewing.timebase import Timebase

if TYPE_CHECKING:
    from aolink.recording.reader import RecordedMessage, Recording

APPLICATION = "aolink"
"""Rerun keeps a user's own layouts by this name."""


def save_rrd(
    recording: Recording, path: str | Path, *, overwrite: bool = False, progress: Callable[[int], None] | None = None
) -> Path:
    """Write a recording as an .rrd file that any Rerun viewer opens with aolink's layout.

    Its recording id in Rerun is the digest of the recording's bytes: the same recording opened twice is one there.

    Parameters
    ----------
    recording:
        A recording, as `aolink.read` opens it.
    path:
        The file to write; it appears only when it is whole.
    overwrite:
        Whether a file of that name may be replaced.
    progress:
        Is told how many parts are written: the frames, each estimator's, the devices'.

    Raises
    ------
    ViewerError
        The file exists already or cannot be written, or the recording has nothing to show.
    """
    path = Path(path)
    with new_rrd(APPLICATION, path, overwrite=overwrite, sources=recording.files, identity=recording.digest) as stream:
        contents = send_recording(stream, recording, progress or (lambda parts: None))
        # Active too: a viewer that gets the data over the network would otherwise keep a layout of its own.
        stream.send_blueprint(blueprint(contents), make_active=True, make_default=True)
        stream.send_recording_name(f"{recording.rig.name} · {recording.path.name}")
    return path


def send_recording(
    stream: rr.RecordingStream, recording: Recording, progress: Callable[[int], None] = lambda parts: None
) -> Contents:
    """Send everything in a recording to a stream; tells what there was, for the layout."""
    check_stands_alone(recording)
    rig = recording.rig
    exposures = list(recording.exposures())
    if strange := [e for e in exposures if e.pixels.shape != rig.sensor.shape]:
        raise ViewerError(
            f"frame {strange[0].frame_id} of {recording.path} has {strange[0].pixels.shape} pixels, the sensor of the"
            f" rig file in it {rig.sensor.shape}: it was recorded with another rig file"
        )
    timebase = Timebase.of(rig, exposures)
    truths = {e.frame_id: e.truth for e in exposures if e.truth is not None}
    names = by_rank(list(recording.estimators))
    estimates = {name: recording.estimates(name) for name in names}

    top = send_camera(stream, rig, timebase, exposures, estimates)
    motion.log_truth(stream, timebase, exposures)
    progress(1)
    for part, sequence in enumerate(estimates.values(), 2):
        motion.log_estimates(stream, timebase, sequence)
        motion.log_errors(stream, timebase, sequence, truths)
        progress(part)
    scenes = rig.scene is not None and scene.log_scenes(stream, rig.scene, timebase, exposures)
    restored = list(recording.restored())
    scenes_restored = scene.log_restored(stream, timebase, exposures, restored)
    true_scene = recording.true_scene
    if rig.scene is not None and true_scene is not None:
        scene.log_true_scene(stream, rig.scene, true_scene)
    stream.log(
        "session", rr.TextDocument(_summary(recording, exposures, estimates), media_type="text/markdown"), static=True
    )
    contents = Contents(
        rig=rig,
        estimators=names,
        measuring=[name for name, sequence in estimates.items() if any(e.innovation.shape[1] for e in sequence)],
        density_top=top,
        truth=bool(truths),
        scenes=list(compress(scene.SCENES, (scenes, scenes_restored, true_scene is not None))),
        restored_spots=any(each.spots is not None for each in restored),
        topics=_send_devices(stream, recording, timebase),
    )
    progress(len(names) + 2)
    return contents


def send_camera(
    stream: rr.RecordingStream,
    rig: Rig,
    timebase: Timebase,
    exposures: list[Exposure],
    estimates: Mapping[str, Sequence[Estimate]],
    *,
    top: float | None = None,
    since: int = 0,
) -> float:
    """Send frames, history and profiles of the exposures from number ``since`` on.

    Gives the density at the top of the profile's plot, found from the exposures if ``top`` is not given.
    """
    sensor = rig.sensor
    new = exposures[since:]
    outputs = {"truth": {e.frame_id: e.truth.path for e in exposures if e.truth is not None}}
    outputs |= {name: {e.frame_id: e.path for e in sequence} for name, sequence in estimates.items()}
    camera.log_frames(stream, timebase, new)
    if isinstance(sensor, SpotSensor):
        for name, by_frame in outputs.items():
            camera.log_spot_paths(stream, sensor, timebase, new, name, by_frame)
    # What follows is one slope over time: the first one.
    paths = {name: {k: path[0] for k, path in by_frame.items()} for name, by_frame in outputs.items()}
    line, seen = sensor.profile, camera.first_profiles(sensor, exposures)
    if top is None:
        top = camera.density_top(line, seen)
        camera.log_profile_axes(stream, line, top)
    camera.log_history(stream, line, timebase, seen, paths, top, since=since)
    camera.log_measured_profile(stream, line, timebase, seen[since:], top)
    for name, first in paths.items():
        camera.log_predicted_profile(stream, line, timebase, seen[since:], name, first, top)
    return top


def _send_devices(stream: rr.RecordingStream, recording: Recording, timebase: Timebase) -> frozenset[str]:
    """Send what does not come from exposures and estimates; the topics that had messages."""
    by_topic: dict[str, list[RecordedMessage]] = {
        topic: [] for topic in recording.counts if topics.named(topic).name in devices.LOGS
    }
    for record in recording.messages(*by_topic) if by_topic else ():
        by_topic[record.topic].append(record)
    for name, log in devices.LOGS.items():
        for topic, records in by_topic.items():
            if topics.named(topic).name == name and records:
                log(stream, timebase, records)
    return frozenset(by_topic)


def _summary(recording: Recording, exposures: list[Exposure], estimates: dict[str, list[Estimate]]) -> str:
    """What a session was and, where the truth is known, who was right: a page of Markdown."""
    rig = recording.rig
    steps = rig.timing.exposure_steps
    frames = exposures[-1].frame_id - exposures[0].frame_id + 1
    lines = [
        f"## {rig.name}",
        f"{len(exposures)} exposures of {steps} fast steps, {steps * rig.timing.fast_step_s:g} s each;"
        f" {frames - len(exposures)} frames lost.",
        "",
        "| estimator | path RMSE (slope units) | end state | NIS (95 % bounds) | gated |",
        "| --- | --- | --- | --- | --- |",
    ]
    by_frame = {e.frame_id: e for e in exposures}
    for name, sequence in estimates.items():
        known = [e for e in sequence if e.frame_id in by_frame]
        result = score([by_frame[e.frame_id] for e in known], known)
        path, end = (f"{x:.4f}" if result.exposures else "truth unknown" for x in (result.path_rmse, result.end_rmse))
        nis = result.nis
        shown = "" if np.isnan(nis.mean) else f"{nis.mean:.2f} ({nis.low:.2f} to {nis.high:.2f})"
        lines.append(f"| {name} | {path} | {end} | {shown} | {result.gated} of {len(known)} |")
    skipped = {name: n for name in estimates if (n := len(recording.skipped(name)))}
    if skipped:
        lines += ["", "Exposures skipped for want of time: " + ", ".join(f"{name} {n}" for name, n in skipped.items())]
    return "\n".join([*lines, "", rig.summary])
