"""New estimates from a recording, by the same code as in a live session."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from itertools import tee
from pathlib import Path

import numpy as np

from aolink.errors import RecordingError
from aolink.estimation import Driver, Estimate, Score, Scorer
from aolink.estimation.estimate import COMPARED
from aolink.exporting.common import Progress, no_progress
from aolink.exposure import Exposure
from aolink.files import writing
from aolink.recording import schemas_pb2, topics
from aolink.recording.editing import RecordingCopy, recorded_estimate
from aolink.recording.exposures import Walk
from aolink.recording.messages import END_OF_TIME, RawMessage
from aolink.recording.reader import Recording
from aolink.recording.side_files import check_stands_alone
from aolink.series import NOTHING, Also, Step

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
    recording: Recording, names: Sequence[str], progress: Progress = no_progress, *, as_recorded: bool = False
) -> Iterator[tuple[Exposure, list[Estimate]]]:
    """The estimates of `reestimate`, exposure by exposure, in the order of ``names``; nothing stays in memory."""
    skipped = Skipped(recording, names if as_recorded else ())
    driver = Driver(recording.rig, names, skipped.frames)
    for number, done in enumerate(driver.steps(skipped.exposures()), 1):
        yield done
        progress(number)


class Skipped:
    """The exposures that estimators had no time for in the session, as a pass over the recording finds them.

    ``frames`` has their frame ids, by the names of the estimators of which the recording tells.
    """

    def __init__(self, recording: Recording, names: Iterable[str]) -> None:
        told = [name for name in names if topics.estimation_topic(name) in recording.counts]
        self.frames: dict[str, set[int]] = {name: set() for name in told}

        self._recording = recording

    def exposures(self) -> Iterator[Exposure]:
        """The recording's exposures, each after it was noted who skipped it."""
        return (step.exposure for step in self.steps())

    def steps(self, also: Also = NOTHING) -> Iterator[Step]:
        """The same with what belongs to them; ``also`` as for `aolink.series.Series.steps`."""
        for step in self._recording.steps(list(self.frames), also=also):
            for name in step.skipped:
                self.frames[name].add(step.exposure.frame_id)
            yield step


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


def scored(recording: Recording, names: Sequence[str]) -> dict[str, Score]:
    """Scores of the estimates in a recording against its truth, by name; one exposure at a time is in memory."""
    scorers = {name: Scorer() for name in names}
    for exposure, estimates in recording.walk(names):
        for name, estimate in estimates.items():
            scorers[name].add(exposure, estimate)
    return {name: scorer.result() for name, scorer in scorers.items()}


def scored_anew(recording: Recording, names: Sequence[str], progress: Progress = no_progress) -> dict[str, Score]:
    """Run estimators over a recording, in one pass; gives their scores against its truth, by name."""
    scorers = {name: Scorer() for name in names}
    for number, (step, made) in enumerate(steps_estimated(recording, names), 1):
        for estimate in made:
            scorers[estimate.estimator].add(step.exposure, estimate)
        progress(number)
    return {name: scorer.result() for name, scorer in scorers.items()}


def steps_estimated(recording: Recording, names: Sequence[str]) -> Iterator[tuple[Step, list[Estimate]]]:
    """The steps of a recording, each with new estimates by ``names``; a batch of exposures at a time is in memory."""
    steps, ahead = tee(recording.steps())
    made = Driver(recording.rig, names).steps(step.exposure for step in ahead)
    yield from zip(steps, (estimates for _, estimates in made), strict=True)


def check_has_exposures(recording: Recording) -> None:
    """Raise RecordingError if there is nothing to estimate."""
    check_stands_alone(recording)
    if not (recording.counts.get(topics.EXPOSURE) and recording.counts.get(topics.IMAGE)):
        raise RecordingError(
            f"{recording.path} holds no exposure, which is a message on {topics.EXPOSURE} and one on {topics.IMAGE}:"
            " there is nothing to estimate; `aolink info` says what it holds"
        )


