"""Messages of a recording become exposures, and find what was recorded beside them."""

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


class ExposureAssembly:
    """Messages become exposures, as they did in the session."""

    def __init__(self, rig: Rig) -> None:
        self._assembler = Assembler(rig)
        self._info: schemas_pb2.ExposureInfo | None = None

    def take(self, topic: str, message: Message) -> list[Exposure]:
        """Take any message; gives the exposures that are complete with it."""
        if isinstance(message, wire.Applied):
            return self._assembler.add_applied(message)
        if isinstance(message, wire.CommandBlock):
            self._assembler.add_command(message)
        elif topic == topics.EXPOSURE and isinstance(message, schemas_pb2.ExposureInfo):
            self._info = message
        elif topic == topics.IMAGE and isinstance(message, RawImage) and self._info is not None:
            info, self._info = self._info, None
            return self._assembler.add_frame(convert.frame_from_messages(info, message))
        return []

    def flush(self) -> list[Exposure]:
        """Exposures that were still incomplete when the recording ended."""
        return self._assembler.flush()


class Companions:
    """Exposures that wait for what is recorded beside them: truth and scene."""

    def __init__(self, counts: Container[str]) -> None:
        self.waiting: deque[Exposure] = deque()
        self._truths: dict[int, Truth] = {}
        self._scenes: dict[int, Picture] = {}
        kept: list[tuple[str, dict[int, Any]]] = [(topics.TRUTH, self._truths), (topics.SCENE, self._scenes)]
        self._expected = [found for topic, found in kept if topic in counts]
        self._info: schemas_pb2.ExposureInfo | None = None

    @property
    def has_next(self) -> bool:
        """Whether the next exposure has all that it will get."""
        waiting = self.waiting
        return bool(waiting) and (len(waiting) > 1 or all(waiting[0].frame_id in found for found in self._expected))

    def next(self) -> Exposure:
        """The next exposure, with what came for it."""
        exposure = self.waiting.popleft()
        truth, scene = self._truths.pop(exposure.frame_id, None), self._scenes.pop(exposure.frame_id, None)
        return replace(exposure, truth=truth, scene=scene) if truth or scene else exposure

    def take(self, topic: str, message: Message) -> None:
        """Take a message that belongs to an exposure."""
        if isinstance(message, wire.Truth):
            self._truths[message.frame_id] = convert.truth_from_message(message)
        elif topic == topics.SCENE_EXPOSURE and isinstance(message, schemas_pb2.ExposureInfo):
            self._info = message
        elif topic == topics.SCENE and isinstance(message, RawImage) and self._info is not None:
            frame = convert.frame_from_messages(self._info, message)
            self._scenes[frame.frame_id], self._info = Picture(pixels=frame.pixels, mask=frame.mask), None
