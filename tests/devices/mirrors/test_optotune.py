"""Optotune's driver on a pseudo terminal: the bytes, the limits, a session, and what goes wrong."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aolink.devices.mirrors.optotune import OptotuneMirror
from aolink.devices.paced import PacedMirror
from aolink.errors import DeviceError, RigError
from aolink.estimation import make_estimator
from aolink.extensions import installed
from aolink.jobs.calibrate import Poked, interaction, record_pokes
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report, record
from tests.devices.mirrors import bench
from tests.devices.simulators.optotune import OptotuneSimulator
from tests.devices.simulators.serial_device import Faults

RIG = load_rig("tip-tilt")
UNIT_RAD = 0.5
TAN_50 = math.tan(math.radians(50))


def opened(simulator: OptotuneSimulator, rig: Rig = RIG, **keys: Any) -> OptotuneMirror:
    return OptotuneMirror(rig, port=simulator.port, **{"unit_rad": UNIT_RAD, **keys})


def test_an_input_is_an_optical_angle_on_the_unit_circle() -> None:
    with OptotuneSimulator() as simulator:
        mirror = opened(simulator, unit_rad=[0.5, -0.25])
        assert simulator.now() == (0, 0)  # at its safe input, wherever it was
        taken = mirror.put(np.array([0.8, 0.4]))
        assert simulator.requests[-1] == b"XY=0.354765;-0.084190"
        assert simulator.now() == pytest.approx((math.tan(0.4) / TAN_50, -math.tan(0.1) / TAN_50), abs=1e-6)
        np.testing.assert_allclose(taken, [0.8, 0.4], atol=1e-5)
        assert not np.array_equal(taken, [0.8, 0.4])  # but what its six decimals say
        mirror.park()
        mirror.close()
        assert simulator.now() == (0, 0)
    assert mirror.description == "Optotune MR-E-3, serial number ABCD0001, firmware 1.6.742180"


@pytest.mark.parametrize("unit_rad", [1.0, [0.2, 0.9], 0.75, 4.0])
def test_limits_beyond_the_unit_circle_are_refused_before_the_port_is_opened(unit_rad: Any) -> None:
    """A corner at 43 degrees along both axes is beyond a circle of 50."""
    with pytest.raises(DeviceError, match=r"optical angles of .* degrees along x and y, beyond the circle of 50 deg"):
        OptotuneMirror(RIG, port="/dev/no-such-port", unit_rad=unit_rad)


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ({"unit_rad": [0.1]}, r"devices.mirror.unit_rad: expected a finite number, or a list of 2 .* found \[0.1\]"),
        ({"unit_rad": float("nan")}, "devices.mirror.unit_rad: expected a finite number"),
        ({"unit_rad": []}, "devices.mirror.unit_rad: expected a finite number"),
        ({"unit_rad": 0}, "devices.mirror.unit_rad: expected a number that is not zero"),
    ],
)
def test_wrong_keys(keys: dict[str, Any], what: str) -> None:
    with pytest.raises(RigError, match=what):
        OptotuneMirror(RIG, **{"port": "/dev/no-such-port", **keys})


def test_it_has_two_inputs() -> None:
    with pytest.raises(DeviceError, match="has 2 inputs, x and y; the rig file has 1"):
        OptotuneMirror(load_rig("section-vi"), port="/dev/no-such-port")


def test_a_driver_that_was_left_in_its_pro_mode_is_brought_back() -> None:
    with OptotuneSimulator(pro_mode=True) as simulator:
        opened(simulator).close()
        assert simulator.now() == (0, 0)


@pytest.mark.parametrize(
    ("answers", "what"),
    [
        ({"START": "NO"}, "answers START with 'NO', an Optotune mirror driver with OK"),
        ({"STATUS": "fine"}, "answers STATUS with 'fine', not with a hexadecimal number"),
        ({"STATUS": "0x00000001"}, r"says that no mirror is connected to it \(STATUS 0x00000001\)"),
        ({"STATUS": "00000006"}, "says that the mirror's electronics are too hot and the mirror is too hot"),
        ({"XY": "ERROR"}, r"answers XY=0.000000;0.000000 with 'ERROR', not with OK: give the port of a mirror driver"),
        ({"XY": "NO"}, "it does not take commands in its present state"),
        ({"XY": "OU"}, "it went to its upper limit instead"),
    ],
)
def test_a_driver_that_is_not_ready_or_another_one(answers: dict[str, str], what: str) -> None:
    with OptotuneSimulator(answers=answers) as simulator:
        with pytest.raises(DeviceError, match=what):
            opened(simulator)
        with pytest.raises(DeviceError, match=what):  # the port was given back
            opened(simulator)


@pytest.fixture
def rig_of(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The rig of a simulator and of a camera that sees it."""
    bench.install(monkeypatch, tmp_path, optotune="aolink.devices.mirrors.optotune:OptotuneMirror")

    def rig_for(simulator: OptotuneSimulator) -> Rig:
        bench.watch(simulator.held, lambda xy: np.arctan(xy * TAN_50) / UNIT_RAD)
        devices = f'driver = "optotune"\nport = "{simulator.port}"\nunit_rad = {UNIT_RAD}'
        return bench.rig_with(f'[devices.camera]\ndriver = "spot"\n[devices.mirror]\n{devices}\n')

    yield rig_for
    installed.cache_clear()


