"""Films from MCAP files and ROS bags: foxglove.RawImage and CompressedImage, sensor_msgs/Image and CompressedImage."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.extensions import needs_extra
from aolink.importing.film import Film, Frame

_ENCODINGS = {
    "mono8": "u1", "8uc1": "u1", "mono16": "<u2", "16uc1": "<u2", "32fc1": "<f4", "64fc1": "<f8",
    "rgb8": "u1", "bgr8": "u1", "8uc3": "u1", "rgba8": "u1", "bgra8": "u1",
}  # fmt: skip
_COLOURS = {"rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4}
_LOSSY = "the pictures are compressed with JPEG, after a gamma curve"


@dataclass(frozen=True, eq=False)
class _Stamped:
    """A picture of a bag."""

    time_ns: int
    """Its own stamp, or 0 where it has none."""
    arrival_ns: int
    picture: Frame
    lossy: bool


def mcap_film(path: Path, topic: str | None) -> Film:
    """The pictures on one channel of an MCAP file. Raises ImportingError."""

    def channels() -> dict[str, str]:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        if summary is None:
            raise ImportingError(f"{path} has no index: `aolink recover` or `mcap recover` makes one")
        schemas = {number: schema.name for number, schema in summary.schemas.items()}
        return {each.topic: schemas.get(each.schema_id, "") for each in summary.channels.values()}

    try:
        chosen = _chosen(channels(), topic, path)

        def messages() -> Iterator[_Stamped]:
            with path.open("rb") as file:
                for schema, _, message in make_reader(file).iter_messages(topics=[chosen]):
                    read = _DECODERS[schema.name if schema else ""]
                    yield read(message.data, message.publish_time or message.log_time)

        return _film(path, chosen, messages)
    except (McapError, DecodeError) as error:
        raise ImportingError(f"{path} is damaged or no MCAP file: {error}") from None


def ros_film(path: Path, topic: str | None) -> Film:
    """The pictures on one topic of a ROS 1 or ROS 2 bag. Raises ImportingError."""
    with needs_extra("ros", ImportingError):
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

    def opened() -> Any:
        return AnyReader([path], default_typestore=get_typestore(Stores.LATEST))

    try:
        with opened() as bag:
            types = {each.topic: each.msgtype.replace("/msg/", "/") for each in bag.connections}
        chosen = _chosen(types, topic, path)

        def messages() -> Iterator[_Stamped]:
            with opened() as bag:
                wanted = [each for each in bag.connections if each.topic == chosen]
                for connection, arrival_ns, data in bag.messages(connections=wanted):
                    yield _ros(bag.deserialize(data, connection.msgtype), arrival_ns)

        return _film(path, chosen, messages)
    except AnyReaderError as error:
        raise ImportingError(f"{path} cannot be read as a ROS bag: {error}") from None


def _chosen(types: dict[str, str], topic: str | None, path: Path) -> str:
    pictures = [name for name, kind in types.items() if kind in _DECODERS]
    if topic is not None and topic in pictures:
        return topic
    have = ", ".join(f"{name} ({kind})" for name, kind in types.items()) or "nothing"
    if topic is not None or not pictures:
        raise ImportingError(f"{path} has no pictures on {topic or 'any topic'}: it has {have}")
    if len(pictures) > 1:
        raise ImportingError(f"{path} has pictures on {', '.join(pictures)}: say which with --topic")
    return pictures[0]


def _film(path: Path, topic: str, messages: Callable[[], Iterator[_Stamped]]) -> Film:
    first: Frame | None = None
    stamps, arrivals, lossy = [], [], False
    for each in messages():
        first = each.picture if first is None else first
        if each.picture.shape != first.shape:
            raise ImportingError(f"{path}: pictures on {topic} change their size from {first.shape}: give one film")
        stamps.append(each.time_ns)
        arrivals.append(each.arrival_ns)
        lossy |= each.lossy
    if first is None:
        raise ImportingError(f"{path} has no picture on {topic}")
    stamped = all(stamps) and len(set(stamps)) == len(stamps)
    times = np.array(stamps if stamped else arrivals, dtype=np.int64)
    return Film(
        name=f"{path.name}:{topic}", shape=(int(first.shape[0]), int(first.shape[1])), dtype=first.dtype,
        count=len(times), frames=lambda: (each.picture for each in messages()), start_ns=int(times[0]), times_ns=times,
        nonlinear=_LOSSY if lossy else "",
        notes=() if stamped else ("the pictures have no times of their own: those of their arrival are used",),
    )  # fmt: skip


def raw_picture(data: bytes, encoding: str, height: int, width: int, step: int, big_endian: bool = False) -> Frame:
    """Pixels of a raw picture in grey, (rows, columns). Raises ImportingError."""
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
        return np.asarray(pixels.reshape(height, width, -1)[..., :3].mean(axis=2))
    return np.asarray(pixels.astype(kind.newbyteorder("=")))


def compressed_picture(data: bytes) -> tuple[NDArray[Any], bool]:
    """Pixels of a JPEG or PNG in grey, (rows, columns), and whether it is lossy. Raises ImportingError."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            lossy = image.format != "PNG"
            pixels = np.asarray(image)
    except (OSError, ValueError) as error:
        raise ImportingError(f"a compressed picture cannot be read: {error}") from None
    return (pixels[..., :3].mean(axis=2) if pixels.ndim == 3 else pixels), lossy


