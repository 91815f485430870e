"""Films from MCAP files and ROS bags: foxglove.RawImage and CompressedImage, sensor_msgs/Image and CompressedImage."""

from __future__ import annotations

import hashlib
import io
import re
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

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.films.facts import dated
from aolink.films.film import Film, FilmFrame
from aolink.films.stills import COMPRESSED, decoded

_NAMES = {"mono8": "8UC1", "mono16": "16UC1", "rgb8": "8UC3", "bgr8": "8UC3", "rgba8": "8UC4", "bgra8": "8UC4",
          "rgb16": "16UC3", "bgr16": "16UC3", "rgba16": "16UC4", "bgra16": "16UC4"}  # fmt: skip
_BAYER = re.compile(r"bayer_([rgb]{4})(8|16)$")
_OPENCV = re.compile(r"(8|16|32|64)([usf])c([1234]?)$")
_MAGIC = b"\x89MCAP0\r\n"
_JUMP_NS = 10**9
"""Change of the time from a picture's stamp to its arrival that is a jump of a clock."""


@dataclass(frozen=True, eq=False)
class _Stamped:
    time_ns: int
    """The picture's own time stamp, or 0 where it has none."""
    arrival_ns: int
    picture: FilmFrame
    """(rows, columns) or (rows, columns, 3 or 4)."""
    lossy: bool = False
    top: float | None = None
    mosaic: str = ""


def mcap_film(path: Path, topic: str | None) -> Film:
    """The pictures on one channel of an MCAP file. Raises ImportingError."""

    with path.open("rb") as file:
        if _is_cut_off(file):
            raise ImportingError(f"{path} has no end: `mcap recover` (of a recording `aolink copy`) saves the rest")
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
        raise ImportingError(f"{path} has pictures on {', '.join(sorted(pictures))}: say which with --film topic=NAME")
    return pictures[0]


def _film(path: Path, topic: str, messages: Callable[[], Iterator[_Stamped]]) -> Film:
    first: _Stamped | None = None
    stamps, arrivals, pictures, lossy = [], [], set[tuple[int, bytes]](), False
    for each in messages():
        first = each if first is None else first
        one, other = first.picture, each.picture
        if (one.shape, one.dtype, first.mosaic) != (other.shape, other.dtype, each.mosaic):
            change = f"{one.dtype} of shape {one.shape} to {other.dtype} of shape {other.shape}"
            raise ImportingError(f"{path}: pictures on {topic} change from {change}: a film has frames of one kind")
        stamps.append(each.time_ns)
        arrivals.append(each.arrival_ns)
        lossy |= each.lossy
        pictures.add((each.time_ns, hashlib.blake2b(other.tobytes(), digest_size=16).digest()))
    if first is None:
        raise ImportingError(f"{path} has no picture on {topic}")
    stamped, notes = all(stamps) and len(set(stamps)) == len(pictures), []  # a message may come twice
    if not stamped:
        why = "some pictures have no time of their own" if not all(stamps) else "pictures share a time of their own"
        why = why if any(stamps) else "the pictures have no times of their own"
        notes.append(f"{why}: those of their arrival are used")
    else:
        jumps = np.diff(np.array(stamps, np.int64) - np.array(arrivals, np.int64))
        notes += [
            f"the clock of the stamps jumps by {jumps[k] / 1e9:.6g} s at frame {k + 2}, by the times of arrival"
            for k in np.flatnonzero(np.abs(jumps) > _JUMP_NS)[:3]
        ]
    times = np.array(stamps if stamped else arrivals, dtype=np.int64)
    start = int(times[0])
    if stamped and not dated(start) and dated(arrivals[0]):
        start = arrivals[0]
        notes.append("the stamps count from the start of a clock: the first picture has the date of its arrival")
    rows, columns = first.picture.shape[:2]
    return Film(
        name=f"{path.name}:{topic}", shape=(int(rows), int(columns)), dtype=first.picture.dtype, count=len(times),
        pictures=lambda: (each.picture for each in messages()), start_ns=start, times_ns=times,
        nonlinear=COMPRESSED if lossy else "", top=first.top, mosaic=first.mosaic, notes=tuple(notes),
    )  # fmt: skip


