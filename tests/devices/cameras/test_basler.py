"""Cameras of Basler, by the emulator in the maker's own library: whole sessions, lost frames, and what goes wrong."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.devices.cameras.basler import BaslerCamera, discover, unwrapped
from aolink.errors import DeviceError
from aolink.recording.reader import Recording
from aolink.session import record
from tests.devices.cameras.bench import counted, pictures, recorded, rig_of, save
from tests.needs import needed

needed("pypylon")

Run = Callable[..., subprocess.CompletedProcess[str]]
SERIAL = "0815-0000"


@pytest.fixture(autouse=True)
def emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera, which the maker's library emulates."""
    monkeypatch.setenv("PYLON_CAMEMU", "1")


def table(folder: Path) -> str:
    shows = {"TestImageSelector": "Off", "ImageFilename": str(folder), "ImageFileMode": "On"}
    listed = ", ".join(f"{name} = {value!r}" for name, value in shows.items())
    return f'driver = "basler"\ndelay_s = 0.0\ndelay_sd_s = 0.002\nfeatures = {{ {listed} }}'


@pytest.mark.slow
def test_a_session_records_the_counts_that_the_camera_gives(tmp_path: Path) -> None:
    """All 16 bits of them, one frame after the other; the emulator's time stamps are always 0, so it has none."""
    shown = pictures(12)
    rig = rig_of(table(save(tmp_path / "frames", shown)), tmp_path)
    report, recording, found = recorded(rig, tmp_path / "a.mcap", 8, ["o3"])
    assert (report.ended, report.frames_lost) == ("complete", 0)
    assert len(found) >= 8  # more where several arrive at once
    counted(found, shown)
    assert all(each.alignment_sigma_ns >= 2e6 for each in found)  # what the table says of the delay, at least
    assert recording.metadata["camera"] == f"Basler Emulation, serial number {SERIAL}, firmware 1.1, exposure 0.04 s"
    assert "reports no time" in recording.metadata["camera_lacks"]
    assert "does not count" not in recording.metadata["camera_lacks"]


def test_frames_that_could_not_be_grabbed_are_counted_as_lost(tmp_path: Path) -> None:
    """The emulator fails to grab where a file is no picture."""
    shown = pictures(8)
    save(tmp_path / "frames", shown)
    for number in (2, 5, 6):
        (tmp_path / "frames" / f"{number:03}.png").write_text("no picture")
    report, _, found = recorded(rig_of(table(tmp_path / "frames"), tmp_path), tmp_path / "a.mcap", 10)
    assert not {2, 5, 6} & {*counted(found, shown)}
    ids = [each.frame_id for each in found]
    assert report.frames_lost == ids[-1] - ids[0] + 1 - len(ids) > 0


def test_a_picture_of_another_size_ends_the_session_with_what_there_is(tmp_path: Path) -> None:
    shown = [*pictures(30), np.zeros((1, 24), dtype=np.uint16)]
    rig = rig_of(table(save(tmp_path / "frames", shown)), tmp_path)
    with pytest.raises(DeviceError, match=r"the camera gives \(1, 24\) pixels .*\(1, 40\).* are saved in"):
        record(rig, None, None, tmp_path / "a.mcap", exposures=60)
    assert counted(list(Recording(tmp_path / "a.mcap").exposures()), shown)[-1] == 29


def test_the_rate_of_a_triggered_camera_is_that_of_its_trigger(tmp_path: Path) -> None:
    rig, slow = rig_of('driver = "basler"', tmp_path), {"AcquisitionFrameRate": 5.0}
    with pytest.raises(DeviceError, match=r"Emulation.* reaches 5 frames a second .*, the rig file says 25: correct"):
        BaslerCamera(rig, features=slow)
    camera = BaslerCamera(rig, features={**slow, "TriggerMode": "On", "TriggerSource": "Line1"})
    assert [each.name for each in camera.lacks] == ["TIME"]
    assert camera.time_ns() is None
    camera.close()


