"""One pass over a recording's messages: exposures with their truth, their scene and their estimates."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message

from aolink.assembly import Assembler
from aolink.estimation import ExposureModel
from aolink.exposure import Exposure, Picture, Truth
from aolink.recording import convert, schemas_pb2, topics
from aolink.rig import Rig
from aolink.series import Step
from aolink.wire import messages_pb2 as wire
from aolink.wire.runs_pb2 import Run

ASSEMBLED = (topics.COMMAND, topics.APPLIED, topics.EXPOSURE, topics.IMAGE)
"""Topics that exposures are made of."""
BESIDE = (topics.TRUTH, topics.SCENE_EXPOSURE, topics.SCENE)
"""Topics of what belongs to an exposure."""


class ExposureAssembly:
    """Assembles exposures from the messages of a recording, as the session did.

    Parameters
    ----------
    before:
        Number of frames before the first message that it will take.
    """

    def __init__(self, rig: Rig, before: int = 0) -> None:
        self._assembler = Assembler(rig)
        self._info: schemas_pb2.ExposureInfo | None = None
        self._number, self._is_frame = before, False
        self._numbers: dict[int, int] = {}
        """Numbers of the frames whose exposures have not been asked for, by frame id."""

    def take(self, topic: str, message: Message | None) -> list[Exposure]:
        """Take any message, None for one that cannot be used; gives the exposures that are complete with it."""
        if topic == topics.IMAGE:
            info, self._info = self._info, None
            number, self._number = self._number, self._number + self._is_frame
            self._is_frame = False
            if isinstance(message, RawImage) and info is not None:
                self._numbers[info.frame_id] = number
                return self._assembler.add_frame(convert.frame_from_messages(info, message))
        elif topic == topics.EXPOSURE:
            # The picture of a frame whose facts are lost does not belong to the frame before.
            self._info, self._is_frame = message if isinstance(message, schemas_pb2.ExposureInfo) else None, True
        elif topic == topics.APPLIED:
            if isinstance(message, (Run, wire.Applied)):
                return self._assembler.add_applied(message)
        elif topic == topics.COMMAND and isinstance(message, (Run, wire.CommandBlock)):
            self._assembler.add_command(message)
        return []

    def number(self, exposure: Exposure) -> int:
        """The number of an exposure among the frames, those that cannot be used included; to be asked for once."""
        return self._numbers.pop(exposure.frame_id, self._number)

    def flush(self) -> list[Exposure]:
        """Exposures that were still incomplete when the recording ended."""
        return self._assembler.flush()


class Walk:
    """Assembles a recording's exposures, each with its truth, scene and estimates, from all its messages in order.

    Truth and scene come with their exposure, before the next one. An estimate comes before or after its exposure, in
    the order of the exposures; some exposures have none.

    Parameters
    ----------
    names:
        The estimators whose estimates are wanted.
    counts:
        Number of messages by topic that will come; a topic that is missing has none. Where a number is not right,
        exposures only wait for longer.
    model:
        Gives the model that expands recorded coefficients into paths.
    before:
        Number of frames before the first message that it will take.
    most:
        How many exposures may wait for what belongs to them; None for any number.
    """

    def __init__(
        self, rig: Rig, names: Sequence[str], counts: Mapping[str, int], model: Callable[[], ExposureModel],
        before: int = 0, most: int | None = None,
    ) -> None:  # fmt: skip
        self._assembly, self._model, self._names = ExposureAssembly(rig, before), model, names
        self._waiting: deque[Step] = deque()
        self._most = most
        self._truths: dict[int, Truth] = {}
        self._scenes: dict[int, Picture] = {}
        beside: list[tuple[str, Collection[int]]] = [(topics.TRUTH, self._truths), (topics.SCENE, self._scenes)]
        self._expected = [found for topic, found in beside if topic in counts]
        self._scene_info: schemas_pb2.ExposureInfo | None = None
        self._found: dict[str, dict[int, schemas_pb2.Estimate | None]] = {name: {} for name in names}
        """Messages of estimates by estimator and frame id, None where it skipped the exposure."""
        self._reached = dict.fromkeys(names, -1)
        """Frame id of an estimator's last estimate."""
        of_names = {name: (topics.estimate_topic(name), topics.estimation_topic(name)) for name in names}
        self._left = {name: sum(counts.get(topic, 0) for topic in both) for name, both in of_names.items()}
        """Messages of an estimator that are still to come."""
        self.completed: list[Exposure] = []
        """The exposures that the last message completed, without what belongs to them."""

    def take(self, topic: str, time_ns: int, message: Message | None) -> Iterator[Step]:
        """Take the next message, None for one that cannot be used; gives the exposures that wait for nothing more."""
        self.completed = []
        if topic in ASSEMBLED:
            self.completed = self._assembly.take(topic, message)
            self._wait(time_ns)
        elif topic.startswith((topics.ESTIMATE, topics.ESTIMATION)):
            self._note(topic, message)
        elif isinstance(message, wire.Truth):
            self._truths[message.frame_id] = convert.truth_from_message(message)
        elif topic == topics.SCENE_EXPOSURE:
            self._scene_info = message if isinstance(message, schemas_pb2.ExposureInfo) else None
        elif topic == topics.SCENE:
            info, self._scene_info = self._scene_info, None
            if isinstance(message, RawImage) and info is not None:
                frame = convert.frame_from_messages(info, message)
                self._scenes[frame.frame_id] = Picture(pixels=frame.pixels, mask=frame.mask)
        while self._waiting and self._is_whole(self._waiting[0].exposure.frame_id):
            yield self._next()

    def flush(self, time_ns: int) -> Iterator[Step]:
        """The exposures that were still incomplete when the recording ended, at a log time in ns, or still wait."""
        self.completed = self._assembly.flush()
        self._wait(time_ns)
        while self._waiting:
            yield self._next()

    def _wait(self, time_ns: int) -> None:
        self._waiting.extend(Step(self._assembly.number(each), each, time_ns=time_ns) for each in self.completed)

    def _note(self, topic: str, message: Message | None) -> None:
        """Take what an estimator tells of an exposure."""
        name = topic.removeprefix(topics.ESTIMATE).removeprefix(topics.ESTIMATION)
        if name not in self._found:
            return
        self._left[name] -= 1
        if isinstance(message, schemas_pb2.Estimate):
            self._found[name][message.frame_id] = message
            self._reached[name] = message.frame_id
        elif isinstance(message, schemas_pb2.Estimation) and message.skipped:
            self._found[name][message.frame_id] = None

    def _is_whole(self, frame_id: int) -> bool:
        if self._most is not None and len(self._waiting) > self._most:
            return True
        if len(self._waiting) == 1 and not all(frame_id in found for found in self._expected):
            return False
        return all(
            frame_id in self._found[name] or self._reached[name] >= frame_id or self._left[name] <= 0
            for name in self._names
        )

    def _next(self) -> Step:
        step = self._waiting.popleft()
        exposure, frame_id = step.exposure, step.exposure.frame_id
        truth, scene = self._truths.pop(frame_id, None), self._scenes.pop(frame_id, None)
        if truth or scene:
            step.exposure = replace(exposure, truth=truth, scene=scene)
        for name, found in self._found.items():
            for earlier in [key for key in found if key < frame_id]:  # their exposures are lost
                del found[earlier]
            if frame_id in found:
                message = found.pop(frame_id)
                if message is None:
                    step.skipped.add(name)
                else:
                    step.estimates[name] = convert.estimate_from_message(message, self._model(), exposure)
        return step
