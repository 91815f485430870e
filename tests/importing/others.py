"""Films as other programs write them: each function writes one with its own package and gives its path."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import aotpy
import av
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap.writer import Writer as McapWriter
from mcap_protobuf.writer import Writer as ProtobufWriter
from numpy.typing import NDArray
from PIL import Image
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from aolink.errors import ImportingError
from aolink.films.formats import open_film

START_NS = 1_790_000_000_123_456_789
PERIOD_NS = 20_000_000
STAMPS = START_NS + np.arange(7) * PERIOD_NS


def numbers(dtype: Any, count: int = 7, rows: int = 6, columns: int = 9, seed: int = 1) -> NDArray[Any]:
    """Frames in which no two pixels need be alike, (count, rows, columns)."""
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return rng.standard_normal((count, rows, columns)).astype(dtype)
    return rng.integers(0, np.iinfo(dtype).max, (count, rows, columns), dtype)


def smooth(count: int, rows: int, columns: int) -> NDArray[np.uint8]:
    """Frames that compression harms little: a slope that grows brighter from frame to frame."""
    y, x = np.mgrid[:rows, :columns]
    frames = [40 + 10 * k + 80 * x / columns + 40 * y / rows for k in range(count)]
    return np.rint(frames).astype(np.uint8)


def encoded(picture: NDArray[Any], kind: str) -> bytes:
    """A picture as a PNG or JPEG of Pillow's."""
    data = io.BytesIO()
    Image.fromarray(picture).save(data, format=kind)
    return data.getvalue()


def foxglove_raw(
    picture: NDArray[Any], encoding: str, time_ns: int = 0, padding: int = 0,
) -> RawImage:  # fmt: skip
    """A picture as foxglove.RawImage, whose rows end with ``padding`` bytes that are no pixels."""
    rows = picture.reshape(len(picture), -1)
    padded = [row.tobytes() + b"\xaa" * padding for row in rows]
    image = RawImage(
        width=picture.shape[1], height=len(picture), encoding=encoding, step=len(padded[0]), data=b"".join(padded)
    )
    if time_ns:
        image.timestamp.FromNanoseconds(time_ns)
    return image


def foxglove_compressed(picture: NDArray[Any], kind: str, time_ns: int) -> CompressedImage:
    image = CompressedImage(data=encoded(picture, kind), format=kind)
    image.timestamp.FromNanoseconds(time_ns)
    return image


def write_mcap(path: Path, topics: Mapping[str, Sequence[Message]], first_ns: int = START_NS) -> Path:
    """An MCAP file of messages, which arrive a frame period apart."""
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for topic, messages in topics.items():
            for k, message in enumerate(messages):
                at = first_ns + k * PERIOD_NS
                writer.write_message(topic, message, log_time=at, publish_time=at)
    return path


def ros_image(store: Any, picture: NDArray[Any], encoding: str, time_ns: int, *, big_endian: bool = False) -> Any:
    """sensor_msgs/Image with the pixels as they lie in memory."""
    types = store.types
    header = _ros_header(store, time_ns)
    data = np.frombuffer(picture.tobytes(), np.uint8)
    rows, columns = picture.shape[:2]
    return types["sensor_msgs/msg/Image"](
        header=header, height=rows, width=columns, encoding=encoding, is_bigendian=int(big_endian),
        step=data.size // rows, data=data,
    )  # fmt: skip


def ros_compressed(store: Any, picture: NDArray[Any], kind: str, time_ns: int) -> Any:
    """sensor_msgs/CompressedImage."""
    data = np.frombuffer(encoded(picture, kind), np.uint8)
    return store.types["sensor_msgs/msg/CompressedImage"](header=_ros_header(store, time_ns), format=kind, data=data)


def _ros_header(store: Any, time_ns: int) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    more = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **more)


ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)


def write_ros1(path: Path, topics: Mapping[str, Sequence[Any]]) -> Path:
    with rosbag1.Writer(path) as bag:
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__
            connection = bag.add_connection(topic, kind, typestore=ROS1)
            for k, message in enumerate(messages):
                bag.write(connection, START_NS + k * PERIOD_NS, ROS1.serialize_ros1(message, kind))
    return path


