"""Films that somebody else's writer wrote, read back: pixel by pixel, with what their files say of their times."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aotpy
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray
from PIL import Image

from aolink.errors import ImportingError
from aolink.films.film import Film
from aolink.films.formats import open_film
from aolink.recording import topics
from aolink.recording.reader import Recording
from tests.importing import others
from tests.importing.others import KINDS, ROS1, ROS2, STAMPS, START_NS, numbers, refused, smooth


def check(film: Film, frames: NDArray[Any], dtype: Any = None) -> None:
    """The film has these frames, bit for bit, and gives them again when it is asked again."""
    assert film.count == len(frames)
    assert film.shape == frames.shape[1:]
    assert film.dtype.newbyteorder("=") == np.dtype(dtype or frames.dtype)
    for _ in range(2):
        np.testing.assert_array_equal(np.array(list(film.frames())), frames)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_every_kind_are_read_bit_for_bit(kind, tmp_path):
    frames = numbers(np.uint8)
    check(open_film(KINDS[kind](tmp_path, frames)), frames)


@pytest.mark.parametrize("dtype", [np.bool_, np.uint16, np.int32, np.float32, np.float64])
def test_npy_keeps_its_type(dtype, tmp_path):
    frames = numbers(np.uint8) > 99 if dtype is np.bool_ else numbers(dtype)
    film = open_film(others.written_npy(tmp_path, frames))
    check(film, frames)
    assert (film.rate_hz, film.exposure_s, film.start_ns, film.times_ns, film.nonlinear) == (None, None, None, None, "")


@pytest.mark.parametrize("inputs", [np.linspace(0, 1, 14).reshape(7, 2), np.arange(7)], ids=["two", "one"])
def test_npz_says_what_it_knows(inputs, tmp_path):
    frames, times = numbers(np.uint16), np.arange(7) * 0.02 + 3
    facts = {"rate_hz": 50, "exposure_s": 0.015, "times_s": times, "inputs": inputs, "gain": np.eye(3)}
    np.savez(tmp_path / "a.npz", film=frames, **facts)
    film = open_film(tmp_path / "a.npz")
    check(film, frames)
    assert film.rate_hz == 50
    assert film.exposure_s == 0.015
    np.testing.assert_array_equal(film.times_ns, 3_000_000_000 + np.arange(7) * 20_000_000)
    np.testing.assert_array_equal(film.inputs, inputs.reshape(7, -1))


def test_films_of_several_spots_stand_side_by_side(tmp_path):
    spots = np.stack([numbers(np.uint8, seed=k) for k in range(3)])
    np.savez(tmp_path / "a.npz", frames=spots)
    film = open_film(tmp_path / "a.npz")
    check(film, np.concatenate(list(spots), axis=2))
    assert "3 spots stand side by side" in film.notes[0]


@pytest.mark.parametrize("channels", [3, 4])
def test_an_array_of_colours_is_the_mean_of_red_green_and_blue(tmp_path, channels):
    colours = np.stack([numbers(np.uint8, seed=k) for k in range(channels)], axis=3)
    np.save(tmp_path / "a.npy", colours)
    check(open_film(tmp_path / "a.npy"), colours[..., :3].sum(axis=3) / 3, dtype=np.uint8)


def test_spots_of_three_by_three_pixels_are_no_colours(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 7, 3, 3), np.uint8))
    assert open_film(tmp_path / "a.npy").shape == (3, 15)


def test_of_several_stacks_the_one_called_frames_is_the_film(tmp_path):
    frames, more = numbers(np.uint8), numbers(np.uint8, seed=2)
    np.savez(tmp_path / "a.npz", darks=more, frames=frames)
    check(open_film(tmp_path / "a.npz"), frames)
    np.savez(tmp_path / "b.npz", darks=more, light=frames)
    text = refused(tmp_path / "b.npz")
    assert "darks (7, 6, 9), light (7, 6, 9)" in text
    assert "name the array with the film 'frames'" in text


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"times_s": np.arange(6)}, "for 7 frames"),
        ({"times_s": np.array(["now"] * 7)}, "times_s"),
        ({"times_s": np.full(7, np.nan)}, "finite"),
        ({"rate_hz": np.array([50, 60])}, "rate_hz"),
        ({"rate_hz": 0}, "above 0"),
        ({"exposure_s": "long"}, "exposure_s"),
        ({"inputs": np.zeros((7, 1, 1))}, "inputs"),
        ({"frames": np.zeros(4)}, "shape (4,), expected numbers as (frames, rows, columns)"),
        ({"frames": np.zeros((0, 4, 4))}, "shape (0, 4, 4)"),
        ({"frames": np.zeros((3, 4, 4), complex)}, "complex128"),
        ({"frames": np.array([None])}, "it holds objects of Python's"),
    ],
)  # fmt: skip
def test_wrong_arrays_are_refused(arrays, says, tmp_path):
    np.savez(tmp_path / "a.npz", **{"frames": numbers(np.uint8), **arrays})
    assert says in refused(tmp_path / "a.npz")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("count", [1, 7])
def test_tiff_stacks(dtype, count, tmp_path):
    frames = numbers(dtype, count)
    tifffile.imwrite(tmp_path / "a.tiff", frames, photometric="minisblack")
    film = open_film(tmp_path / "a.tiff")
    check(film, frames)
    assert film.rate_hz is None


@pytest.mark.parametrize(
    ("interval", "unit", "rate"),
    [(0.04, None, 25), (40, "ms", 25), (0.04, "s", 25), (0.04, "sec", 25), (40_000, "usec", 25),
     (40_000, r"\u00B5s", 25), (2, "turns", None)],
)  # fmt: skip
def test_an_imagej_stack_says_its_rate_where_its_unit_is_known(interval, unit, rate, tmp_path):
    frames = numbers(np.uint16)
    metadata = {"axes": "TYX", "finterval": interval, **({} if unit is None else {"tunit": unit})}
    tifffile.imwrite(tmp_path / "a.tif", frames, imagej=True, metadata=metadata)
    film = open_film(tmp_path / "a.tif")
    check(film, frames)
    assert film.rate_hz == (rate and pytest.approx(rate))


@pytest.mark.parametrize(("interval", "unit"), [(40, "ms"), (0.04, None), (40_000, "\N{MICRO SIGN}s")])
def test_an_ome_stack_says_its_rate_and_exposure(interval, unit, tmp_path):
    frames = numbers(np.uint16)
    plane = {"ExposureTime": [interval / 2] * len(frames)}
    metadata = {"axes": "TYX", "TimeIncrement": interval, "Plane": plane}
    if unit is not None:
        metadata["TimeIncrementUnit"] = unit
        plane["ExposureTimeUnit"] = [unit] * len(frames)
    tifffile.imwrite(tmp_path / "a.ome.tif", frames, metadata=metadata)
    film = open_film(tmp_path / "a.ome.tif")
    check(film, frames)
    assert film.rate_hz == pytest.approx(25)
    assert film.exposure_s == pytest.approx(0.02)


def test_pictures_that_were_appended_to_a_tiff_file_are_frames(tmp_path):
    frames = numbers(np.uint16)
    for frame in frames:
        tifffile.imwrite(tmp_path / "a.tif", frame, append=True)
    check(open_film(tmp_path / "a.tif"), frames)
    tifffile.imwrite(tmp_path / "a.tif", frames[0, :5], append=True)
    assert "pictures of uint16 of shape (6, 9) and of uint16 of shape (5, 9)" in refused(tmp_path / "a.tif")


def test_of_several_stacks_in_a_tiff_file_the_first_is_taken_and_said(tmp_path):
    frames = numbers(np.uint16)
    for k in range(3):
        tifffile.imwrite(tmp_path / "a.tif", frames + k, append=True, photometric="minisblack")
    film = open_film(tmp_path / "a.tif")
    check(film, frames)
    assert film.notes == ("a.tif holds 3 stacks: the first is taken",)


def test_a_tiff_stack_of_jpegs_is_no_linear_light(tmp_path):
    frames = smooth(7, 32, 48)
    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(tmp_path / "a.tif", save_all=True, append_images=rest, compression="jpeg", quality=95)
    film = open_film(tmp_path / "a.tif")
    assert (film.count, film.shape) == (7, (32, 48))
    assert "JPEG" in film.nonlinear
    assert abs(np.array(list(film.frames())) - frames.astype(float)).max() < 8


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pictures_are_in_the_order_of_their_numbers(dtype, tmp_path):
    frames = numbers(dtype, count=12)
    film = open_film(others.write_pictures(tmp_path / "film", frames))
    check(film, frames)
    assert film.notes == ("pictures in the order of their names, frame5.png to frame16.png",)


def test_pictures_of_other_formats(tmp_path):
    frames = numbers(np.uint16, count=3)
    folder = tmp_path / "film"
    folder.mkdir()
    np.save(folder / "1.npy", frames[0])
    others.write_fits(folder / "2.fits", frames[1])
    tifffile.imwrite(folder / "3.tif", frames[2])
    (folder / "notes.txt").write_text("no picture")
    check(open_film(folder), frames)


def test_a_part_of_a_bag_is_refused_with_what_to_give(tmp_path):
    bag = others.write_ros2(tmp_path / "a", {"/camera": others.ros_images(ROS2, numbers(np.uint8), "mono8")})
    assert "give the bag's folder" in refused(next(bag.glob("*.db3")))
    (bag / "metadata.yaml").unlink()
    assert "has no metadata.yaml, as a ROS 2 bag has" in refused(bag)


def test_hidden_files_are_no_pictures(tmp_path):
    frames = numbers(np.uint8, count=3)
    folder = others.write_pictures(tmp_path / "film", frames)
    (folder / "._frame5.png").write_bytes(b"what macOS keeps about a file")
    check(open_film(folder), frames)


def test_a_pixel_saturated_in_one_colour_is_saturated(tmp_path):
    colours = np.full((1, 2, 2, 3), 90, np.uint8)
    colours[0, 0, 0] = (255, 90, 90)
    film = open_film(others.write_pictures(tmp_path / "film", colours))
    check(film, np.array([[[255, 90], [90, 90]]], float), np.uint8)


def test_pictures_that_are_not_alike_are_refused(tmp_path):
    sizes = others.write_pictures(tmp_path / "sizes", numbers(np.uint8, 3))
    Image.fromarray(numbers(np.uint8)[0, :5]).save(sizes / "frame99.png")
    with pytest.raises(
        ImportingError, match=r"frame99.png has 5 x 9 pixels of uint8, those before it have 6 x 9 pixels"
    ):
        list(open_film(sizes).frames())
    types = others.write_pictures(tmp_path / "types", numbers(np.uint8, 3))
    Image.fromarray(numbers(np.uint16)[0]).save(types / "frame99.png")
    with pytest.raises(ImportingError, match="pixels of uint16, those before it have 6 x 9 pixels of uint8"):
        list(open_film(types).frames())


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.float32, np.float64])
def test_fits_cubes(dtype, tmp_path):
    frames = numbers(dtype)
    check(open_film(others.write_fits(tmp_path / "a.fits", frames)), frames)
    check(open_film(others.write_fits(tmp_path / "b.fit.gz", frames)), frames)
    check(open_film(others.write_fits(tmp_path / "one.fits", frames[0])), frames[:1])
    check(open_film(others.write_fits(tmp_path / "axis.fits", frames[None])), frames)


@pytest.mark.parametrize("count", [7, 3])
def test_of_several_fits_cubes_the_first_is_taken_and_said(count, tmp_path):
    frames = numbers(np.int16)
    fits.HDUList([fits.PrimaryHDU(frames), fits.ImageHDU(frames[:count] + 1)]).writeto(tmp_path / "a.fits")
    film = open_film(tmp_path / "a.fits")
    check(film, frames)
    assert film.notes == ("a.fits holds 2 cubes: the first is taken",)


@pytest.mark.parametrize("kept", [100, 2880, -100])
def test_a_whole_cube_is_read_whatever_follows_it(tmp_path, kept):
    """Zeros after its end, or a second cube that is cut off."""
    frames = numbers(np.int16)
    fits.PrimaryHDU(frames).writeto(tmp_path / "a.fits")
    fits.HDUList([fits.PrimaryHDU(frames), fits.ImageHDU(frames)]).writeto(tmp_path / "two.fits")
    whole, two = (tmp_path / "a.fits").read_bytes(), (tmp_path / "two.fits").read_bytes()
    (tmp_path / "a.fits").write_bytes(whole + bytes(kept) if kept > 0 else two[: len(whole) + 2880 + 100])
    film = open_film(tmp_path / "a.fits")
    check(film, frames)
    assert kept > 0 or "what follows the first cube cannot be read" in film.notes[0]


def test_a_fits_cube_compressed_in_tiles(tmp_path):
    frames = numbers(np.int16)
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(frames)]).writeto(tmp_path / "a.fits.fz")
    check(open_film(tmp_path / "a.fits.fz"), frames)


def test_fits_numbers_with_a_scale(tmp_path):
    frames = numbers(np.int16)
    primary = fits.PrimaryHDU(frames)
    primary.header["BSCALE"], primary.header["BZERO"] = 0.5, 100.0
    # Written as it is: astropy would undo the scale.
    data = frames.astype(">i2").tobytes()
    (tmp_path / "a.fits").write_bytes(
        primary.header.tostring().encode() + data + bytes(-len(data) % 2880)
    )  # fmt: skip
    check(open_film(tmp_path / "a.fits"), (frames * 0.5 + 100).astype(np.float32))


def test_a_fits_header_says_times(tmp_path):
    header = {"EXPTIME": 0.015, "FRATE": 50.0, "DATE_OBS": "2026-09-21T10:30:00.250"}
    film = open_film(others.write_fits(tmp_path / "a.fits", numbers(np.uint16), **header))
    assert (film.rate_hz, film.exposure_s, film.start_ns) == (50, 0.015, 1_789_986_600_250_000_000)
    film = open_film(others.write_fits(tmp_path / "b.fits", numbers(np.uint16), KINTIME=0.04, EXPOSURE=0.03))
    assert (film.rate_hz, film.exposure_s) == (25, 0.03)
    film = open_film(others.write_fits(tmp_path / "c.fits", numbers(np.uint16), EXPTIME="long", DATE_OBS="May"))
    assert (film.rate_hz, film.exposure_s, film.start_ns) == (None, None, None)


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_a_video(name, tmp_path):
    frames = smooth(9, 48, 64)
    film = open_film(others.write_video(tmp_path / name, np.repeat(frames[..., None], 3, axis=3)))
    assert (film.count, film.shape, film.dtype.name) == (9, (48, 64), "uint8")
    assert film.times_ns is not None
    np.testing.assert_array_equal(np.diff(film.times_ns), 50_000_000)
    assert "video" in film.nonlinear
    read = np.array(list(film.frames()))
    assert abs(read.mean(axis=(1, 2)) - frames.mean(axis=(1, 2))).max() < 2
    assert abs(read - frames).max() < 16


def test_a_gif(tmp_path):
    frames = smooth(5, 24, 32) // 10 * 10
    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(tmp_path / "a.GIF", format="gif", save_all=True, append_images=rest, duration=[40, 10, 20, 500, 40])
    film = open_film(tmp_path / "a.GIF")
    assert (film.count, film.shape) == (5, (24, 32))
    np.testing.assert_array_equal(film.times_ns, np.array([0, 40, 50, 70, 570]) * 10**6)
    read = np.array(list(film.frames()))
    assert abs(read - frames).max() <= 2


@pytest.mark.parametrize(
    ("encoding", "dtype"),
    [("mono8", "u1"), ("8UC1", "u1"), ("mono16", "<u2"), ("16UC1", "<u2"), ("32FC1", "<f4"), ("64FC1", "<f8")],
)
@pytest.mark.parametrize("padding", [0, 6])
def test_foxglove_raw_images(encoding, dtype, padding, tmp_path):
    frames = numbers(np.dtype(dtype))
    images = [others.foxglove_raw(f, encoding, int(t), padding) for f, t in zip(frames, STAMPS, strict=True)]
    film = open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": images}, first_ns=5))
    check(film, frames)
    assert film.start_ns == START_NS
    np.testing.assert_array_equal(film.times_ns, STAMPS)
    assert film.notes == ()


@pytest.mark.parametrize(("encoding", "channels"), [("rgb8", 3), ("bgr8", 3), ("rgba8", 4), ("bgra8", 4)])
def test_colours_of_raw_images_become_grey(encoding, channels, tmp_path):
    colours = np.stack([numbers(np.uint8, seed=k) for k in range(channels)], axis=-1)
    images = [others.foxglove_raw(each, encoding, padding=5) for each in colours]
    film = open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": images}))
    check(film, colours[..., :3].mean(axis=3), np.uint8)


def test_pictures_without_stamps_have_the_times_of_their_arrival(tmp_path):
    film = open_film(others.written_mcap(tmp_path, numbers(np.uint8)))
    np.testing.assert_array_equal(film.times_ns, STAMPS)
    assert "those of their arrival are used" in film.notes[0]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_foxglove_compressed_images_as_png(dtype, tmp_path):
    frames = numbers(dtype)
    images = [others.foxglove_compressed(f, "png", int(t)) for f, t in zip(frames, STAMPS, strict=True)]
    film = open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": images}))
    check(film, frames)
    np.testing.assert_array_equal(film.times_ns, STAMPS)
    assert film.nonlinear == ""


def test_foxglove_compressed_images_as_jpeg(tmp_path):
    frames = smooth(7, 32, 48)
    images = [others.foxglove_compressed(f, "jpeg", int(t)) for f, t in zip(frames, STAMPS, strict=True)]
    film = open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": images}))
    assert "JPEG" in film.nonlinear
    assert abs(np.array(list(film.frames())) - frames.astype(float)).max() < 8


def cut_off(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[:-20])
    return path


def stack_of_stacks(folder: Path) -> Path:
    tifffile.imwrite(folder / "a.tif", np.zeros((2, 3, 8, 8), np.uint8), imagej=True, metadata={"axes": "TZYX"})
    return folder / "a.tif"


def pictures_in_parts(folder: Path) -> Path:
    fits.HDUList([fits.PrimaryHDU(), *map(fits.ImageHDU, numbers(np.int16))]).writeto(folder / "a.fits")
    return folder / "a.fits"


def in_mcap(*messages: Message) -> Callable[[Path], Path]:
    return lambda folder: others.write_mcap(folder / "a.mcap", {"/camera": messages})


TALL, FLAT = (others.foxglove_raw(numbers(np.uint8)[0, :rows], "mono8") for rows in (6, 5))
SAID = [ROS1.types["std_msgs/msg/String"](data="hello")]
NO_FILMS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no picture in a folder": (lambda folder: folder, "no pictures"),
    "a stack of stacks": (stack_of_stacks, "expected (frames, rows, columns)"),
    "FITS without pixels": (lambda folder: others.write_fits(folder / "a.fits", None), "no array of pixels"),  # type: ignore[arg-type]
    "FITS of four axes": (lambda folder: others.write_fits(folder / "a.fits", np.zeros((2, 3, 4, 5))), "(2, 3, 4, 5)"),
    "FITS of pictures": (pictures_in_parts, "7 arrays of shape (6, 9)"),
    "an unknown encoding": (in_mcap(others.foxglove_raw(numbers(np.uint8)[0], "yuv422")), "'yuv422': mono8"),
    "two sizes": (in_mcap(TALL, FLAT), "(6, 9) to uint8 of shape (5, 9)"),
    "parts of a video": (in_mcap(CompressedImage(data=b"a part", format="h264")), "JPEG and PNG can"),
    "an MCAP file without an end": (lambda folder: cut_off(in_mcap(TALL)(folder)), "`mcap recover`"),
    "a bag of words": (lambda folder: others.write_ros1(folder / "a.bag", {"/said": SAID}), "/said (std_msgs/String"),
    "telemetry of nothing": (
        lambda folder: others.write_aot(folder / "a.fits", None, slopes=np.full((7, 2, 1), np.nan)), "all NaN",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", NO_FILMS)
def test_what_is_no_film_is_refused_with_what_it_holds(what, tmp_path):
    write, says = NO_FILMS[what]
    assert says in refused(write(tmp_path))


WRITERS = {
    "ROS 1 bag": (ROS1, "a.bag", others.write_ros1),
    "ROS 2 bag": (ROS2, "a", others.write_ros2),
    "ROS 2 bag in MCAP": (ROS2, "a", lambda path, topics: others.write_ros2(path, topics, "mcap")),
    "ROS 2 MCAP": (ROS2, "a.mcap", lambda path, topics: others.write_cdr_mcap(path, topics["/camera"])),
    "ROS 1 MCAP": (ROS1, "a.mcap", lambda path, topics: others.write_ros1_mcap(path, topics["/camera"])),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_ros_images(kind, tmp_path):
    store, name, write = WRITERS[kind]
    frames = numbers(np.uint16)
    for folder, stored, big_endian in (("little", frames.astype("<u2"), False), ("big", frames.astype(">u2"), True)):
        (tmp_path / folder).mkdir()
        images = others.ros_images(store, stored, "mono16", big_endian=big_endian)
        film = open_film(write(tmp_path / folder / name, {"/camera": images}))
        check(film, frames)
        assert film.start_ns == START_NS
        np.testing.assert_array_equal(film.times_ns, STAMPS)


@pytest.mark.parametrize("kind", WRITERS)
def test_ros_compressed_images(kind, tmp_path):
    store, name, write = WRITERS[kind]
    frames = numbers(np.uint8)
    images = [others.ros_compressed(store, f, "png", int(t)) for f, t in zip(frames, STAMPS, strict=True)]
    film = open_film(write(tmp_path / name, {"/camera": images}))
    check(film, frames)
    np.testing.assert_array_equal(film.times_ns, STAMPS)


@pytest.mark.parametrize("kind", ["MCAP", "ROS 1 bag", "ROS 2 bag"])
def test_of_two_topics_with_pictures_one_is_chosen(kind, tmp_path):
    first, second = numbers(np.uint8), numbers(np.uint8, seed=2)
    if kind == "MCAP":
        both = {name: [others.foxglove_raw(f, "mono8") for f in film] for name, film in (("/a", first), ("/b", second))}
        path = others.write_mcap(tmp_path / "two.mcap", both)
    else:
        store, name, write = WRITERS[kind]
        both = {"/a": others.ros_images(store, first, "mono8"), "/b": others.ros_images(store, second, "mono8")}
        path = write(tmp_path / name, both)
    assert "has pictures on /a, /b: say which with --film topic=NAME" in refused(path)
    check(open_film(path, "/b"), second)
    assert "no pictures on /c: it has /a (" in refused(path, "/c")


@pytest.mark.slow
def test_our_own_recording_is_an_mcap_film(recorded):
    film = open_film(recorded.path, topics.IMAGE)
    exposures = list(Recording(recorded.path).exposures())
    check(film, np.array([each.pixels for each in exposures]))
    assert film.times_ns is not None
    assert abs(np.diff(film.times_ns) / 1e9 - 0.2).max() < 1e-3  # by the clock of its host


def test_telemetry_with_commands_and_times(tmp_path):
    frames, commands = numbers(np.uint16), np.arange(14, dtype=np.float32).reshape(7, 2)
    times = [1_790_000_000 + k / 64 for k in range(7)]
    film = open_film(others.write_aot(tmp_path / "a.fits", frames, commands=commands, times_s=times))
    check(film, frames)
    assert (film.rate_hz, film.exposure_s, film.start_ns) == (50, 0.02, 1_790_000_000_000_000_000)
    np.testing.assert_array_equal(film.times_ns, np.arange(7) * 15_625_000)
    np.testing.assert_array_equal(film.inputs, commands)


def test_telemetry_without_times_begins_at_its_date(tmp_path):
    film = open_film(others.write_aot(tmp_path / "a.fits", numbers(np.uint16), commands=np.ones((5, 2), np.float32)))
    assert film.start_ns == 1_789_986_600_000_000_000
    assert film.times_ns is None
    assert film.inputs is None
    assert (
        "the 5 commands of loop (5 rows) for 7 frames have neither times nor a rate: they are left out" in film.notes[1]
    )


def test_commands_of_loops_that_do_not_command_together_are_left_out_and_said(tmp_path):
    seven, nine = np.ones((7, 2)), np.ones((9, 2))
    film = open_film(others.write_aot(tmp_path / "a.fits", numbers(np.uint16), commands=seven, more=nine))
    assert film.inputs is None
    assert "the loops loop (7 rows) and more (9 rows) do not command together" in film.notes[1]


@pytest.mark.parametrize("kind", ["npy", "npz", "TIFF", "pictures", "FITS", "packed FITS"])
def test_a_topic_of_a_file_without_topics_is_refused(kind, tmp_path):
    text = refused(KINDS[kind](tmp_path, numbers(np.uint8)), "/camera")
    assert "has no topics: --film topic=/camera says which channel of an MCAP file or a bag" in text


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False,
         "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"repeat_schemas": False},
        {"use_chunking": False, "index_types": IndexType.NONE},
    ],
)  # fmt: skip
def test_an_mcap_file_with_a_small_summary_or_none_is_read(options, tmp_path):
    frames = numbers(np.uint8)
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start()
        definition = build_file_descriptor_set(RawImage).SerializeToString()
        schema = writer.register_schema("foxglove.RawImage", "protobuf", definition)
        channel = writer.register_channel("/camera", "protobuf", schema)
        for k in (3, 1, 0, 2, 6, 5, 4):  # messages need not be in order
            message = others.foxglove_raw(frames[k], "mono8", int(STAMPS[k]))
            writer.add_message(channel, int(STAMPS[k]), message.SerializeToString(), int(STAMPS[k]))
        writer.finish()
    film = open_film(tmp_path / "a.mcap")
    check(film, frames)
    np.testing.assert_array_equal(film.times_ns, STAMPS)


def test_raw_and_compressed_pictures_on_one_topic_are_one_film(tmp_path):
    frames = numbers(np.uint8)
    raw = [others.foxglove_raw(f, "mono8", int(t)) for f, t in zip(frames, STAMPS, strict=True)]
    packed = [others.foxglove_compressed(f, "PNG", int(t)) for f, t in zip(frames, STAMPS, strict=True)]
    mixed = [*raw[:3], *packed[3:]]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channels: dict[str, int] = {}
        for kind in (RawImage, CompressedImage):
            definition = build_file_descriptor_set(kind).SerializeToString()
            schema = writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", definition)
            channels[kind.DESCRIPTOR.name] = writer.register_channel("/camera", "protobuf", schema)
        for message, time_ns in zip(mixed, STAMPS.tolist(), strict=True):
            writer.add_message(channels[message.DESCRIPTOR.name], time_ns, message.SerializeToString(), time_ns)
        writer.finish()
    check(open_film(tmp_path / "a.mcap"), frames)


def test_pictures_some_of_which_have_no_stamp_have_the_times_of_their_arrival(tmp_path):
    stamps = [0, *STAMPS[1:].tolist()]
    messages = [others.foxglove_raw(f, "mono8", t) for f, t in zip(numbers(np.uint8), stamps, strict=True)]
    film = open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": messages}))
    assert film.notes == ("some pictures have no time of their own: those of their arrival are used",)


@pytest.fixture
def two_sensors(tmp_path):
    """Telemetry of two wavefront sensors, and the frames of each."""
    frames = [numbers(np.float32, seed=k) for k in (1, 2)]
    sensors = [
        aotpy.Pyramid(
            uid=uid, source=aotpy.NaturalGuideStar(uid=f"star of {uid}"), n_valid_subapertures=1, n_sides=4,
            subaperture_mask=aotpy.Image(name=f"mask of {uid}", data=np.zeros((1, 1))),
            detector=aotpy.Detector(
                uid=f"camera of {uid}", pixel_intensities=aotpy.Image(name=f"pixels of {uid}", data=each)
            ),
        )
        for uid, each in zip(("low", "high"), frames, strict=True)
    ]  # fmt: skip
    sensors[0].detector.dark = aotpy.Image(name="dark", data=np.ones((6, 9), np.float32))
    telescope = aotpy.MainTelescope(uid="telescope")
    mirror = aotpy.TipTiltMirror(uid="mirror", telescope=telescope)
    aotpy.AOSystem(
        ao_mode="SCAO", main_telescope=telescope, sources=[each.source for each in sensors], wavefront_sensors=sensors,
        wavefront_correctors=[mirror],
        loops=[aotpy.ControlLoop(uid="loop", commanded_corrector=mirror, input_sensor=sensors[1])],
    ).write_to_file(str(tmp_path / "a.fits"))  # fmt: skip
    return tmp_path / "a.fits", frames


@pytest.mark.slow
def test_of_two_wavefront_sensors_one_is_chosen(two_sensors):
    path, (low, high) = two_sensors
    first = open_film(path)
    check(first, low)
    assert "a.fits has those of high too: say which with --film topic=NAME" in first.notes
    assert "not applied to the pictures: the detector's dark" in first.notes
    check(open_film(path, "low"), low)
    second = open_film(path, "high")
    check(second, high)
    assert second.notes == ("pictures of the wavefront sensor high",)
    assert "has no wavefront sensor 'other': it has low, high" in refused(path, "other")


def test_telemetry_whose_times_are_not_those_of_its_frames(tmp_path):
    frames = numbers(np.float32)
    short = open_film(others.write_aot(tmp_path / "a.fits", frames, times_s=[0.0, 0.02]))
    assert short.times_ns is None
    assert "not used: 2 times and 0 frame numbers for 7 frames" in short.notes
    path = others.write_aot(tmp_path / "b.fits", frames, times_s=[float("nan"), *np.arange(6) / 50])
    assert "some times of the wavefront sensor SH are no numbers" in refused(path)


def test_frames_of_telemetry_that_are_missing_by_their_numbers(tmp_path):
    path = others.write_aot(tmp_path / "a.fits", numbers(np.float32), times_s=[0.0])
    system = aotpy.AOSystem.read_from_file(path)
    time = system.wavefront_sensors[0].detector.pixel_intensities.time
    time.timestamps, time.frame_numbers = [], [4, 5, 6, 8, 9, 10, 11]
    system.write_to_file(str(tmp_path / "b.fits"))
    film = open_film(tmp_path / "b.fits")
    np.testing.assert_array_equal(film.times_ns, np.array([0, 1, 2, 4, 5, 6, 7]) * 20_000_000)
    assert "frames are missing by their numbers" in film.notes


def numbered(tmp_path, frame_numbers, delay, count=7):
    """Telemetry at 50 frames/s with frame numbers instead of times, and ``count`` commands of a loop with a delay."""
    path = others.write_aot(tmp_path / "a.fits", numbers(np.float32), times_s=[0.0], commands=np.ones((count, 2)))
    system = aotpy.AOSystem.read_from_file(path)
    time = system.wavefront_sensors[0].detector.pixel_intensities.time
    time.timestamps, time.frame_numbers = [], frame_numbers
    system.loops[0].delay, system.loops[0].framerate = delay, 100.0
    system.write_to_file(str(tmp_path / "b.fits"))
    return open_film(tmp_path / "b.fits")


def test_a_delayed_command_follows_its_frame_where_frames_are_missing(tmp_path):
    film = numbered(tmp_path, [4, 5, 6, 8, 9, 10, 11], 1.0)
    np.testing.assert_array_equal(film.input_times_ns, (np.array([0, 1, 2, 4, 5, 6, 7]) + 1) * 20_000_000)
    assert any("from its picture on, 1 frame later" in note for note in film.notes)


def test_commands_at_their_loops_rate_wait_for_its_delay(tmp_path):
    film = numbered(tmp_path, range(7), 2.0, 14)
    np.testing.assert_array_equal(film.input_times_ns, np.arange(14) * 10_000_000 + 40_000_000)


@pytest.mark.slow
def test_a_delay_that_cannot_be_leaves_the_commands_out(tmp_path):
    film = numbered(tmp_path, range(7), -1.0)
    assert film.inputs is None
    assert any("is -1: their commands are left out" in note for note in film.notes)


@pytest.mark.slow
@pytest.mark.parametrize("stated", [[0] * 7, range(0, 70, 10), [253, 254, 255, 0, 1, 2, 3]])
def test_frame_numbers_that_do_not_count_frames_are_not_used(stated, tmp_path):
    film = numbered(tmp_path, list(stated), None)
    assert film.times_ns is None
    assert "the frame numbers do not count up by one: not used" in film.notes


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(7, 4, 2), (7, 2)])
def test_slopes_in_another_order_are_refused(shape, tmp_path):
    telemetry = others.write_aot(tmp_path / "a.fits", None, slopes=np.zeros((7, 2, 1), np.float32))
    system = aotpy.AOSystem.read_from_file(telemetry)
    system.wavefront_sensors[0].measurements.data = np.zeros(shape, np.float32)
    system.write_to_file(str(tmp_path / "b.fits"))
    assert f"has slopes of shape {shape}, expected (frames, 2 directions" in refused(tmp_path / "b.fits")


@pytest.mark.slow
def test_telemetry_without_loops_is_read_without_complaint(two_sensors, tmp_path):
    path, (low, _) = two_sensors
    system = aotpy.AOSystem.read_from_file(path)
    system.loops = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system.write_to_file(str(tmp_path / "b.fits"))
    check(open_film(tmp_path / "b.fits"), low)  # pytest makes errors of warnings
