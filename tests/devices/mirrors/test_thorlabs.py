"""Thorlabs units on pseudo terminals: the messages, the limits, and what goes wrong."""

from __future__ import annotations

import re
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aolink.devices.mirrors.thorlabs import ThorlabsAligner, ThorlabsPiezo
from aolink.errors import AolinkError, DeviceError, RigError
from aolink.extensions import install_command
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report, record
from tests.devices.mirrors import bench
from tests.devices.simulators.serial_device import Faults
from tests.devices.simulators.thorlabs import Aligner, Piezo
from tests.needs import needed

needed("thorlabs_apt_protocol")

KEYS = {"unit": 30.0, "zero": 35.0}
"""Inputs from -1 to 1 as 5 V to 65 V."""
REPORT = struct.pack("<HHBBHhhL", 0x0661, 10, 0x81, 0x50, 1, 300, 400, 0)


def rig_with(name: str = "tip-tilt", bits: int = 12) -> Rig:
    return parse_rig(load_rig(name).toml.replace("dac_bits = 16", f"dac_bits = {bits}"))


def opened(*devices: Piezo, bays: int = 0, **keys: Any) -> ThorlabsPiezo:
    port = [device.port for device in devices] if len(devices) > 1 else devices[0].port
    numbers = list(range(1, bays + 1)) or None
    return ThorlabsPiezo(rig_with(), port=port, bays=numbers, **{**KEYS, **keys})


def test_two_cubes_are_two_inputs() -> None:
    with Piezo() as x, Piezo() as y:
        mirror = opened(x, y, unit=[30.0, -20.0])
        assert mirror.description == "Thorlabs KPZ101, serial number 29501986, firmware 2.1.0"
        assert (x.now()[0], y.now()[0]) == pytest.approx((35, 35), abs=2e-3)  # at the safe input, and then enabled
        assert (x.enabled, x.sources, x.modes) == ({0x50: True}, {0x50: 0}, {0x50: 1})
        taken = mirror.put(np.array([0.5, -0.25]))
        assert (x.now()[0], y.now()[0]) == pytest.approx((50, 40), abs=2e-3)
        np.testing.assert_allclose(taken, [0.5, -0.25], atol=1e-4)
        assert not np.array_equal(taken, [0.5, -0.25])  # but what the converter makes of it
        mirror.close()
        assert (x.now()[0], y.now()[0]) == pytest.approx((35, 35), abs=2e-3)


def test_bays_are_inputs_of_one_line_and_other_messages_between_do_no_harm() -> None:
    with Piezo("BPC303", bays=3, volts=150.0, reports=REPORT, faults=Faults(split=True, late_s=0.001)) as device:
        mirror = opened(device, bays=2)
        assert device.now() == pytest.approx((35, 35, 5000 / 32767 * 150), abs=3e-3)
        assert device.enabled == {0x21: True, 0x22: True, 0x23: False}
        mirror.put(np.array([1.0, -1.0]))
        assert device.now()[:2] == pytest.approx((65, 5), abs=3e-3)
        mirror.close()


def test_in_closed_loop_inputs_are_micrometres() -> None:
    with Piezo() as x, Piezo() as y:
        mirror = opened(x, y, closed_loop=True, travel_um=20.0, unit=8.0, zero=10.0)
        np.testing.assert_allclose(mirror.put(np.array([0.75, -1.0])), [0.75, -1.0], atol=1e-4)
        assert (x.now()[0], y.now()[0]) == pytest.approx((16, 2), abs=1e-3)
        mirror.close()


def test_the_aligner_has_two_outputs() -> None:
    with Aligner() as device:
        mirror = ThorlabsAligner(rig_with(), port=device.port, unit=[5.0, -5.0], zero=1.0)
        assert device.now() == pytest.approx((1, 1), abs=1e-3)
        np.testing.assert_allclose(mirror.put(np.array([0.5, 1.0])), [0.5, 1.0], atol=1e-4)
        assert device.now() == pytest.approx((3.5, -4), abs=1e-3)
        mirror.close()
        assert device.now() == pytest.approx((1, 1), abs=1e-3)


