"""The account of commands: each commanded step ends exactly once, whatever the line does; the watchdog's latch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.devices.reports import AppliedReports
from aolink.errors import DeviceError
from aolink.recording import topics
from aolink.recording.account import STEPS, Account, Commands
from aolink.recording.editing import cut
from aolink.recording.facts import recording_facts
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import CommandAnswer
from aolink.rig import Rig, load_rig, parse_rig
from aolink.simulation.devices import SimulatedDevices
from aolink.wire import messages_pb2 as pb
from tests.kinds import log_of, messages_of
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session

RIG = load_rig("section-vi")


def rig_with(mirror: str = "", **faults: float) -> Rig:
    text = RIG.toml.replace("block_steps = 50", f"block_steps = 50\n{mirror}")
    return parse_rig(text + "\n[simulation.faults]\n" + "\n".join(f"{k} = {v}" for k, v in faults.items()))


def check_account(run: Run) -> None:
    """The sums are exact, and what is said to be applied was applied."""
    report, held = run.report, run.hub.truth()
    assert report.commands.ended == report.commands.commanded
    blocks = messages_of(pb.CommandBlock, Recording(run.path), topics.COMMAND)
    really = sum(
        held.get(step, (0, 0))[0] == block.block_id
        for block in blocks
        for step in range(block.first_step, block.first_step + block.n_steps)
    )
    assert report.commands.commanded == sum(block.n_steps for block in blocks)
    assert report.commands.applied <= really <= report.commands.applied + report.commands.not_reported
    # In the recording each step is reported, or said not to be, once.
    ends = messages_of(pb.Applied, Recording(run.path), topics.APPLIED)
    steps = [
        step for m in ends if m.source != pb.Applied.AWAITED for step in range(m.first_step, m.first_step + m.n_steps)
    ]
    assert len(steps) == len(set(steps))


def recorded_steps(run: Run, source: pb.Applied.Source) -> set[int]:
    ends = messages_of(pb.Applied, Recording(run.path), topics.APPLIED)
    return {step for m in ends if m.source == source for step in range(m.first_step, m.first_step + m.n_steps)}


def check_live_is_recorded(run: Run) -> None:
    """The exposures of the recording are those that were made live, and where an error ended the session some more."""
    recorded = list(Recording(run.path).exposures())
    if run.error is None:
        assert len(recorded) == len(run.exposures)
    # What an error leaves undone is made when the file is read: exposures whose reports were still asked for.
    assert len(recorded) >= len(run.exposures)
    for live, again in zip(run.exposures, recorded, strict=False):
        assert (live.frame_id, live.inputs_assumed) == (again.frame_id, again.inputs_assumed)
        assert np.array_equal(live.inputs, again.inputs)
        assert np.array_equal(live.lead_inputs, again.lead_inputs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"bit_error_rate": 1e-5},
        {"bit_error_rate": 1e-4},
        {"bit_error_rate": 1e-3},
        {"packet_loss_rate": 0.1, "command_loss_rate": 0.1, "duplicate_rate": 0.1, "bit_flip_rate": 0.1},
        {"packet_loss_rate": 0.4, "command_loss_rate": 0.4, "duplicate_rate": 0.3, "bit_flip_rate": 0.2},
    ],
    ids=str,
)
def test_every_commanded_step_ends_once_at_every_error_rate(faults: dict[str, float], tmp_path: Path) -> None:
    rig = rig_with("", **faults)
    run = run_session(SimulatedTimeHub(rig, 1), rig, tmp_path / "a.mcap", 8)
    check_account(run)
    check_live_is_recorded(run)
    if max(faults.values(), default=0) <= 1e-4:  # then nothing is lost for good
        assert run.error is None
        assert run.report.commands.commanded == run.report.commands.applied == 1600
        assert (run.report.reports_asked > 0) == (
            run.report.connection_faults["sequence_gaps"] > run.report.frames_lost
        )
        check_inputs_are_what_was_applied(run, rig)


def check_inputs_are_what_was_applied(run: Run, rig: Rig) -> None:
    exact = rig.mirror.quantise(rig.drive.inputs(0, run.report.commands.commanded, rig.timing.fast_step_s))
    for exposure in run.exposures:
        since = exposure.first_step - run.first_step
        assert np.array_equal(exposure.inputs, exact[since : since + exposure.n_steps])


def test_what_the_mirror_no_longer_knows_is_not_reported_and_assumed_as_converted(tmp_path: Path) -> None:
    """The line from the mirror is dead for 0.4 s; the commands get there all the while.

    It remembers as much as its queue holds, 0.3 s. The host is patient for longer, because the line is slow.
    """
    rig = rig_with("watchdog_s = 0.05\nqueue_steps = 300")
    hub = SimulatedTimeHub(rig)
    for way in (hub.to_device["mirror"], hub.to_host["mirror"]):
        way.latency_ns = 30_000_000
    hub.at = [
        (1_300_000_000, lambda: hub.cut(to_device=False)),
        (1_700_000_000, lambda: hub.cut(to_device=False, to_host=False)),
    ]
    run = run_session(hub, rig, tmp_path / "a.mcap", 20)
    assert run.error is None
    assert run.report.ended == "complete"
    assert 100 < run.report.commands.not_reported < 460
    assert run.report.commands.applied + run.report.commands.not_reported == run.report.commands.commanded == 4000
    assert sum(exposure.inputs_assumed for exposure in run.exposures) == run.report.commands.not_reported
    check_account(run)
    check_live_is_recorded(run)
    check_inputs_are_what_was_applied(run, rig)
    commands = recording_facts(Recording(run.path))["commands"]
    assert Commands.of(commands) == run.report.commands


@pytest.mark.slow
def test_a_block_is_sent_again_as_often_as_its_lead_leaves_room_for(tmp_path: Path) -> None:
    """The lead is 150 steps of 1 ms, the time-out at least 10 ms: at 0, 10, ... 140 ms, and once more just before."""
    loss = 0.8
    rig = rig_with("watchdog_s = 10", command_loss_rate=loss)
    run = run_session(SimulatedTimeHub(rig), rig, tmp_path / "a.mcap", 100)
    assert run.error is None
    check_account(run)
    held = run.hub.truth()
    blocks = messages_of(pb.CommandBlock, Recording(run.path), topics.COMMAND)
    late = sum(held[block.first_step][0] != block.block_id for block in blocks)
    expected = len(blocks) * loss**16
    assert expected - 4 * expected**0.5 < late < expected + 4 * expected**0.5 + 1
    assert (run.report.commands.late > 0) == (late > 0)
    assert run.report.commands.late == run.report.steps_parked


@pytest.mark.slow
@pytest.mark.parametrize("when", [0, 5_000])
def test_a_host_that_is_held_up_for_less_than_the_queue_lasts_is_late_with_nothing(when: int, tmp_path: Path) -> None:
    """At the start, too: the queue has been filled by then."""
    rig = rig_with("queue_steps = 4000\nwatchdog_s = 8")
    hub, left = SimulatedTimeHub(rig), [2.0]

    def inputs(first_step: int, n_steps: int) -> np.ndarray:
        if first_step >= when and left:
            hub.hold_up(left.pop())
        return np.zeros((n_steps, 1))

    run = run_session(hub, rig, tmp_path / "a.mcap", 40, inputs=inputs)
    assert run.error is None
    check_account(run)
    assert (left, run.report.commands.late, run.report.commands.applied) == ([], 0, 8_000)


def test_a_slow_line_is_not_flooded(tmp_path: Path) -> None:
    """Its round trip, 60 ms, is found out from the answers, also while blocks are sent again before they come."""
    hub = SimulatedTimeHub(RIG)
    for way in (hub.to_device["mirror"], hub.to_host["mirror"]):
        way.latency_ns = 30_000_000
    run = run_session(hub, RIG, tmp_path / "a.mcap", 20)
    assert run.report.commands.applied == 4000
    assert run.report.blocks_retransmitted <= 2
    assert run.mirror.flights.round_trip_s == pytest.approx(0.06, rel=0.02)


def test_no_block_is_sent_again_before_its_answer_is_due(tmp_path: Path) -> None:
    """Where the round trip, .8 s, is longer than the longest time-out, only what is sent before the first answer comes
    is sent again."""
    rig = rig_with("queue_steps = 4000\nwatchdog_s = 8")
    hub = SimulatedTimeHub(rig)
    for way in (hub.to_device["mirror"], hub.to_host["mirror"]):
        way.latency_ns = 400_000_000
    run = run_session(hub, rig, tmp_path / "a.mcap", 40)
    assert run.error is None
    check_account(run)
    blocks = run.report.commands.commanded // rig.mirror.block_steps
    assert run.report.blocks_retransmitted < blocks / 2


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_line_of_921600_baud_carries_what_is_sent_again(loss: float, tmp_path: Path) -> None:
    """A block takes it 5 ms. While the mirror hears nothing for a while, no more piles up than the line can carry."""
    rig = rig_with(command_loss_rate=loss)
    hub, piled_up = SimulatedTimeHub(rig), list[int]()
    for way in (hub.to_device["mirror"], hub.to_host["mirror"]):
        way.bytes_per_s = 92_160
    way = hub.to_device["mirror"]
    hub.at = [(1_300_000_000, hub.cut), (2_000_000_000, lambda: hub.cut(to_device=False, to_host=False))]
    run = run_session(hub, rig, tmp_path / "a.mcap", 20, progress=lambda _: piled_up.append(way.backlog_ns()))
    assert (run.error, run.report.ended) == (None, "complete")
    check_account(run)
    assert max(piled_up) < 25_000_000
    assert run.report.steps_parked == run.report.commands.late < 750


def test_a_dead_mirror_line_ends_the_session_within_twice_the_watchdog(tmp_path: Path) -> None:
    """The mirror parks itself, and stays parked until the next session tells it to go on."""
    hub, path = SimulatedTimeHub(RIG), tmp_path / "a.mcap"
    ended_ns: list[int] = []
    hub.at = [(1_300_000_000, hub.cut)]
    run = run_session(hub, RIG, path, 100, progress=lambda _: ended_ns.append(hub.clock_ns))
    assert isinstance(run.error, DeviceError)
    assert "not acknowledged a command for 2.0 s" in str(run.error)
    assert ended_ns[-1] < 1_300_000_000 + 2.1e9 * RIG.mirror.watchdog_s
    check_account(run)
    assert run.report.commands.not_reported > 0
    held = hub.truth()
    parked = [step for step, (_, source) in held.items() if source == pb.Applied.WATCHDOG]
    assert parked == list(range(parked[0], len(held)))  # from the watchdog on
    hub.cut(to_device=False, to_host=False)
    hub.hold_up(1.0)
    again = run_session(hub, RIG, tmp_path / "b.mcap", 3)
    assert (again.error, again.report.ended, again.report.rearmed) == (None, "complete", 1)
    assert again.mirror.identity.mirror.latched
    assert again.report.commands.applied == 600
    assert any("parked by its watchdog in a session before: re-armed" in text for text in log_of(again.path))


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.9, 1.1, 1.9])
def test_a_mirror_line_that_comes_back_in_time(seconds: float, tmp_path: Path) -> None:
    """After the watchdog it takes a word to go on; before, the queue has run empty and nothing more."""
    hub = SimulatedTimeHub(RIG)
    mended_ns = 1_300_000_000 + round(seconds * 1e9)
    hub.at = [(1_300_000_000, hub.cut), (mended_ns, lambda: hub.cut(to_device=False, to_host=False))]
    run = run_session(hub, RIG, tmp_path / "a.mcap", 30)
    assert (run.error, run.report.ended, run.report.exposures) == (None, "complete", 30)
    check_account(run)
    check_live_is_recorded(run)
    latched = seconds > RIG.mirror.watchdog_s
    assert run.report.rearmed == latched
    assert any("parked by its watchdog in this session: re-armed" in text for text in log_of(run.path)) == latched
    # The gap is in the recording as it was, though no report came while the line was cut.
    parked = recorded_steps(run, pb.Applied.WATCHDOG)
    assert parked == {step for step, (_, source) in hub.truth().items() if source == pb.Applied.WATCHDOG}
    assert bool(parked) == latched
    idle = [k for k in range(run.first_step, run.first_step + 6000) if hub.truth()[k][1] != pb.Applied.COMMAND]
    assert run.report.steps_parked == len(idle)
    assert idle[-1] < mended_ns / 1e6 + 100  # commanded again as soon as the line was back


def test_an_interrupted_session_accounts_for_what_was_queued(tmp_path: Path) -> None:
    hub, exposures = SimulatedTimeHub(RIG), list[int]()
    run = run_session(
        hub, RIG, tmp_path / "a.mcap", 0, stop=lambda: bool(exposures and exposures[-1] >= 3), progress=exposures.append
    )
    assert (run.error, run.report.ended) == (None, "interrupted")
    check_account(run)
    report = run.report
    assert report.commands.not_reported == report.commands.late == report.steps_parked == 0
    assert 100 <= report.commands.superseded <= 200  # the lead


def test_long_blocks_keep_the_watchdog_quiet(tmp_path: Path) -> None:
    """Commands go out twice a second, the watchdog is faster: something else has to be said in between."""
    rig = parse_rig(RIG.toml.replace("block_steps = 50", "block_steps = 500\nwatchdog_s = 0.2"))
    run = run_session(SimulatedTimeHub(rig), rig, tmp_path / "a.mcap", 20)
    assert (run.error, run.report.rearmed, run.report.commands.applied) == (None, 0, 4000)


def test_a_refusal_is_in_the_account_of_the_session_that_it_ends(tmp_path: Path) -> None:
    """The device's limits change while the session goes on."""
    hub = SimulatedTimeHub(RIG)
    narrow = replace(RIG, mirror=replace(RIG.mirror, input_max=np.array([0.001])))
    hub.at = [(1_300_000_000, lambda: setattr(hub.server.devices, "rig", narrow))]
    run = run_session(hub, RIG, tmp_path / "a.mcap", 100)
    assert isinstance(run.error, DeviceError)
    assert "the mirror refused command block" in str(run.error)
    check_account(run)
    assert run.report.commands.refused == 50


