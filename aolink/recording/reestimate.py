"""Estimates from a recording again, with the code that made them live."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import numpy as np

from aolink.estimation import Driver, Estimate
from aolink.recording import convert, topics
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter


def reestimate(
    recording: Recording, names: Sequence[str], progress: Callable[[int], None] = lambda exposures: None
) -> dict[str, list[Estimate]]:
    """Run estimators over a recording; gives the estimates by name, one for each exposure."""
    driver = Driver(recording.rig, names)
    estimates: dict[str, list[Estimate]] = {name: [] for name in names}
    for number, exposure in enumerate(recording.exposures(), 1):
        for estimate in driver.step(exposure):
            estimates[estimate.estimator].append(estimate)
        progress(number)
    return estimates


def write_reestimated(
    recording: Recording,
    names: Sequence[str],
    path: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int], None] = lambda exposures: None,
) -> None:
    """Copy a recording with new estimates in the place of those that it has.

    The same recording and the same version of aolink give the same bytes.

    Raises
    ------
    RecordingError
        ``path`` exists and not ``overwrite``, or cannot be written.
    """
    driver, done = Driver(recording.rig, names), 0
    metadata = recording.metadata | {
        "aolink_version": version("aolink"),
        "estimators": " ".join(names),
        "estimated_from": recording.path.name,
        "recorded_with": recording.metadata.get("aolink_version", "unknown"),
    }
    if recording.damage:
        metadata["damage"] = recording.damage
    with RecordingWriter(
        path, recording.rig, metadata, recording.start_ns, overwrite=overwrite, deterministic=True
    ) as writer:
        last_ns = recording.start_ns
        for recorded, exposures in recording.assembled():
            if recorded is not None and not recorded.topic.startswith(topics.ESTIMATE):
                writer.write(recorded.topic, recorded.message, recorded.log_time_ns)
                last_ns = recorded.log_time_ns
            for exposure in exposures:
                for estimate in driver.step(exposure):
                    message = convert.estimate_message(estimate)
                    writer.write(topics.estimate_topic(estimate.estimator), message, last_ns)
                done += 1
                progress(done)


def first_difference(ours: Sequence[Estimate], theirs: Sequence[Estimate]) -> str | None:
    """Where two runs of an estimator first differ, in words; None if they agree bit for bit."""
    if len(ours) != len(theirs):
        return f"{len(ours)} estimates against {len(theirs)}"
    for mine, other in zip(ours, theirs, strict=True):
        for field in fields(Estimate):
            a, b = getattr(mine, field.name), getattr(other, field.name)
            if isinstance(a, np.ndarray):
                same = a.shape == b.shape and a.tobytes() == b.tobytes()
            else:
                same = a == b
            if not same:
                return f"frame {mine.frame_id}: {field.name} differs"
    return None