Session = Callable[..., Report]
RigOf = Callable[..., Rig]


@pytest.fixture
def session(rig_of: RigOf, tmp_path: Path) -> Session:
    """Records ten exposures with a simulator."""

    def run(simulator: OptotuneSimulator, report: Report | None = None) -> Report:
        rig = parse_rig(rig_of(simulator).toml.replace("watchdog_s = 30.0", "watchdog_s = 1.0"))
        return record(rig, None, None, tmp_path / "a.mcap", exposures=10, report=report)

    return run


@pytest.mark.slow
def test_how_late_inputs_are_taken_is_recorded_and_enters_the_estimates(session: Session, tmp_path: Path) -> None:
    """The line takes its time for each answer, and the session's only doubt about the alignment is that."""
    with OptotuneSimulator(faults=Faults(late_s=0.003)) as simulator:
        report = session(simulator)
    assert report.ended == "complete"
    recording = Recording(tmp_path / "a.mcap")
    step_ns = recording.rig.timing.fast_step_ns
    exposures = list(recording.exposures())
    sigma_ns = np.array([each.alignment_sigma_ns for each in exposures[1:]])
    assert (sigma_ns > 3e6).all()
    known = (replace(each, alignment_sigma_ns=0.0) for each in exposures)
    widened = []
    estimators = make_estimator(recording.rig, "o1"), make_estimator(recording.rig, "o1")
    for exposure, without in zip(exposures, known, strict=True):
        doubted, sure = (estimator.step(each) for estimator, each in zip(estimators, (exposure, without), strict=True))
        assert np.array_equal(doubted.path, sure.path)
        if (
            exposure.alignment_sigma_ns > 0.02 * step_ns
        ):  # of the first exposure little may be doubted: that is left out
            assert doubted.alignment is not None
            assert doubted.alignment.steps == exposure.alignment_sigma_ns / step_ns
        assert sure.alignment is None
        widened.append((doubted.path_sd / sure.path_sd).max())
    assert max(widened) > 1.01


@pytest.mark.slow
def test_a_session_says_once_that_its_exposures_are_hardly_aligned(rig_of: RigOf, tmp_path: Path) -> None:
    """With a mirror that follows its inputs at some time within 30 ms, in exposures of 100 ms."""
    with OptotuneSimulator() as simulator:
        toml = rig_of(simulator).toml.replace('driver = "optotune"', 'driver = "optotune"\ndelay_sd_s = 0.03')
        report = record(parse_rig(toml), None, None, tmp_path / "a.mcap", exposures=3)
    (warning,) = [each for each in report.warnings if "of an exposure (sd" in each]
    assert re.match(r"which of .* is known only to 0\.3\d? of an exposure \(sd, frame 1\)", warning)


