"""GigE cameras that are not there, are taken or cannot do what is asked: one line says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS
from aolink.devices.simple import Trigger
from aolink.errors import AolinkError, DeviceError, RigError
from aolink.rig import Rig
from tests.devices.cameras.gige import fast_rig, need_aravis, noise, opened, packed
from tests.devices.simulators.gige import FAKE, gige_camera

need_aravis()


def brief_rig(exposure_steps: int) -> Rig:
    """Exposures of steps of half a microsecond: the fake camera takes whole microseconds, from 10 on."""
    timing = fast_rig(period_steps=2000).timing
    return replace(fast_rig(), timing=replace(timing, fast_step_s=5e-7, exposure_steps=exposure_steps))


@pytest.mark.slow
def test_what_cannot_be_opened_is_said_in_one_line(tmp_path: Path) -> None:
    rig = fast_rig()
    refused: list[tuple[Rig, dict[str, Any], type[AolinkError], str]] = [
        (rig, {"address": "127.0.0.9"}, DeviceError, "cannot be opened: Can't connect to device at address"),
        (rig, {"pixel_format": "Mono12"}, DeviceError, "has the pixel formats .* Mono12 is asked for: correct"),
        (fast_rig(10), {}, DeviceError, "has the pixel formats .*; one of 10 bits is asked for: correct sensor"),
        (
            fast_rig(period_steps=5),
            {},
            DeviceError,
            "takes 1000 frames a second, the rig file says 2000: correct timing.frame_period",
        ),
        (rig, {"corner": [0, 4000]}, DeviceError, r"cannot give 16 x 16 pixels at \(4000, 0\)"),
        (rig, {"packet_size": 100_000}, DeviceError, "cannot send packets of 100000 bytes"),
        (rig, {"features": {"GainRav": 3}}, DeviceError, "has no feature GainRav: correct devices.camera.features"),
        (rig, {"features": {"GainRaw": 300}}, DeviceError, "cannot set GainRaw to 300"),
        (rig, {"trigger": Trigger("hardware", "Line7")}, DeviceError, "cannot be triggered by Line7"),
        (brief_rig(21), {}, DeviceError, "exposes for 1e-05 s, the rig file says 1.05e-05 s: correct timing.exp"),
        (brief_rig(10), {}, DeviceError, "cannot expose for 5e-06 s"),
        (rig, {"stamp_at": "middle"}, RigError, "stamp_at is 'middle', expected 'start' or 'end'"),
        (rig, {"corner": [3]}, RigError, r"corner is \[3\], expected the row and the column"),
    ]
    with gige_camera(tmp_path, packed(noise(16, 16), PIXEL_FORMATS["Mono16"]), {}):
        for each, keys, kind, said in refused:
            with pytest.raises(kind, match=said) as raised, opened(each, **{"address": FAKE, **keys}):
                pass
            assert "\n" not in str(raised.value)
        with opened(rig), pytest.raises(DeviceError, match="is used by another program"), opened(rig):
            pass