def _foxglove_raw(data: bytes, arrival_ns: int) -> _Stamped:
    image = RawImage.FromString(data)
    picture = raw_picture(image.data, image.encoding, image.height, image.width, image.step)
    return _Stamped(image.timestamp.ToNanoseconds(), arrival_ns, picture, False)


def _foxglove_compressed(data: bytes, arrival_ns: int) -> _Stamped:
    image = CompressedImage.FromString(data)
    return _Stamped(image.timestamp.ToNanoseconds(), arrival_ns, *compressed_picture(image.data))


def _ros1(kind: str) -> Callable[[bytes, int], _Stamped]:
    def read(data: bytes, arrival_ns: int) -> _Stamped:
        with needs_extra("ros", ImportingError):
            from rosbags.typesys import Stores, get_typestore
        return _ros(get_typestore(Stores.ROS1_NOETIC).deserialize_ros1(data, f"sensor_msgs/msg/{kind}"), arrival_ns)

    return read


def _ros2(kind: str) -> Callable[[bytes, int], _Stamped]:
    def read(data: bytes, arrival_ns: int) -> _Stamped:
        with needs_extra("ros", ImportingError):
            from rosbags.typesys import Stores, get_typestore
        return _ros(get_typestore(Stores.LATEST).deserialize_cdr(data, f"sensor_msgs/msg/{kind}"), arrival_ns)

    return read


def _ros(image: Any, arrival_ns: int) -> _Stamped:
    stamp = image.header.stamp
    time_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
    if hasattr(image, "format"):
        return _Stamped(time_ns, arrival_ns, *compressed_picture(image.data.tobytes()))
    big = bool(image.is_bigendian)
    picture = raw_picture(image.data.tobytes(), image.encoding, image.height, image.width, image.step, big)
    return _Stamped(time_ns, arrival_ns, picture, False)


_DECODERS: dict[str, Callable[[bytes, int], _Stamped]] = {
    "foxglove.RawImage": _foxglove_raw,
    "foxglove.CompressedImage": _foxglove_compressed,
    "sensor_msgs/Image": _ros1("Image"),
    "sensor_msgs/CompressedImage": _ros1("CompressedImage"),
    "sensor_msgs/msg/Image": _ros2("Image"),
    "sensor_msgs/msg/CompressedImage": _ros2("CompressedImage"),
}
"""By the name of the schema."""
