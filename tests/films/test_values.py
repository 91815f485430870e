"""The numbers of a file are those of its format, whether it is a stack, a folder of files or a single picture."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import h5py
import imagecodecs
import netpbmfile
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image

from aolink.films.film import one_colour
from aolink.films.formats import open_film
from tests.importing import others
from tests.importing.others import numbers, refused

TWELVE = numbers(np.uint16, count=3, rows=6, columns=8) % 4096
EIGHT = (TWELVE >> 4).astype(np.uint8)
SIGNED = EIGHT.astype(np.int8)
COLOURS = np.stack([TWELVE * 16, TWELVE * 8, TWELVE * 4], axis=-1)


def packed_tiff(path: Path, frames: NDArray[Any]) -> None:
    """Two pixels of 12 bits in three bytes, as industrial cameras write them."""
    at, parts = 8, [struct.pack("<2sHI", b"II", 42, 8)]
    for k, frame in enumerate(frames):
        one, two = frame.reshape(-1, 2).T.astype(np.uint32)
        data = np.stack([one >> 4, (one & 15) << 4 | two >> 8, two & 255], axis=1).astype(np.uint8).tobytes()
        rows, columns = frame.shape
        start = at + 2 + 9 * 12 + 4
        tags = [(256, 4, columns), (257, 4, rows), (258, 3, 12), (259, 3, 1), (262, 3, 1), (273, 4, start), (277, 3, 1)]
        entries = [struct.pack("<HHII", *tag[:2], 1, tag[2]) for tag in [*tags, (278, 4, rows), (279, 4, len(data))]]
        at = start + len(data)
        parts += [struct.pack("<H", 9), *entries, struct.pack("<I", at if k < len(frames) - 1 else 0), data]
    path.write_bytes(b"".join(parts))


def png_of_ffmpeg(picture: NDArray[Any]) -> bytes:
    """A PNG of three times 16 bits."""
    codec: Any = av.CodecContext.create("png", "w")
    codec.width, codec.height, codec.pix_fmt, codec.time_base = (
        picture.shape[1],
        picture.shape[0],
        "rgb48be",
        Fraction(1, 25),
    )
    frame = av.VideoFrame.from_ndarray(picture, "rgb48le").reformat(format="rgb48be")
    return b"".join(map(bytes, [*codec.encode(frame), *codec.encode(None)]))


def with_palette(path: Path, frames: NDArray[Any]) -> None:
    """Numbers whose meaning the palette turns round."""
    grey = np.arange(255, -1, -1, dtype=np.uint16) * 257
    tifffile.imwrite(path, 255 - frames, photometric="palette", colormap=np.stack([grey] * 3))


TIFFS: dict[str, tuple[Callable[[Path, NDArray[Any]], object], NDArray[Any]]] = {
    "packed 12 bits": (packed_tiff, TWELVE),
    "white is zero": (lambda path, frames: tifffile.imwrite(path, 65535 - frames, photometric="miniswhite"), TWELVE),
    "palette": (with_palette, EIGHT),
    "signed 8 bits": (
        lambda path, frames: tifffile.imwrite(path, frames, photometric="minisblack"),
        SIGNED,
    ),
    "LZW": (lambda path, frames: tifffile.imwrite(path, frames, compression="lzw", photometric="minisblack"), TWELVE),
    "bilevel": (lambda path, frames: tifffile.imwrite(path, ~frames, photometric="miniswhite"), TWELVE > 2000),
    "three times 16 bits": (lambda path, frames: tifffile.imwrite(path, frames, photometric="rgb"), COLOURS),
}


@pytest.mark.parametrize("kind", TIFFS)
def test_a_tiff_stack_a_folder_and_a_picture_have_the_same_numbers(kind, tmp_path):
    write, frames = TIFFS[kind]
    grey = frames if frames.ndim == 3 else frames.mean(axis=3)
    write(tmp_path / "stack.tif", frames)
    (tmp_path / "folder").mkdir()
    for k in range(3):
        write(tmp_path / "folder" / f"{k}.tif", frames[k : k + 1])
    for film in (open_film(tmp_path / "stack.tif"), open_film(tmp_path / "folder")):
        assert (film.dtype, film.nonlinear) == (frames.dtype, "")
        np.testing.assert_array_equal(list(film.frames()), grey)
    np.testing.assert_array_equal(next(open_film(tmp_path / "folder" / "1.tif").frames()), grey[1])


def test_a_folder_of_stacks_has_all_of_their_frames(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", TWELVE[:2])
    tifffile.imwrite(tmp_path / "b.tif", TWELVE[2:])
    np.testing.assert_array_equal(list(open_film(tmp_path).frames()), TWELVE)


def test_an_ome_stack_over_several_files_comes_once(tmp_path):
    with tifffile.TiffWriter(tmp_path / "x.ome.tif", ome=True) as file:
        file.write(TWELVE, photometric="minisblack", metadata={"axes": "TYX"})
    with tifffile.TiffFile(tmp_path / "x.ome.tif") as file:
        ome = file.ome_metadata or ""
    part = '<TiffData FirstT="{0}" IFD="0" PlaneCount="1"><UUID FileName="{0}.ome.tif">urn:uuid:{0}</UUID></TiffData>'
    whole = "".join(map(part.format, range(3)))
    ome = ome[: ome.index("<TiffData")] + whole + ome[ome.index("</Pixels>") :]
    (tmp_path / "x.ome.tif").unlink()
    for k in range(3):
        mine = ome.replace("<OME ", f'<OME UUID="urn:uuid:{k}" ', 1) if "UUID=" not in ome[:400] else ome
        tifffile.imwrite(tmp_path / f"{k}.ome.tif", TWELVE[k], description=mine, metadata=None)
    np.testing.assert_array_equal(list(open_film(tmp_path).frames()), TWELVE)
    np.testing.assert_array_equal(list(open_film(tmp_path / "0.ome.tif").frames()), TWELVE)


@pytest.mark.parametrize("most", [100, 255, 1023, 4095, 65535])
def test_a_pgm_has_its_own_counts_and_its_own_largest_value(most, tmp_path):
    picture = np.minimum(TWELVE[0], most).astype(np.uint8 if most < 256 else np.uint16)
    netpbmfile.imwrite(tmp_path / "a.pgm", picture, maxval=most)
    film = open_film(tmp_path / "a.pgm")
    np.testing.assert_array_equal(next(film.frames()), picture)
    assert film.full_scale == most


@pytest.mark.parametrize("kind", ["PNG", "PNG with transparency", "JPEG 2000", "TIFF"])
def test_three_times_16_bits_stay_16_bits(kind, tmp_path):
    picture = COLOURS[0]
    if kind == "PNG":
        (tmp_path / "a.png").write_bytes(png_of_ffmpeg(picture))
    elif kind == "PNG with transparency":
        picture = np.dstack([picture, picture[..., 0]])
        (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(picture))
    elif kind == "JPEG 2000":
        (tmp_path / "a.jp2").write_bytes(imagecodecs.jpeg2k_encode(picture, reversible=True))
    else:
        tifffile.imwrite(tmp_path / "a.tif", picture, photometric="rgb")
    film = open_film(tmp_path)
    np.testing.assert_array_equal(next(film.pictures()), picture)
    np.testing.assert_array_equal(next(film.frames()), picture[..., :3].sum(axis=2) / 3)


@pytest.mark.parametrize(("kind", "bits"), [("gray", 8), ("gray10le", 10), ("gray12le", 12), ("gray16le", 16)])
def test_a_video_without_loss_keeps_its_bits(kind, bits, tmp_path):
    frames = numbers(np.uint16, count=3, rows=16, columns=16) >> (16 - bits)
    frames = frames.astype(np.uint8) if bits == 8 else frames
    film = open_film(others.write_stream(tmp_path / "a.mkv", frames, "ffv1", kind))
    np.testing.assert_array_equal(list(film.frames()), frames)
    assert (film.full_scale, film.nonlinear) == (2**bits - 1, "")


def test_undefined_pixels_of_a_fits_file_are_no_counts(tmp_path):
    frames = TWELVE.astype(np.int16)
    frames[1, 2, 3] = -1
    primary = fits.PrimaryHDU(frames)
    primary.header["BLANK"] = -1
    primary.writeto(tmp_path / "a.fits")
    film = open_film(tmp_path / "a.fits")
    assert film.dtype == np.int16
    np.testing.assert_array_equal(list(film.frames()), np.where(frames == -1, np.nan, frames))


def test_fits_numbers_with_the_exponent_d(tmp_path):
    header = fits.PrimaryHDU(TWELVE.astype(np.int16)).header.tostring()
    cards = [header[k : k + 80] for k in range(0, len(header), 80) if header[k : k + 4].strip()]
    cards[-1:] = [
        "EXPTIME =              1.5D-01".ljust(80),
        "BSCALE  =              2.0D+00".ljust(80),
        "END".ljust(80),
    ]
    data = TWELVE.astype(">i2").tobytes()
    (tmp_path / "a.fits").write_bytes("".join(cards).ljust(2880).encode() + data + bytes(-len(data) % 2880))
    film = open_film(tmp_path / "a.fits")
    assert film.exposure_s == 0.15
    np.testing.assert_array_equal(list(film.frames()), TWELVE * 2.0)


def test_previews_beside_pictures_are_left_out(tmp_path):
    for k, each in enumerate(EIGHT):
        Image.fromarray(each).save(tmp_path / f"{k}.png")
        Image.fromarray(each).save(tmp_path / f"{k}.jpg")
    film = open_film(tmp_path)
    np.testing.assert_array_equal(list(film.frames()), EIGHT)
    assert "3 JPEG files beside other pictures are left out" in film.notes[0]
    np.save(tmp_path / "1.npy", EIGHT[1])
    assert "1.npy and 1.png have one name" in refused(tmp_path)


@pytest.mark.parametrize("attributes", [False, True])
def test_hdf5(attributes, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("entry/data", data=TWELVE)
        facts = {"rate_hz": 50.0, "times_ns": np.arange(3) * 20_000_000 + 5}
        for name, value in facts.items():
            if attributes:
                data.attrs[name] = value
            else:
                file[f"entry/{name}"] = value
    film = open_film(tmp_path / "a.h5")
    np.testing.assert_array_equal(list(film.frames()), TWELVE)
    assert film.rate_hz == 50
    np.testing.assert_array_equal(film.times_ns, facts["times_ns"])
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["entry/data"], file["entry/dark"] = TWELVE, TWELVE + 1
    assert "say with --film topic=NAME which one has the frames" in refused(tmp_path / "b.h5")
    np.testing.assert_array_equal(list(open_film(tmp_path / "b.h5", "/entry/dark").frames()), TWELVE + 1)


def write_ser(path: Path, frames: NDArray[Any], bits: int, colour: int, stamps: NDArray[Any] | None = None) -> Path:
    rows, columns = frames.shape[1:3]
    header = struct.pack("<14s7i120s2q", b"LUCAM-RECORDER", 0, colour, 0, columns, rows, bits, len(frames), b"", 0, 0)
    ticks = b"" if stamps is None else (stamps // 100 + 621_355_968_000_000_000).astype("<i8").tobytes()
    path.write_bytes(header + frames.tobytes() + ticks)
    return path


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2"])
def test_ser_with_its_stamps(kind, tmp_path):
    frames, stamps = (EIGHT if kind == "u1" else TWELVE), 1_790_000_000_123_456_700 + np.arange(3) * 20_000_000
    path = write_ser(tmp_path / "a.ser", frames.astype(kind), 8 if kind == "u1" else 12, 0, stamps)
    film = open_film(path)
    np.testing.assert_array_equal(list(film.frames()), frames)
    np.testing.assert_array_equal(film.times_ns, stamps)
    assert film.start_ns == stamps[0]
    path.write_bytes(path.read_bytes()[:250])
    assert "cut off" in refused(path)


def test_one_colour_of_a_mosaic_and_of_colours(tmp_path):
    film = open_film(write_ser(tmp_path / "a.ser", TWELVE.astype("<u2"), 12, 9))
    assert "under a Bayer mosaic, GRBG" in film.notes[0]
    red, blue = TWELVE[:, ::2, 1::2], TWELVE[:, 1::2, ::2]
    green = (TWELVE[:, ::2, ::2].astype(float) + TWELVE[:, 1::2, 1::2]) / 2
    for name, expected in (("red", red), ("green", green), ("blue", blue), ("all", (red + green + blue) / 3)):
        assert abs(np.array(list(one_colour(film, name).frames())) - expected).max() < 1e-9
    tifffile.imwrite(tmp_path / "a.tif", COLOURS, photometric="rgb")
    np.testing.assert_array_equal(list(one_colour(open_film(tmp_path / "a.tif"), "blue").frames()), COLOURS[..., 2])
    tifffile.imwrite(tmp_path / "b.tif", TWELVE, photometric="minisblack")
    with pytest.raises(Exception, match="has no colours: leave --film colour out"):
        list(one_colour(open_film(tmp_path / "b.tif"), "red").frames())


@pytest.mark.parametrize(("encoding", "pixels"), [("bgr16", COLOURS), ("16SC1", TWELVE.astype("<i2")), ("8UC2", EIGHT)])
def test_raw_images_of_other_encodings(encoding, pixels, tmp_path):
    pixels = np.stack([pixels, pixels], axis=-1) if encoding == "8UC2" else pixels
    images = [
        others.ros_image(others.ROS2, each, encoding, int(t)) for each, t in zip(pixels, others.STAMPS, strict=False)
    ]
    film = open_film(others.write_cdr_mcap(tmp_path / "a.mcap", images))
    np.testing.assert_array_equal(list(film.pictures()), pixels)


def test_compressed_depths(tmp_path):
    images = []
    for each, t in zip(TWELVE, others.STAMPS, strict=False):
        image = others.ros_compressed(others.ROS2, each, "png", int(t))
        image.format, image.data = "16UC1; compressedDepth png", np.concatenate([np.zeros(12, np.uint8), image.data])
        images.append(image)
    film = open_film(others.write_cdr_mcap(tmp_path / "a.mcap", images))
    np.testing.assert_array_equal(list(film.frames()), TWELVE)


def test_one_picture_among_many_jpegs_is_not_taken_for_the_film(tmp_path):
    for k in range(3):
        Image.fromarray(EIGHT[k]).save(tmp_path / f"{k}.jpg")
    Image.fromarray(EIGHT[0]).save(tmp_path / "plot.png")
    assert "holds 3 JPEG files and 1 others: which are the frames?" in refused(tmp_path)


def test_a_long_film_in_a_file_is_read_in_little_memory(tmp_path: Path) -> None:
    """Pages of a mapped file count as a process's memory until they are given back."""
    path = tmp_path / "long.npy"
    frames = np.lib.format.open_memmap(path, "w+", np.uint16, (400, 512, 512))
    frames[:] = np.arange(400, dtype=np.uint16)[:, None, None]
    del frames
    program = (
        "import re, sys; from pathlib import Path; from aolink.films.formats import open_film\n"
        "used = lambda: int(re.search(r'VmHWM:\\s*(\\d+)', Path('/proc/self/status').read_text())[1])\n"
        "before = used(); film = open_film(Path(sys.argv[1]))\n"
        "last = [int(each.max()) for each in film.frames()]\n"
        "assert last == list(range(400)); print(used() - before)"
    )
    done = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 120_000, "of 210 MB"
