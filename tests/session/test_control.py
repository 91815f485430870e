"""Sessions that close their loop, over real pseudo terminals: what is commanded, what is recorded, what is safe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink.control import State
from aolink.devices.gate import Gate
from aolink.devices.identity import identify
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.errors import ControlError
from aolink.estimation import Status
from aolink.jobs.closed_loop import closed_loop, replayed
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate
from aolink.rig import Rig, load_rig, parse_rig
from aolink.session import Report, record
from aolink.session.replay import would_command
from aolink.wire import messages_pb2 as wire
from tests.commands import simulated_rig
from tests.control.rigs import DRIFT, VIBRATION, small_rig
from tests.control.test_fall_back import played, vibration
from tests.kinds import log_of, messages_of, must_be
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session
from tests.session.slow import SLOW, slow_installed

FAULTS = """
[simulation.faults]
bit_flip_rate = 0.02
packet_loss_rate = 0.04
command_loss_rate = 0.05
duplicate_rate = 0.03
"""


def rig_file(folder: Path, rig: Rig, more: str = "") -> Path:
    path = folder / "rig.toml"
    path.write_text(rig.toml + more)
    return path


def close(
    path: Path, folder: Path, controller: str, *estimators: str, exposures: int = 40, how: tuple[str, ...] = ()
) -> Report:
    with simulated_rig(path, *how) as (camera, mirror):
        return record(
            load_rig(path), camera, mirror, folder / "a.mcap", estimators=estimators, exposures=exposures,
            control=controller, overwrite=True,
        )  # fmt: skip


def acts(folder: Path) -> list[pb.Control]:
    return [must_be(pb.Control, each.message) for each in Recording(folder / "a.mcap").messages(topics.CONTROL)]


@pytest.mark.slow
@pytest.mark.parametrize(("controller", "estimator"), [("integrator", ""), ("lqg", "o1")])
def test_on_virtual_time_the_session_is_the_loop_in_memory_bit_for_bit(
    tmp_path: Path, controller: str, estimator: str
) -> None:
    path = rig_file(tmp_path, small_rig(DRIFT, VIBRATION))
    report = close(path, tmp_path, controller, *([estimator] if estimator else []))
    assert report.ended == "complete"
    assert report.commands.commanded == report.commands.applied == 40 * 40
    memory = list(closed_loop(load_rig(path), controller, estimator, 40))
    for ours, theirs, act in zip(Recording(tmp_path / "a.mcap").exposures(), memory, acts(tmp_path), strict=True):
        assert np.array_equal(ours.inputs, theirs.exposure.inputs)
        assert ours.truth is not None
        assert theirs.exposure.truth is not None
        assert np.array_equal(ours.truth.path, theirs.exposure.truth.path)
        assert theirs.act is not None
        for name in ("frame_id", "first_step", "delay_steps"):
            assert getattr(act, name) == getattr(theirs.act, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tip-tilt", "sh-4x4"])
def test_spots_close_the_loop_over_the_wire_as_in_memory(tmp_path: Path, name: str) -> None:
    """Two slopes of one mirror; sixteen spots, each with a plant of its own."""
    path = rig_file(tmp_path, load_rig(name))
    report = close(path, tmp_path, "lqg", "moments", exposures=8)
    rig = load_rig(path)
    assert report.ended == "complete"
    assert report.commands.commanded == report.commands.applied == 8 * rig.timing.frame_period_steps
    memory = list(closed_loop(rig, "lqg", "moments", 8))
    for ours, theirs in zip(Recording(tmp_path / "a.mcap").exposures(), memory, strict=True):
        assert np.array_equal(ours.inputs, theirs.exposure.inputs)
    assert np.ptp(memory[-1].exposure.inputs, axis=0).all()  # every input moves


@pytest.mark.slow
def test_the_recording_says_who_closed_the_loop_and_how(tmp_path: Path) -> None:
    path = rig_file(tmp_path, small_rig(DRIFT, control="gain = 0.4"))
    report = close(path, tmp_path, "lqg", "moments", "o1")
    facts = Recording(tmp_path / "a.mcap").metadata
    assert (facts["controller"], facts["control_estimator"]) == ("lqg", "moments")
    assert "gain 0.4" in facts["control"]
    assert "stable with up to" in facts["control_stability"]
    assert report.control is not None
    assert facts["control_exposures"] == "40"
    assert float(facts["control_delay_ms"]) == 10.0
    assert float(facts["control_slope_rms"]) == report.control.slope_rms
    for act in acts(tmp_path):
        assert (act.controller, act.estimator, act.delay_steps, act.late) == ("lqg", "moments", 10, False)
        assert act.slope_rms > 0
    # Each block knows the newest exposure that had changed the inputs when it was sent.
    changed = {act.first_step: act.frame_id for act in acts(tmp_path)}
    for each in Recording(tmp_path / "a.mcap").messages(topics.COMMAND):
        block = must_be(wire.CommandBlock, each.message)
        assert block.cause_frame_id == max(
            (frame for step, frame in changed.items() if step <= block.first_step), default=0
        )


@pytest.mark.slow
def test_estimates_of_a_closed_loop_are_the_same_offline(tmp_path: Path) -> None:
    path = rig_file(tmp_path, small_rig(VIBRATION))
    close(path, tmp_path, "lqg", "o1")
    recording = Recording(tmp_path / "a.mcap")
    assert first_difference(recording.estimates("o1"), reestimate(recording, ["o1"])["o1"]) is None


@pytest.mark.slow
def test_faults_on_the_wire_leave_the_loop_closed_and_every_step_accounted_for(tmp_path: Path) -> None:
    """Frames are lost, commands and reports come again; and the same seed gives the same bytes."""
    path = rig_file(tmp_path, small_rig(VIBRATION), FAULTS)
    first = close(path, tmp_path, "lqg", "o1")
    bytes_of_first = (tmp_path / "a.mcap").read_bytes()
    report = close(path, tmp_path, "lqg", "o1")
    assert (tmp_path / "a.mcap").read_bytes() == bytes_of_first
    assert report.counts() == first.counts()
    assert report.ended == "complete"
    assert 0 < report.frames_lost < 20
    assert report.blocks_retransmitted > 0
    assert report.commands.commanded == report.commands.ended
    assert report.commands.applied + report.steps_parked == 40 * 40
    truths = [each.truth for each in list(Recording(tmp_path / "a.mcap").exposures())[10:]]
    assert np.sqrt(np.mean([truth.path**2 for truth in truths if truth is not None])) < 0.07  # 0.1 in the open loop


@pytest.mark.slow
def test_in_real_time_every_step_is_accounted_for_and_within_limits(tmp_path: Path) -> None:
    """Nothing is said about how fast: only that each step ends once, and each exposure has its delay."""
    path = rig_file(tmp_path, small_rig(DRIFT))
    report = close(path, tmp_path, "lqg", "o1", exposures=50, how=("--real-time",))
    assert report.ended == "complete"
    assert report.commands.commanded == report.commands.ended
    rig, recording = load_rig(path), Recording(tmp_path / "a.mcap")
    for act in acts(tmp_path):
        assert act.delay_steps >= 10
    held: dict[int, float] = {}
    commanded: dict[int, dict[int, float]] = {}
    for each in recording.messages(topics.COMMAND, topics.APPLIED):
        if isinstance(each.message, wire.CommandBlock):
            block = each.message
            commanded[block.block_id] = {block.first_step + k: u for k, u in enumerate(block.u)}
            assert rig.mirror.input_min[0] <= min(block.u) <= max(block.u) <= rig.mirror.input_max[0]
        elif isinstance(each.message, wire.Applied) and each.message.source == wire.Applied.COMMAND:
            applied = each.message
            for k, u in enumerate(applied.u):
                assert abs(u - commanded[applied.block_id][applied.first_step + k]) < 1e-4
                held[applied.first_step + k] = u
    assert len(held) == report.commands.applied


@pytest.mark.slow
def test_an_estimator_that_is_too_slow_to_control_opens_the_loop_and_costs_nothing_else(tmp_path: Path) -> None:
    """It takes longer for an exposure than six of them last: the mirror holds, and the recording has it all."""
    path = rig_file(tmp_path, small_rig(DRIFT))
    with slow_installed(tmp_path):
        report = close(path, tmp_path, "lqg", SLOW, exposures=60, how=("--real-time",))
    assert (report.ended, report.exposures) == ("complete", report.frames_received)
    assert report.commands.applied + report.steps_parked + report.commands.not_reported == 60 * 40
    assert report.control is not None
    assert report.control.exposures < report.exposures
    assert report.control.late_exposures == report.control.exposures


@pytest.mark.slow
@pytest.mark.parametrize(("when_lost", "state"), [("hold", State.HELD), ("park", State.PARKED)])
def test_a_light_that_goes_out_opens_the_loop(tmp_path: Path, when_lost: str, state: State) -> None:
    """The camera sees nothing: the mirror stays where the rig file says, and the session goes on."""
    path = rig_file(tmp_path, small_rig(DRIFT, control=f'when_lost = "{when_lost}"', light="dark"))
    report = close(path, tmp_path, "lqg", "o1", exposures=20)
    assert report.ended == "complete"
    assert [int(act.state) for act in acts(tmp_path)][-10:] == [int(state)] * 10
    assert any("the loop is open from frame" in warning for warning in report.warnings)
    assert any("the loop is open from frame" in text for text in log_of(tmp_path / "a.mcap"))


def lost_and_found(folder: Path, when_lost: str, away: float, gone: range, estimator: str) -> tuple[Report, list[int]]:
    """A session of 40 exposures whose disturbance is farther away by so many slope units in some of them; and its
    states. All that must hold whatever befalls a loop is asserted: limits, each step accounted for, the open loop."""
    slopes = vibration(0.5, 40, 0.1)
    slopes[gone.start * 40 : gone.stop * 40] += away
    played(folder, slopes, DRIFT, control=f'when_lost = "{when_lost}"')
    report = close(folder / "played.toml", folder, "lqg", estimator)
    assert (report.ended, report.exposures) == ("complete", 40)
    assert report.commands.commanded == report.commands.applied == 40 * 40
    recording = Recording(folder / "a.mcap")
    rig, blocks = recording.rig, messages_of(wire.CommandBlock, recording, topics.COMMAND)
    commanded = np.concatenate([block.u for block in blocks])
    assert rig.mirror.input_min[0] <= commanded.min() <= commanded.max() <= rig.mirror.input_max[0]
    states = [int(act.state) for act in acts(folder)]
    opened = states.index(State.HELD if when_lost == "hold" else State.PARKED)
    closed = states.index(State.CLOSED, opened)
    assert states == [0] * opened + [states[opened]] * (closed - opened) + [0] * (40 - closed)
    inputs = np.concatenate([each.inputs for each in recording.exposures()])[:, 0]
    first, last = (acts(folder)[k].first_step - acts(folder)[0].first_step + 50 for k in (opened, closed))
    open_inputs = inputs[first:last]
    assert len(set(open_inputs)) == 1
    assert open_inputs[0] == (inputs[first - 1] if when_lost == "hold" else rig.mirror.quantise(rig.mirror.park)[0])
    assert len(set(inputs[last : last + 40])) > 1
    for text in (f"open from frame {opened + 1} on", f"closed again from frame {closed + 1} on"):
        assert [f"the loop is {text}" in warning for warning in report.warnings].count(True) == 1
    return report, states


@pytest.mark.slow
@pytest.mark.parametrize("when_lost", ["hold", "park"])
def test_light_that_is_lost_in_a_closed_loop_and_comes_back(tmp_path: Path, when_lost: str) -> None:
    """The spot jumps off the sensor in exposure 20 of a loop that is closed, and is back in exposure 30."""
    report, states = lost_and_found(tmp_path, when_lost, 3.0, range(20, 30), "o1")
    slopes = np.array([act.slope_rms for act in acts(tmp_path)])
    # One of 100 dark frames has enough noise to count as a measurement; the loop is open after six in a row without.
    opened = next(k for k in range(40) if np.isnan(slopes[k - 5 : k + 1]).sum() == 6)
    assert 25 <= opened < 30
    assert np.count_nonzero(states) == 32 - opened
    assert any("6 exposures in a row gave no measurement" in warning for warning in report.warnings)
    assert slopes[34:].max() < 0.02 < 0.05 < slopes[30:32].min()


@pytest.mark.slow
@pytest.mark.parametrize(("when_lost", "estimator"), [("hold", "o1"), ("park", "o1"), ("hold", "moments")])
def test_an_estimator_that_diverges_in_a_closed_loop_opens_it_until_it_has_started_again(
    tmp_path: Path, when_lost: str, estimator: str
) -> None:
    """A knock shifts the spot for good by four standard deviations of what the model believes in, in exposure 20."""
    report, states = lost_and_found(tmp_path, when_lost, 0.6, range(20, 40), estimator)
    found = [each.status for each in Recording(tmp_path / "a.mcap").estimates(estimator)]
    assert found[20:25] == [Status.GATED, Status.GATED, Status.DIVERGED, Status.REINITIALISED, Status.OK]
    assert [k for k, state in enumerate(states) if state] == [22, 23, 24, 25]
    assert any("the estimator is diverged at frame 23" in warning for warning in report.warnings)
    slopes = [act.slope_rms for act in acts(tmp_path)]
    assert max(slopes[30:]) < 0.1 < 0.5 < min(slopes[20:26])


@pytest.mark.slow
def test_a_model_that_no_longer_fits_is_said(tmp_path: Path) -> None:
    """The rig is shaken five times as much as the session's rig file says."""
    path = rig_file(tmp_path, small_rig(DRIFT.replace("0.15", "0.6")))
    with simulated_rig(path) as ports:
        report = record(
            small_rig(DRIFT), *ports, tmp_path / "a.mcap", estimators=["moments"], exposures=80, control="lqg"
        )
    assert any("the model does not fit" in warning for warning in report.warnings)