@pytest.mark.parametrize(
    "behaviour", [{"faults": Faults(split=True)}, {"faults": Faults(late_s=0.02)}, {"reports": REPORT}]
)
def test_a_slow_line_or_other_messages_do_an_aligner_no_harm(behaviour: dict[str, Any]) -> None:
    with Aligner(**behaviour) as device:
        mirror = ThorlabsAligner(rig_with(), port=device.port, unit=5.0, zero=1.0)
        for u in (0.5, -1.0, 0.25):
            np.testing.assert_allclose(mirror.put(np.array([u, -u])), [u, -u], atol=1e-4)
            assert device.now() == pytest.approx((1 + 5 * u, 1 - 5 * u), abs=1e-3)
        mirror.close()
        assert device.now() == pytest.approx((1, 1), abs=1e-3)


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ({"bays": None, "port": ["a", "b"], "closed_loop": True}, "travel_um: in closed loop cubes need the travel of"),
        ({"unit": 40.0}, "are -5 to 75 V by devices.mirror.s unit and zero, the Thorlabs unit goes from 0 to 75 V"),
        ({"closed_loop": True}, "are 5 to 65 um by devices.mirror.s unit and zero, .* from 0 to 20 um"),
        ({"unit": 1e-3}, "mirror.dac_bits = 12 is finer than the Thorlabs unit, which goes in steps of 2.29 of an"),
        ({"unit": 0}, "devices.mirror.unit: expected a number that is not zero, found 0"),
        ({"zero": [1, 2, 3]}, "devices.mirror.zero: expected a finite number, or a list of 2"),
        ({"bays": [1]}, r"has 2 input\(s\), and port = '/dev/pts/\d+', bays = \[1\] name 1 unit"),
        ({"bays": [1, 77]}, "devices.mirror.bays: expected whole numbers from 1 to 10, found 77"),
        ({"bays": None}, "name 1 unit.s.: give a list of ports, or of bays, with one for each"),
    ],
)
def test_wrong_keys(keys: dict[str, Any], what: str) -> None:
    with Piezo("BPC303", bays=3) as device, pytest.raises((DeviceError, RigError), match=what):
        ThorlabsPiezo(rig_with(), **{"port": device.port, "bays": [1, 2], **KEYS, **keys})


def test_an_aligner_has_two_inputs_within_ten_volts() -> None:
    with pytest.raises(DeviceError, match=r"has 2 outputs, x and y; the rig file has 1 input"):
        ThorlabsAligner(rig_with("section-vi"), port="/dev/no-such-port")
    with pytest.raises(DeviceError, match=r"are -11 to 11 V by .* goes from -10 to 10 V"):
        ThorlabsAligner(rig_with(), port="/dev/no-such-port", unit=11.0)


@pytest.mark.parametrize(
    ("behaviour", "what"),
    [
        ({"complains_at": 4}, "reports an error as it is asked pz_req_positioncontrolmode.*7 Actuator not connected"),
        ({"interlocked": True}, "does not switch its output on: is its interlock open"),
        ({"travel_um": 0.0}, "its range is 0 um: is an actuator connected"),
        ({"has_gauge": False}, r"stays in control mode 1, asked for 2 \(closed loop\): is its strain gauge connected"),
    ],
)
def test_a_unit_that_is_not_as_it_should_be_is_one_line(behaviour: dict[str, Any], what: str) -> None:
    with Piezo("BPC303", bays=2, **behaviour) as device, pytest.raises(AolinkError, match=what):
        opened(device, bays=2, closed_loop=True, unit=8.0, zero=10.0)


def test_an_aligner_that_reports_an_error() -> None:
    with Aligner(complains_at=4) as device, pytest.raises(AolinkError, match="code 7 Actuator not"):
        ThorlabsAligner(rig_with(), port=device.port, unit=5.0, zero=1.0)


def test_without_the_codec_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "thorlabs_apt_protocol", None)
    with Aligner() as device, pytest.raises(DeviceError, match=re.escape(install_command("thorlabs"))):
        ThorlabsAligner(rig_with(), port=device.port)


def session_rig(devices: list[str]) -> Rig:
    rig = bench.rig_with(
        f'[devices.camera]\ndriver = "spot"\n[devices.mirror]\ndriver = "thorlabs_piezo"\nport = {devices}\n'
        "unit = 30.0\nzero = 35.0"
    )
    return parse_rig(rig.toml.replace("dac_bits = 16", "dac_bits = 12"))


def test_a_unit_that_is_unplugged_ends_the_session_with_a_whole_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.install(monkeypatch, tmp_path, thorlabs_piezo="aolink.devices.mirrors.thorlabs:ThorlabsPiezo")
    with Piezo() as x, Piezo(faults=Faults(unplugged_at=60)) as y:
        bench.watch(x.held, lambda volts: np.repeat(volts - 35, 2) / 30)
        with pytest.raises(AolinkError, match=r"lost /dev/pts/\d+: .*is the device still there\?"):
            record(session_rig([x.port, y.port]), None, None, tmp_path / "a.mcap", report=(report := Report()))
        assert x.now() == pytest.approx((35,), abs=2e-3)  # the other one is parked
    assert Recording(tmp_path / "a.mcap").complete
    assert report.commands.ended == report.commands.commanded > 0
