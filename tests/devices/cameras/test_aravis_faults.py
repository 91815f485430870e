"""GigE cameras that go wrong in the middle: one line says how, and the recording is whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.errors import DeviceError
from aolink.recording.reader import Recording
from aolink.session import record
from tests.devices.cameras.gige import codes, fast_rig, lenslet, need_aravis, noise, opened, packed, started, taken
from tests.devices.simulators.gige import Faults, gige_camera

need_aravis()


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (Faults(resize_after=20), "has changed its picture to 17 x 16 pixels of format 0x1100007"),
        (Faults(restart_after=20), "numbers a frame 30001 .* it was started anew, or gives a frame twice"),
    ],
)
def test_a_camera_that_changes_its_size_or_counts_anew(tmp_path: Path, faults: Faults, said: str) -> None:
    frames = packed(noise(16, 16), PIXEL_FORMATS["Mono16"])
    with (
        gige_camera(tmp_path, frames, {}, faults),
        opened(fast_rig(period_steps=20)) as camera,
        pytest.raises(DeviceError, match=said) as raised,
    ):
        taken(started(camera), 1000)
    assert "\n" not in str(raised.value)


def test_a_camera_that_stops_ends_the_session_and_the_recording_is_whole(tmp_path: Path) -> None:
    frames = packed(noise(12, 16), PIXEL_FORMATS["Mono12"])
    with (
        gige_camera(tmp_path, frames, codes("Mono12"), Faults(stop_after=8)),
        pytest.raises(DeviceError, match=r"the camera has sent no frame for .* are saved in"),
    ):
        record(lenslet(), None, None, tmp_path / "a.mcap", exposures=60)
    recording = Recording(tmp_path / "a.mcap")
    assert (recording.complete, 1 <= len(recording) <= 8) == (True, True)


@pytest.mark.slow
def test_a_camera_that_is_pulled_out_is_said_to_be(tmp_path: Path) -> None:
    frames = packed(noise(16, 16), PIXEL_FORMATS["Mono16"])
    with (
        gige_camera(tmp_path, frames, {}, Faults(unplug_after=20)),
        opened(fast_rig(period_steps=100)) as camera,
        pytest.raises(DeviceError, match=r"127.0.0.2 no longer answers, or another program has taken it"),
    ):
        taken(started(camera), 1000)
