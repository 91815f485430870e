"""Micro-Manager's own DemoCamera in whole sessions, through the real pymmcore."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink.devices.cameras.micromanager import MicroManagerCamera
from aolink.devices.simple import FREE_RUNNING, Lacks, Trigger
from aolink.errors import DeviceError
from aolink.recording.reader import Recording
from aolink.session import record
from tests.devices.cameras.bench import rig_of
from tests.needs import needed

needed("pymmcore")
mm_test_adapters = needed("mm_test_adapters")
FOLDER = mm_test_adapters.device_adapter_path()


def table(
    properties: str = '{ PixelType = "16bit", BitDepth = 16 }', adapter: str = "DemoCamera", more: str = ""
) -> str:
    return (
        f'driver = "micromanager"\nadapter = "{adapter}"\ndevice = "DCam"\nfolder = "{FOLDER}"\n'
        f"properties = {properties}\ncorner = [3, 5]\ndelay_s = 0.0\ndelay_sd_s = 0.002\n{more}"
    )


@pytest.mark.slow
def test_a_session_records_what_the_camera_shows(tmp_path: Path) -> None:
    """Waves that move by a fifth of a period from frame to frame: each frame is the one before, moved on."""
    rig = rig_of(table(), tmp_path)
    report = record(rig, None, None, tmp_path / "a.mcap", exposures=6)
    assert report.ended == "complete"
    recording = Recording(tmp_path / "a.mcap")
    assert "Micro-Manager's DCam, MMCore version" in recording.metadata["camera"]
    assert "exposure 0.04 s" in recording.metadata["camera"]
    assert "reports no time" in recording.metadata["camera_lacks"]
    frames = np.array([exposure.pixels[0].astype(float) for exposure in recording])
    assert frames.shape[1] == 40
    assert len({each.tobytes() for each in frames}) == len(frames)
    # A sine over the columns: y(k+1) + y(k-1) = 2 cos(w) y(k) about its mean, in every frame with the same w.
    middle = frames - (frames.max() + frames.min()) / 2
    inner, beside = middle[:, 1:-1].ravel(), (middle[:, 2:] + middle[:, :-2]).ravel()
    slope = float(inner @ beside / (inner @ inner))
    assert abs(slope) < 2
    assert np.abs(beside - slope * inner).max() < 0.02 * np.abs(middle).max()


@pytest.mark.parametrize(
    ("trigger", "lacks"),
    [(FREE_RUNNING, (Lacks.TIME, Lacks.TRIGGER, Lacks.ROWS)), (Trigger("hardware"), (Lacks.TIME, Lacks.ROWS))],
)
def test_a_frame_has_the_cameras_own_count(trigger: Trigger, lacks: tuple[Lacks, ...], tmp_path: Path) -> None:
    """A hardware trigger is only declared: the demo camera has none, and runs."""
    camera = MicroManagerCamera(
        rig_of(table(), tmp_path), adapter="DemoCamera", device="DCam", folder=FOLDER,
        properties={"PixelType": "16bit", "BitDepth": 16}, trigger=trigger,
    )  # fmt: skip
    assert camera.lacks == lacks
    try:
        camera.start(0, 0)
        found: list[int | None] = []
        while len(found) < 3:
            found += [each.number for each in camera.frames()]
        camera.stop()
    finally:
        camera.close()
    assert found[:3] == [0, 1, 2]


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (table(adapter="NoSuch"), "cannot be opened: .*NoSuch"),
        (table('{ PixelType = "32bitRGB" }'), "gives 4 colour"),
        (table("{ Nonsense = 1 }"), "cannot be opened: .*Nonsense"),
        ('driver = "micromanager"\nconfig = "none.cfg"', "none.cfg cannot be opened"),
        (table(more='config = "my.cfg"'), "needs config .* or adapter and device"),
        (table().replace("[3, 5]", "[600, 5]"), r"gives \(512, 512\) pixels, .*corner"),
        (table().replace("[3, 5]", "[3, 500]"), r"gives \(512, 512\) pixels, .*corner"),
    ],
)
def test_what_cannot_work_is_one_clear_error(camera: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=says) as raised:
        record(rig_of(camera, tmp_path), None, None, tmp_path / "a.mcap", exposures=2)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "a.mcap").exists()