def write_ros2(path: Path, topics: Mapping[str, Sequence[Any]], storage: str = "sqlite3") -> Path:
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()]) as bag:
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__
            connection = bag.add_connection(topic, kind, typestore=ROS2)
            for k, message in enumerate(messages):
                bag.write(connection, START_NS + k * PERIOD_NS, ROS2.serialize_cdr(message, kind))
    return path


def write_cdr_mcap(path: Path, messages: Sequence[Any], topic: str = "/camera") -> Path:
    """An MCAP file of ROS 2 messages as its own recorder writes them."""
    kind = messages[0].__msgtype__
    definition, _ = ROS2.generate_msgdef(kind, ros_version=2)
    return _plain_mcap(path, kind, "ros2msg", definition, "cdr", [ROS2.serialize_cdr(m, kind) for m in messages], topic)


def write_ros1_mcap(path: Path, messages: Sequence[Any], topic: str = "/camera") -> Path:
    """An MCAP file of ROS 1 messages, as converters make them of bags."""
    kind = messages[0].__msgtype__
    definition, _ = ROS1.generate_msgdef(kind)
    data = [ROS1.serialize_ros1(each, kind) for each in messages]
    return _plain_mcap(path, kind.replace("/msg/", "/"), "ros1msg", definition, "ros1", data, topic)


def _plain_mcap(
    path: Path, name: str, schema_encoding: str, definition: str, encoding: str, messages: Sequence[Any], topic: str,
) -> Path:  # fmt: skip
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(name=name, encoding=schema_encoding, data=definition.encode())
        channel = writer.register_channel(topic=topic, message_encoding=encoding, schema_id=schema)
        for k, data in enumerate(messages):
            at = START_NS + k * PERIOD_NS
            writer.add_message(channel_id=channel, log_time=at, publish_time=at, data=bytes(data))
        writer.finish()
    return path


def write_fits(path: Path, data: NDArray[Any], **header: Any) -> Path:
    """A FITS file by astropy, which keeps unsigned numbers with a BZERO."""
    primary = fits.PrimaryHDU(data)
    primary.header.update({key.replace("_", "-"): value for key, value in header.items()})
    primary.writeto(path)
    return path


def write_aot(
    path: Path,
    frames: NDArray[Any] | None,
    *,
    commands: NDArray[Any] | None = None,
    more: NDArray[Any] | None = None,
    command_times_s: list[float] | None = None,
    framerate: float | None = None,
    times_s: list[float] | None = None,
    slopes: NDArray[Any] | None = None,
) -> Path:
    """AO telemetry of one Shack-Hartmann sensor and its loops, and of a loop that offloads a mirror to itself."""
    telescope, star = aotpy.MainTelescope(uid="telescope"), aotpy.NaturalGuideStar(uid="star")
    time = aotpy.Time(uid="time", timestamps=times_s) if times_s is not None else None
    detector = None
    if frames is not None:
        pixels = aotpy.Image(name="pixels", data=frames, time=time)
        detector = aotpy.Detector(uid="detector", pixel_intensities=pixels, frame_rate=50.0, integration_time=0.02)
    slopes = np.zeros((7, 2, 1), np.float32) if slopes is None else slopes
    sensor = aotpy.ShackHartmann(
        uid="SH", source=star, n_valid_subapertures=slopes.shape[2], detector=detector,
        subaperture_mask=aotpy.Image(name="mask", data=np.zeros((1, 1))),
        measurements=aotpy.Image(name="slopes", data=slopes, time=time, unit="rad"),
    )  # fmt: skip
    mirror = aotpy.DeformableMirror(uid="mirror", telescope=telescope, n_valid_actuators=2)
    given = {"loop": commands, "more": more}
    loops = {uid: aotpy.Image(name=uid, data=each) for uid, each in given.items() if each is not None}
    offloaded = aotpy.Image(name="offloaded", data=np.ones((7, 2), np.float32))
    aotpy.AOSystem(
        ao_mode="SCAO", main_telescope=telescope, sources=[star], wavefront_sensors=[sensor],
        wavefront_correctors=[mirror], date_beginning=datetime(2026, 9, 21, 10, 30, tzinfo=UTC),
        loops=[
            *(
                aotpy.ControlLoop(
                    uid=uid, commanded_corrector=mirror, input_sensor=sensor, commands=each, framerate=framerate,
                    time=None if command_times_s is None else aotpy.Time(uid=f"{uid} time", timestamps=command_times_s),
                )
                for uid, each in loops.items()
            ),
            aotpy.OffloadLoop(uid="off", commanded_corrector=mirror, input_corrector=mirror, commands=offloaded),
        ],
    ).write_to_file(str(path))  # fmt: skip
    return path