@pytest.mark.slow
def test_a_controller_that_does_not_pay_is_left_and_the_recording_says_so(tmp_path: Path) -> None:
    """The vibration is not where the model has it; and the same is decided offline."""
    rig = played(tmp_path, vibration(10.5, 50), DRIFT, VIBRATION)
    with simulated_rig(tmp_path / "played.toml") as ports:
        report = record(rig, *ports, tmp_path / "a.mcap", estimators=["o1"], exposures=50, control="lqg")
    acting = [act.acting for act in acts(tmp_path)]
    first = acting.index("still")
    assert acting[:first] == ["lqg"] * first
    assert report.control is not None
    assert report.control.fall_back_exposures == 50 - acting.count("lqg")
    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["control_fall_back_exposures"] == str(report.control.fall_back_exposures)
    assert "fall_back True" in recording.metadata["control"]
    said = f"% less of the slopes (rms) than lqg, and acts from frame {first + 1} on"
    for texts in (report.warnings, log_of(recording.path)):
        assert any("still would have left" in text and said in text for text in texts)
    assert [each.act.acting for each in would_command(recording, "lqg", "o1")] == acting
    assert {each.act.acting for each in would_command(recording, "integrator", "")} == {"integrator"}


@pytest.mark.parametrize(
    ("controller", "rig", "message"),
    [("pid", small_rig(), "'pid'"), ("integrator", small_rig(control="gain = 4.0"), "unstable")],
)
def test_a_loop_that_cannot_be_closed_is_refused_before_anything_is_opened(
    tmp_path: Path, controller: str, rig: Rig, message: str
) -> None:
    with pytest.raises(ControlError, match=message):
        record(rig, "/dev/none", "/dev/none", tmp_path / "a.mcap", control=controller)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(("controller", "estimators"), [("lqg", ["moments"]), ("integrator", [])])