spans = st.tuples(st.integers(-20, 120), st.integers(1, 60))


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("block"), spans, st.booleans()),
            st.tuples(st.just("advance"), st.integers(1, 80), st.booleans()),
            st.tuples(st.just("park"), st.just(0), st.booleans()),
            st.tuples(st.just("watchdog"), st.just(0), st.booleans()),
            st.tuples(st.just("rearm"), st.just(0), st.booleans()),
        ),
        max_size=25,
    ),
    st.booleans(),
)
def test_the_account_agrees_with_the_device_whatever_it_is_told(
    calls: list[tuple[str, object, bool]], all_arrive: bool
) -> None:
    """Blocks that overlap, come late or are refused, parking, the watchdog; answers and reports that are lost."""
    device = SimulatedDevices(RIG, virtual_time=True, step_zero_ns=0)
    reports, account = AppliedReports(1_000_000, 0), Account()
    blocks: dict[int, range] = {}
    acks: dict[int, pb.CommandAck] = {}
    held: dict[int, int] = {}

    def hear(*, lost: bool = False) -> None:
        for message in [each.message for each in device.outbox]:
            if isinstance(message, pb.CommandAck):
                acks[message.block_id] = message
                if all_arrive or not lost:
                    account.answered(
                        CommandAnswer(
                            block_id=message.block_id, n_steps=len(blocks[message.block_id]), tries=1,
                            late_steps=message.late_steps, answer=pb.Code.Name(message.code),
                        )
                    )  # fmt: skip
            elif isinstance(message, pb.Applied) and not lost:
                for new in reports.take(message, 0):
                    account.reported(new)
        device.outbox.clear()

    def advance(n_steps: int, lost: bool) -> None:
        before = device.step
        device.advance_to(before + n_steps)
        hear(lost=lost)
        while before < device.step:
            device.handle("mirror", pb.AppliedQuery(first_step=before, n_steps=n_steps), 0)
            answer = device.outbox.pop().message
            assert isinstance(answer, pb.Applied)
            held.update(dict.fromkeys(range(before, before + answer.n_steps), answer.block_id))
            before += answer.n_steps

    for what, value, lost in calls:
        if what == "block":
            assert isinstance(value, tuple)
            first = max(device.step + value[0], 0)
            block = pb.CommandBlock(
                block_id=len(blocks) + 1,
                first_step=first,
                n_steps=value[1],
                u=[0.06 if lost and all_arrive else 0.01] * value[1],
            )
            blocks[block.block_id] = range(first, first + value[1])
            reports.begin(0)
            account.commanded(block)
            device.handle("mirror", block, 0)
            hear(lost=lost)
        elif what == "advance":
            assert isinstance(value, int)
            advance(value, lost)
        elif what == "park":
            device.handle("mirror", pb.Park(), 0)
            account.parked_from(device.step)
        elif what == "watchdog":
            device.watchdog_expires()
        else:
            device.handle("mirror", pb.Rearm(), 0)
        hear()
    advance(200, False)
    # What was missed is asked for, until all is known.
    reports.expect_until(device.step, 0)
    for _ in range(1000):
        queries, _given_up = reports.ask(0, 0)
        if not queries:
            break
        for query in queries:
            device.handle("mirror", query, 0)
        hear()
    counts = account.close()

    assert counts.ended == counts.commanded == sum(map(len, blocks.values()))
    assert counts.applied == sum(held.get(k) == name for name, steps in blocks.items() for k in steps)
    if all_arrive:
        refused = {name for name, ack in acks.items() if ack.code in (pb.OUT_OF_RANGE, pb.LATCHED)}
        assert counts.refused == sum(len(blocks[name]) for name in refused)
        assert counts.late == sum(ack.late_steps for ack in acks.values())
        assert counts.not_reported == 0
    effective = {name for name, steps in blocks.items() if any(held.get(k) == name for k in steps)}
    without = sum(each.blocks for each in counts.without_effect)
    assert without >= len(blocks) - len(effective)
    assert without == len(blocks) - len(effective) or not all_arrive