def write_pictures(folder: Path, frames: NDArray[Any], kind: str = "png") -> Path:
    """A folder of pictures whose numbers have no leading zeros."""
    folder.mkdir()
    for k, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"frame{k + 5}.{kind}")
    return folder


def write_video(path: Path, frames: NDArray[Any], rate_hz: float = 20.0) -> Path:
    """A video by FFmpeg with a codec that loses little, frames (count, rows, columns, 3)."""
    return write_stream(path, frames, "mpeg4" if path.suffix == ".avi" else "libx264", "yuv420p", rate_hz)


def write_stream(
    path: Path, frames: NDArray[Any], codec: str, kind: str, rate_hz: float = 20.0, at: Sequence[int] | None = None,
) -> Path:  # fmt: skip
    """A video of a codec and a pixel format of FFmpeg's; frame k is the one numbered ``at[k]`` in time."""
    rate = Fraction(rate_hz).limit_denominator(10_000)
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], kind
        stream.options = {"crf": "10", "qmin": "1", "qmax": "2"} if codec in ("libx264", "mpeg4") else {}
        plain = "rgb24" if frames.ndim == 4 and frames.dtype == np.uint8 else kind
        for k, each in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(each), plain)
            frame.pts, frame.time_base = (k if at is None else at[k]), 1 / rate
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def written_npy(folder: Path, frames: NDArray[Any]) -> Path:
    np.save(folder / "film.npy", frames)
    return folder / "film.npy"


def written_npz(folder: Path, frames: NDArray[Any]) -> Path:
    np.savez_compressed(folder / "film.npz", frames=frames, rate_hz=50.0)
    return folder / "film.npz"


def written_tiff(folder: Path, frames: NDArray[Any]) -> Path:
    tifffile.imwrite(folder / "film.tif", frames, photometric="minisblack", compression="zlib")
    return folder / "film.tif"


def written_mcap(folder: Path, frames: NDArray[Any]) -> Path:
    return write_mcap(folder / "film.mcap", {"/camera": [foxglove_raw(each, "mono8") for each in frames]})


def ros_images(store: Any, frames: NDArray[Any], encoding: str, **options: Any) -> list[Any]:
    return [ros_image(store, f, encoding, int(t), **options) for f, t in zip(frames, STAMPS, strict=True)]


Write = Callable[[Path, NDArray[Any]], Path]


def written_ros(write: Callable[..., Path], store: Any, name: str, *options: str) -> Write:
    """Writes frames as a ROS bag of one topic."""
    return lambda folder, frames: write(folder / name, {"/camera": ros_images(store, frames, "mono8")}, *options)


KINDS: dict[str, Write] = {
    "npy": written_npy,
    "npz": written_npz,
    "TIFF": written_tiff,
    "pictures": lambda folder, frames: write_pictures(folder / "film", frames),
    "FITS": lambda folder, frames: write_fits(folder / "film.fits", frames),
    "packed FITS": lambda folder, frames: write_fits(folder / "film.fits.gz", frames),
    "MCAP": written_mcap,
    "ROS 2 MCAP": lambda folder, frames: write_cdr_mcap(folder / "film.mcap", ros_images(ROS2, frames, "mono8")),
    "ROS 1 bag": written_ros(write_ros1, ROS1, "film.bag"),
    "ROS 2 bag": written_ros(write_ros2, ROS2, "film"),
    "ROS 2 bag in MCAP": written_ros(write_ros2, ROS2, "film", "mcap"),
    "AOT": lambda folder, frames: write_aot(folder / "film.fits", frames),
}
"""Writers of frames of 8 bits, by the kind of their files; all of them keep every bit."""


def refused(path: Path, topic: str | None = None) -> str:
    """The one line with which a film is refused, at its opening or while it is read."""
    with pytest.raises(ImportingError) as caught:
        list(open_film(path, topic).frames())
    text = str(caught.value)
    assert "\n" not in text
    assert path.name in text
    return text