def raw_picture(data: bytes, encoding: str, height: int, width: int, step: int, big_endian: bool = False) -> FilmFrame:
    """Pixels of a raw picture, (rows, columns) or (rows, columns, 2 to 4). Raises ImportingError."""
    name = encoding.lower()
    bayer = _BAYER.match(name)
    found = _OPENCV.match(f"{bayer[2]}uc1" if bayer else _NAMES.get(name, name).lower())
    if found is None or (found[2] == "f") != (int(found[1]) >= 32 and found[2] != "s"):
        raise ImportingError(f"pictures are encoded as {encoding!r}: {', '.join(_NAMES)}, bayer_rggb8 (and the like)"
                             " and OpenCV's such as 16SC1 can be read")  # fmt: skip
    channels = int(found[3] or 1)
    kind = np.dtype(f"{found[2]}{int(found[1]) // 8}".replace("s", "i")).newbyteorder(">" if big_endian else "<")
    row = width * kind.itemsize * channels
    step = step or row
    if not height or not width or step < row or len(data) < step * (height - 1) + row:
        raise ImportingError(f"a picture of {height} x {width} pixels has {len(data)} bytes only: the file is damaged")
    rows = np.lib.stride_tricks.as_strided(np.frombuffer(data, np.uint8), (height, row), (step, 1))
    pixels = np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="))
    return pixels.reshape(height, width, channels) if channels > 1 else pixels


def compressed_picture(data: bytes, kind: str = "") -> tuple[FilmFrame, bool, float | None]:
    """Pixels of a JPEG, PNG or another picture, (rows, columns) or (rows, columns, 2 to 4), whether it is lossy, and
    the largest value of a pixel where it is not that of the type.

    Depths of ROS's compressedDepth, whose ``kind`` says so, are a PNG after a header of 12 bytes; depths that it keeps
    as floating-point numbers become these. Raises ImportingError.
    """
    depth = "compresseddepth" in kind.lower()
    try:
        pixels, top, lossy = decoded(data[12:] if depth else data)
    except OSError as error:
        said = "their format is not known" if "identify" in str(error) else str(error)
        raise ImportingError(f"compressed pictures cannot be read ({said}): JPEG and PNG can") from None
    if depth and kind.lower().startswith("32fc1"):
        a, b = np.frombuffer(data, "<f4", 2, 4)
        with np.errstate(divide="ignore"):
            pixels = np.where(pixels > 0, a / (pixels.astype(np.float32) - b), np.float32(np.nan))
    return pixels, lossy, top


def _mosaic(encoding: str) -> str:
    found = _BAYER.match(encoding.lower())
    return found[1].upper() if found else ""


def _foxglove_raw(data: bytes, arrival_ns: int) -> _Stamped:
    image = RawImage.FromString(data)
    picture = raw_picture(image.data, image.encoding, image.height, image.width, image.step)
    return _Stamped(image.timestamp.ToNanoseconds(), arrival_ns, picture, mosaic=_mosaic(image.encoding))


def _foxglove_compressed(data: bytes, arrival_ns: int) -> _Stamped:
    image = CompressedImage.FromString(data)
    return _Stamped(image.timestamp.ToNanoseconds(), arrival_ns, *compressed_picture(image.data, image.format))


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
        return _Stamped(time_ns, arrival_ns, *compressed_picture(image.data.tobytes(), image.format))
    big = bool(image.is_bigendian)
    picture = raw_picture(image.data.tobytes(), image.encoding, image.height, image.width, image.step, big)
    return _Stamped(time_ns, arrival_ns, picture, mosaic=_mosaic(image.encoding))


_DECODERS: dict[str, Callable[[bytes, int], _Stamped]] = {
    "foxglove.RawImage in protobuf": _foxglove_raw,
    "foxglove.CompressedImage in protobuf": _foxglove_compressed,
}
for _name in ("Image", "CompressedImage"):
    _DECODERS[f"sensor_msgs/{_name} in ros1"] = _ros_reader(_name, "ROS1_NOETIC", "ros1")
    _DECODERS[f"sensor_msgs/msg/{_name} in cdr"] = _ros_reader(_name, "LATEST", "cdr")
"""Decoders of a channel, by the schema and the encoding of its messages."""
