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
    """Assembles exposures from the messages of a recording, as the session did."""

    def __init__(self, rig: Rig) -> None:
        self._assembler = Assembler(rig)
        self._info: schemas_pb2.ExposureInfo | None = None

    def take(self, topic: str, message: Message) -> list[Exposure]:
        """Take any message; gives the exposures that are complete with it."""
        if topic == topics.IMAGE:
            if isinstance(message, RawImage) and self._info is not None:
                info, self._info = self._info, None
                return self._assembler.add_frame(convert.frame_from_messages(info, message))
        elif topic == topics.EXPOSURE:
            if isinstance(message, schemas_pb2.ExposureInfo):
                self._info = message
        elif topic == topics.APPLIED:
            if isinstance(message, (Run, wire.Applied)):
                return self._assembler.add_applied(message)
        elif topic == topics.COMMAND and isinstance(message, (Run, wire.CommandBlock)):
            self._assembler.add_command(message)
        return []

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

    def take(self, topic: str, message: Message) -> list[Exposure]:
        """Take a message that belongs to an exposure; gives exposures as `add` does."""
        if isinstance(message, wire.Truth):
            self._truths[message.frame_id] = convert.truth_from_message(message)
        elif topic == topics.SCENE_EXPOSURE and isinstance(message, schemas_pb2.ExposureInfo):
            self._info = message
        elif topic == topics.SCENE and isinstance(message, RawImage) and self._info is not None:
            frame = convert.frame_from_messages(self._info, message)
            self._scenes[frame.frame_id], self._info = Picture(pixels=frame.pixels, mask=frame.mask), None
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
