"""Frames keep the times that their file has; what is not known is said."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from aolink.films.film import array_film
from aolink.films.formats import open_film
from aolink.importing.frames import FilmAccount, FilmSettings
from aolink.importing.recording import import_film
from aolink.recording.reader import Recording
from tests.importing import others
from tests.importing.others import numbers
from tests.importing.rigs import small_rig

FRAMES = numbers(np.uint16, 6, 8, 8)


def made(tmp_path, film, **options):
    account: FilmAccount = import_film(film, small_rig(), FilmSettings(**options), tmp_path / "a.mcap", overwrite=True)
    return list(Recording(tmp_path / "a.mcap")), account


def test_exposures_have_the_times_of_their_frames(tmp_path):
    """The rig has 50 frames/s, the film half a hundredth less, and jitter."""
    times = np.rint(np.arange(6) * 20.1e6 + [0, 900, 5000, -7000, 100, 3]).astype(np.int64)
    exposures, account = made(tmp_path, array_film(FRAMES, "film", times_ns=times, start_ns=1_790_000_000_000_000_001))
    np.testing.assert_array_equal([each.host_start_ns for each in exposures], times + 1_790_000_000_000_000_001)
    assert [each.first_step for each in exposures] == [0, 20, 40, 60, 80, 100]
    assert any("the frames came at 49.7" in note and "-0.50% from the rig file's 50" in note for note in account.notes)


def test_commands_stay_with_their_frames_at_another_rate(tmp_path):
    count, period = 150, 20_100_000
    inputs = np.arange(count)[:, None] * np.array([1e-5, -1e-5])
    film = array_film(
        np.zeros((count, 8, 8), np.uint16), "film", times_ns=np.arange(count) * period, inputs=inputs,
        input_times_ns=np.arange(count) * period,
    )  # fmt: skip
    exposures, _ = made(tmp_path, film)
    np.testing.assert_array_equal([each.inputs[0] for each in exposures], inputs)


def test_gaps_are_said_with_their_lengths(tmp_path):
    times = np.array([0, 1, 4, 5, 6, 18_006]) * 20_000_000
    _, account = made(tmp_path, array_film(FRAMES, "film", times_ns=times))
    assert account.missing == 18_001
    expected = (
        "18001 frames are missing by the times of the others: 2 after frame 2 (0.06 s), 17999 after frame 5 (360 s)"
    )
    assert expected in account.notes


def test_stamps_that_jump_against_their_arrival_are_said(tmp_path):
    stamps = others.STAMPS + 3600 * 10**9 * (np.arange(7) >= 4)
    images = [others.foxglove_raw(each, "mono8", int(t)) for each, t in zip(numbers(np.uint8), stamps, strict=True)]
    film = open_film(others.write_mcap(tmp_path / "a.mcap", {"/camera": images}))
    assert film.notes == ("the clock of the stamps jumps by 3600 s at frame 5, by the times of arrival",)


def test_seconds_since_1970_lose_nothing_more_and_nanoseconds_stay(tmp_path):
    times = 1_790_000_000_123_456_789 + np.arange(6) * 20_000_000
    np.savez(tmp_path / "a.npz", frames=FRAMES, times_ns=times)
    np.testing.assert_array_equal(open_film(tmp_path / "a.npz").times_ns, times)
    np.savez(tmp_path / "b.npz", frames=FRAMES, times_s=times / 1e9)
    found = open_film(tmp_path / "b.npz").times_ns
    assert found is not None
    assert abs(found - times).max() <= 240


def test_frames_that_a_video_lacks_are_a_gap(tmp_path):
    frames = numbers(np.uint8, 6, 16, 16)
    film = open_film(others.write_stream(tmp_path / "a.mkv", frames, "ffv1", "gray", 300.0, [0, 1, 2, 6, 7, 8]))
    np.testing.assert_array_equal(list(film.frames()), frames)
    assert film.times_ns is not None
    assert abs(film.times_ns - np.array([0, 1, 2, 6, 7, 8]) * 1e9 / 300).max() <= 1


def test_ome_planes_have_their_own_times(tmp_path):
    delta = [0.0, 40.0, 81.0, 120.0, 160.0, 200.0]
    plane = {"DeltaT": delta, "DeltaTUnit": ["ms"] * 6}
    tifffile.imwrite(tmp_path / "a.ome.tif", FRAMES, metadata={"axes": "TYX", "TimeIncrement": 0.05, "Plane": plane})
    film = open_film(tmp_path / "a.ome.tif")
    np.testing.assert_array_equal(film.times_ns, np.array(delta) * 1e6)
    assert film.rate_hz is None


def test_a_folder_of_fits_files_has_their_dates(tmp_path):
    folder = tmp_path / "film"
    folder.mkdir()
    for k, each in enumerate(FRAMES):
        others.write_fits(folder / f"{k}.fits", each, DATE_OBS=f"2026-09-21T10:30:00.{20_000_001 * k:09d}")
    film = open_film(folder)
    np.testing.assert_array_equal(film.times_ns, 1_789_986_600_000_000_000 + np.arange(6) * 20_000_001)
    others.write_fits(folder / "7.fits", FRAMES[0])
    film = open_film(folder)
    assert film.times_ns is None
    assert "6 of 7 files have a time of their own: these times are not used" in film.notes


@pytest.mark.parametrize(
    ("header", "start_ns", "says"),
    [
        ({"DATE_OBS": "2026-09-21", "TIME_OBS": "10:30:00.000000001"}, 1_789_986_600_000_000_001, None),
        ({"DATE_OBS": "2026-09-21T10:30:37", "TIMESYS": "TAI"}, 1_789_986_600_000_000_000, None),
        ({"DATE_OBS": "2026-09-21"}, None, "its start is not known: DATE-OBS is '2026-09-21' (it has no time of day)"),
        ({"DATE_OBS": "2016-12-31T23:59:60.5"}, None, "its start is not known: DATE-OBS is '2016-12-31T23:59:60.5'"),
        ({"DATE_OBS": "21/09/98", "TIME_OBS": "10:30:00"}, None, "its start is not known: DATE-OBS is '21/09/98T10"),
    ],
)
def test_a_start_that_is_not_known_is_said(header, start_ns, says, tmp_path):
    film = open_film(others.write_fits(tmp_path / "a.fits", FRAMES, **header))
    assert film.start_ns == start_ns
    assert not film.notes if says is None else film.notes[0].startswith(says)


@pytest.mark.parametrize(
    ("name", "value", "seconds"),
    [
        ("exposure_s", 0.04, 0.04), ("exposure_time_s", 0.05, 0.05), ("exposure_ms", 12.0, 0.012),
        ("exposureTimeUs", 900.0, 9e-4),
    ],
)  # fmt: skip
def test_the_unit_of_an_exposure_that_its_name_has_is_taken(name, value, seconds, tmp_path):
    """Also where it does not fit between the frames: that is said and not mended by another unit."""
    np.savez(tmp_path / "film.npz", frames=FRAMES, rate_hz=30.0, **{name: value})
    assert open_film(tmp_path / "film.npz").exposure_s == pytest.approx(seconds)