def test_a_controller_that_needs_an_estimator_has_the_default_one(
    tmp_path: Path, controller: str, estimators: list[str]
) -> None:
    path = rig_file(tmp_path, small_rig(DRIFT))
    with simulated_rig(path) as ports:
        report = record(load_rig(path), *ports, tmp_path / "a.mcap", exposures=4, control=controller)
    assert report.control is not None
    assert report.control.estimator == "".join(estimators)
    assert Recording(tmp_path / "a.mcap").estimators == estimators


@pytest.mark.slow
def test_an_unstable_loop_that_is_forced_stays_within_the_limits(tmp_path: Path) -> None:
    path = rig_file(tmp_path, small_rig(DRIFT, control="gain = 20.0"))
    with simulated_rig(path) as ports:
        report = record(load_rig(path), *ports, tmp_path / "a.mcap", exposures=20, control="integrator", force=True)
    assert report.ended == "complete"
    assert report.control is not None
    assert report.control.clipped_steps > 0
    u = np.concatenate([exposure.inputs for exposure in Recording(tmp_path / "a.mcap").exposures()])
    assert np.abs(u).max() <= 1 + 1e-9
    assert np.abs(u).max() > 0.99


def test_several_spots_and_a_mirror_of_many_actuators_run_in_a_closed_loop(tmp_path: Path) -> None:
    """sh-8x8: 48 lenslets, 16 actuators, a turning plate of turbulence; the mirror's modes are what is controlled."""
    rig = load_rig("sh-8x8")
    series = list(closed_loop(rig, "integrator", "", 12))
    still = list(closed_loop(rig, "", "", 12))
    ours, theirs = (
        np.sqrt(np.mean([each.exposure.truth.path**2 for each in some[4:] if each.exposure.truth is not None]))
        for some in (series, still)
    )
    assert ours < theirs


