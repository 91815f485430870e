"""Deformable mirrors of python-microscope, held to its own simulated one: inputs, a session, and what goes wrong."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aolink import estimate
from aolink.devices.mirrors.microscope import MicroscopeMirror
from aolink.errors import DeviceError, RigError
from aolink.extensions import install_command
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig
from aolink.session import Report, record
from tests.devices.mirrors import bench
from tests.devices.simulators import spot_camera
from tests.devices.simulators.deformable import WatchedMirror

DEVICE = "watched"
RIG = load_rig("tip-tilt")


@pytest.fixture(autouse=True)
def drivers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.install(
        monkeypatch, tmp_path,
        microscope="aolink.devices.mirrors.microscope:MicroscopeMirror\n[aolink.microscope]\n"
        f"{DEVICE} = tests.devices.simulators.deformable:WatchedMirror\n"
        "other = tests.devices.simulators.spot_camera:SpotCamera",
    )  # fmt: skip


def opened(**keys: Any) -> MicroscopeMirror:
    return MicroscopeMirror(RIG, **{"device": DEVICE, "settings": {"n_actuators": 2}, **keys})


def test_inputs_are_parts_of_the_range_of_each_actuator() -> None:
    mirror = opened(unit=[0.5, -0.25])
    device = WatchedMirror.latest
    np.testing.assert_allclose(device.get_current_pattern(), [0.5, 0.5])
    np.testing.assert_array_equal(mirror.put(np.array([1.0, 0.5])), [1.0, 0.5])
    np.testing.assert_allclose(device.get_current_pattern(), [1.0, 0.375])
    assert mirror.description == f"{DEVICE} {{'n_actuators': 2}}"
    mirror.close()
    np.testing.assert_allclose(device.get_current_pattern(), [0.5, 0.5])
    assert device.is_shut_down


@pytest.mark.parametrize(
    ("keys", "error", "what"),
    [
        ({"settings": {"n_actuators": 69}}, DeviceError, r"has 69 actuators, the rig file's mirror 2 input\(s\)"),
        ({"settings": {"serial": 3}}, DeviceError, "cannot be opened with .*'serial': 3.*TypeError"),
        ({"unit": 0.6}, DeviceError, "are -0.1 to 1.1 of the range by devices.mirror.s unit and zero"),
        ({"device": "microscope.simulators.SimulatedCamera"}, RigError, "is no deformable mirror of python-microscope"),
        ({"device": "microscope.mirror.alpao.AlpaoDeformableMirror"}, DeviceError, "cannot be had .LibraryLoadError.*"),
        ({"device": "microscope.nowhere.Mirror"}, DeviceError, "Mirror cannot be had .ModuleNotFoundError.*right"),
        ({"device": "microscope.mirror"}, RigError, "microscope.mirror is no class of python-microscope"),
        ({"device": "other"}, RigError, "is no deformable mirror of python-microscope"),
        ({"device": "nowhere"}, RigError, "no installed package offers a device of this name"),
    ],
)
def test_what_is_wrong_is_one_line(keys: dict[str, Any], error: type[Exception], what: str) -> None:
    with pytest.raises(error, match=what):
        opened(**keys)


@pytest.mark.parametrize("device", ["payload.Mirror", "microscope_extra.Mirror", "microscope.payload.Mirror"])
def test_no_other_module_is_imported(device: str, tmp_path: Path) -> None:
    """Whatever lies on the path: a rig file may come from anywhere."""
    for name in ("payload", "microscope_extra"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('it has run')")
    (tmp_path / "microscope").mkdir()
    (tmp_path / "microscope" / "payload.py").write_text("raise SystemExit('it has run')")
    with pytest.raises((RigError, DeviceError), match=r"no class of python-microscope|cannot be had"):
        opened(device=device)


def test_without_the_library_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "microscope.abc", None)
    with pytest.raises(DeviceError, match=re.escape(install_command("microscope"))):
        opened()


def held(time_ns: int) -> Any:
    """The inputs that the latest mirror holds."""
    before = [pattern for since_ns, pattern in WatchedMirror.latest.held if since_ns <= time_ns]
    return 2 * np.array(before[-1]) - 1


def session_rig(settings: str = "") -> Rig:
    return bench.rig_with(
        '[devices.camera]\ndriver = "spot"\n'
        f'[devices.mirror]\ndriver = "microscope"\ndevice = "{DEVICE}"\nsettings = {{ n_actuators = 2{settings} }}'
    )


@pytest.mark.slow
def test_a_whole_session(tmp_path: Path) -> None:
    spot_camera.mirror.held = held
    report = record(session_rig(), None, None, tmp_path / "a.mcap", estimators=["o1"], exposures=10)
    assert (report.ended, report.exposures) == ("complete", 10)
    assert WatchedMirror.latest.is_shut_down
    assert WatchedMirror.latest.held[-1][1] == (0.5, 0.5)
    assert report.commands.ended == report.commands.commanded == 100
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["mirror"].startswith(DEVICE)
    # The drive moves the spot by 0.3.
    bench.check_paths(
        recording.rig, zip(recording.exposures(), estimate(recording, "o1").estimates("o1"), strict=True), within=0.1
    )


@pytest.mark.parametrize(
    ("settings", "parked"), [(", fails = [30, 31]", True), (", fails = [30, inf], keeps_on = true", False)]
)
def test_a_device_that_fails_in_a_session_is_parked_where_it_can_be_and_shut_down(
    settings: str, parked: bool, tmp_path: Path
) -> None:
    """The first thing that went wrong is said, not what could not be done about it."""
    spot_camera.mirror.held = held
    what = r"the driver of the mirror failed .*RuntimeError\(.*no answer from the electronics"
    with pytest.raises(DeviceError, match=what):
        record(session_rig(settings), None, None, tmp_path / "a.mcap", report=(report := Report()))
    assert (WatchedMirror.latest.held[-1][1] == (0.5, 0.5)) == parked
    assert WatchedMirror.latest.is_shut_down
    bench.check_ended(report, tmp_path / "a.mcap")


def test_a_device_that_cannot_be_shut_down_is_one_line_after_a_session(tmp_path: Path) -> None:
    spot_camera.mirror.held = held
    what = r"the driver of the mirror failed when it was closed: RuntimeError\(.*cannot be shut down"
    with pytest.raises(DeviceError, match=what):
        record(session_rig(", keeps_on = true"), None, None, tmp_path / "a.mcap", exposures=2)
    assert WatchedMirror.latest.held[-1][1] == (0.5, 0.5)
    assert Recording(tmp_path / "a.mcap").complete
