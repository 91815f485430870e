"""The simulated devices' side of the protocol: what a host may count on, without a wire."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st

from aolink.rig import load_rig
from aolink.simulation.devices import LineName, SimulatedDevices
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MAX_PAYLOAD

RIG = load_rig("section-vi")
QUEUE = RIG.mirror.queue_steps


def devices() -> SimulatedDevices:
    return SimulatedDevices(RIG, virtual_time=True, step_zero_ns=0)


def ask(device: SimulatedDevices, message: Message, line: LineName = "mirror", sequence: int = 0) -> Any:
    """Hand over a message; gives the answer, which is the only thing that leaves and is of the question's kind."""
    device.handle(line, message, sequence)
    (answer,) = device.outbox
    device.outbox.clear()
    return answer.message


def block(block_id: int, first_step: int, n_steps: int = 50, u: float = 0.01) -> pb.CommandBlock:
    return pb.CommandBlock(block_id=block_id, first_step=first_step, n_steps=n_steps, u=[u] * n_steps)


def applied(device: SimulatedDevices, step: int) -> list[pb.Applied]:
    device.advance_to(step)
    reports = [o.message for o in device.outbox if isinstance(o.message, pb.Applied)]
    device.outbox.clear()
    return reports


def test_a_block_is_applied_at_its_steps_and_reported_as_converted() -> None:
    device = devices()
    assert ask(device, block(1, 0)) == pb.CommandAck(block_id=1, queue_end_step=50)
    (report,) = applied(device, 50)
    assert (report.block_id, report.first_step, report.n_steps, report.source) == (1, 0, 50, pb.Applied.COMMAND)
    assert np.array_equal(report.u, RIG.mirror.quantise(np.full((50, 1), 0.01))[:, 0])
    assert report.device_ns == 50_000_000


def test_a_block_sent_again_changes_nothing_and_gets_the_same_answer() -> None:
    device = devices()
    first = ask(device, block(1, 0))
    applied(device, 30)
    assert ask(device, block(1, 0)) == first
    assert ask(device, block(1, 0, u=-0.04)) == first  # the first of an id counts
    (report,) = applied(device, 50)
    assert set(report.u) == {RIG.mirror.quantise(np.array([0.01]))[0]}


def test_late_and_superseded_steps_are_counted() -> None:
    device = devices()
    ask(device, block(1, 0))
    applied(device, 20)
    ack = ask(device, block(2, 10, 60))
    assert (ack.late_steps, ack.superseded_steps, ack.queue_end_step) == (10, 30, 70)
    reports = applied(device, 70)
    assert [(r.block_id, r.first_step, r.n_steps) for r in reports] == [(2, 20, 50)]


@pytest.mark.parametrize(
    ("bad", "code"),
    [
        (block(1, 0, u=0.0501), pb.OUT_OF_RANGE),
        (block(1, 0, u=float("nan")), pb.OUT_OF_RANGE),
        (pb.CommandBlock(block_id=1, first_step=0, n_steps=3, u=[0.0, 0.0]), pb.WRONG_SHAPE),
        (pb.CommandBlock(block_id=1), pb.WRONG_SHAPE),
        (block(0, 0), pb.WRONG_SHAPE),
        (block(1, QUEUE - 49), pb.QUEUE_FULL),
        (block(1, 2**60), pb.QUEUE_FULL),
    ],
)
def test_what_cannot_be_done_is_refused_whole(bad: pb.CommandBlock, code: int) -> None:
    device = devices()
    assert ask(device, bad).code == code
    assert device.queue_end == 0


