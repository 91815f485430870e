"""The assembly of exposures from a recording's messages, with the truth and the scene that were recorded beside
them."""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from dataclasses import replace
from typing import Any

from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message

from aolink.assembly import Assembler
from aolink.exposure import Exposure, Picture, Truth
from aolink.recording import convert, schemas_pb2, topics
from aolink.rig import Rig
from aolink.wire import messages_pb2 as wire
from aolink.wire.runs_pb2 import Run


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


class Companions:
    """Exposures that wait for their truth and scene, which are recorded beside them."""

    def __init__(self, counts: Container[str]) -> None:
        self._waiting: deque[Exposure] = deque()
        self._truths: dict[int, Truth] = {}
        self._scenes: dict[int, Picture] = {}
        kept: list[tuple[str, dict[int, Any]]] = [(topics.TRUTH, self._truths), (topics.SCENE, self._scenes)]
        self._expected = [found for topic, found in kept if topic in counts]
        self._info: schemas_pb2.ExposureInfo | None = None

    def add(self, exposures: list[Exposure]) -> list[Exposure]:
        """Take the next exposures; gives those that wait for nothing more."""
        if not self._expected:
            return exposures
        self._waiting.extend(exposures)
        return self._ready()

    def take(self, topic: str, message: Message | None) -> list[Exposure]:
        """Take a message that belongs to an exposure, None for one that cannot be used; gives exposures as `add`
        does."""
        if isinstance(message, wire.Truth):
            self._truths[message.frame_id] = convert.truth_from_message(message)
        elif topic == topics.SCENE_EXPOSURE:
            self._info = message if isinstance(message, schemas_pb2.ExposureInfo) else None
        elif topic == topics.SCENE:
            info, self._info = self._info, None
            if isinstance(message, RawImage) and info is not None:
                frame = convert.frame_from_messages(info, message)
                self._scenes[frame.frame_id] = Picture(pixels=frame.pixels, mask=frame.mask)
        return self._ready()

    def flush(self) -> list[Exposure]:
        """The exposures that still wait, with the messages that came for them."""
        return [self._next() for _ in range(len(self._waiting))]

    def _ready(self) -> list[Exposure]:
        # Truth and scene may come after their exposure, but not after the next one.
        ready, waiting = [], self._waiting
        while len(waiting) > 1 or (waiting and all(waiting[0].frame_id in found for found in self._expected)):
            ready.append(self._next())
        return ready

    def _next(self) -> Exposure:
        exposure = self._waiting.popleft()
        truth, scene = self._truths.pop(exposure.frame_id, None), self._scenes.pop(exposure.frame_id, None)
        return replace(exposure, truth=truth, scene=scene) if truth or scene else exposure
