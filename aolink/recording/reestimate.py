"""New estimates from a recording, by the same code as in a live session."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from aolink.errors import RecordingError
from aolink.estimation import Driver, Engine, Estimate, Score, Scorer
from aolink.estimation.estimate import COMPARED
from aolink.estimation.registry import retired
from aolink.exporting.common import Progress, no_progress
from aolink.exposure import Exposure
from aolink.files import writing
from aolink.recording import schemas_pb2, topics
from aolink.recording.editing import RecordingCopy, recorded_estimate
from aolink.recording.exposures import ExposureAssembly
from aolink.recording.messages import END_OF_TIME, RawMessage
from aolink.recording.reader import Recording
from aolink.recording.side_files import check_stands_alone

_AT_ONCE = 512
"""The most exposures that are estimated together."""
_BYTES_AT_ONCE = 4 << 20
"""The most bytes of messages that wait for them."""


def reestimate(
    recording: Recording, names: Sequence[str], progress: Progress = no_progress, *, as_recorded: bool = False
) -> dict[str, list[Estimate]]:
    """Run estimators over a recording; gives the estimates by name, one for each exposure.

    With ``as_recorded`` an estimator skips the exposures that it had no time for in the session, and gives the same
    bits as there.

    Raises
    ------
    EstimatorError
        There is no such estimator, or it cannot work on this rig.
    """
    estimates: dict[str, list[Estimate]] = {name: [] for name in names}
    for _, each in reestimated(recording, names, progress, as_recorded=as_recorded):
        for estimate in each:
            estimates[estimate.estimator].append(estimate)
    return estimates


def reestimated(
    recording: Recording, names: Sequence[str], progress: Progress = no_progress, engine: Engine = "aolink", *,
    as_recorded: bool = False,
) -> Iterator[tuple[Exposure, list[Estimate]]]:  # fmt: skip
    """The estimates of `reestimate`, exposure by exposure, in the order of ``names``; nothing stays in memory."""
    driver = Driver(recording.rig, names, engine, skipped_by(recording, names) if as_recorded else None)
    for number, done in enumerate(driver.steps(recording.exposures()), 1):
        yield done
        progress(number)


class Reestimated(Recording):
    """The estimates that a recording has, made again each time they are read: `compare` takes it as a second recording,
    and nothing is written. An estimator skips the exposures that it had no time for in the session.
    """

    def __init__(self, recording: Recording, names: Iterable[str]) -> None:
        super().__init__(recording.path)
        self._source = recording
        self.counts = {topics.estimate_topic(name): recording.n_frames for name in names}

    def raw_messages(
        self, *wanted: str, start_ns: int = 0, end_ns: int = END_OF_TIME, first_chunk: int = 0
    ) -> Iterator[RawMessage]:
        names = [topic.removeprefix(topics.ESTIMATE) for topic in wanted or self.counts]
        for exposure, estimates in reestimated(self._source, names, as_recorded=True):
            for estimate in estimates:
                yield recorded_estimate(estimate, exposure.host_receive_ns)


def own_estimators(recording: Recording, say: Callable[[str], None]) -> list[str]:
    """The estimators of a recording that can run again; ``say`` gets a line about each of an earlier version."""
    for reason in filter(None, map(retired, recording.estimators)):
        say(f"{recording.path.name} has estimates that are not made again: {reason}")
    return [name for name in recording.estimators if not retired(name)]


def skipped_by(recording: Recording, names: Sequence[str]) -> dict[str, frozenset[int]]:
    """Frame ids of the exposures that estimators skipped in the session, by the names of those that skipped any."""
    return {name: skipped for name in names if (skipped := recording.skipped(name))}


def scored(recording: Recording, names: Sequence[str]) -> dict[str, Score]:
    """Scores of the estimates in a recording against its truth, by name; one exposure at a time is in memory."""
    scorers = {name: Scorer() for name in names}
    for exposure, estimates in recording.with_estimates(names):
        for estimate in estimates:
            if estimate is not None:
                scorers[estimate.estimator].add(exposure, estimate)
    return {name: scorer.result() for name, scorer in scorers.items()}


def scored_and_compared(
    recording: Recording, series: Iterable[tuple[Exposure, Sequence[Estimate]]], names: Sequence[str]
) -> tuple[dict[str, Score], dict[str, str | None]]:
    """Scores by name, and where estimates first differ from those in the recording, for the names that it has.

    With another rig than the recording's own there are no estimates to compare with.
    """
    scorers = {name: Scorer() for name in names}
    skipped = skipped_by(recording, names)
    made_before = recording.estimators if recording.rig_is_recorded else []
    recorded = {name: recording.iter_estimates(name) for name in names if name in made_before and name not in skipped}
    differences: dict[str, str | None] = dict.fromkeys(recorded)
    for name, frames in skipped.items():
        differences[name] = (
            f"the session had no time for {len(frames)} exposures, all are estimated here;"
            " `aolink compare` makes the others again as they were"
        )
    count = 0
    for count, (exposure, each) in enumerate(series, 1):
        for estimate in each:
            name = estimate.estimator
            scorers[name].add(exposure, estimate)
            if name in recorded and differences[name] is None:
                theirs = next(recorded[name], None)
                differences[name] = first_difference([theirs] if theirs else [], [estimate])
                if theirs is None:
                    differences[name] = f"{count - 1} estimates against more"
    for name, rest in recorded.items():
        if differences[name] is None and (more := sum(1 for _ in rest)):
            differences[name] = f"{count + more} estimates against {count}"
    return {name: scorer.result() for name, scorer in scorers.items()}, differences


def check_has_exposures(recording: Recording) -> None:
    """Raise RecordingError if there is nothing to estimate."""
    check_stands_alone(recording)
    if not (recording.counts.get(topics.EXPOSURE) and recording.counts.get(topics.IMAGE)):
        raise RecordingError(
            f"{recording.path} holds no exposure, which is a message on {topics.EXPOSURE} and one on {topics.IMAGE}:"
            " there is nothing to estimate; `aolink info` says what it holds"
        )


def write_reestimated(
    recording: Recording, names: Sequence[str], path: str | Path, *, only: bool = False, overwrite: bool = False,
    progress: Progress = no_progress, engine: Engine = "aolink",
) -> None:  # fmt: skip
    """Copy a recording with new estimates.

    Estimates by other names, and pictures restored with them, stay in the copy, unless ``only``; those that were made
    with another rig than ``recording.rig`` could not be read in it and are left out. Messages of other software are
    copied unchanged. The same recording and the same version of aolink give the same bytes.

    Raises
    ------
    RecordingError
        ``path`` exists and not ``overwrite``, or cannot be written.
    """
    with writing(Path(path), overwrite=overwrite, sources=recording.files, error=RecordingError) as partial:
        fill_reestimated(recording, names, partial, only, progress, engine)


def fill_reestimated(
    recording: Recording, names: Sequence[str], path: Path, only: bool = False, progress: Progress = no_progress,
    engine: Engine = "aolink",
) -> None:  # fmt: skip
    """Write the content of `write_reestimated` into an empty file that is there already. Raises OSError for errors of
    the disk."""
    kept = kept_estimators(recording, names, only=only)
    notes = recording.metadata | {
        "aolink_version": version("aolink"),
        "estimators": " ".join([*kept, *names]),
        "estimated_from": recording.path.name,
        "recorded_with": recording.metadata.get("aolink_version", "unknown"),
    }
    if engine != "aolink":
        notes["engine"] = engine
    with RecordingCopy(recording, path, notes) as copy:
        for some in _with_estimates(recording, Driver(recording.rig, names, engine), kept):
            copy.add(some)
            progress(copy.exposures)
        copy.finish(recording.losses)


def kept_estimators(recording: Recording, names: Sequence[str], *, only: bool) -> list[str]:
    """The estimators whose estimates stay in a copy of a recording with new estimates by ``names``."""
    if only or not recording.rig_is_recorded:
        return []
    return [name for name in recording.estimators if name not in names]


def _without_old_estimates(recording: Recording, kept: Sequence[str]) -> Iterator[RawMessage]:
    """The messages of a recording, with the estimates, skipped exposures and restored pictures of the estimators
    ``kept`` only."""
    restored_with = ""
    for raw in recording.raw_messages():
        if raw.topic == topics.RESTORATION:  # it comes before its pictures
            message = recording.decoded(raw)
            restored_with = message.estimator if isinstance(message, schemas_pb2.Restoration) else ""
        if raw.topic.startswith(topics.RESTORED) and restored_with not in kept:
            continue
        if raw.topic.startswith(topics.ESTIMATE) and raw.topic.removeprefix(topics.ESTIMATE) not in kept:
            continue
        if raw.topic.startswith(topics.ESTIMATION) and raw.topic.removeprefix(topics.ESTIMATION) not in kept:
            continue
        yield raw


def _with_estimates(recording: Recording, driver: Driver, kept: Sequence[str]) -> Iterator[RawMessage]:
    """The messages of a recording with new estimates after their exposures, and the old estimates of ``kept``."""
    assembly = ExposureAssembly(recording.rig)
    waiting: list[tuple[RawMessage, list[Exposure]]] = []
    exposures = size = 0
    for raw in _without_old_estimates(recording, kept):
        message = recording.decoded_run(raw) or recording.decoded(raw)
        completed = assembly.take(raw.topic, message)
        if message is None and raw.schema in topics.SCHEMAS:
            continue  # it is one of the losses, and completes nothing
        waiting.append((raw, completed))
        exposures, size = exposures + len(completed), size + len(raw.data)
        if exposures >= _AT_ONCE or size >= _BYTES_AT_ONCE:
            yield from _estimated(driver, waiting)
            waiting, exposures, size = [], 0, 0
    if waiting:
        waiting[-1][1].extend(assembly.flush())
        yield from _estimated(driver, waiting)


def _estimated(driver: Driver, messages: Sequence[tuple[RawMessage, list[Exposure]]]) -> Iterator[RawMessage]:
    """Messages, each with the estimates of the exposures that it completes, which are made in order."""
    made = driver.steps(exposure for _, completed in messages for exposure in completed)
    for raw, completed in messages:
        yield raw
        for _ in completed:
            for estimate in next(made)[1]:
                yield recorded_estimate(estimate, raw.log_time_ns)


def first_difference(ours: Sequence[Estimate], theirs: Sequence[Estimate]) -> str | None:
    """The first difference between two runs of an estimator, in words; None if they agree bit for bit."""
    if len(ours) != len(theirs):
        return f"{len(ours)} estimates against {len(theirs)}"
    for mine, other in zip(ours, theirs, strict=True):
        for name in COMPARED:
            a, b = getattr(mine, name), getattr(other, name)
            if isinstance(a, np.ndarray):
                same = a.shape == b.shape and a.tobytes() == b.tobytes()
            else:
                same = a == b
            if not same:
                return f"frame {mine.frame_id}: {name} differs"
    return None
