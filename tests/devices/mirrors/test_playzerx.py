"""PlayzerX: its commands on a real pseudo terminal, its samples as fast steps, whole sessions, and what goes wrong."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from aolink import estimate
from aolink.devices.mirrors.playzerx import PlayzerX, codes_of, command, remaining, sample_rate, samples
from aolink.devices.simple import Held, Lacks
from aolink.errors import AolinkError, DeviceError
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import record
from tests.devices.mirrors import bench
from tests.devices.simulators import playzerx as simulators
from tests.devices.simulators import spot_camera
from tests.devices.simulators.serial_device import Faults

NAMED = "aolink.devices.mirrors.playzerx:PlayzerX"
STEP_NS = 2_000_000
STALL_S = 0.5
"""How long the device's queue lasts in tests: longer than a busy machine holds a test up."""
PATIENCE_S = 10.0
"""Half of what the queue lasts in the test of a dry one."""

codes = st.lists(st.tuples(st.integers(0, 4095), st.integers(0, 4095)), min_size=1, max_size=40)
lasers = st.one_of(st.tuples(st.integers(0, 255)), st.tuples(*[st.integers(0, 255)] * 3))


@given(codes, lasers, st.binary(max_size=3), st.data())
def test_what_is_sent_is_what_the_makers_page_says(
    sent: list[tuple[int, int]], laser: tuple[int, ...], noise: bytes, data: st.DataObject
) -> None:
    """The simulator reads the bytes by the page, in whatever pieces they come."""
    stream = noise.replace(b"p", b"") + sample_rate(1000) + samples(np.array(sent, dtype=np.uint16), laser)
    found, rest = [], b""
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        commands, rest = simulators.read_commands(rest + stream[:cut])
        found += commands
        stream = stream[cut:]
    assert found[0] == b"plr\x08\xe8\x03\x00\n"
    assert [simulators.read_sample(each) for each in found[1:]] == [(x, y, laser) for x, y in sent]
    assert not rest


def test_commands_are_those_of_the_makers_page() -> None:
    """Its table, row by row, as bytes."""
    assert command("p") == bytes([112, 108, 112, 5, 10])
    assert command("i", b"usb") == bytes([112, 108, 105, 8, 117, 115, 98, 10])
    assert sample_rate(50_000) == bytes([112, 108, 114, 8, 0x50, 0xC3, 0, 10])
    one = codes_of(np.array([[-1.0, 1.0], [0.0, 0.0], [1.0, -1.0]]))
    assert one.tolist() == [[0, 4095], [2048, 2048], [4095, 0]]
    assert samples(np.array([[0xABC, 0x123]], dtype=np.uint16), [7]) == bytes(
        [112, 108, 100, 9, 0xBC, 0xA3, 0x12, 7, 10]
    )
    assert remaining(b"pl-\x48\xe8\x01") == 125_000


@given(st.binary(min_size=6, max_size=6))
def test_any_other_answer_is_refused(answer: bytes) -> None:
    if answer.startswith(b"pl-") and answer[5] < 2:
        return
    with pytest.raises(DeviceError, match="when it is asked how many samples remain"):
        remaining(answer)


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=9))
def test_positions_are_rounded_to_the_nearest_step(u: list[float]) -> None:
    found = codes_of(np.array(u)[:, None])[:, 0] / 2047.5 - 1
    assert np.abs(found - u).max() <= 0.5001 / 2047.5


def rig_with(**changes: str) -> Rig:
    """One with 2 ms fast steps and a long queue; changes are lines of the rig file and what they say instead."""
    text = load_rig("tip-tilt").toml
    settings = {"fast_step_s": "0.002", "resonance_hz": "40.0", "dac_bits": "12", "block_steps": "20", **changes}
    text = text.replace("[mirror]", "[mirror]\npark = [0.0, 0.0]")
    for name, value in settings.items():
        before = next(line for line in text.splitlines() if line.startswith(f"{name} = "))
        text = text.replace(before, f"{name} = {value}")
    return parse_rig(text.replace("[mirror]", "[mirror]\nqueue_steps = 400"))


def opened(device: simulators.PlayzerX, **keys: Any) -> PlayzerX:
    return PlayzerX(rig_with(), port=device.port, **{"ahead_s": STALL_S, **keys})


