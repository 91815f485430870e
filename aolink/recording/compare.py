"""The first difference between two recordings, topic by topic."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError, Message
from google.protobuf.wrappers_pb2 import BytesValue

from aolink.errors import RecordingError
from aolink.exporting.common import Progress, no_progress
from aolink.recording import topics
from aolink.recording.reader import Recording, opened
from aolink.wire import messages_pb2 as wire

_WAITING_BYTES = 64 << 20
"""Memory for messages whose counterpart has not come yet. Those of one exposure come within seconds in both recordings:
more than this waits only where a recording lacks much of what the other has."""


@dataclass(slots=True)
class TopicComparison:
    """The differences in one topic."""

    compared: int = 0
    """Messages that are in both recordings."""
    differ: int = 0
    """Messages that differ, or are in one of the recordings only."""
    frame_id: int | None = None
    """Frame id of the exposure that the first difference belongs to; None where it belongs to none."""
    first: str = ""
    """The first difference: which message, which field, both values."""

    def add(self, named: _Named, what: str) -> None:
        """Count a message that differs."""
        self.differ += 1
        earlier = self.frame_id is not None and named.frame_id is not None and named.frame_id < self.frame_id
        if not self.first or earlier:
            self.frame_id, self.first = named.frame_id, f"{named.name}: {what}"

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        return not self.differ


class _Named(NamedTuple):
    """A message with a name that its counterpart has too."""

    time_ns: int
    """Log time since the recording's start, ns."""
    is_first: bool
    """Whether it is in the first recording."""
    topic: str
    name: str
    frame_id: int | None
    message: Any

    @property
    def alone(self) -> str:
        return f"only in the {'first' if self.is_first else 'second'}"


def compare(
    first: Recording | str | Path, second: Recording | str | Path, *, relative: float = 1e-9,
    absolute: float = 1e-12, only: Sequence[str] = (),
    progress: Progress = no_progress,
) -> dict[str, TopicComparison]:  # fmt: skip
    """Compare two recordings, or the files of two, by topic.

    Messages are matched by the exposure or command block that they belong to, or else by their number in the topic, not
    by their place in the file. Two numbers are the same if they differ by no more than ``absolute`` plus ``relative``
    times the larger, which another machine's arithmetic may make, or if both are NaN; integers, texts and pictures must
    be equal. ``only`` has the topics to compare (all if none is given); one that ends with "/" means all that begin
    with it.

    Raises RecordingError where neither recording has any of the topics.
    """
    first, second = opened(first), opened(second)
    names = {topic for recording in (first, second) for topic in recording.counts if is_wanted(topic, only)}
    if not names:
        asked = f" of {', '.join(only)}" if only else ""
        raise RecordingError(f"there is nothing{asked} to compare in {first.path} and {second.path}")
    result = {name: TopicComparison() for name in sorted(names)}
    waiting: dict[tuple[str, str], _Named] = {}
    waiting_bytes = 0
    both = merge(_named(first, result, True), _named(second, result, False), key=lambda each: each.time_ns)
    for number, each in enumerate(both, 1):
        found, key = result[each.topic], (each.topic, each.name)
        if (other := waiting.get(key)) is None:
            waiting[key] = each
            waiting_bytes += _size(each)
            if waiting_bytes > _WAITING_BYTES:
                oldest = waiting.pop(next(iter(waiting)))
                waiting_bytes -= _size(oldest)
                result[oldest.topic].add(oldest, oldest.alone)
        elif other.is_first == each.is_first:
            found.add(each, each.alone)  # it is there twice
        else:
            waiting_bytes -= _size(waiting.pop(key))
            found.compared += 1
            a, b = (each.message, other.message) if each.is_first else (other.message, each.message)
            if a != b and (what := _difference(a, b, relative, absolute)):
                found.add(each, what)
        progress(number)
    for each in waiting.values():
        result[each.topic].add(each, each.alone)
    return result


def is_wanted(topic: str, only: Sequence[str]) -> bool:
    """Whether a topic is one of these, as `compare` takes them."""
    return not only or any(topic == each or (each.endswith("/") and topic.startswith(each)) for each in only)


def _size(each: _Named) -> int:
    return int(each.message.ByteSize()) + 1000  # of the objects about it


def _named(recording: Recording, wanted: Collection[str], is_first: bool) -> Iterator[_Named]:
    """The messages with their names. Those that cannot be used are compared too, and are among the recording's losses;
    what cannot be decoded, or is of an unknown kind, is given as bytes."""
    places: dict[str, int] = {}
    exposures: dict[str, int | None] = {}
    for raw in recording.raw_messages(*wanted):
        message: Any = recording.decoded(raw)
        if message is None:
            try:
                message = topics.SCHEMAS[raw.schema].FromString(raw.data)
            except (DecodeError, KeyError):
                message = BytesValue(value=raw.data)
        frame_id, row = None, topics.find(raw.topic, message)
        if row.after:
            frame_id = exposures.get(raw.topic)
        elif row.belongs_to == "exposure":
            frame_id = message.frame_id
            exposures |= dict.fromkeys(topics.PICTURES.get(raw.topic, ()), frame_id)
        if frame_id is not None:
            name = f"frame {frame_id}"
        elif row.belongs_to == "steps":
            awaited = getattr(message, "source", None) == wire.Applied.AWAITED
            what = "report awaited from" if awaited else f"block {message.block_id} at"
            name = f"{what} fast step {message.first_step}"
        else:
            places[raw.topic] = places.get(raw.topic, 0) + 1
            name = f"message {places[raw.topic]}"
        yield _Named(raw.log_time_ns - recording.start_ns, is_first, raw.topic, name, frame_id, message)


def _difference(a: Message, b: Message, relative: float, absolute: float) -> str:
    """The first field in which two messages differ, with both values; empty where none does."""
    if a.DESCRIPTOR is not b.DESCRIPTOR:
        return f"{a.DESCRIPTOR.full_name} against {b.DESCRIPTOR.full_name}"
    for field in a.DESCRIPTOR.fields:
        u, v = _values(a, field.name), _values(b, field.name)
        if u.shape != v.shape:
            return f"{field.name}: {u.size} values against {v.size}"
        differs = np.asarray(u != v)
        if u.dtype.kind == "f":
            with np.errstate(over="ignore"):  # numbers further apart than a double holds are apart
                near = [np.isclose(x, y, relative, absolute, equal_nan=True) for x, y in ((u, v), (v, u))]
            differs = ~(near[0] | near[1])
        if differs.any():
            k = int(np.argmax(differs))
            one, other = (shorten(str(each[k]), 60) for each in (u, v))
            return f"{field.name}{f'[{k}]' if u.size > 1 else ''}: {one} against {other}"
    return ""


def _values(message: Message, field: str) -> np.ndarray[Any, Any]:
    """The values of a field, of a picture its bytes."""
    value = getattr(message, field)
    return np.atleast_1d(np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.asarray(value))
