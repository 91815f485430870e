"""The reader of recordings: decoded messages, exposures that are made of them, estimates."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from aolink.arguments import path as path_of
from aolink.errors import RecordingError, RigError
from aolink.estimation import ExposureModel, exposure_model
from aolink.limits import load_array
from aolink.recording import convert, schemas_pb2, topics
from aolink.recording.exposures import ASSEMBLED, BESIDE, Walk
from aolink.recording.frame_index import FrameIndex, StepRun
from aolink.recording.messages import END_OF_TIME, RawMessage, RecordedMessage, RecordedMessages, in_time
from aolink.recording.scan import Loss
from aolink.recording.side_files import check_is_side_of
from aolink.recording.sound import what_is_wrong
from aolink.rig import Rig, parse_rig
from aolink.series import NOTHING, Also, Series, Step
from aolink.wire.messages_pb2 import Applied, CommandBlock
from aolink.wire.runs_pb2 import Run

if TYPE_CHECKING:
    from aolink.restoration import RestoredPictures


def opened(recording: Recording | str | Path) -> Recording:
    """A recording, or the one of a path. Raises AolinkError for anything else."""
    return recording if isinstance(recording, Recording) else Recording(path_of(recording, "a recording"))


class Recording(RecordedMessages, Series):
    """A recording on disk, read piece by piece, so files may be larger than the memory.

    It is a series of exposures: a loop over it gives them, and so do its length, numbers and slices. The numbers are
    those of the frames in the file's index.

    A complete file is read by its index. One that was cut off or damaged is scanned for its undamaged parts; `losses`
    lists the others.

    Parameters
    ----------
    path:
        The file.
    rig:
        A rig to use instead of the one in the file, so that new estimates are made with another model. Estimates in the
        file cannot be read with it.
    check:
        Read every byte at once, so that `losses` is known from the start. Without it, damage in the
        middle of a file that has its index is noticed when it is read.
    side:
        Side files of the recording, which hold estimates of it alone: their estimates replace those of the same
        estimators in the file, as in a copy with new estimates, and their rig replaces the file's.

    Raises
    ------
    RecordingError
        The file cannot be read, or is not a recording of aolink; a side file is not of this recording, or two of them
        were made with different rigs.
    """

    def __init__(
        self, path: str | Path, *, rig: Rig | None = None, check: bool = False,
        side: Sequence[str | Path] = (),
    ) -> None:  # fmt: skip
        super().__init__(path, check=check)
        rig_text = self.rig_text
        if rig_text is None:
            raise RecordingError(f"{self.path} is an MCAP file but not a recording of aolink: it holds no rig file")
        self._unusable: dict[tuple[str, str], dict[tuple[int, int], int]] = {}
        """Messages that are not of their kind, by topic and kind of error: sequence, log time and length."""
        try:
            recorded_rig = _parsed_rig(rig_text)
        except RigError as error:
            if rig is None:
                raise RecordingError(f"{self.path} holds a rig file that this aolink does not take: {error}") from None
        else:
            _check_replaces(rig, recorded_rig, self.path)
        self.rig: Rig = rig or recorded_rig
        self.rig_is_recorded = self.rig.toml == rig_text
        """Whether ``rig`` is the one in the file, so that the estimates in the file can be read with it."""
        self._side: list[Recording] = []
        if check:
            deque(self.sound_messages(), maxlen=0)
        self._side = [Recording(each, check=check) for each in side]
        if self._side:
            self._take_side(rig)
        Series.__init__(self, self)

    @property
    def losses(self) -> list[Loss]:
        """The parts that could not be read, so far as the file has been read, in the order of the file; messages that
        are not of their kind come after them."""
        found = super().losses
        for (topic, wrong), messages in self._unusable.items():
            times = [time_ns for _, time_ns in messages]
            what = f"{len(messages)} message(s) on {topic} {wrong}"
            found.append(Loss(0, sum(messages.values()), what, min(times), max(times), len(messages)))
        return found + [loss for each in self._side for loss in each.losses]

    @property
    def files(self) -> list[Path]:
        """The files that it is read from: no file made from it may replace them."""
        return [self.path, *(side.path for side in self._side)]

    @property
    def estimators(self) -> list[str]:
        """Names of the estimators whose results are in the file."""
        return [name.removeprefix(topics.ESTIMATE) for name in self.counts if name.startswith(topics.ESTIMATE)]

    @property
    def has_truth(self) -> bool:
        """Whether the file has the truth."""
        return topics.TRUTH in self.counts

    @property
    def n_frames(self) -> int:
        """Number of the camera's frames in the file."""
        return self.counts.get(topics.IMAGE, 0)

    @cached_property
    def model(self) -> ExposureModel:
        """The exposure model that expands the recorded coefficients into paths."""
        return exposure_model(self.rig.plant, self.rig.window_steps)

    def messages(self, *wanted: str, start_ns: int = 0, end_ns: int = END_OF_TIME) -> Iterator[RecordedMessage]:
        """The messages of some topics (of all, if none is named) in the order in which they were recorded.

        With ``start_ns`` (inclusive) and ``end_ns`` (exclusive) only those whose log time is between them; with
        an index, the rest of the file is not read.
        """
        for raw in self.raw_messages(*wanted, start_ns=start_ns, end_ns=end_ns):
            if (message := self.decoded(raw)) is not None:
                yield RecordedMessage(raw.topic, raw.log_time_ns, raw.sequence, message)

    def decoded(self, raw: RawMessage) -> Message | None:
        """The decoded message; None if aolink does not know its kind, or, as a loss, if it cannot be decoded."""
        kind = topics.SCHEMAS.get(raw.schema)
        if kind is None:
            return None
        try:
            message = kind.FromString(raw.data)
        except DecodeError:
            message = None
        if message is None or (wrong := what_is_wrong(message, self.rig, raw.topic)):
            what = "cannot be decoded" if message is None else f"cannot be used: {wrong}"
            self._unusable.setdefault((raw.topic, what), {})[raw.sequence, raw.log_time_ns] = len(raw.data)
            return None
        return message

    def sound_messages(self) -> Iterator[tuple[RawMessage, Message | None]]:
        """All messages as bytes, each with its decoded message, which is None if aolink does not know the kind. Those
        that cannot be used are left out, as losses."""
        for raw in self.raw_messages():
            if (message := self.decoded(raw)) is not None or raw.schema not in topics.SCHEMAS:
                yield raw, message

    def decoded_run(self, raw: RawMessage) -> Run | None:
        """A command or a report of the mirror, with its inputs as bytes; None for another message, or one of another
        layout."""
        if topics.RUNS.get(raw.topic) != raw.schema:
            return None
        try:
            run = Run.FromString(raw.data)
        except DecodeError:
            return None
        # A writer may have split the row, or written each number by itself: the message's own class decodes those.
        return None if what_is_wrong(run, self.rig) else run

    def raw_messages(
        self, *wanted: str, start_ns: int = 0, end_ns: int = END_OF_TIME, first_chunk: int = 0
    ) -> Iterator[RawMessage]:
        """The messages as bytes, with those of other software too, selected as by `messages`; with an index, from one
        of its chunks on."""
        own = self.own_messages(wanted, start_ns, end_ns, slice(first_chunk, None))
        if not self._side:
            return own
        others = (each.raw_messages(*wanted, start_ns=start_ns, end_ns=end_ns) for each in self._side)
        timed = heapq.merge(*map(in_time, (own, *others)), key=lambda each: each[0])
        return (raw for _, raw in timed)

    def __len__(self) -> int:
        return self.n_frames

    def facts(self) -> dict[str, str]:
        """The summary of the recording, in words."""
        return super().facts() | ({"damage": self.damage} if self.damage else {})

    def steps(
        self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
    ) -> Iterator[Step]:
        """One pass over the file: the exposures in order, with their truth, their scene and their estimates.

        Parameters
        ----------
        names:
            The estimators whose estimates are wanted.
        start, stop:
            Numbers of the exposures that are wanted, counted from 0, from the former to below the latter; None: to the
            last.
        also:
            Functions that get the messages of other topics as they are read, by topic.
        """
        if stop is not None and stop <= start:
            return
        for step in self._walk(names, *self._beginning(start), also):
            if step.number >= start and (stop is None or step.number < stop):
                yield step
            if stop is not None and step.number >= stop - 1:
                return

    def _walk(self, names: Sequence[str], first_chunk: int, before: int, also: Also = NOTHING) -> Iterator[Step]:
        """The steps that the messages of a chunk and of later ones complete, in a file with an index; ``before`` is the
        number of frames before that chunk."""
        now, walk = 0, Walk(self.rig, names, self.counts, lambda: self.model, before)
        of_names = [topic for name in names for topic in (topics.estimate_topic(name), topics.estimation_topic(name))]
        for raw in self.raw_messages(*{*ASSEMBLED, *BESIDE, *of_names, *also}, first_chunk=first_chunk):
            now, see = raw.log_time_ns, also.get(raw.topic)
            message = (None if see else self.decoded_run(raw)) or self.decoded(raw)
            if see and message is not None:
                see(raw.topic, now, message)
            yield from walk.take(raw.topic, raw.log_time_ns, message)
        yield from walk.flush(now)

    def _beginning(self, number: int) -> tuple[int, int]:
        """The chunk to read from so that an exposure is the same as if read from the file's start, and the number of
        frames before it.

        An exposure's inputs begin where those of the one before it ended. The latter are certain if the mirror reported
        all of them; otherwise they may depend on the exposure before, and so on.
        """
        index, back = self._frame_index if number else None, 1
        while index is not None and number - back > 0:
            first = number - back
            chunk = index.chunk_of(first)
            infos = self.own_messages((topics.EXPOSURE,), chunks=slice(chunk, chunk + 1))
            info = next(islice(map(self.decoded, infos), first - index.before[chunk], None), None)
            if not isinstance(info, schemas_pb2.ExposureInfo):
                break
            # Reports come in the order of their steps. Commands may be replaced by others of the same steps, but none
            # is for a step beyond the mirror's queue.
            reach = {topics.APPLIED: info.first_step, topics.COMMAND: info.first_step - self.rig.mirror.queue_steps}
            reach = {topic: step for topic, step in reach.items() if self.counts.get(topic)}
            chunk = index.first_chunk(first, reach, self._runs_in)
            found = self._walk((), chunk, index.before[chunk])
            known = next((each for each in found if each.number >= first), None)
            if known is None:
                break
            if known.number == first and not known.exposure.inputs_assumed:
                return chunk, index.before[chunk]
            back *= 2
        return 0, 0

    @cached_property
    def _frame_index(self) -> FrameIndex | None:
        """The index of frames; None where the file has no index, or one without the messages' places."""
        if self.chunk_index is None or self.lost or self.counts.get(topics.EXPOSURE) != self.n_frames:
            return None
        frames = {channel for channel, (topic, _) in self.channels.items() if topic == topics.EXPOSURE}
        index = FrameIndex.of(self.chunk_index, frames)
        return index if index is not None and index.before[-1] == self.n_frames else None

    def _runs_in(self, chunk: int) -> Iterator[StepRun]:
        """The commands and reports in a chunk."""
        for raw in self.own_messages(tuple(topics.RUNS), chunks=slice(chunk, chunk + 1)):
            message = self.decoded_run(raw) or self.decoded(raw)
            if isinstance(message, Run | Applied | CommandBlock):
                yield raw.topic, message.first_step + message.n_steps

    @property
    def true_scene(self) -> NDArray[np.uint16] | None:
        """Counts that the picture sensor would read of the scene at rest, without noise; None where it is not known.

        Raises RecordingError if the attachment is something else.
        """
        data = self.attachments.get(topics.TRUE_SCENE_ATTACHMENT)
        if data is None or self.rig.scene is None:
            return None
        try:
            counts = load_array(data)
        except (ValueError, EOFError, OSError):
            counts = np.zeros(0)
        if counts.shape != self.rig.scene.shape or counts.dtype != np.uint16:
            raise RecordingError(f"{self.path}: the attachment {topics.TRUE_SCENE_ATTACHMENT} is not the rig's scene")
        return np.asarray(counts)

    def restored(self) -> Iterator[RestoredPictures]:
        """The restored pictures that `aolink deblur` wrote, exposure by exposure."""
        found = Restorations()
        for recorded in self.messages(*Restorations.TOPICS):
            found.take(recorded.topic, recorded.log_time_ns, recorded.message)
            yield from found.whole()
        yield from found.whole(ended=True)

    def _take_side(self, rig: Rig | None) -> None:
        """Put the estimates of side files in the place of the file's own."""
        for each in self._side:
            check_is_side_of(each, self)
        texts = {each.rig.toml for each in self._side} | ({rig.toml} if rig else set())
        if len(texts) > 1:
            raise RecordingError(
                f"the side files of {self.path} were made with different rig files, or with another than is asked for:"
                " give those of one"
            )
        replaced = {topics.estimate_topic(name) for each in self._side for name in each.estimators}
        other_rig = self._side[0].rig.toml != self.rig_text
        own = {topic for topic in self.counts if topic.startswith(topics.ESTIMATE)}
        gone = own if other_rig else own & replaced
        # Pictures were restored with some of these estimates; only reading all of them would show which.
        self.left_out = frozenset(
            {*gone, *(topics.estimation_topic(topic.removeprefix(topics.ESTIMATE)) for topic in gone)}
            | {topic for topic in self.counts if gone and topic.startswith(topics.RESTORED)}
        )
        self.counts = {topic: count for topic, count in self.counts.items() if topic not in self.left_out}
        for each in self._side:
            self.counts |= each.counts
            self.schemas = each.schemas | self.schemas
            self.encodings |= each.encodings
        self.rig, self.rig_is_recorded = self._side[0].rig, True