def poll(mirror: PlayzerX, until: Callable[[list[Held]], bool]) -> list[Held]:
    """What it says that it held, until that is enough."""
    reported: list[Held] = []
    deadline = time.monotonic() + PATIENCE_S
    while not until(reported):
        assert time.monotonic() < deadline
        time.sleep(0.005)  # as a session does
        reported += mirror.applied()
    return reported


def use(device: simulators.PlayzerX) -> None:
    """Open it and ask it until it fails."""
    mirror = opened(device)
    try:
        poll(mirror, lambda reported: False)
    finally:
        mirror.close()


def reported_until(step: int) -> Callable[[list[Held]], bool]:
    return lambda reported: bool(reported) and reported[-1].first_step + len(reported[-1].u) > step


def inputs_of(device: simulators.PlayzerX, n_steps: int) -> NDArray[np.float64]:
    """What the device put out in each sample period, (n_steps, 2)."""
    with device.lock:
        return np.array([sample[:2] for sample in device.put_out[:n_steps]]) / 2047.5 - 1


@pytest.mark.parametrize("data_format", ["XYM", "XYRGB", None])
def test_each_step_holds_its_command_and_the_safe_input_between(data_format: str | None) -> None:
    with simulators.PlayzerX(data_format=data_format, rate_error=80e-6) as device:
        mirror = opened(device, laser=9)
        assert mirror.description == f"Mirrorcle PlayzerX-SX, firmware 1.0.2.0, {data_format or 'XYM'}"
        begin = mirror.time_ns() // STEP_NS + 500
        u = np.column_stack([np.linspace(-1, 1, 60), np.linspace(0.5, 0, 60)])
        assert mirror.send(begin, u[:40]) == 0
        assert mirror.send(begin + 20, u[20:]) == 0  # instead of the steps that are not handed over yet
        reported = poll(mirror, reported_until(begin + 80))
        held, late = (
            np.concatenate([each.u for each in reported]),
            [each.late for each in reported if each.late is not None],
        )
        assert [each.first_step for each in reported] == [0, *np.cumsum([len(each.u) for each in reported])[:-1]]
        assert np.array_equal(held, inputs_of(device, len(held)))
        if not np.concatenate(late).any():  # the machine was not held up for so long
            assert np.abs(held[begin : begin + 60] - u).max() < 3e-4
            assert np.abs(np.delete(held, range(begin, begin + 60), axis=0)).max() < 3e-4
        with device.lock:
            assert device.output is not None
            assert device.output.colours == ((9, 9, 9) if data_format == "XYRGB" else (9,))
        mirror.close()
        assert not device.overflowed
        assert device.at_rest() == (*simulators.ORIGIN, (0, 0, 0) if data_format == "XYRGB" else (0,))


def test_it_is_left_at_a_safe_input_that_is_not_the_origin_with_its_laser_off() -> None:
    """Emptying the queue alone would leave it at its last sample, with the light on."""
    with simulators.PlayzerX() as device:
        mirror = PlayzerX(rig_with(park="[0.25, -0.5]"), port=device.port, laser=200, ahead_s=STALL_S)
        begin = mirror.time_ns() // STEP_NS + 300
        mirror.send(begin, np.full((1000, 2), 0.75))
        reported = poll(mirror, reported_until(begin + 20))
        np.testing.assert_allclose(reported[0].u[0], [0.25, -0.5], atol=3e-4)
        with device.lock:
            assert device.output == (3583, 3583, (200,))
        mirror.close()
        assert device.at_rest() == (2559, 1024, (0,))


@pytest.mark.parametrize("behaviour", [{"analog": True}, {"updates_ms": 1}])
def test_a_device_is_brought_from_what_it_was_left_in(behaviour: dict[str, Any]) -> None:
    """Its analog input, and updates for another program between the answers."""
    with simulators.PlayzerX(**behaviour) as device:
        mirror = opened(device)
        poll(mirror, reported_until(100))
        mirror.close()
        assert device.at_rest() == (*simulators.ORIGIN, (0,))
        assert device.every_s is None


@pytest.mark.slow  # in real time
def test_a_command_for_steps_that_are_handed_over_is_late() -> None:
    with simulators.PlayzerX() as device:
        mirror = opened(device)
        assert mirror.send(0, np.full((20, 2), 0.5)) == 20
        assert 0 < mirror.send(0, np.full((1000, 2), 0.5)) < 1000
        parked = mirror.park()
        reported = poll(mirror, reported_until(parked + 5))
        held = np.concatenate([each.u for each in reported])
        assert np.abs(held[parked:]).max() < 3e-4
        mirror.close()


