"""A camera and a mirror of another package, which is installed and used as anybody's would be."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink import estimate as estimate_exposures
from aolink import extensions
from aolink.errors import DeviceError
from aolink.recording import topics
from aolink.recording.account import Commands
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import Report, record
from aolink.wire.messages_pb2 import Applied
from tests.commands import simulated_rig
from tests.kinds import messages_of
from tests.packages import package

Run = Callable[..., subprocess.CompletedProcess[str]]
ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "tests" / "example_package"


@pytest.fixture(scope="module")
def installed(with_example: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process in which the example package is installed, and one whose drivers are broken."""
    points = "[aolink.cameras]\nbroken = no_such_module:Camera\nbare = contextlib:nullcontext\n"
    folder = package(tmp_path_factory.mktemp("broken"), "broken", points)
    return {**with_example, "PYTHONPATH": os.pathsep.join([str(folder), with_example["PYTHONPATH"]]), "COLUMNS": "200"}


def rig_file(folder: Path, camera: str = 'driver = "example"', mirror: str = 'driver = "example"') -> Path:
    tables = [f"[devices.{kind}]\n{keys}\n" for kind, keys in (("camera", camera), ("mirror", mirror)) if keys]
    path = folder / "mine.toml"
    path.write_text("\n".join([load_rig("section-vi").toml, *tables]))
    return path


@pytest.mark.slow
def test_a_session_with_devices_of_another_package(aolink: Run, installed: dict[str, str], tmp_path: Path) -> None:
    rig = rig_file(tmp_path, 'driver = "example"\nclock_offset_s = 3.5')
    arguments = ("--rig", rig, "--estimator", "o1", "--exposures", "6", "-o", "a.mcap", "--json")
    done = aolink("record", *arguments, env=installed)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["ended"], report["frames_received"], report["frames_lost"]) == ("complete", 6, 0)
    commands = Commands.of(report["commands"])
    assert commands.commanded == commands.ended == 1200
    assert commands.applied > 0

    recording = Recording(tmp_path / "a.mcap")
    assert (recording.metadata["camera"], recording.metadata["mirror"]) == ("example camera", "example mirror")
    assert recording.counts[topics.TRUTH] == recording.counts[topics.IMAGE] == 6
    assert topics.CONNECTION not in recording.counts
    reported = messages_of(Applied, recording, topics.APPLIED)
    steps = [k for m in reported for k in range(m.first_step, m.first_step + m.n_steps)]
    assert steps == list(range(steps[0], steps[0] + len(steps)))  # each once, in order
    exposures = list(recording.exposures())
    assert all(exposure.inputs_assumed == 0 for exposure in exposures)
    assert max(np.abs(each.inputs).max() for each in exposures) > 0.001
    found = estimate_exposures(tmp_path / "a.mcap", "o1").estimates("o1")
    for exposure, estimate in zip(exposures, found, strict=True):
        assert exposure.truth is not None
        assert np.abs(estimate.path - exposure.truth.path).max() < 0.02  # its frames have no noise
    again = aolink("record", "--rig", rig, "--input", "a.mcap", "-o", "b.mcap", env=installed)
    assert again.returncode == 0, again.stderr
    assert "b.mcap: 6 exposures, complete" in again.stdout
    info = aolink("info", "a.mcap")
    assert (info.returncode, "example mirror" in info.stdout) == (0, True)