def test_another_exposure_time_than_the_rig_files_is_read_back(tmp_path: Path) -> None:
    rig = rig_of('driver = "basler"\nfeatures = { ExposureTime = 100000.0 }', tmp_path)
    with pytest.raises(DeviceError, match=r"the camera exposes for 0.1 s, the rig file says 0.04 s"):
        record(rig, None, None, tmp_path / "a.mcap", exposures=3)


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ({"serial": "22"}, f"there is no Basler camera with the serial number 22, there is {SERIAL}"),
        ({"features": {"Gian": 3}}, "Emulation.* has no feature Gian in this state: correct devices.camera.features"),
        (
            {"features": {"Gain": 1000.0}},
            r"Emulation.* refuses Gain = 1000.0: Value 1000.* must be smaller than",
        ),
        ({"features": {"Width": "40"}}, r"Emulation.* refuses Width = '40': it is of another type"),
        ({"features": {"PixelFormat": "Mono9"}}, r"refuses PixelFormat = Mono9: .*cannot convert value 'Mono9'"),
        ({"corner": [0, 4090]}, r"Emulation.* refuses OffsetX = 4090: Value = 4090 must be equal or smaller than Max"),
    ],
)
def test_what_the_camera_cannot_do_is_said_when_it_is_opened(
    tmp_path: Path, keys: dict[str, object], what: str
) -> None:
    with pytest.raises(DeviceError, match=what):
        BaslerCamera(rig_of('driver = "basler"', tmp_path), **keys)  # type: ignore[arg-type]


def test_a_depth_that_the_camera_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="refuses PixelFormat = Mono14"):
        BaslerCamera(rig_of('driver = "basler"', tmp_path, bit_depth=(16, 14), black_level=(20000, 200)))


def test_which_of_several_cameras_must_be_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    assert [serial for serial, _ in discover()] == [SERIAL, "0815-0001"]
    with pytest.raises(DeviceError, match=f"several Basler cameras: set devices.camera.serial to one of {SERIAL}, "):
        BaslerCamera(rig_of('driver = "basler"', tmp_path))
    BaslerCamera(rig_of('driver = "basler"', tmp_path), serial="0815-0001").close()


def test_no_camera_is_said_to_be_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYLON_CAMEMU")
    assert discover() == []
    with pytest.raises(DeviceError, match="pylon finds no Basler camera: is it connected"):
        BaslerCamera(rig_of('driver = "basler"', tmp_path))


@given(st.integers(1, 65_535), st.lists(st.integers(0, 30_000), max_size=8))
def test_block_ids_of_16_bits_count_on_after_they_wrap(first: int, steps: list[int]) -> None:
    """65535 is followed by 1. An id that comes again is that frame again."""
    true = np.cumsum([first, *steps])
    before = None
    for number in true:
        before = unwrapped(before, int((number - 1) % 65_535 + 1))
        assert before == number


def test_block_ids_of_64_bits_do_not_wrap() -> None:
    assert [unwrapped(65_535, 65_536), unwrapped(70_000, 70_001), unwrapped(None, 0), unwrapped(0, 1)] == [
        65_536, 70_001, 0, 1,
    ]  # fmt: skip


@pytest.mark.slow
def test_a_camera_that_is_there_is_listed(aolink: Run) -> None:
    environment = {**os.environ, "PYLON_CAMEMU": "1", "COLUMNS": "200"}
    drivers = json.loads(aolink("devices", "--json", env=environment).stdout)["drivers"]
    (found,) = [each for each in drivers if (each["kind"], each["name"]) == ("camera", "basler")]
    ((serial_number, description),) = found["devices"]
    assert "Emulation" in description
    assert not found["search"]
    text = " ".join(aolink("devices", env=environment).stdout.split())
    assert serial_number in text
    assert description in text
