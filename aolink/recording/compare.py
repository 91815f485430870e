"""The differences between two recordings, message by message and field by field."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple, Self

import numpy as np
from google.protobuf.message import DecodeError, Message
from google.protobuf.wrappers_pb2 import BytesValue

from aolink.errors import RecordingError
from aolink.exporting.common import Progress, no_progress
from aolink.recording import schemas_pb2, topics
from aolink.recording.reader import Recording
from aolink.wire import messages_pb2 as wire

RELATIVE = 1e-9
"""Default relative tolerance: differences that another machine's arithmetic may make."""
ABSOLUTE = 1e-12
_BYTES_KEPT = 32 << 20
"""Bytes in memory of messages whose counterpart has not come yet; the rest is in a temporary file."""
_LATER = ("verdict",)
"""Fields that recordings made before do not have: they are compared where both have them."""
_Key = tuple[str, str]
"""Topic, and the name that a message and its counterpart share."""


class Difference(NamedTuple):
    """The first place where two recordings differ in a field."""

    frame_id: int | None
    """Frame id of the exposure that the message belongs to; None where it belongs to none."""
    text: str
    """Both values, in short."""


@dataclass(slots=True)
class FieldDifference:
    """How a field of the messages of a topic differs."""

    first: Difference
    messages: int = 0
    """Number of messages in which it differs."""
    largest: float = 0.0
    """Largest absolute difference between numbers; infinite where one is not finite, or the lengths differ."""
    largest_relative: float = 0.0
    """Largest difference relative to the larger of the two numbers."""


@dataclass(slots=True)
class TopicComparison:
    """The differences in one topic."""

    compared: int = 0
    """Messages that are in both recordings."""
    missing: int = 0
    """Messages that are in the first only."""
    added: int = 0
    """Messages that are in the second only."""
    first_missing: str = ""
    first_added: str = ""
    fields: dict[str, FieldDifference] = field(default_factory=dict)

    def count_alone(self, *, is_first: bool, text: str) -> None:
        """Count a message that is in one of them only, with its name."""
        if is_first:
            self.missing += 1
            self.first_missing = self.first_missing or text
        else:
            self.added += 1
            self.first_added = self.first_added or text

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        return not (self.missing or self.added or self.fields)


def compare(
    first: Recording, second: Recording, *, relative: float = RELATIVE, absolute: float = ABSOLUTE,
    only: Sequence[str] = (), relative_to_start: bool = False, progress: Progress = no_progress,
) -> dict[str, TopicComparison]:  # fmt: skip
    """Compare two recordings by topic.

    Messages are matched by the exposure or command block that they belong to, or else by their number in the topic, not
    by their place in the file. Two numbers are the same if they differ by no more than ``absolute`` plus ``relative``
    times the larger, or if both are NaN; integers, texts and pictures must be equal.

    Parameters
    ----------
    only:
        Topics to compare; all if none is given. One that ends with "/" means all that begin with it.
    relative_to_start:
        Count exposures and fast steps from the first of each recording, and leave out clock times: in two sessions of
        one rig they differ.

    Raises
    ------
    RecordingError
        Neither recording has any of the topics; or messages without a counterpart do not fit on the disk.
    """
    names = {topic for recording in (first, second) for topic in recording.counts if is_wanted(topic, only)}
    if not names:
        asked = f" of {', '.join(only)}" if only else ""
        raise RecordingError(f"there is nothing{asked} to compare in {first.path} and {second.path}")
    result = {name: TopicComparison() for name in sorted(names)}
    in_both = {name for name in names if name in first.counts and name in second.counts}
    with _Waiting() as waiting:
        each = _alternating(first, second, sorted(names), relative_to_start)
        for number, (is_first, key, message, frame_id) in enumerate(each, 1):
            found = result[key[0]]
            if key[0] not in in_both:
                found.count_alone(is_first=is_first, text=key[1])
            elif (other := waiting.partner(key, is_first=is_first)) is None:
                waiting.put(key, message, is_first=is_first)
            else:
                found.compared += 1
                pair = (message, other) if is_first else (other, message)
                if pair[0] != pair[1]:
                    _compare_messages(found, *pair, frame_id, relative, absolute, times=not relative_to_start)
            progress(number)
        for topic, name, is_first in waiting.left():
            result[topic].count_alone(is_first=is_first, text=name)
    return result


