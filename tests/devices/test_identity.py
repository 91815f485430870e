"""The question who a device is."""

from __future__ import annotations

from aolink.devices.identity import new_nonce
from aolink.wire import messages_pb2 as pb


def test_every_question_is_another_one_and_as_long_as_the_others() -> None:
    """A shorter packet now and then would make two sessions on virtual time differ."""
    questions = {pb.Identify(nonce=new_nonce()).SerializeToString() for _ in range(2000)}
    assert len(questions) > 1990
    assert len({len(each) for each in questions}) == 1
