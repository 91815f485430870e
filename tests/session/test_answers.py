"""What the mirror answered to each block is recorded, and why a block had no effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from aolink.errors import DeviceError
from aolink.recording import topics
from aolink.recording.account import Commands
from aolink.recording.editing import cut, merge, recover
from aolink.recording.facts import recording_facts
from aolink.recording.mcap_file import WriteOptions
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import CommandAnswer
from aolink.rig import Rig, parse_rig
from aolink.wire import messages_pb2 as pb
from tests.conftest import Session
from tests.control.rigs import DRIFT, small_rig
from tests.kinds import messages_of
from tests.recording.small import copied
from tests.session.simulated_time import Run, SimulatedTimeHub, run_session

RIG = small_rig(DRIFT)
REFERENCE = Path(__file__).parents[2] / "recordings"


def lossy(rate: float) -> Rig:
    return parse_rig(f"{RIG.toml}\n[simulation.faults]\npacket_loss_rate = {rate}\ncommand_loss_rate = {rate}\n")


def check(run: Run) -> Commands:
    """Each block has one answer, the tries add up, and blocks of which no effect is known had none, unless the mirror
    could not report it."""
    recording = Recording(run.path)
    blocks = messages_of(pb.CommandBlock, recording, topics.COMMAND)
    answers = messages_of(CommandAnswer, recording, topics.ANSWER)
    assert sorted((each.block_id, each.first_step, each.n_steps) for each in answers) == [
        (each.block_id, each.first_step, each.n_steps) for each in blocks
    ]
    assert sum(each.tries for each in answers) == len(blocks) + run.report.blocks_retransmitted
    for each in answers:
        answered = each.answer != CommandAnswer.NONE
        assert bool(each.answered_ns) == bool(each.device_ns) == answered
        assert not answered or 0 < each.sent_ns < each.answered_ns
    found = run.report.commands
    assert recording_facts(recording)["commands"] == asdict(found)
    assert Commands.of(asdict(found)) == found
    effective = {block_id for block_id, _ in run.hub.truth().values()}
    without = {each.block_id for each in blocks} - effective
    certain = [each for each in found.without_effect if "report" not in each.reason]
    assert {each.first_block for each in certain} <= without
    most = sum(each.blocks for each in found.without_effect)
    assert sum(each.blocks for each in certain) <= len(without) <= most
    return found


def test_the_numbers_of_the_answers_are_those_of_the_wire() -> None:
    ours, wires = dict(CommandAnswer.Answer.items()), dict(pb.Code.items())
    assert ours.pop("NONE") not in wires.values()
    assert ours == wires


def test_all_is_accepted_on_a_good_line(tmp_path: Path) -> None:
    found = check(run_session(SimulatedTimeHub(RIG), RIG, tmp_path / "a.mcap", 5))
    assert found.lines() == ["10 blocks: OK 10"]


def test_on_a_bad_line_it_is_recorded_how_often_each_block_was_sent(tmp_path: Path) -> None:
    """A closed loop replaces blocks whose answers were lost: those of some are not waited for any more."""
    run = run_session(SimulatedTimeHub(rig := lossy(0.2), 1), rig, tmp_path / "a.mcap", 20, controller="integrator")
    found = check(run)
    assert found.sent_again > 5
    assert found.most_tries > 1
    assert set(found.by_answer) == {"OK", "NONE"}
    reasons = [each.reason for each in found.without_effect]
    assert "replaced by a later block" in reasons


def test_blocks_that_never_came_were_never_answered(tmp_path: Path) -> None:
    rig = parse_rig(RIG.toml.replace("watchdog_s = 2.0", "watchdog_s = 0.2"))
    hub = SimulatedTimeHub(rig)
    hub.at = [(700_000_000, hub.cut)]
    run = run_session(hub, rig, tmp_path / "a.mcap", 300)
    assert isinstance(run.error, DeviceError)
    (never,) = [each for each in check(run).without_effect if each.reason == "never answered"]
    assert never.tries > 5
    assert f"block {never.first_block}, fast steps {never.first_step} to" in never.text()


def test_a_host_that_was_held_up_finds_the_mirror_latched(tmp_path: Path) -> None:
    hub, left = SimulatedTimeHub(RIG), [3.0]

    def progress(done: int) -> None:
        if done == 9 and left:
            hub.hold_up(left.pop())

    found = check(run_session(hub, RIG, tmp_path / "a.mcap", 100, progress=progress))
    assert found.by_answer["LATCHED"] > 0
    assert "refused, the watchdog had parked the mirror" in [each.reason for each in found.without_effect]


def test_a_refusal_has_the_words_of_the_mirror(tmp_path: Path) -> None:
    hub = SimulatedTimeHub(RIG)
    narrow = replace(RIG, mirror=replace(RIG.mirror, input_max=np.array([-0.5])))
    hub.at = [(1_300_000_000, lambda: setattr(hub.server.devices, "rig", narrow))]
    run = run_session(hub, RIG, tmp_path / "a.mcap", 100)
    assert isinstance(run.error, DeviceError)
    texts = [each.text() for each in check(run).without_effect]
    assert any(each.endswith("refused as OUT_OF_RANGE: an input is beyond the limits") for each in texts)


def test_what_is_still_queued_when_a_session_is_interrupted_has_no_effect(tmp_path: Path) -> None:
    done, path = list[int](), tmp_path / "a.mcap"
    run = run_session(
        SimulatedTimeHub(RIG), RIG, path, 0, stop=lambda: bool(done and done[-1] > 3), progress=done.append
    )  # fmt: skip
    (queued,) = check(run).without_effect
    assert queued.reason == "not reported before the session ended, which empties the queue"
    assert queued.blocks == run.report.commands.superseded // RIG.mirror.block_steps > 0


def test_a_queue_that_is_full_is_counted(tmp_path: Path) -> None:
    """The mirror's queue is shorter than it says, until it says so."""
    hub = SimulatedTimeHub(RIG)
    short = replace(RIG, mirror=replace(RIG.mirror, queue_steps=45))
    hub.at = [(300_000_000, lambda: setattr(hub.server.devices, "rig", short))]
    run = run_session(hub, RIG, tmp_path / "a.mcap", 20)
    check(run)
    answers = messages_of(CommandAnswer, Recording(run.path), topics.ANSWER)
    full = [each for each in answers if each.times_full]
    assert full
    assert all(each.tries > each.times_full for each in full)