@pytest.mark.slow
def test_a_piece_of_a_recording_has_the_same_exposures(tmp_path: Path) -> None:
    """Also where reports were asked for again across its edges."""
    rig = rig_with(bit_error_rate=2e-4)  # the first word to start is lost here: the session begins later
    run = run_session(SimulatedTimeHub(rig, 5), rig, tmp_path / "a.mcap", 30)
    assert run.error is None
    whole = {exposure.frame_id: exposure for exposure in Recording(run.path).exposures()}
    assert run.report.reports_asked > 50
    for start_s in np.arange(0.5, 5.0, 0.31):
        cut(run.path, tmp_path / "b.mcap", start_s, start_s + 1.0, overwrite=True)
        for exposure in Recording(tmp_path / "b.mcap").exposures():
            assert np.array_equal(exposure.inputs, whole[exposure.frame_id].inputs)
            assert exposure.inputs_assumed == 0


SAID = {
    "in time": CommandAnswer(answer=CommandAnswer.OK),
    "too late": CommandAnswer(answer=CommandAnswer.OK, late_steps=1),
    "refused": CommandAnswer(answer=CommandAnswer.OUT_OF_RANGE),
    "nothing": CommandAnswer(answer=CommandAnswer.NONE),
}
HELD = {
    "no report yet": None,
    "another command": pb.Applied(block_id=2, n_steps=1, source=pb.Applied.COMMAND),
    "its safe input": pb.Applied(n_steps=1, source=pb.Applied.PARKED),
    "no report at all": pb.Applied(n_steps=1, source=pb.Applied.NOT_REPORTED),
    "this command": pb.Applied(block_id=1, n_steps=1, source=pb.Applied.COMMAND),
    "this command, clipped": pb.Applied(block_id=1, n_steps=1, source=pb.Applied.CLIPPED),
    "this command, too late": pb.Applied(block_id=1, n_steps=1, source=pb.Applied.LATE),
}
ENDS = {
    # what the mirror held         in time         too late        refused     nothing: how the step ends, "" while open
    "no report yet":             ("",             "",             "refused",  ""),
    "another command":           ("superseded",   "late",         "refused",  "late"),
    "its safe input":            ("superseded",   "late",         "refused",  "late"),
    "no report at all":          ("not_reported", "late",         "refused",  "not_reported"),
    "this command":              ("applied",      "applied",      "applied",  "applied"),
    "this command, clipped":     ("applied",      "applied",      "applied",  "applied"),
    "this command, too late":    ("late",         "late",         "late",     "late"),
}  # fmt: skip


@pytest.mark.parametrize("said", SAID)
@pytest.mark.parametrize("held", HELD)
def test_what_is_said_and_held_decides_how_a_step_ends(said: str, held: str) -> None:
    """Whichever comes first, unless the mirror refuses: then the step has ended. What is open ends with the session."""
    answer, report, end = CommandAnswer(block_id=1, n_steps=1), HELD[held], ENDS[held][list(SAID).index(said)]
    answer.MergeFrom(SAID[said])
    for messages, expected in (([answer, report], "refused" if said == "refused" else end), ([report, answer], end)):
        account = Account()
        account.commanded(pb.CommandBlock(block_id=1, n_steps=1))
        for message in messages:
            if message is not None:
                account.take("", 0, message)
        ended = [name for name in STEPS[1:-1] if getattr(account.counts, name)]
        assert ended == ([expected] if expected else [])
        assert account.close().ended == account.counts.commanded == 1