@pytest.mark.slow
def test_a_camera_of_another_package_beside_a_native_mirror(
    aolink: Run, installed: dict[str, str], tmp_path: Path,
) -> None:  # fmt: skip
    """In real time the mirror's clock and count of fast steps are known; on virtual time no other camera follows."""
    rig = rig_file(tmp_path, mirror="")
    arguments = ("--rig", rig, "--exposures", "4", "-o", "a.mcap")
    with simulated_rig(rig, "--real-time") as (_, mirror):
        done = aolink("record", "--mirror", mirror, *arguments, "--json", env=installed)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["ended"], report["frames_received"]) == ("complete", 4)
    assert report["commands"]["commanded"] >= 800  # more where the mirror had to be re-armed
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["camera"] == "example camera"
    assert report["commands"]["applied"] > 0
    starts = [exposure.first_step + exposure.start_offset for exposure in recording.exposures()]
    assert np.abs(np.diff(starts) - 200).max() < 1  # as well as the clocks can be compared on a busy machine
    with simulated_rig(rig) as (camera, mirror):
        refused = aolink("record", "--mirror", mirror, *arguments, "--overwrite", env=installed)
        assert refused.returncode == 4
        assert (
            "the mirror runs on virtual time, which only the camera of the same simulated rig follows" in refused.stderr
        )
        rig = rig_file(tmp_path, camera="")
        refused = aolink("record", "--camera", camera, *arguments, "--overwrite", env=installed)
        assert refused.returncode == 4
        assert "a native camera counts fast steps together with its own mirror" in refused.stderr


@pytest.mark.rare
def test_a_camera_alone_is_recorded(aolink: Run, installed: dict[str, str], tmp_path: Path) -> None:
    """Nothing is commanded; every exposure has the safe input, and is estimated as any other."""
    rig = rig_file(tmp_path, mirror="")
    arguments = ("record", "--rig", rig, "--estimator", "o1", "--exposures", "4", "-o", "a.mcap")
    done = aolink(*arguments, "--json", env=installed)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["ended"], report["frames_received"], report["commands"]["commanded"]) == ("complete", 4, 0)
    assert "the rig file's drive is not played" in " ".join(done.stderr.split())
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["mirror"] == "none"
    assert topics.COMMAND not in recording.counts
    exposures = list(recording.exposures())
    assert [len(exposure.inputs) for exposure in exposures] == [200] * 4
    assert all(not exposure.inputs.any() and not exposure.inputs_assumed for exposure in exposures)
    assert len(list(estimate_exposures(tmp_path / "a.mcap", "o1"))) == 4
    info = aolink("info", "a.mcap")
    assert info.returncode == 0, info.stderr


@pytest.mark.slow
def test_a_native_camera_alone_is_recorded(aolink: Run, tmp_path: Path) -> None:
    """It counts the fast steps itself."""
    with simulated_rig("section-vi", "--real-time") as (camera, _):
        arguments = ("record", "--rig", "section-vi", "--camera", camera, "--exposures", "3", "-o", "a.mcap")
        done = aolink(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames_received"] == 3
    exposures = list(Recording(tmp_path / "a.mcap").exposures())
    assert [len(exposure.inputs) for exposure in exposures] == [200] * 3
    with simulated_rig("section-vi") as (camera, _):
        refused = aolink(*arguments[:4], camera, *arguments[5:], "--overwrite")
    assert refused.returncode == 4
    assert "runs on virtual time" in refused.stderr


FAILING = """
from aolink_example import devices

calls = []


class Mirror(devices.Mirror):
    def park(self):
        calls.append("park")
        return super().park()


class Camera(devices.Camera):
    def frames(self):
        yield from super().frames()
        if len(calls) > 100:
            raise OSError("the camera was pulled out")
        calls.append("frames")

    def stop(self):
        calls.append("stop")

    def close(self):
        calls.append("close")
"""


def test_a_driver_that_fails_ends_the_session_in_good_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """The mirror is parked, the camera stopped, both are closed, and the recording is whole."""
    (tmp_path / "failing.py").write_text(FAILING)
    points = "[aolink.cameras]\nfailing = failing:Camera\n[aolink.mirrors]\nexample = failing:Mirror\n"
    package(tmp_path, "failing", points)
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.syspath_prepend(tmp_path)
    extensions.installed.cache_clear()  # an earlier test may have asked, and later ones must not find these
    request.addfinalizer(extensions.installed.cache_clear)
    rig = load_rig(rig_file(tmp_path, 'driver = "failing"'))
    what = r"the driver of the camera failed when it was asked for its frames: OSError\('the camera was pulled out'\)"
    with pytest.raises(DeviceError, match=what):
        record(rig, None, None, tmp_path / "a.mcap", report=(report := Report()))
    calls = sys.modules["failing"].calls
    assert calls[calls.index("park") :] == ["park", "stop", "close"]
    assert Recording(tmp_path / "a.mcap").complete
    assert report.commands.ended == report.commands.commanded > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "code", "what"),
    [
        ("", 2, "nothing says what drives the camera: give --camera PORT, or [devices.camera] in the rig file with"),
        ('driver = "exmaple"', 4, "there is no camera driver exmaple, there is native, "),
        ('driver = "broken"', 4, "the camera driver broken of broken (no_such_module:Camera) cannot be loaded: Module"),
        ('driver = "bare"', 4, "the camera driver bare lacks description, time_ns, start, frames, stop, close: see"),
        ('driver = "example"\nclock = 3', 2, "devices.camera: the driver example has no key clock; it takes "),
        ('driver = "example"\nclock_offset_s = "x"', 4, "the driver of the camera failed when it was opened"),
        ('driver = "native"\nbaud = 9600', 2, "devices.camera: the driver native takes port, a text"),
        ("port = 3", 2, "devices.camera.driver is missing"),
    ],
)
def test_a_driver_that_is_not_there_is_one_line(
    aolink: Run, installed: dict[str, str], tmp_path: Path, camera: str, code: int, what: str
) -> None:
    mirror = 'driver = "native"\nport = "/dev/null"' if "native" in camera else 'driver = "example"'
    done = aolink("record", "--rig", rig_file(tmp_path, camera, mirror), "-o", "a.mcap", env=installed)
    assert done.returncode == code
    assert what in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.slow
