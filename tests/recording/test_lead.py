"""What a file that begins in the middle of a session needs of what came before."""

from __future__ import annotations

from aolink.recording import schemas_pb2, topics
from aolink.recording.lead import Lead
from aolink.wire import messages_pb2 as wire


def test_blocks_that_reach_behind_the_last_exposure_are_kept_and_no_others() -> None:
    lead = Lead()
    for k, (first, steps) in enumerate([(0, 150), (150, 50), (150, 51), (200, 50)]):
        lead.add(topics.APPLIED, wire.Applied(first_step=first, n_steps=steps), 10 + k, k)
    lead.add(topics.EXPOSURE, schemas_pb2.ExposureInfo(frame_id=1, first_step=0, last_step=199), 20, 4)
    assert [sequence for *_, sequence in lead.messages()] == [2, 3]