@pytest.mark.slow
@pytest.mark.parametrize("waiting", [False, True])
def test_a_queue_that_runs_dry_is_said_and_survived(waiting: bool) -> None:
    """The device does not read its line for longer than its queue lasts, perhaps with samples and a question on it.

    Every step is told once, with what was really held.
    """
    # Otherwise the machine may have stopped the simulator in the middle of its samples.
    reported, out = bench.undisturbed(lambda: ran_dry(waiting))
    held = np.concatenate([each.u for each in reported])
    late = np.concatenate([each.late for each in reported if each.late is not None])
    assert [each.first_step for each in reported] == [0, *np.cumsum([len(each.u) for each in reported])[:-1]]
    assert late.sum() > 50
    near = [np.abs(held[1:-1] - out[1 + k : len(out) - 1 + k]).max(axis=1) < 1e-9 for k in (-1, 0, 1)]
    dry = np.count_nonzero(np.diff(late.astype(int)) > 0)  # how often: a busy machine adds to it
    assert (~np.any(near, axis=0)).sum() <= 2 * dry  # where the phase of the samples was in doubt, by one at most


def ran_dry(waiting: bool) -> tuple[list[Held], NDArray[np.float64]]:
    """What the driver told, and what the device put out."""
    with simulators.PlayzerX(deaf=(600 if waiting else sys.maxsize, 0.4)) as device:
        mirror = opened(device, ahead_s=0.2)
        begin = mirror.time_ns() // STEP_NS + 300
        assert mirror.send(begin, np.repeat(np.linspace(0.1, 0.9, 1000), 2).reshape(-1, 2)) == 0
        reported = poll(mirror, reported_until(begin + 30))
        if not waiting:
            with device.lock:  # it hears nothing meanwhile, and goes on putting out samples
                time.sleep(0.4)
        end = mirror.time_ns() // STEP_NS + (500 if waiting else 200)
        reported += poll(mirror, reported_until(end))
        out = inputs_of(device, sum(len(each.u) for each in reported))
        mirror.close()
    return reported, out


def session_rig(device: simulators.PlayzerX) -> Rig:
    rig = bench.rig_with(
        '[devices.camera]\ndriver = "spot"\n'
        f'[devices.mirror]\ndriver = "playzerx"\nport = "{device.port}"\nahead_s = 0.4'
    )
    return parse_rig(rig.toml.replace("dac_bits = 16", "dac_bits = 12\nqueue_steps = 150"))


@pytest.mark.slow
def test_a_whole_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.install(monkeypatch, tmp_path, playzerx=NAMED)
    with simulators.PlayzerX(rate_error=-50e-6) as device:
        spot_camera.mirror.held = device.inputs_at
        report = record(session_rig(device), None, None, tmp_path / "a.mcap", estimators=["o1"], exposures=10)
        assert device.at_rest() == (*simulators.ORIGIN, (0,))  # parked, with the laser off
    assert (report.ended, report.exposures) == ("complete", 10)
    ended = report.steps_applied + report.steps_late + report.steps_refused + report.steps_not_reported
    assert ended + report.steps_superseded == report.steps_commanded == 100
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["mirror"] == "Mirrorcle PlayzerX-SX, firmware 1.0.2.0, XYM"
    assert recording.metadata["mirror_lacks"].split("; ") == [*PlayzerX.lacks]
    exposures = list(recording.exposures())
    assert all(exposure.inputs_assumed == 0 for exposure in exposures)
    assert max(np.abs(exposure.inputs).max() for exposure in exposures) > 0.1
    # The drive moves the spot by 0.3.
    bench.check_paths(recording.rig, zip(exposures, estimate(recording, "o1").estimates("o1"), strict=True))