def test_a_block_refused_for_a_full_queue_may_come_again() -> None:
    device = devices()
    for k in range(QUEUE // 50):
        assert ask(device, block(k + 1, 50 * k)).code == pb.OK
    again = block(99, QUEUE)
    assert ask(device, again).code == pb.QUEUE_FULL
    applied(device, 50)
    assert ask(device, again).code == pb.OK


def test_a_block_that_is_wholly_late_is_said_to_be() -> None:
    device = devices()
    device.advance_to(100)
    assert ask(device, block(1, 0)) == pb.CommandAck(
        block_id=1, code=pb.TOO_LATE, late_steps=50, queue_end_step=100
    )  # fmt: skip


def test_the_camera_started_again_for_the_same_step_is_the_same_start() -> None:
    device = devices()
    start = pb.CameraControl(run=True, first_step=0, exposures=2)
    assert ask(device, start, "camera", 7) == pb.Ack(sequence=7)
    device.advance_to(60)
    assert ask(device, start, "camera", 8) == pb.Ack(sequence=8)  # the first answer was lost
    device.advance_to(1000)
    frames = {o.message.frame_id for o in device.outbox if isinstance(o.message, pb.FrameChunk)}
    assert frames == {1, 2}
    device.outbox.clear()
    late = pb.CameraControl(run=True, first_step=900)
    assert ask(device, late, "camera").code == pb.TOO_LATE


def test_a_line_takes_only_what_is_for_it() -> None:
    assert ask(devices(), pb.CameraControl(), "mirror", 3) == pb.Ack(
        sequence=3, code=pb.NOT_SUPPORTED, text="a mirror does not take CameraControl"
    )
    assert ask(devices(), block(1, 0), "camera").code == pb.NOT_SUPPORTED


def test_an_empty_queue_parks_the_mirror_and_says_so() -> None:
    device = devices()
    ask(device, block(1, 0))
    device.advance_to(60)
    events = [o.message for o in device.outbox if isinstance(o.message, pb.Event)]
    reports = [o.message for o in device.outbox if isinstance(o.message, pb.Applied)]
    assert [e.text for e in events] == ["mirror parked: its queue ran empty"]
    assert [(r.source, r.first_step, r.n_steps) for r in reports] == [
        (pb.Applied.COMMAND, 0, 50),
        (pb.Applied.PARKED, 50, 10),
    ]
    assert set(reports[1].u) == {0.0}
    assert device.parked


def test_identify_begins_a_session_with_a_parked_mirror_and_no_frames() -> None:
    device = devices()
    ask(device, pb.CameraControl(run=True, first_step=0), "camera")
    ask(device, block(1, 50))  # with a gap before it
    identity = ask(device, pb.Identify(nonce=5))
    assert (identity.nonce, identity.kind, identity.next_step) == (5, pb.Identity.MIRROR, 0)
    assert ask(device, pb.Identify(nonce=6), "camera").kind == pb.Identity.CAMERA
    device.advance_to(500)
    assert device.outbox == []
    assert ask(device, block(1, 500)).code == pb.OK  # ids begin anew


@given(
    st.lists(st.tuples(st.integers(0, 300), st.integers(1, 60)), min_size=1, max_size=12),
    st.lists(st.integers(1, 90), min_size=1, max_size=12),
)
def test_every_step_is_reported_once_and_in_order(blocks: list[tuple[int, int]], advances: list[int]) -> None:
    """Whatever comes when: from the first block taken on, the reports are a timeline without gaps."""
    device, reports = devices(), []
    first = None
    for k, advance in enumerate(advances):
        if k < len(blocks):
            ack = ask(device, block(k + 1, *blocks[k]))
            if ack.code == pb.OK and first is None:
                first = device.step
        reports += applied(device, device.step + advance)
    steps = [r.first_step + i for r in reports for i in range(r.n_steps)]
    assert steps == ([] if first is None else list(range(first, device.step)))
    assert all(len(r.u) == r.n_steps for r in reports)
    assert all((r.block_id == 0) == (r.source == pb.Applied.PARKED) for r in reports)


def query(device: SimulatedDevices, first: int, end: int) -> list[tuple[int, int, int, int]]:
    """Ask again; gives block, source, first step and end of each answer."""
    device.handle("mirror", pb.AppliedQuery(first_step=first, n_steps=end - first), 0)
    answers = [o.message for o in device.outbox if isinstance(o.message, pb.Applied)]
    device.outbox.clear()
    return [(a.block_id, a.source, a.first_step, a.first_step + a.n_steps) for a in answers]


def test_what_was_held_can_be_asked_for_again() -> None:
    device = devices()
    ask(device, block(1, 10))
    reports = applied(device, 100)
    assert query(device, 0, 100) == [(0, pb.Applied.PARKED, 0, 10)]
    assert query(device, 10, 100) == [(1, pb.Applied.COMMAND, 10, 60)]
    assert query(device, 30, 40) == [(1, pb.Applied.COMMAND, 30, 40)]
    assert query(device, 90, 200) == [(0, pb.Applied.PARKED, 90, 100)]
    assert query(device, 100, 200) == query(device, 2**63, 2**63 + 50) == []  # has not gone by
    device.handle("mirror", pb.AppliedQuery(first_step=10, n_steps=50), 0)
    assert device.outbox[0].message in reports


def test_what_is_no_longer_remembered_is_not_reported_and_the_rest_comes_with_it() -> None:
    device = devices()
    history = ask(device, pb.Identify()).mirror.history_steps
    device.advance_to(history + 100)
    assert query(device, 0, 50) == [(0, pb.Applied.NOT_REPORTED, 0, 50)]
    (forgotten, known) = query(device, 50, history)
    assert forgotten == (0, pb.Applied.NOT_REPORTED, 50, 100)
    assert known[:3] == (0, pb.Applied.PARKED, 100)


@pytest.mark.slow
@given(st.integers(0, 600), st.integers(1, 600))
def test_an_answer_is_one_packet_and_goes_on_where_it_is_asked(first: int, n_steps: int) -> None:
    device = devices()
    for k in range(4):
        ask(device, block(k + 1, 100 * k, 60))
    device.advance_to(700)
    device.outbox.clear()
    step = first
    while step < first + n_steps:
        device.handle("mirror", pb.AppliedQuery(first_step=step, n_steps=first + n_steps - step), 0)
        answers = [o.message for o in device.outbox]
        device.outbox.clear()
        if not answers:
            assert step >= device.step
            break
        (answer,) = answers
        assert isinstance(answer, pb.Applied)
        assert len(answer.SerializeToString()) <= MAX_PAYLOAD
        assert answer.first_step == step
        assert answer.n_steps > 0
        assert {answer.block_id} == {
            k // 100 + 1 if k < 400 and k % 100 < 60 else 0 for k in range(step, step + answer.n_steps)
        }
        step += answer.n_steps


def test_the_watchdog_latches_until_it_is_told_to_go_on() -> None:
    device = devices()
    ask(device, block(1, 0))
    device.advance_to(20)
    device.outbox.clear()
    device.watchdog_expires()
    (event,) = (o.message for o in device.outbox)
    assert isinstance(event, pb.Event)
    assert event.text == "mirror parked by its watchdog: no valid packet for 1 s"
    device.outbox.clear()
    for message in (block(2, 30), pb.Park(), block(3, 30), pb.Identify(nonce=1), block(1, 30)):
        answer = ask(device, message)
        if isinstance(answer, pb.CommandAck):
            assert answer.code == pb.LATCHED
        if isinstance(answer, pb.Identity):
            assert (answer.mirror.parked, answer.mirror.latched) == (True, True)
    device.advance_to(60)
    device.outbox.clear()
    assert query(device, 20, 60) == [(0, pb.Applied.WATCHDOG, 20, 60)]
    assert ask(device, pb.Rearm(), sequence=7) == pb.Ack(sequence=7, step=60)
    assert ask(device, pb.Rearm(), sequence=8) == pb.Ack(sequence=8, step=60)  # the first answer was lost
    assert ask(device, block(4, 60)).code == pb.OK
    assert not ask(device, pb.Identify(nonce=2)).mirror.latched


def test_the_watchdog_is_at_rest_while_nothing_was_commanded() -> None:
    device = devices()
    device.watchdog_expires()
    ask(device, block(1, 0))
    ask(device, pb.Park())
    device.watchdog_expires()
    assert not device.outbox
    assert not device.latched


def test_an_answer_says_which_try_it_answers() -> None:
    device = devices()
    assert [ask(device, block(1, 0), sequence=k).sequence for k in (5, 9)] == [5, 9]