@pytest.mark.slow
def test_a_controller_asked_offline_says_what_it_commanded_in_the_session(tmp_path: Path) -> None:
    """And for a simulated rig, what came of it: the same numbers as in the session, from the same seed."""
    path = rig_file(tmp_path, small_rig(VIBRATION))
    close(path, tmp_path, "lqg", "o1")
    recording = Recording(tmp_path / "a.mcap")
    for each in would_command(recording, "lqg", "o1"):
        assert np.array_equal(each.inputs[: len(each.recorded)], each.recorded)
    result = replayed(recording, "lqg", "o1", lambda: False, lambda done: None)
    assert (result.exposures, result.difference_rms, result.seed) == (40, 0.0, 3)
    assert result.closed_rms == result.recorded_rms < 0.5 * result.open_rms


@pytest.mark.slow
def test_another_controller_offline_answers_to_what_was_recorded(tmp_path: Path) -> None:
    path = rig_file(tmp_path, small_rig(DRIFT))
    with simulated_rig(path, "--seed", "8") as ports:
        record(load_rig(path), *ports, tmp_path / "a.mcap", exposures=30)
    result = replayed(Recording(tmp_path / "a.mcap"), "integrator", "o1", lambda: False, lambda done: None)
    assert (result.estimator, result.seed) == ("", 8)
    assert result.recorded_rms == result.open_rms > result.closed_rms
    assert result.difference_rms > 0