@pytest.mark.slow
def test_a_mirror_without_a_queue_is_poked_no_faster_than_its_rig_file_allows(rig_of: RigOf, tmp_path: Path) -> None:

    def poked() -> Poked:
        with OptotuneSimulator() as simulator:
            rig = rig_of(simulator)
            rig = replace(rig, mirror=replace(rig.mirror, slew_max_per_s=5.0))
            record_pokes(
                rig, None, None, tmp_path / "a.mcap", share=0.1, repeats=1, overwrite=True, stop=bool,
                progress=lambda _: None,
            )  # fmt: skip
            assert simulator.now() == (0, 0)
        return interaction(rig, tmp_path / "a.mcap")

    found = bench.undisturbed(poked)
    assert found.measured.exposures >= 3  # a step is late on a busy machine
    assert found.difference < 0.1


@pytest.mark.slow
def test_a_mirror_that_gets_too_hot_ends_the_session_parked(session: Session, tmp_path: Path) -> None:
    """Its status is asked for about once a second; the bit stays set, even if it has cooled down by then."""

    class Overheating(OptotuneSimulator):
        def answer(self, request: bytes) -> bytes:
            self.status = 4 * (len(self.held) > 5)
            return super().answer(request)

    what = r"says that the mirror is too hot \(STATUS 0x00000004\); the \d exposure.* saved in"
    with Overheating() as simulator:
        with pytest.raises(DeviceError, match=what):
            session(simulator, report := Report())
        assert simulator.now() == (0, 0)
        assert 1 < simulator.requests.count(b"STATUS") < 8
    bench.check_ended(report, tmp_path / "a.mcap")


def test_the_driver_is_a_mirror_without_a_queue() -> None:
    """Which the host drives at the fast rate, and parks."""
    with OptotuneSimulator() as simulator:
        mirror = PacedMirror(RIG, opened(simulator))
        assert mirror.send(0, np.full((10_000, 2), 0.3)) < 10_000
        while len(simulator.held) < 3:
            pass
        mirror.park()
        mirror.close()
        assert simulator.now() == (0, 0)
        assert simulator.held[-2][1] == pytest.approx(2 * (math.tan(0.15) / TAN_50,), abs=1e-6)


ANGLE_RAD = st.floats(-1.5, 1.5)
ON_THE_CIRCLE_RAD = math.atan(TAN_50 / math.sqrt(2))


@example((ON_THE_CIRCLE_RAD, ON_THE_CIRCLE_RAD), (0.0, 0.0))
@settings(max_examples=25)
@given(st.tuples(ANGLE_RAD, ANGLE_RAD), st.tuples(ANGLE_RAD, ANGLE_RAD))
def test_no_input_within_limits_that_were_accepted_is_clamped(
    one: tuple[float, float], other: tuple[float, float]
) -> None:
    low, high = np.minimum(one, other), np.maximum(one, other)
    rig = replace(RIG, mirror=replace(RIG.mirror, input_min=low, input_max=high, park=low))
    corners = [np.array(corner) for corner in itertools.product(*np.transpose([low, high]))]
    with OptotuneSimulator() as simulator:
        try:
            mirror = opened(simulator, rig, unit_rad=1.0)
        except DeviceError:
            assert max(math.hypot(*np.tan(corner)) for corner in corners) > TAN_50
            return
        for corner in corners:
            taken = mirror.put(corner)
            assert simulator.now() == pytest.approx(np.tan(taken) / TAN_50, abs=1e-9)
            np.testing.assert_allclose(taken, corner, atol=1e-5)
        mirror.close()
