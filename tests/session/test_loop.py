"""The session's loop and the hub on devices that are already open."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aolink.estimation import Driver
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.session.commanding import lead_steps
from aolink.session.loop import SessionLoop
from aolink.wire import messages_pb2 as pb
from tests.commands import simulated_rig
from tests.session.native import open_native

RIG = load_rig("section-vi")


def test_a_long_queue_is_kept_full_and_others_are_three_blocks_ahead() -> None:
    assert lead_steps(RIG.mirror) == 3 * RIG.mirror.block_steps
    slow = load_rig("membrane-12x12").mirror
    assert 200 < lead_steps(slow) == slow.queue_steps - 5 * slow.block_steps


def test_on_virtual_time_one_line_waits_for_the_other() -> None:
    """Otherwise the rig might take the camera's query before the mirror's block or after it."""
    with simulated_rig("section-vi") as ports, open_native(RIG, *ports) as (hub, camera, mirror):
        before = hub.now_ns()
        for k in range(3):
            mirror.send_block(50 * k, np.zeros((50, 1)), 0, before)
            camera.query_clock(before)
            assert camera.link.handed is not None
            assert camera.link.handed.mirror_bytes == mirror.link.sent_bytes
            assert hub.now_ns() == before  # what a send sees of the time does not depend on what has come
        answers = [received.message for _, received in hub.wait(1.0)]
        assert [a.block_id for a in answers if isinstance(a, pb.CommandAck)] == [1, 2, 3]
        assert hub.now_ns() > before


def test_frames_of_before_the_session_are_not_its_own(tmp_path: Path) -> None:
    """A camera that was running already: its frames come while the clocks are still being compared."""
    with simulated_rig("section-vi") as ports, open_native(RIG, *ports) as (hub, camera, mirror):
        first = mirror.identity.next_step
        camera.start(first, 2)
        mirror.send_block(first, np.zeros((200, 1)), 0, hub.now_ns())
        mirror.send_block(first + 200, np.zeros((200, 1)), 0, hub.now_ns())
        mirror.identity.next_step += 400
        with RecordingWriter(tmp_path / "a.mcap", RIG, {}, hub.now_ns(), deterministic=True) as writer:
            loop = SessionLoop(RIG, hub, camera, mirror, writer, Driver(RIG, ["o1"]))
            loop.run(3, lambda: False, lambda exposures: None)
    assert (loop.report.ended, loop.report.frames_received, loop.report.frames_lost) == ("complete", 3, 0)
    assert [e.first_step for e in Recording(tmp_path / "a.mcap").exposures()] == [first + k for k in (400, 600, 800)]
