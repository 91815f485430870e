"""Films from MCAP files and ROS bags: foxglove.RawImage and CompressedImage, sensor_msgs/Image and CompressedImage."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import McapReader, NonSeekingReader, make_reader
from mcap.records import Channel, Schema
from PIL import UnidentifiedImageError

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.importing.film import Film, FilmFrame, grey
from aolink.optics.pictures import image_pixels, opened_image

_ENCODINGS = {
    "mono8": "u1", "8uc1": "u1", "mono16": "<u2", "16uc1": "<u2", "32fc1": "<f4", "64fc1": "<f8",
    "rgb8": "u1", "bgr8": "u1", "8uc3": "u1", "rgba8": "u1", "bgra8": "u1",
}  # fmt: skip
_COLOURS = {"rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4}
_MAGIC = b"\x89MCAP0\r\n"
_LOSSLESS = ("PNG", "BMP", "TIFF", "PPM")
_LOSSY = "the pictures are compressed with JPEG, after a gamma curve"


@dataclass(frozen=True, eq=False)
class _Stamped:
    time_ns: int
    """The picture's own time stamp, or 0 where it has none."""
    arrival_ns: int
    picture: FilmFrame
    """(rows, columns) or (rows, columns, 3 or 4)."""
    lossy: bool


def mcap_film(path: Path, topic: str | None) -> Film:
    """The pictures on one channel of an MCAP file. Raises ImportingError."""

    with path.open("rb") as file:
        if _is_cut_off(file):
            raise ImportingError(
                f"{path} has no end: it was cut off, or is still being written. `mcap recover` saves what is whole"
                " of it (`aolink recover`, where it is a recording of aolink)"
            )
        summary = make_reader(file, validate_crcs=True).get_summary()
        kinds = set[tuple[str, str]]()
        disordered = set[str]()
        indexed = summary is not None and bool(summary.channels and summary.chunk_indexes)
        if indexed and summary is not None:
            channels = summary.channels.values()
            kinds = {(each.topic, _kind(summary.schemas.get(each.schema_id), each)) for each in channels}
            indexed = all(each.schema_id in summary.schemas or not each.schema_id for each in channels)
        if not indexed:  # the summary is optional, and so are the channels and the schemas in it
            latest: dict[str, int] = {}
            for schema, channel, message in _linear(file).iter_messages(log_time_order=False):
                kinds.add((channel.topic, _kind(schema, channel)))
                if message.log_time < latest.get(channel.topic, 0):
                    disordered.add(channel.topic)
                latest[channel.topic] = message.log_time
        found = [(name, kind) for name, kind in kinds if kind]
    chosen = _chosen(dict(sorted(found, key=lambda one: one[1] in _DECODERS)), topic, path)  # a picture's kind wins

    def messages() -> Iterator[_Stamped]:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True) if indexed else _linear(file)
            # Without an index all messages are held in memory where they are sorted.
            sort = indexed or chosen in disordered
            for schema, channel, message in reader.iter_messages(topics=[chosen], log_time_order=sort):
                if read := _DECODERS.get(_kind(schema, channel)):
                    yield read(message.data, message.publish_time or message.log_time)

    return _film(path, chosen, messages)


def _is_cut_off(file: IO[bytes]) -> bool:
    """Whether an MCAP file begins as one and does not end as one."""
    begins = file.read(len(_MAGIC)) == _MAGIC
    file.seek(-min(len(_MAGIC), file.seek(0, io.SEEK_END)), io.SEEK_END)
    ends = file.read() == _MAGIC
    file.seek(0)
    return begins and not ends


def _linear(file: IO[bytes]) -> McapReader:
    """A reader that needs no summary."""
    file.seek(0)
    return NonSeekingReader(file, validate_crcs=True)


def _kind(schema: Schema | None, channel: Channel) -> str:
    """Schema and encoding of a channel's messages; empty where it has no schema."""
    return f"{schema.name} in {channel.message_encoding}" if schema else ""


def ros_film(path: Path, topic: str | None) -> Film:
    """The pictures on one topic of a ROS 1 or ROS 2 bag. Raises ImportingError."""
    with needs_extra("ros", ImportingError):
        from rosbags.highlevel import AnyReader

    def opened() -> Any:
        return AnyReader([path], default_typestore=_typestore("LATEST"))

    with opened() as bag:
        encoding = "cdr" if bag.is2 else "ros1"
        types = {each.topic: f"{each.msgtype} in {encoding}" for each in bag.connections}
        if not bag.is2:
            types = {name: kind.replace("/msg/", "/") for name, kind in types.items()}
    chosen = _chosen(types, topic, path)

    def messages() -> Iterator[_Stamped]:
        with opened() as bag:
            wanted = [each for each in bag.connections if each.topic == chosen]
            for connection, arrival_ns, data in bag.messages(connections=wanted):
                yield _ros(bag.deserialize(data, connection.msgtype), arrival_ns)

    return _film(path, chosen, messages)


def _chosen(types: dict[str, str], topic: str | None, path: Path) -> str:
    pictures = [name for name, kind in types.items() if kind in _DECODERS]
    if topic is not None and topic in pictures:
        return topic
    have = ", ".join(f"{name} ({kind})" for name, kind in sorted(types.items())) or "no messages"
    if topic is not None or not pictures:
        where = "that can be read on any topic" if topic is None else f"on {topic or 'a topic without a name'}"
        raise ImportingError(f"{path} has no pictures {where}: it has {have}")
    if len(pictures) > 1:
        raise ImportingError(f"{path} has pictures on {', '.join(sorted(pictures))}: say which with --topic")
    return pictures[0]


