"""The camera and the mirror on the page, as they stand there: installed, and recorded in a session."""

from __future__ import annotations

import os
import pty
import re
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aolink.devices.drivers import check_driver
from aolink.errors import DeviceError, RigError
from aolink.extensions import installed
from aolink.recording.reader import Recording
from aolink.session import record
from tests.devices.mirrors import bench
from tests.packages import package

PAGE = Path(__file__).parents[2] / "aolink" / "pages" / "devices.md"


@pytest.fixture(autouse=True)
def _drivers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package of the page's two blocks of Python."""
    camera, mirror = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for name, text in (("page_camera", camera), ("page_mirror", mirror)):
        (tmp_path / f"{name}.py").write_text(text)
    points = "[aolink.cameras]\npage = page_camera:Camera\n[aolink.mirrors]\npage = page_mirror:Mirror\n"
    package(tmp_path, "page", points)
    monkeypatch.syspath_prepend(tmp_path)
    installed.cache_clear()
    yield
    installed.cache_clear()


@pytest.fixture
def amplifiers() -> Iterator[tuple[int, str]]:
    """The far end of a serial line, and the path of the near one."""
    device, host = pty.openpty()
    tty.setraw(host)
    yield device, os.ttyname(host)
    os.close(device)
    os.close(host)


def test_both_are_recorded_in_a_session(amplifiers: tuple[int, str], tmp_path: Path) -> None:
    device, port = amplifiers
    tables = f'[devices.camera]\ndriver = "page"\nlevel = 900\n[devices.mirror]\ndriver = "page"\nport = "{port}"\n'
    report = record(bench.rig_with(tables), None, None, tmp_path / "a.mcap", exposures=5)
    assert (report.ended, report.commands.ended) == ("complete", report.commands.commanded)
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["camera"] == "noise about 900 counts"
    assert "begin anywhere in a fast step" in recording.metadata["camera_lacks"]
    assert "queues no inputs" in recording.metadata["mirror_lacks"]
    assert np.mean([each.pixels.mean() for each in recording]) == pytest.approx(900, rel=0.01)
    *_, before, safe = [np.array(each.split(), dtype=int) for each in os.read(device, 1 << 16).splitlines()]
    assert safe.tolist() == [0, 0]
    assert before.shape == (2,)
    assert report.commands.applied > 0


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('level = "high"', "devices.camera.level: expected a whole number, found 'high'"),
        ("levels = 3", "devices.camera: the driver page has no key levels; it takes "),
        ('trigger = "hardware:Line1"', "devices.camera.trigger: expected 'free-running' with this driver, found 'hard"),
    ],
)
def test_wrong_keys_are_refused_before_anything_is_opened(keys: str, says: str) -> None:
    rig = bench.rig_with(f'[devices.camera]\ndriver = "page"\n{keys}\n')
    with pytest.raises(RigError, match=re.escape(says)):
        check_driver("camera", rig.devices["camera"], rig)


def test_a_port_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    tables = '[devices.camera]\ndriver = "page"\n[devices.mirror]\ndriver = "page"\nport = "/dev/no-such-port"\n'
    with pytest.raises(DeviceError, match="the driver of the mirror failed when it was opened: SerialException"):
        record(bench.rig_with(tables), None, None, tmp_path / "a.mcap", exposures=5)


def test_the_page_names_each_driver_and_says_first_that_none_has_met_hardware() -> None:
    text = PAGE.read_text()
    assert text.splitlines()[2].startswith("**No driver here has met hardware.**")
    for group in ("cameras", "mirrors"):
        own = {name for name, point in installed(f"aolink.{group}").items() if point.value.startswith("aolink.")}
        assert own
        assert all(f"`{name}`" in text.partition("Extras")[0] for name in own)