def test_on_virtual_time_each_block_has_its_answer(recorded: Session) -> None:
    recording = Recording(recorded.path)
    assert recording.counts[topics.ANSWER] == recording.counts[topics.COMMAND] > 0


def answers_in(path: Path) -> list[bytes]:
    return [each.data for each in Recording(path).raw_messages(topics.ANSWER)]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("answers") / "a.mcap"
    run_session(SimulatedTimeHub(rig := lossy(0.1), 2), rig, path, 40)
    return path


def test_a_piece_has_the_answers_to_its_blocks(session: Path, tmp_path: Path) -> None:
    cut(session, tmp_path / "b.mcap", 0.5, 1.2)
    piece = Recording(tmp_path / "b.mcap")
    blocks, answers = ([each.message for each in piece.messages(topic)] for topic in (topics.COMMAND, topics.ANSWER))
    assert 0 < len(answers) < len(answers_in(session))
    assert {each.block_id for each in answers} == {each.block_id for each in blocks}  # type: ignore[attr-defined]


def test_recovering_keeps_the_answers(session: Path, tmp_path: Path) -> None:
    recover(session, tmp_path / "b.mcap")
    assert answers_in(tmp_path / "b.mcap") == answers_in(session)


def test_the_parts_of_a_session_joined_have_each_answer_once(session: Path, tmp_path: Path) -> None:
    paths = copied(session, tmp_path / "p.mcap", options=WriteOptions(split_s=0.4))
    assert len(paths) > 2
    merge(paths, tmp_path / "joined.mcap")
    assert answers_in(tmp_path / "joined.mcap") == answers_in(session)


def test_an_answer_takes_little_room(session: Path) -> None:
    sizes = [len(data) for data in answers_in(session)]
    assert max(sizes) < 80


@pytest.mark.parametrize("change", [lambda each: each.Clear(), lambda each: setattr(each, "answer", 77)])
def test_an_answer_of_a_later_aolink_is_no_error(
    session: Path, tmp_path: Path, change: Callable[[Message], None]
) -> None:
    def changed(topic: str, message: Message) -> list[Message]:
        if topic == topics.ANSWER:
            change(message)
        return [message]

    copied(session, tmp_path / "b.mcap", changed)
    facts = recording_facts(Recording(tmp_path / "b.mcap"))
    assert sum(facts["commands"]["by_answer"].values()) == Recording(session).counts[topics.ANSWER]
