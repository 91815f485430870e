"""A folder of pictures as a camera: a whole session, and what is wrong with a folder in one line."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.devices.cameras.folder import FolderCamera
from aolink.errors import DeviceError, RigError
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from tests.devices.cameras.bench import EXPOSURE_STEPS, counted, pictures, recorded, rig_of, save

Run = Callable[..., subprocess.CompletedProcess[str]]
SHAPE = (1, 40)


@pytest.mark.slow
def test_a_session_records_the_pictures_as_they_are(tmp_path: Path) -> None:
    """They begin again after the last, and each exposure follows the one before without a gap."""
    shown = pictures(5)
    save(tmp_path / "frames", shown)
    rig = rig_of('driver = "folder"\npath = "frames"', tmp_path)
    report, recording, found = recorded(rig, tmp_path / "a.mcap", 8, ["o3"])
    assert (report.ended, report.frames_received + report.frames_lost) == ("complete", 8)
    counted(found, shown)
    starts = np.array([each.first_step + each.start_offset - each.frame_id * EXPOSURE_STEPS for each in found])
    assert np.ptp(starts) < 2  # as well as the clocks can be compared on a busy machine
    assert recording.metadata["camera"] == "5 pictures of frames, repeated"
    assert recording.metadata["camera_lacks"] == ""


def test_a_film_that_ends_ends_the_session_with_what_there_is(tmp_path: Path) -> None:
    np.save(tmp_path / "film.npy", np.array(pictures(5)))
    rig = rig_of('driver = "folder"\npath = "film.npy"\nrepeat = false', tmp_path)
    with pytest.raises(DeviceError, match=r"film.npy has ended after 5 pictures: ask for fewer exposures, .*are saved"):
        record(rig, None, None, tmp_path / "a.mcap", exposures=50)
    found = list(Recording(tmp_path / "a.mcap").exposures())
    assert counted(found, pictures(5)) == sorted(counted(found, pictures(5)))
    assert recorded(rig, tmp_path / "b.mcap", 5)[0].ended == "complete"


def test_the_sensor_may_be_a_part_of_the_pictures(tmp_path: Path) -> None:
    shown = [np.pad(picture, ((3, 4), (5, 6))) for picture in pictures(3)]
    save(tmp_path / "frames", shown)
    rig = rig_of('driver = "folder"\npath = "frames"\ncorner = [3, 5]', tmp_path)
    _, _, found = recorded(rig, tmp_path / "a.mcap", 3)
    counted(found, pictures(3))


def test_a_picture_of_another_size_ends_the_session(tmp_path: Path) -> None:
    save(tmp_path / "frames", [*pictures(3), np.zeros((2, 40), dtype=np.uint16)])
    rig = rig_of('driver = "folder"\npath = "frames"', tmp_path)
    with pytest.raises(DeviceError, match=r"003.png has 2 x 40 pixels .*, those before it have 1 x 40 .*are saved in"):
        record(rig, None, None, tmp_path / "a.mcap", exposures=8)
    counted(list(Recording(tmp_path / "a.mcap").exposures()), pictures(3))


@pytest.mark.slow
def test_a_camera_alone_can_be_calibrated(aolink: Run, tmp_path: Path) -> None:
    """In the dark, as far as that goes: here the other lights are left out."""
    noise = np.random.default_rng(1).normal(20_000, 50, (30, *SHAPE))
    np.save(tmp_path / "dark.npy", noise.round().astype(np.uint16))
    (tmp_path / "my.toml").write_text(rig_of('driver = "folder"\npath = "dark.npy"', tmp_path).toml)
    done = aolink("calibrate", "--rig", "my.toml", "--measure", "frames:count=30", "-o", "out.toml", input="\ns\ns\n")
    assert done.returncode == 0, done.stderr
    measured = load_rig(str(tmp_path / "out.toml")).sensor
    assert measured.black_level == pytest.approx(20_000, abs=10)
    assert measured.noise_density == pytest.approx((50 / 2000) ** 2 * measured.pixel_size, rel=0.2)


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ({"path": "none"}, r"cannot read .*none: there is no such file or folder"),
        ({"path": "empty"}, r"empty holds no pictures"),
        ({"path": "large.npy"}, r"large.npy gives \(8, 60\) pixels, the rig file's sensor has \(1, 40\).*corner = "),
        ({"path": "large.npy", "corner": [0, 21]}, r"gives \(8, 60\) pixels, the rig file's sensor has \(1, 40\)"),
        ({"path": "large.npy", "corner": [0, -1]}, r"corner is \[0, -1\], expected the row and the column"),
        ({"path": "dark.npy"}, r"dark.npy gives values from -1.0 to -1.0, expected counts from 0 to 65535"),
        ({"path": "nan.npy"}, r"nan.npy gives values from nan to nan, expected counts from 0 to 65535"),
    ],
)
def test_what_cannot_be_played_is_refused_when_it_is_opened(tmp_path: Path, keys: dict[str, object], what: str) -> None:
    (tmp_path / "empty").mkdir()
    np.save(tmp_path / "large.npy", np.zeros((2, 8, 60), dtype=np.uint8))
    np.save(tmp_path / "dark.npy", np.full((2, *SHAPE), -1.0))
    np.save(tmp_path / "nan.npy", np.full((2, *SHAPE), np.nan))
    with pytest.raises((DeviceError, RigError), match=what):
        FolderCamera(rig_of('driver = "folder"', tmp_path), **keys)  # type: ignore[arg-type]
