"""Copy a recording with its pictures restored, each with the estimated path of its exposure."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.errors import RecordingError
from aolink.estimation import Estimate, Scorer
from aolink.exporting.common import Progress, no_progress
from aolink.exposure import Exposure
from aolink.files import check_target, writing
from aolink.numerics.workers import processes
from aolink.optics.scene import scene_motion
from aolink.recording import convert, schemas_pb2, topics
from aolink.recording.editing import RecordingCopy, recorded_estimate
from aolink.recording.messages import RawMessage
from aolink.recording.reader import Recording
from aolink.recording.reestimate import check_has_exposures, reestimated
from aolink.restoration import RestoredPictures, deblur, find_method
from aolink.restoration.deblur import blurred_psnr, psnr
from aolink.restoration.registry import DEFAULT_METHOD
from aolink.rig import Rig

_AHEAD = 4
"""Exposures handed out to each worker before the first of them is written."""


@dataclass(kw_only=True)
class RestoredCounts:
    """How many pictures were restored, and how well where the true scene is known."""

    exposures: int = 0
    scenes: int = 0
    """Scenes restored."""
    spots: int = 0
    """Exposures whose spots were restored."""
    reasons: Counter[str] = field(default_factory=Counter)
    """Reasons why pictures are missing, each with its number."""
    psnr_blurred: list[float] = field(default_factory=list)
    """Peak signal-to-noise ratio of each scene before restoration, moved back by its mean displacement, dB."""
    psnr_restored: list[float] = field(default_factory=list)
    expected_gains: list[float] = field(default_factory=list)
    """`RestoredPictures.expected_gain_db` of each exposure for which the method expects one, dB."""
    motion: Scorer = field(default_factory=Scorer)
    """Score of the estimates whose paths the pictures were restored with."""


def write_deblurred(
    recording: Recording, path: Path, *, estimator: str, method: str = DEFAULT_METHOD, overwrite: bool = False,
    workers: int = 0, progress: Progress = no_progress,
) -> RestoredCounts:  # fmt: skip
    """Copy a recording with its pictures restored.

    Everything else stays, byte for byte; restored pictures that it has are replaced, and estimates of ``estimator``
    are added if it has none. ``workers`` processes do the work, with one thread each; with 0 this process does it.

    Raises
    ------
    RecordingError
        There is no exposure; ``path`` exists and not ``overwrite``, or cannot be written.
    EstimatorError
        There is no such estimator, or it cannot work on this rig.
    RestorationError
        There is no such method.
    """
    check_has_exposures(recording)
    find_method(method)
    check_target(path, overwrite=overwrite, sources=recording.files, error=RecordingError)
    summary = RestoredCounts()
    made = _deblurred(recording.rig, _estimated(recording, estimator, summary), method, workers)
    held = next(made, None)  # an estimator that cannot work shows before the file is made
    notes = {
        "aolink_version": version("aolink"),
        "deblurred_from": recording.path.name,
        "deblurred_with": f"{estimator} {method}",
        "recorded_with": recording.metadata.get("aolink_version", "unknown"),
    }
    with (
        writing(path, overwrite=overwrite, sources=recording.files, error=RecordingError) as partial,
        RecordingCopy(recording, partial, recording.metadata | notes) as copy,
    ):
        _written(recording, copy, made, held, estimator, summary, progress)
    return summary


def _written(
    recording: Recording, copy: RecordingCopy, made: Iterator[tuple[Exposure, Estimate, RestoredPictures]],
    held: tuple[Exposure, Estimate, RestoredPictures] | None, estimator: str, summary: RestoredCounts,
    progress: Progress,
) -> None:  # fmt: skip
    true_scene, log_times = recording.true_scene, dict[int, int]()
    left_out: tuple[str, ...] = (topics.RESTORED,)
    if estimator not in recording.estimators:
        left_out += (topics.estimation_topic(estimator),)  # the estimates are new, and belong to all exposures

    def emit(exposure: Exposure, estimate: Estimate, done: RestoredPictures) -> None:
        log_time_ns = log_times.pop(exposure.frame_id, recording.end_ns)
        if estimator not in recording.estimators:
            copy.add(recorded_estimate(estimate, log_time_ns))
        for topic, message in _messages(done, exposure.host_start_ns):
            copy.add(RawMessage.of(topic, message, log_time_ns))
        _score(summary, recording.rig, true_scene, exposure, estimate, done)
        progress(summary.exposures)

    for raw, message in recording.sound_messages():
        if raw.topic == topics.EXPOSURE and isinstance(message, schemas_pb2.ExposureInfo):
            frame_id = message.frame_id
            # All messages that belong to the exposures before this one have gone by.
            while held is not None and held[0].frame_id < frame_id:
                emit(*held)
                held = next(made, None)
            log_times[frame_id] = raw.log_time_ns
        if not raw.topic.startswith(left_out):
            copy.add(raw)
    while held is not None:
        emit(*held)
        held = next(made, None)
    copy.finish(recording.losses)


def _estimated(recording: Recording, name: str, summary: RestoredCounts) -> Iterator[tuple[Exposure, Estimate]]:
    """Exposures with their recorded estimates, or with new ones where the recording has none of that name."""
    if name not in recording.estimators:
        for exposure, (estimate,) in reestimated(recording, [name]):
            yield replace(exposure, truth=None), estimate
        return
    for step in recording.steps([name]):
        if name in step.estimates:
            yield replace(step.exposure, truth=None), step.estimates[name]
        elif name in step.skipped:
            summary.reasons["the session had no time to estimate it: `aolink estimate -o` does"] += 1


def _deblurred(
    rig: Rig, series: Iterator[tuple[Exposure, Estimate]], method: str, workers: int
) -> Iterator[tuple[Exposure, Estimate, RestoredPictures]]:
    if not workers:
        for exposure, estimate in series:
            yield exposure, estimate, deblur(rig, exposure, estimate, method)
        return
    with processes(workers) as pool:
        waiting: deque[tuple[Exposure, Estimate, Future[RestoredPictures]]] = deque()
        for exposure, estimate in series:
            waiting.append((exposure, estimate, pool.submit(deblur, rig, exposure, estimate, method)))
            if len(waiting) > _AHEAD * workers:
                first, its, done = waiting.popleft()
                yield first, its, done.result()
        for exposure, estimate, done in waiting:
            yield exposure, estimate, done.result()


def _messages(done: RestoredPictures, time_ns: int) -> Iterator[tuple[str, Message]]:
    yield topics.RESTORATION, convert.restoration_message(done)
    for topic, picture in ((topics.RESTORED_SCENE, done.scene), (topics.RESTORED_SPOTS, done.spots)):
        if picture is not None:
            yield topic, convert.float_image(picture, time_ns)


def _score(
    summary: RestoredCounts, rig: Rig, true_scene: NDArray[np.uint16] | None, exposure: Exposure, estimate: Estimate,
    done: RestoredPictures,
) -> None:  # fmt: skip
    summary.exposures += 1
    summary.motion.add(exposure, estimate)
    summary.scenes += done.scene is not None
    summary.spots += done.spots is not None
    if not np.isnan(done.expected_gain_db):
        summary.expected_gains.append(done.expected_gain_db)
    if done.reason:
        summary.reasons[done.reason] += 1
    if true_scene is None or rig.scene is None or exposure.scene is None or done.scene is None:
        return
    scene = rig.scene.to_intensity(true_scene)
    displacement = (scene_motion(rig.n_outputs) @ estimate.path).mean(axis=1) / rig.scene.pixel_scale
    shift = np.rint(displacement).astype(np.intp)
    summary.psnr_blurred.append(blurred_psnr(rig.scene, exposure, shift, scene))
    summary.psnr_restored.append(psnr(done.scene.astype(np.float64), scene))