@pytest.mark.slow  # in real time
@pytest.mark.parametrize(
    ("behaviour", "what"),
    [
        ({"faults": Faults(silent_from=0)}, r"the PlayzerX at /dev/pts/\d+ does not answer 'plp.*nothing came: is it"),
        ({"faults": Faults(garbled=frozenset([0]))}, r"answers '.xf0.*', expected 'pl-ok': it is no PlayzerX"),
        ({"faults": Faults(garbled=frozenset([5]))}, r"answers .* when it is asked how many samples remain, expected"),
        ({"faults": Faults(silent_from=450)}, r"the PlayzerX at .* does not answer 'plg.*nothing came: is it"),
        ({"ping": b"MR-E-3\n"}, "answers 'MR-E-3', expected 'pl-ok': it is no"),
        ({"data_format": "XYZ"}, "takes samples of 'XYZ', this driver knows XYM and XYRGB only"),
        ({"loses": 320}, "off by -.*: its line loses bytes"),
        ({"slowest": 700}, "off by -.*or it does not play 500 samples a second as it was asked to"),
        ({"capacity": 0}, "none of 250 samples remain as soon as it is sent them: it does not take them"),
    ],
)
def test_a_device_that_is_not_as_it_should_be_is_one_line(behaviour: dict[str, Any], what: str) -> None:
    with simulators.PlayzerX(**behaviour) as device, pytest.raises(AolinkError, match=what):
        use(device)


@pytest.mark.parametrize(
    "behaviour", [{"faults": Faults(split=True)}, {"faults": Faults(late_s=0.002)}, {"left_over": b"l-\0\0pl-\1\0\0pl"}]
)
def test_a_slow_line_or_what_another_program_has_left_does_no_harm(behaviour: dict[str, Any]) -> None:
    with simulators.PlayzerX(**behaviour) as device:
        mirror = opened(device)
        reported = poll(mirror, reported_until(100))
        assert sum(len(each.u) for each in reported) > 100
        mirror.close()


def test_an_error_in_a_session_leaves_it_at_the_safe_input_with_its_laser_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.install(monkeypatch, tmp_path, playzerx=NAMED)
    with simulators.PlayzerX(faults=Faults(garbled=frozenset([250]))) as device:
        spot_camera.mirror.held = device.inputs_at
        toml = session_rig(device).toml.replace("ahead_s = 0.4", "ahead_s = 0.4\nlaser = 200")
        rig = parse_rig(toml.replace("dac_bits = 12", "dac_bits = 12\npark = [0.25, -0.5]"))
        with pytest.raises(DeviceError, match=r"answers .* when it is asked how many samples remain, expected"):
            record(rig, None, None, tmp_path / "a.mcap")
        assert device.at_rest() == (2559, 1024, (0,))
    assert Recording(tmp_path / "a.mcap").complete


@pytest.mark.parametrize(
    ("keys", "changes", "what"),
    [
        ({}, {"fast_step_s": "0.0003"}, "is 3333.33 samples a second: the PlayzerX plays a whole number from 50 to"),
        ({}, {"fast_step_s": "0.00001"}, "is 100000 samples a second"),
        ({}, {"fast_step_s": "0.04", "resonance_hz": "5.0"}, "is 25 samples a second"),
        ({}, {"input_max": "1.5"}, r"two axes, each from -1 to 1: the rig file's mirror has 2 input.* -1 to 1.5"),
        (
            {},
            {"dac_bits": "16"},
            "mirror.dac_bits = 16 is finer than the PlayzerX, .*0.000488 of an input: set it to 12",
        ),
        ({"laser": 256}, {}, "devices.mirror.laser = 256: expected a whole number from 0 to 255"),
        ({"ahead_s": 0.0001}, {}, "devices.mirror.ahead_s is shorter than a fast step"),
        ({"ahead_s": 0.7}, {}, "mirror.queue_steps = 400 leaves too little time for commands.*set it to 470 or more"),
    ],
)
def test_what_the_device_cannot_do_is_refused_before_it_is_opened(
    keys: dict[str, Any], changes: dict[str, str], what: str
) -> None:
    with pytest.raises(DeviceError, match=what):
        PlayzerX(rig_with(**changes), port="/dev/no-such-port", **keys)


def test_a_device_that_fails_while_it_is_opened_is_left_with_its_laser_off() -> None:
    with simulators.PlayzerX(slowest=700) as device:
        with pytest.raises(DeviceError, match="does not play 500 samples a second"):
            opened(device, laser=200)
        assert device.at_rest() == (*simulators.ORIGIN, (0,))


def test_what_it_lacks_is_declared() -> None:
    assert PlayzerX.lacks == (Lacks.READ_BACK, Lacks.WATCHDOG, Lacks.STOP)
