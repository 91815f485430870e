"""The simulated devices' side of the protocol: what a host may count on, without a wire."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st

from aolink.rig import load_rig
from aolink.simulation.devices import Line, SimulatedDevices
from aolink.wire import messages_pb2 as pb

RIG = load_rig("section-vi")
QUEUE = RIG.mirror.queue_steps


def devices() -> SimulatedDevices:
    return SimulatedDevices(RIG, virtual_time=True, step_zero_ns=0)


def ask(device: SimulatedDevices, message: Message, line: Line = "mirror", sequence: int = 0) -> Message:
    """Hand over a message; gives the answer, which is the only thing that leaves."""
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