def test_the_drivers_that_there_are_are_listed(aolink: Run, installed: dict[str, str]) -> None:
    found = {
        (each["kind"], each["name"]): each
        for each in json.loads(aolink("devices", "--json", env=installed).stdout)["drivers"]
    }
    assert {("camera", name) for name in ("native", "bare", "broken", "example", "folder")} <= {*found}
    assert {("mirror", name) for name in ("native", "example", "optotune")} <= {*found}
    assert "no_such_module" in found["camera", "broken"]["problem"]
    assert any("queues no inputs" in each for each in found["mirror", "optotune"]["lacks"])
    assert "the rig file says where they are" in found["camera", "folder"]["search"]
    text = " ".join(aolink("devices", env=installed).stdout.split())
    assert "camera driver example" in text
    assert "mirror driver optotune" in text


@pytest.mark.slow
def test_the_drivers_of_a_rig_file_are_checked_before_anything_is_opened(
    aolink: Run, installed: dict[str, str], tmp_path: Path,
) -> None:  # fmt: skip
    rig = rig_file(tmp_path, 'driver = "exmaple"', 'driver = "optotune"\nunit_rd = 3')
    checked = aolink("rig", rig, "--check", "--json", env=installed)
    assert checked.returncode == 2
    errors = {each["key"]: each["message"] for each in json.loads(checked.stdout) if each["severity"] == "error"}
    assert "there is no camera driver exmaple" in errors["devices.camera"]
    assert "no key unit_rd" in errors["devices.mirror"]
    good = aolink("rig", rig_file(tmp_path, mirror=""), "--check", env=installed)
    assert good.returncode == 0
    assert "the camera is recorded alone" in " ".join(good.stdout.split())


@pytest.mark.slow
def test_native_devices_may_stand_in_the_rig_file(aolink: Run, tmp_path: Path) -> None:
    with simulated_rig("section-vi") as ports:
        rig = rig_file(tmp_path, *(f'driver = "native"\nport = "{port}"' for port in ports))
        done = aolink("record", "--rig", rig, "--exposures", "2", "-o", "a.mcap")
    assert done.returncode == 0, done.stderr
    assert len(list(Recording(tmp_path / "a.mcap"))) == 2