@lru_cache(maxsize=8)
def _parsed_rig(text: str) -> Rig:
    """The rig of a file. Thousands of recordings may have the same rig, whose exposure model is then made only once."""
    return parse_rig(text)


class Restorations:
    """Restored pictures, put together from a recording's messages as they are read."""

    TOPICS = (topics.RESTORATION, topics.RESTORED_SCENE, topics.RESTORED_SPOTS)

    def __init__(self) -> None:
        self._found: list[tuple[schemas_pb2.Restoration, dict[str, RawImage]]] = []

    def take(self, topic: str, time_ns: int, message: Message) -> None:
        """Take a message on one of the topics."""
        if isinstance(message, schemas_pb2.Restoration):
            self._found.append((message, {}))
        elif isinstance(message, RawImage) and self._found:
            self._found[-1][1][topic] = message

    def whole(self, *, ended: bool = False) -> Iterator[RestoredPictures]:
        """The pictures that are whole, each once; the last are whole with the next, or when the messages ended."""
        while len(self._found) > (not ended):
            info, pictures = self._found.pop(0)
            scene, spots = pictures.get(topics.RESTORED_SCENE), pictures.get(topics.RESTORED_SPOTS)
            yield convert.restored_from_messages(info, scene, spots)


def _check_replaces(rig: Rig | None, recorded: Rig, path: Path) -> None:
    """Raise RigError where another rig cannot stand in for the one that a recording was made with."""
    if rig is None:
        return
    for name, ours, theirs in (
        ("mirror inputs", rig.n_inputs, recorded.n_inputs),
        ("rows and columns of pixels", rig.sensor.shape, recorded.sensor.shape),
        ("rows and columns of scene.pixels", _scene_shape(rig), _scene_shape(recorded)),
        ("fast steps in an exposure", rig.timing.exposure_steps, recorded.timing.exposure_steps),
        ("seconds in a fast step", rig.timing.fast_step_s, recorded.timing.fast_step_s),
    ):
        if ours != theirs:
            raise RigError(f"the rig file has {ours} {name}, but {path} was recorded with {theirs}")


def _scene_shape(rig: Rig) -> tuple[int, int]:
    return rig.scene.shape if rig.scene else (0, 0)