def _film(path: Path, topic: str, messages: Callable[[], Iterator[_Stamped]]) -> Film:
    first: FilmFrame | None = None
    stamps, arrivals, lossy = [], [], False
    for each in messages():
        first = each.picture if first is None else first
        if each.picture.shape != first.shape or each.picture.dtype != first.dtype:
            raise ImportingError(
                f"{path}: pictures on {topic} change from {first.dtype} of shape {first.shape} to {each.picture.dtype}"
                f" of shape {each.picture.shape}: a film has frames of one size and type"
            )
        stamps.append(each.time_ns)
        arrivals.append(each.arrival_ns)
        lossy |= each.lossy
    if first is None:
        raise ImportingError(f"{path} has no picture on {topic}")
    stamped = all(stamps) and len(set(stamps)) == len(stamps)
    why = "the pictures have no times of their own"
    if any(stamps):
        why = "some pictures have no time of their own" if not all(stamps) else "pictures share a time of their own"
    times = np.array(stamps if stamped else arrivals, dtype=np.int64)
    return Film(
        name=f"{path.name}:{topic}", shape=(int(first.shape[0]), int(first.shape[1])), dtype=first.dtype,
        count=len(times), frames=lambda: (grey(each.picture, path) for each in messages()), start_ns=int(times[0]),
        times_ns=times, nonlinear=_LOSSY if lossy else "",
        notes=() if stamped else (f"{why}: those of their arrival are used",),
    )  # fmt: skip


def raw_picture(data: bytes, encoding: str, height: int, width: int, step: int, big_endian: bool = False) -> FilmFrame:
    """Pixels of a raw picture, (rows, columns) or (rows, columns, 3 or 4). Raises ImportingError."""
    encoding = encoding.lower()
    if encoding not in _ENCODINGS:
        raise ImportingError(f"pictures are encoded as {encoding!r}: {', '.join(_ENCODINGS)} can be read")
    kind = np.dtype(_ENCODINGS[encoding]).newbyteorder(">" if big_endian else "<")
    row = width * kind.itemsize * _COLOURS.get(encoding, 1)
    step = step or row
    if not height or not width or step < row or len(data) < step * (height - 1) + row:
        raise ImportingError(f"a picture of {height} x {width} pixels has {len(data)} bytes only: the file is damaged")
    rows = np.lib.stride_tricks.as_strided(np.frombuffer(data, np.uint8), (height, row), (step, 1))
    pixels = np.ascontiguousarray(rows).view(kind)
    if encoding in _COLOURS:
        return pixels.reshape(height, width, -1)
    return np.asarray(pixels.astype(kind.newbyteorder("=")))


def compressed_picture(data: bytes) -> tuple[FilmFrame, bool]:
    """Pixels of a JPEG or PNG, (rows, columns) or (rows, columns, 3 or 4), and whether it is lossy.

    Raises ImportingError.
    """
    try:
        with opened_image(io.BytesIO(data), ImportingError) as image:
            return image_pixels(image), image.format not in _LOSSLESS
    except OSError as error:
        said = "their format is not known" if isinstance(error, UnidentifiedImageError) else str(error)
        raise ImportingError(f"compressed pictures cannot be read ({said}): JPEG and PNG can") from None


def _foxglove_raw(data: bytes, arrival_ns: int) -> _Stamped:
    image = RawImage.FromString(data)
    picture = raw_picture(image.data, image.encoding, image.height, image.width, image.step)
    return _Stamped(image.timestamp.ToNanoseconds(), arrival_ns, picture, False)


def _foxglove_compressed(data: bytes, arrival_ns: int) -> _Stamped:
    image = CompressedImage.FromString(data)
    return _Stamped(image.timestamp.ToNanoseconds(), arrival_ns, *compressed_picture(image.data))


def _ros_reader(kind: str, store: str, encoding: str) -> Callable[[bytes, int], _Stamped]:
    def read(data: bytes, arrival_ns: int) -> _Stamped:
        decoded = getattr(_typestore(store), f"deserialize_{encoding}")
        return _ros(decoded(data, f"sensor_msgs/msg/{kind}"), arrival_ns)

    return read


@cache
def _typestore(name: str) -> Any:
    with needs_extra("ros", ImportingError):
        from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores[name])


def _ros(image: Any, arrival_ns: int) -> _Stamped:
    stamp = image.header.stamp
    time_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
    if hasattr(image, "format"):
        return _Stamped(time_ns, arrival_ns, *compressed_picture(image.data.tobytes()))
    big = bool(image.is_bigendian)
    picture = raw_picture(image.data.tobytes(), image.encoding, image.height, image.width, image.step, big)
    return _Stamped(time_ns, arrival_ns, picture, False)


_DECODERS: dict[str, Callable[[bytes, int], _Stamped]] = {
    "foxglove.RawImage in protobuf": _foxglove_raw,
    "foxglove.CompressedImage in protobuf": _foxglove_compressed,
}
for _name in ("Image", "CompressedImage"):
    _DECODERS[f"sensor_msgs/{_name} in ros1"] = _ros_reader(_name, "ROS1_NOETIC", "ros1")
    _DECODERS[f"sensor_msgs/msg/{_name} in cdr"] = _ros_reader(_name, "LATEST", "cdr")
"""Decoders of a channel, by the schema and the encoding of its messages."""