def on_simulated_time(tmp_path: Path, rig: Rig, exposures: int = 40) -> Run:
    """A session in real time on a simulated clock: what is queued is superseded, and it is the same every time."""
    hub = SimulatedTimeHub(rig)
    return run_session(hub, rig, tmp_path / "a.mcap", exposures, controller="lqg", estimators=["o1"])


@pytest.mark.slow
def test_with_a_queue_the_loop_is_as_good_as_its_delay(tmp_path: Path) -> None:
    """Three blocks of lead, which are longer than a frame, delay nothing: each exposure acts after 10 ms, as asked."""
    rig = small_rig(VIBRATION)
    run = on_simulated_time(tmp_path, rig)
    assert run.error is None
    report = run.report
    assert report.commands.superseded > 40 * 20
    assert report.commands.late == report.steps_parked == 0
    assert {act.delay_steps for act in acts(tmp_path)} == {10}
    truths = [each.truth for each in list(Recording(tmp_path / "a.mcap").exposures())[10:]]
    assert np.sqrt(np.mean([truth.path**2 for truth in truths if truth is not None])) < 0.05  # 0.1 in the open loop
    assert report.commands.commanded == report.commands.ended


@pytest.mark.slow
def test_commands_that_are_lost_while_others_replace_them_are_accounted_for(tmp_path: Path) -> None:
    rig = parse_rig(
        small_rig(VIBRATION).toml + "[simulation.faults]\ncommand_loss_rate = 0.2\npacket_loss_rate = 0.05\n"
    )
    run = on_simulated_time(tmp_path, rig)
    assert run.error is None
    report = run.report
    assert report.ended == "complete"
    assert report.blocks_retransmitted > 0
    assert report.commands.commanded == report.commands.ended
    held = [source for step, (_, source) in run.hub.truth().items() if 0 <= step - run.first_step < 40 * 40]
    assert report.commands.applied + report.commands.not_reported >= held.count(wire.Applied.COMMAND)


def test_a_block_that_was_replaced_is_never_sent_again(tmp_path: Path) -> None:
    """It is lost; another one takes its place; when the line is mended, only that one comes."""
    rig = small_rig()
    hub = SimulatedTimeHub(rig)
    camera_link, mirror_link = hub.links
    asked_ns = hub.now_ns()
    identities = identify(hub, camera_link, 1), identify(hub, mirror_link, 2)
    gate = Gate(rig, hub, identities, asked_ns)
    hub.native = [
        NativeCamera(hub, camera_link, identities[0], gate),
        NativeMirror(hub, mirror_link, identities[1], gate),
    ]
    mirror = must_be(NativeMirror, hub.native[1])
    first = hub.server.devices.step + 200
    hub.cut()
    lost = mirror.send_block(first, np.full((40, 1), 0.1), 0, hub.now_ns())
    assert mirror.withdraw(first + 40) == first + 40
    assert mirror.withdraw(first + 20) == first
    hub.cut(to_device=False, to_host=False)
    mirror.send_block(first, np.full((40, 1), 0.2), 0, hub.now_ns())
    while hub.server.devices.step < first + 40:
        for _ in hub.events(0.005):
            pass
        mirror.serve(hub.now_ns())
    blocks = {hub.truth()[step][0] for step in range(first, first + 40)}
    assert lost.block_id not in blocks
    assert len(blocks) == 1
    assert mirror.in_flight == 0