def write_reestimated(
    recording: Recording, names: Sequence[str], path: str | Path, *, overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Score]:  # fmt: skip
    """Copy a recording with new estimates; gives what `scored_anew` gives, from the same pass.

    Estimates by other names, and pictures restored with them, stay in the copy; those that were made with another rig
    than ``recording.rig`` could not be read in it and are left out. Messages of other software are
    copied unchanged. The same recording and the same version of aolink give the same bytes.

    Raises
    ------
    RecordingError
        ``path`` exists and not ``overwrite``, or cannot be written.
    """
    with writing(Path(path), overwrite=overwrite, sources=recording.files, error=RecordingError) as partial:
        kept = kept_estimators(recording, names)
        notes = recording.metadata | {
            "aolink_version": version("aolink"),
            "estimators": " ".join([*kept, *names]),
            "estimated_from": recording.path.name,
            "recorded_with": recording.metadata.get("aolink_version", "unknown"),
        }
        scorers = {name: Scorer() for name in names}
        with RecordingCopy(recording, partial, notes) as copy:
            for some in _with_estimates(recording, Driver(recording.rig, names), kept, scorers):
                copy.add(some)
                progress(copy.exposures)
            copy.finish(recording.losses)
        return {name: scorer.result() for name, scorer in scorers.items()}


def kept_estimators(recording: Recording, names: Sequence[str]) -> list[str]:
    """The estimators whose estimates stay in a copy of a recording with new estimates by ``names``."""
    if not recording.rig_is_recorded:
        return []
    return [name for name in recording.estimators if name not in names]


def _with_estimates(
    recording: Recording, driver: Driver, kept: Sequence[str], scorers: Mapping[str, Scorer]
) -> Iterator[RawMessage]:
    """The messages of a recording with new estimates after their exposures, and the old estimates, skipped exposures
    and restored pictures of the estimators ``kept``."""
    walk = Walk(recording.rig, (), recording.counts, lambda: recording.model)
    waiting: list[tuple[RawMessage | None, list[Exposure]]] = []
    steps, estimates = deque[Step](), deque[list[Estimate]]()
    exposures = size = now = 0
    restored_with = ""

    def estimated() -> Iterator[RawMessage]:
        made = driver.steps(exposure for _, completed in waiting for exposure in completed)
        for raw, completed in waiting:
            if raw is not None:
                yield raw
            for _ in completed:
                estimates.append(next(made)[1])
                yield from (recorded_estimate(each, raw.log_time_ns if raw else now) for each in estimates[-1])
        waiting.clear()

    def score() -> None:
        while steps and estimates:
            exposure = steps.popleft().exposure
            for estimate in estimates.popleft():
                scorers[estimate.estimator].add(exposure, estimate)

    for raw in recording.raw_messages():
        message = recording.decoded_run(raw) or recording.decoded(raw)
        steps.extend(walk.take(raw.topic, raw.log_time_ns, message))
        if raw.topic == topics.RESTORATION:  # it comes before its pictures
            restored_with = message.estimator if isinstance(message, schemas_pb2.Restoration) else ""
        if message is None and raw.schema in topics.SCHEMAS:
            continue  # it is one of the losses, and completes nothing
        of = restored_with if raw.topic.startswith(topics.RESTORED) else _estimator_of(raw.topic)
        if of is None or of in kept:
            waiting.append((raw, walk.completed))
            now = raw.log_time_ns
        exposures, size = exposures + len(walk.completed), size + len(raw.data)
        if exposures >= _AT_ONCE or size >= _BYTES_AT_ONCE:
            yield from estimated()
            score()
            exposures = size = 0
    steps.extend(walk.flush(now))
    waiting.append((None, walk.completed))
    yield from estimated()
    score()


def _estimator_of(topic: str) -> str | None:
    """The estimator that a topic is about; None where it is about none."""
    for prefix in (topics.ESTIMATE, topics.ESTIMATION):
        if topic.startswith(prefix):
            return topic.removeprefix(prefix)
    return None


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
