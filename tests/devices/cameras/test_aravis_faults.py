"""GigE cameras that go wrong, are not there or cannot do what is asked: one line says so, recordings are whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.errors import AolinkError, DeviceError, RigError
from aolink.recording.reader import Recording
from aolink.rig import Rig
from aolink.session import record
from tests.devices.cameras.gige import codes, fast_rig, lenslet, need_aravis, noise, opened, packed, started, taken
from tests.devices.simulators.gige import FAKE, Faults, gige_camera

need_aravis()


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (Faults(resize_after=20), "has changed its picture to 17 x 16 pixels of format 0x1100005"),
        (Faults(restart_after=20), "numbers a frame 30001 .* it was started anew, or gives a frame twice"),
        (Faults(stop_after=20), "the camera has sent no frame for"),
    ],
)
def test_a_camera_that_goes_wrong_ends_the_session_in_one_line(tmp_path: Path, faults: Faults, said: str) -> None:
    frames = packed(noise(12, 16), PIXEL_FORMATS["Mono12"])
    with gige_camera(tmp_path, frames, codes("Mono12"), faults), pytest.raises(DeviceError, match=said) as raised:
        record(lenslet(), None, None, tmp_path / "a.mcap", exposures=60)
    assert "\n" not in str(raised.value)
    assert 1 <= len(Recording(tmp_path / "a.mcap")) <= 20


def test_a_camera_that_is_pulled_out_is_said_to_be(tmp_path: Path) -> None:
    frames = packed(noise(16, 16), PIXEL_FORMATS["Mono16"])
    with (
        gige_camera(tmp_path, frames, {}, Faults(unplug_after=20)),
        opened(fast_rig(period_steps=100)) as camera,
        pytest.raises(DeviceError, match=r"127.0.0.2 no longer answers, or another program has taken it"),
    ):
        taken(started(camera), 1000)


def test_what_cannot_be_opened_is_said_in_one_line(tmp_path: Path) -> None:
    rig = fast_rig()
    refused: list[tuple[Rig, dict[str, Any], type[AolinkError], str]] = [
        (rig, {"address": "127.0.0.9"}, DeviceError, "cannot be opened: Can't connect to device at address"),
        (rig, {"pixel_format": "Mono12"}, DeviceError, "has the pixel formats .* Mono12 is asked for: correct"),
        (fast_rig(10), {}, DeviceError, "has the pixel formats .*; one of 10 bits is asked for: correct sensor"),
        (fast_rig(period_steps=5), {}, DeviceError, "can take 1000 frames a second, the rig file asks for 2000"),
        (rig, {"offset": [4000, 0]}, DeviceError, r"cannot give 16 x 16 pixels at \(4000, 0\)"),
        (
            rig,
            {"packet_size": 100_000},
            DeviceError,
            "cannot send packets of 100000 bytes",
        ),
        (rig, {"features": {"GainRav": 3}}, DeviceError, "has no feature GainRav: correct devices.camera.features"),
        (rig, {"features": {"GainRaw": 300}}, DeviceError, "cannot set GainRaw to 300"),
        (rig, {"trigger": "Line7"}, DeviceError, "cannot be triggered by Line7"),
        (rig, {"stamp_at": "middle"}, RigError, "stamp_at is 'middle', expected 'start' or 'end'"),
        (rig, {"offset": [3]}, RigError, r"offset is \[3\], expected \[column, row\]"),
        (rig, {"address": 7}, RigError, "address is 7, expected a text"),
    ]
    with gige_camera(tmp_path, packed(noise(16, 16), PIXEL_FORMATS["Mono16"]), {}):
        for each, keys, kind, said in refused:
            with pytest.raises(kind, match=said) as raised, opened(each, **{"address": FAKE, **keys}):
                pass
            assert "\n" not in str(raised.value)
        with opened(rig), pytest.raises(DeviceError, match="is used by another program"), opened(rig):
            pass
