"""Every field of every message of a device at its extremes: taken, dropped, or refused with the field's name."""

from __future__ import annotations

import resource

import pytest
from google.protobuf.message import Message

from aolink.errors import DeviceError
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from tests.devices.test_gate import Host, hub, ports  # noqa: F401
from tests.extremes import changes

FRAME = pb.FrameChunk(
    frame_id=1, total=80, width=40, height=1, last_step=199, exposure_end_ns=200_000_000, data=bytes(80)
)
TRUTH = pb.Truth(frame_id=1, axes=1, n_outputs=1, start_state=[0.0] * 2, end_state=[0.0] * 2, path=[0.0] * 200)
CAMERA: list[Message] = [FRAME, TRUTH, pb.ClockReply(query_id=2), pb.Event(text="a"), pb.Ack(), pb.Identity()]
MIRROR: list[Message] = [
    pb.Applied(block_id=1, n_steps=50, u=[0.0] * 50), pb.CommandAck(block_id=1, queue_end_step=50),
    pb.ClockReply(query_id=2), pb.Event(text="a"), pb.Ack(), pb.Identity(),
]  # fmt: skip


@pytest.mark.parametrize(
    ("sound", "camera"),
    [(message, True) for message in CAMERA] + [(message, False) for message in MIRROR],
    ids=lambda each: type(each).__name__,
)
def test_every_extreme_of_every_field(hub: Hub, sound: Message, camera: bool) -> None:  # noqa: F811
    tried, said = 0, list[tuple[str, str]]()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, value, change in changes(type(sound)):
        message = type(sound)()
        message.CopyFrom(sound)
        change(message)
        if isinstance(message, pb.Truth):
            data = message.SerializeToString()
            message = pb.TruthChunk(frame_id=1, total=len(data), data=data)
        host, tried = Host(hub), tried + 1
        if isinstance(message, pb.ClockReply):
            (host.camera if camera else host.mirror).query_clock(host.now)
        try:
            host.take(message, camera=camera)
        except DeviceError as error:
            said.append((f"{name} = {value}", str(error)))
    for what, text in said:
        assert f"{type(sound).__name__}." in text or f"{type(message).__name__}." in text, (what, text)
        assert text.isprintable()
        assert len(text) < 1000
    assert tried >= 4
    assert said or isinstance(sound, pb.Event | pb.Identity)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 << 10  # KiB
