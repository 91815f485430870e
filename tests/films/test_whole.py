"""Frames are whole, unique and in order, and what a file says of them is read."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from PIL import Image

from aolink.errors import ImportingError
from aolink.films.facts import Said, facts
from aolink.films.film import array_film, other_pixels
from aolink.films.formats import open_film
from aolink.films.names import by_number
from aolink.films.whole import whole_frames
from aolink.importing.frames import FilmSettings, film_times
from tests.importing import others

RNG = np.random.default_rng(3)
FRAMES = np.rint(400 + 40 * RNG.standard_normal((12, 16, 16))).astype(np.uint16)
FRAMES[:, 6:10, 6:10] += 2000


def with_copies(frames):
    film = frames.copy()
    film[5], film[9] = film[4], film[7]
    return film


def with_holes(frames):
    film = frames.copy()
    film[3], film[7] = 0, 4095
    return film


@pytest.mark.parametrize(
    ("damage", "left"),
    [
        (with_copies, [0, 1, 2, 3, 4, 6, 7, 8, 10, 11]),
        (with_holes, [0, 1, 2, 4, 5, 6, 8, 9, 10, 11]),
    ],
)
@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_a_gap_stands_for_a_frame_that_is_none(damage, left, kind):
    found = whole_frames(array_film(damage(FRAMES).astype(kind), "film", rate_hz=5.0))
    np.testing.assert_array_equal(list(found.frames()), FRAMES[left])
    np.testing.assert_array_equal(film_times(found, FilmSettings()).periods, left)
    assert "2 are each" in found.account


@pytest.mark.parametrize(("turn", "share"), [([0, 0], 0.5), ([0, 0, 0], 1 / 3), ([0, 1, 2, 3, 3], 0.8)])
def test_copies_that_come_in_turn_make_a_lower_rate(turn, share):
    kept = len(set(turn))
    order = [kept * k + each for k in range(12 // kept) for each in turn]
    found = whole_frames(array_film(FRAMES[order], "film", times_ns=np.arange(len(order)) * 10_000_000))
    np.testing.assert_array_equal(list(found.frames()), FRAMES)
    times = film_times(found, FilmSettings())
    assert times.missing == 0
    assert times.rate_hz == pytest.approx(100 * share)
    assert film_times(found, FilmSettings(rate_hz=50)).rate_hz == pytest.approx(50 * share)


def test_pixels_that_were_lost_are_no_numbers():
    film = FRAMES.copy()
    film[3, 4:8], film[6, 12:] = 0, film[5, 12:]
    film[:, 0, 0] = 0  # a dead pixel
    found = np.array(list(whole_frames(array_film(film, "film")).frames()))
    lost = np.zeros(film.shape, np.bool_)
    lost[3, 4:8] = lost[6, 12:] = True
    np.testing.assert_array_equal(np.isnan(found), lost)


def test_zeros_of_a_dark_film_are_light():
    film = np.maximum(FRAMES.astype(int) - 420, 0).astype(np.uint16)
    assert not np.isnan(list(whole_frames(array_film(film, "film")).frames())).any()


@pytest.mark.parametrize(
    ("stored", "meant"),
    [
        ((FRAMES - 420).astype(np.uint16), "signed"),
        (FRAMES.byteswap(), "swapped"),
        ((FRAMES.astype(np.int32) * 20).astype(np.int16), "unsigned"),
    ],
)
def test_sixteen_bits_that_are_not_meant_so_are_refused_with_what_reads_them(stored, meant):
    film = array_film(stored, "film")
    with pytest.raises(ImportingError, match=f"pixels={meant}"):
        whole_frames(film)
    found = np.array(list(whole_frames(other_pixels(film, meant)).frames())).astype(np.int64)
    expected = FRAMES.astype(np.int64) * (20 if meant == "unsigned" else 1) - (420 if meant == "signed" else 0)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["f1", "f2", "f4", "f10", "f3"], [0, 1, 2, 3, 9]),
        ([f"img_{(65_526 + k) % 65_536:05d}" for k in range(20)], range(20)),
        ([f"{(253 + k) % 256}" for k in range(6) if k != 4], [0, 1, 2, 3, 5]),
        ([f"t{0.05 * k:g}" for k in range(25) if k != 7], [k for k in range(25) if k != 7]),
        ([f"run1.{k}" for k in range(1, 13)], range(12)),
        ([f"a{k}_b{k * k}" for k in range(5)], None),
        ([f"a{k}" for k in (1, 20, 21, 97)], None),
    ],
)
def test_the_order_of_names_and_what_is_missing_between_them(names, numbers):
    order, found, _ = by_number(sorted(names))
    assert (None if found is None else found.tolist()) == (None if numbers is None else list(numbers))
    if numbers is not None:
        ordered = [sorted(names)[k] for k in order]
        assert ordered == sorted(ordered, key=names.index) or names[2] == "f4"


SECONDS = np.arange(12) * 0.2


@pytest.mark.parametrize(
    ("said", "known"),
    [
        ([Said("fps", 5), Said("exposure", 0.1)], {"rate_hz": 5, "exposure_s": 0.1}),
        ([Said("frame_rate", "5"), Said("Exposure", 100)], {"rate_hz": 5, "exposure_s": 0.1}),
        ([Said("frame rate (kHz)", 0.005), Said("exposureTime", 4000)], {"rate_hz": 5, "exposure_s": 0.004}),
        ([Said("Interval_ms", 200), Said("ExposureTime", "1/250")], {"rate_hz": 5, "exposure_s": 0.004}),
        ([Said("finterval", 0.2, "sec"), Said("fps", 10)], {"rate_hz": 5}),
        ([Said("timestamps", SECONDS)], {"times_ns": SECONDS * 1e9}),
        ([Said("t", SECONDS * 1e3, "ms")], {"times_ns": SECONDS * 1e9}),
        ([Said("times", (SECONDS * 1e6).astype(int)), Said("rate", 5)], {"times_ns": SECONDS * 1e9, "rate_hz": 5}),
        ([Said("time", 1_790_000_000_000 + (SECONDS * 1e3).astype(int))],
         {"times_ns": 1_790_000_000_000_000_000 + SECONDS * 1e9, "start_ns": 1_790_000_000_000_000_000}),
        ([Said("date", "2026-11-22T11:30:00+02:00")], {"start_ns": 1_795_339_800_000_000_000}),
        ([Said("date", "2026-11-22T11:30:00"), Said("rate", -5), Said("times", SECONDS[:5])], {}),
    ],
)  # fmt: skip
def test_times_have_other_names_and_other_units(said, known):
    found, notes = facts(said, 12, longest_s=10)
    assert found.keys() == known.keys()
    for key, value in known.items():
        np.testing.assert_allclose(found[key], value, rtol=1e-12, atol=1)
    assert all(each.name in notes[0] for each in said)
    assert ("not used" in notes[0]) == (not known or len(known) < len(said))


def test_what_is_not_used_is_said(tmp_path):
    np.savez(tmp_path / "a.npz", frames=FRAMES, fps=200, exposure_time=0.004, gain=12)
    assert open_film(tmp_path / "a.npz").notes == ("found: fps 200, exposure_time 0.004 (used); gain 12 (not used)",)


def test_frames_at_the_end_of_a_dataset_that_were_never_written_are_left_out(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (30, 16, 16), "u2", chunks=(1, 16, 16))[:12] = FRAMES
    film = open_film(tmp_path / "a.h5")
    np.testing.assert_array_equal(list(film.frames()), FRAMES)
    assert "last 18" in film.notes[0]


def test_micro_manager_and_a_calibration_of_imagej(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for k, each in enumerate(FRAMES):
            said = json.dumps({"ElapsedTime-ms": 200.0 * k, "Exposure-ms": 100.0})
            file.write(each, metadata=None, extratags=[(51123, 2, 0, said, True)])
    film = open_film(tmp_path / "a.tif")
    np.testing.assert_array_equal(film.times_ns, np.rint(SECONDS * 1e9))
    assert film.exposure_s == 0.1
    signed = FRAMES.astype(np.int16) - 500
    told = {"axes": "TYX", "cf": 0, "c0": -32768, "c1": 1}
    tifffile.imwrite(
        tmp_path / "b.tif", (signed.astype(np.int32) + 32768).astype(np.uint16), imagej=True, metadata=told
    )
    np.testing.assert_array_equal(list(open_film(tmp_path / "b.tif").frames()), signed)


def test_a_folder_of_jpegs_has_the_exposure_times_of_exif(tmp_path):
    for k, each in enumerate(FRAMES):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[33434] = 0.1 if k < 6 else 0.05
        Image.fromarray((each >> 4).astype(np.uint8)).save(tmp_path / f"{k}.jpg", exif=exif)
    film = open_film(tmp_path)
    assert film.exposure_s == 0.1
    assert any("differs" in each for each in film.notes)


def test_undefined_pixels_times_and_mosaics_of_fits(tmp_path):
    cube = fits.PrimaryHDU(FRAMES)
    cube.header.update({"BAYERPAT": "RGGB", "XBAYROFF": 1, "ROWORDER": "BOTTOM-UP"})
    cube.header.update({"DATE-OBS": "2026-11-22T11:30:00", "DATE-UTC": "2026-11-22T09:30:00"})
    cube.data[2, 3, 4] = 0
    cube.header["BLANK"] = -32768
    column = fits.Column("TIMESTAMP", "D", unit="ms", array=SECONDS * 1e3)
    fits.HDUList([cube, fits.BinTableHDU.from_columns([column])]).writeto(tmp_path / "a.fits")
    film = open_film(tmp_path / "a.fits")
    np.testing.assert_array_equal(np.argwhere(np.isnan(list(film.frames()))), [[2, 3, 4]])
    assert (film.dtype.name, film.mosaic, film.start_ns) == ("uint16", "BGGR", 1_795_339_800_000_000_000)
    np.testing.assert_array_equal(film.times_ns, np.rint(SECONDS * 1e9))


def test_colours_in_other_axes_are_colours(tmp_path):
    planes = np.stack([FRAMES, FRAMES // 2, FRAMES // 4], axis=1)
    tifffile.imwrite(tmp_path / "a.tif", planes, imagej=True, metadata={"axes": "TCYX"})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = np.moveaxis(planes, 1, -1)
    for name in ("a.tif", "a.h5"):
        np.testing.assert_array_equal(list(open_film(tmp_path / name).pictures()), np.moveaxis(planes, 1, -1))


def test_a_rate_that_is_given_goes_before_a_player_s_and_gaps_stay(tmp_path):
    eight = (FRAMES >> 4).astype(np.uint8)
    at = [0, 1, 2, 3, 7, 8, 9, 10, 11, 12, 13, 14]
    film = whole_frames(open_film(others.write_stream(tmp_path / "a.mkv", eight, "ffv1", "gray", 30.0, at)))
    times = film_times(film, FilmSettings(rate_hz=5))
    np.testing.assert_array_equal(times.starts_ns, np.array(at) * 200_000_000)
    assert "30" in times.notes[0]


def test_a_video_that_is_cut_off_or_interlaced_is_refused(tmp_path):
    path = others.write_stream(tmp_path / "a.mkv", others.numbers(np.uint8, 40, 64, 64), "ffv1", "gray")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    assert "cut off" in others.refused(path)
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()

    def made(name: str, *options: str) -> Path:
        data = (FRAMES >> 4).astype(np.uint8).tobytes()
        head = ["-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "gray", "-s", "16x16", "-r", "5", "-i", "-"]
        subprocess.run([ffmpeg, *head, *options, "-c:v", "ffv1", tmp_path / name], input=data, check=True)
        return Path(tmp_path / name)

    fields = made("b.mkv", "-vf", "setfield=tff", "-field_order", "tt")
    assert "separatefields" in others.refused(fields)
    film = open_film(made("fields.mkv", "-vf", "setfield=tff,separatefields"))
    np.testing.assert_array_equal(list(film.frames())[:2], [(FRAMES[0] >> 4)[::2], (FRAMES[0] >> 4)[1::2]])


def test_stamps_since_boot_are_no_dates_and_a_message_that_comes_twice_costs_nothing(tmp_path):
    stamps = 12_000_000_000 + np.arange(12) * 200_000_000
    images = [others.foxglove_raw(each, "mono16", int(t)) for each, t in zip(FRAMES, stamps, strict=True)]
    images.insert(5, images[4])
    film = whole_frames(open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": images})))
    np.testing.assert_array_equal(film.times_ns, stamps)
    assert film.start_ns == others.START_NS
    assert "twice" in film.account