def first_parting(found: Mapping[str, TopicComparison]) -> str:
    """The earliest exposure at which two recordings differ, with the fields that differ there; empty if none does."""
    fields = [
        (each.first.frame_id, f"{name} of {topic}")
        for topic, compared in found.items()
        for name, each in compared.fields.items()
        if each.first.frame_id is not None
    ]
    first = min((frame for frame, _ in fields), default=None)
    there = [where for frame, where in fields if frame == first]
    return f"frame {first}: {', '.join(there)}" if there else ""


class _Waiting:
    """Messages whose counterpart has not come yet, in a database of SQLite: in memory up to `_BYTES_KEPT`, and beyond
    in its temporary file. Messages with the same name come out in their order.
    """

    def __init__(self) -> None:
        self._numbers = count()
        self._file = sqlite3.connect("", isolation_level=None)
        self._file.executescript(
            f"""
            PRAGMA journal_mode = OFF;
            PRAGMA cache_size = -{_BYTES_KEPT >> 10};
            CREATE TABLE kept (
                topic, name, number, is_first, kind, data, PRIMARY KEY (topic, name, number)
            ) WITHOUT ROWID;
            BEGIN
            """
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._file.close()
        if isinstance(error, sqlite3.Error):
            raise RecordingError(
                f"what waits for its counterpart does not go into a temporary file: {error}; make room, or name another"
                " folder as SQLITE_TMPDIR"
            ) from None

    def put(self, key: _Key, message: Message, *, is_first: bool) -> None:
        """Keep a message."""
        kept = (*key, next(self._numbers), is_first, message.DESCRIPTOR.full_name, message.SerializeToString())
        self._file.execute("INSERT INTO kept VALUES (?, ?, ?, ?, ?, ?)", kept)

    def partner(self, key: _Key, *, is_first: bool) -> Message | None:
        """Take out what the other recording has under a name; None if it has not come."""
        row = self._file.execute(
            "SELECT number, kind, data FROM kept WHERE topic = ? AND name = ? AND is_first != ? ORDER BY number",
            (*key, is_first),
        ).fetchone()
        if row is None:
            return None
        self._file.execute("DELETE FROM kept WHERE topic = ? AND name = ? AND number = ?", (*key, row[0]))
        return topics.SCHEMAS.get(row[1], BytesValue).FromString(row[2])

    def left(self) -> Iterator[tuple[str, str, bool]]:
        """The messages without a counterpart: topic, name, and whether the message is in the first recording."""
        yield from self._file.execute("SELECT topic, name, is_first FROM kept ORDER BY number")


def is_wanted(topic: str, only: Sequence[str]) -> bool:
    """Whether a topic is one of these, as `compare` takes them."""
    return not only or any(topic == each or (each.endswith("/") and topic.startswith(each)) for each in only)


def _alternating(
    first: Recording, second: Recording, names: Sequence[str], relative_to_start: bool
) -> Iterator[tuple[bool, _Key, Message, int | None]]:
    """The messages of both recordings, a few of each in turn, so that only those without a partner are kept."""
    sides = []
    for is_first, recording in ((True, first), (False, second)):
        found = _messages(recording, names)
        sides.append((is_first, _named(_from_start(found, recording) if relative_to_start else found)))
    while sides:
        for side in list(sides):
            is_first, messages = side
            for _ in range(64):
                named = next(messages, None)
                if named is None:
                    sides.remove(side)
                    break
                yield is_first, *named


def _messages(recording: Recording, names: Sequence[str]) -> Iterator[tuple[str, Message]]:
    """Topics and messages. Those that cannot be used are compared too, and are among the recording's losses; what
    cannot be decoded, or is of an unknown kind, is given as bytes."""
    for raw in recording.raw_messages(*names):
        message = recording.decoded(raw)
        if message is None:
            try:
                message = topics.SCHEMAS[raw.schema].FromString(raw.data)
            except (DecodeError, KeyError):
                message = BytesValue(value=raw.data)
        yield raw.topic, message


def _from_start(messages: Iterator[tuple[str, Message]], recording: Recording) -> Iterator[tuple[str, Message]]:
    """Messages with exposures and fast steps counted from the recording's first exposure."""
    start = next((each.message for each in recording.messages(topics.EXPOSURE)), schemas_pb2.ExposureInfo())
    assert isinstance(start, schemas_pb2.ExposureInfo)
    first = {"frame_id": start.frame_id, "cause_frame_id": start.frame_id}
    first |= dict.fromkeys(("first_step", "last_step"), start.first_step)
    for topic, message in messages:
        for name, value in first.items():
            # Numbers from before the start wrap around, as they do in the other recording.
            if isinstance(was := getattr(message, name, None), int) and (was or name != "cause_frame_id"):
                setattr(message, name, (was - value) % 2**64)
        yield topic, message


def _named(messages: Iterator[tuple[str, Any]]) -> Iterator[tuple[_Key, Message, int | None]]:
    """Each message with a name that its counterpart has too, and the exposure that it belongs to."""
    places: dict[str, int] = {}
    exposures: dict[str, int | None] = {}
    for topic, message in messages:
        frame_id = None
        row = topics.find(topic, message)
        if row.after:
            frame_id = exposures.get(topic)
        elif row.belongs_to == "exposure":
            frame_id = message.frame_id
            exposures |= dict.fromkeys(topics.PICTURES.get(topic, ()), frame_id)
        if frame_id is not None:
            name = f"frame {frame_id}"
        elif row.belongs_to == "steps":
            awaited = getattr(message, "source", None) == wire.Applied.AWAITED
            what = "report awaited from" if awaited else f"block {message.block_id} at"
            name = f"{what} fast step {message.first_step}"
        else:
            places[topic] = places.get(topic, 0) + 1
            name = f"message, number {places[topic]}"
        yield (topic, name), message, frame_id


def _compare_messages(
    found: TopicComparison, a: Message, b: Message, frame_id: int | None, relative: float, absolute: float,
    *, times: bool,
) -> None:  # fmt: skip
    for name in sorted({each.name for each in (*a.DESCRIPTOR.fields, *b.DESCRIPTOR.fields)}):
        if not times and _is_time(name):
            continue
        if name in _LATER and not (a.HasField(name) and b.HasField(name)):
            continue
        x, y = getattr(a, name, None), getattr(b, name, None)
        largest = largest_relative = 0.0
        if isinstance(x, float) or (_is_numbers(x) and _is_numbers(y)):
            largest, largest_relative, differs, at = _numbers_differ(x, y, relative, absolute)
        else:
            differs, at = x != y, ""
            largest = largest_relative = float("inf") if differs else 0.0
            if differs and isinstance(x, int) and isinstance(y, int):
                largest, largest_relative = abs(x - y), abs(x - y) / max(abs(x), abs(y))
        if not differs:
            continue
        difference = found.fields.setdefault(name, FieldDifference(Difference(frame_id, at or _shown(x, y))))
        difference.messages += 1
        difference.largest = max(difference.largest, largest)
        difference.largest_relative = max(difference.largest_relative, largest_relative)


def _is_time(field: str) -> bool:
    """Whether a field is a time on some clock, or the uncertainty of one."""
    return (field.endswith("_ns") and field != "exposure_offset_ns") or field == "timestamp"


def _is_numbers(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str | bytes | Message)


def _numbers_differ(x: Any, y: Any, relative: float, absolute: float) -> tuple[float, float, bool, str]:
    """Largest difference, the same relatively, whether it is too large, and the first place in words."""
    a, b = (np.atleast_1d(np.asarray(value, dtype=np.float64)) for value in (x, y))
    if a.shape != b.shape:
        return np.inf, np.inf, True, f"{a.size} numbers against {b.size}"
    with np.errstate(invalid="ignore", over="ignore"):  # numbers further apart than a double holds are apart
        gap = np.abs(a - b)
    gap[(a == b) | (np.isnan(a) & np.isnan(b))] = 0.0
    gap[np.isnan(gap)] = np.inf
    scale = np.maximum(np.abs(a), np.abs(b))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(gap > 0, gap / scale, 0.0)
        wrong = gap > absolute + relative * np.where(np.isfinite(scale), scale, 0.0)
    if not wrong.any():
        return 0.0, 0.0, False, ""
    k = int(np.argmax(wrong))
    where = f"[{k}] " if a.size > 1 else ""
    largest = float(gap.max()), float(np.nan_to_num(ratio, nan=np.inf).max())
    return *largest, True, f"{where}{a[k]:.10g} against {b[k]:.10g}"


def _shown(x: Any, y: Any) -> str:
    def short(value: Any) -> str:
        if isinstance(value, bytes):
            return f"{len(value)} bytes"
        text = " ".join(str(value).split())
        return text if len(text) < 60 else text[:57] + "..."

    if isinstance(x, bytes) and isinstance(y, bytes) and len(x) == len(y):
        return f"byte {next(k for k, (p, q) in enumerate(zip(x, y, strict=True)) if p != q)} of {len(x)} differs"
    return f"{short(x)} against {short(y)}"
