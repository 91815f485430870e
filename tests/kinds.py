"""What a test knows and a type checker cannot see: of which kind a thing is."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from foxglove_schemas_protobuf.Log_pb2 import Log

from aolink.exposure import Exposure, Truth
from aolink.optics.sensor import Sensor, SpotSensor
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.rig import Rig

Kind = TypeVar("Kind")


def must_be(kind: type[Kind], thing: object) -> Kind:
    """The thing itself, which is of that kind."""
    assert isinstance(thing, kind), f"{thing!r} is no {kind.__name__}"
    return thing


def messages_of(kind: type[Kind], recording: Recording, topic: str) -> list[Kind]:
    """The messages of a topic, which are of that kind."""
    return [must_be(kind, each.message) for each in recording.messages(topic)]


def log_of(path: Path) -> list[str]:
    """What a session said while it ran, as its recording has it."""
    return [each.message for each in messages_of(Log, Recording(path), topics.LOG)]


def truth_of(exposure: Exposure) -> Truth:
    """What the simulated rig did in an exposure."""
    return must_be(Truth, exposure.truth)


def line_of(rig: Rig) -> Sensor:
    """The sensor of a rig with a line of pixels."""
    return must_be(Sensor, rig.sensor)


def spots_of(rig: Rig) -> SpotSensor:
    """The sensor of a rig with spots on a plane."""
    return must_be(SpotSensor, rig.sensor)
