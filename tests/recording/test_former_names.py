"""Recordings made before a topic and its messages were renamed are used as before, by the present names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Metadata

from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.compare import compare
from aolink.recording.editing import cut, recover
from aolink.recording.growing import GrowingRecording
from aolink.recording.reader import Recording
from aolink.recording.topics import present_names
from aolink.viewing.save import save_rrd
from tests.conftest import Session
from tests.kinds import messages_of
from tests.viewing.rrd import read_rrd

OLD = Path(__file__).parents[2] / "recordings" / "section-vi.mcap"
FORMER = ("/link", "aolink.recording.LinkStatistics")
PRESENT = (topics.CONNECTION, "aolink.recording.ConnectionStatistics")


def names_in(path: Path) -> set[tuple[str, str]]:
    """Topics and schemas as the file itself has them."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {(each.topic, summary.schemas[each.schema_id].name) for each in summary.channels.values()}


def counted(recording: Recording) -> list[pb.ConnectionStatistics]:
    return messages_of(pb.ConnectionStatistics, recording, topics.CONNECTION)


def test_a_new_recording_has_the_present_names(recorded: Session) -> None:
    assert PRESENT in names_in(recorded.path)
    assert FORMER not in names_in(recorded.path)
    assert {each.device for each in counted(Recording(recorded.path))} == {"camera", "mirror"}
    assert all(each.messages_received and each.messages_sent for each in counted(Recording(recorded.path)))


def test_an_older_recording_is_read_by_the_present_names() -> None:
    assert FORMER in names_in(OLD)
    recording = Recording(OLD)
    assert "/link" not in recording.counts
    found = counted(recording)
    assert len(found) == recording.counts[topics.CONNECTION] > 0
    assert {each.device for each in found} == {"camera", "mirror"}
    assert all(each.messages_received and each.messages_sent and each.bytes_received for each in found)
    assert found == counted(Recording(OLD, check=True)), "with and without the index"


def test_a_former_name_asks_for_the_topic_that_has_another_now(tmp_path: Path) -> None:
    for path in (OLD, shutil.copy(OLD, tmp_path / "again.mcap")):
        found = compare(Recording(OLD), Recording(path), only=["/link"])
        assert found.keys() == {topics.CONNECTION}
        assert found[topics.CONNECTION].same
    both = compare(Recording(OLD), Recording(OLD), only=["/link", "/camera/"])
    assert both.keys() == {topics.CONNECTION, topics.EXPOSURE, topics.IMAGE}


@pytest.mark.slow
def test_an_older_recording_is_shown(tmp_path: Path) -> None:
    save_rrd(Recording(OLD), tmp_path / "a.rrd")
    shown = read_rrd(tmp_path / "a.rrd")
    assert "/connection/faults/mirror" in shown
    assert not any(name.startswith("/link") for name in shown)


def test_copies_have_the_present_names_and_are_the_same(tmp_path: Path) -> None:
    recover(OLD, tmp_path / "whole.mcap")
    cut(OLD, tmp_path / "part.mcap", 0, 2)
    for copy in ("whole.mcap", "part.mcap"):
        assert PRESENT in names_in(tmp_path / copy)
        assert FORMER not in names_in(tmp_path / copy)
    assert all(found.same for found in compare(Recording(OLD), Recording(tmp_path / "whole.mcap")).values())
    assert topics.CONNECTION in compare(Recording(OLD), Recording(tmp_path / "whole.mcap"))


@pytest.mark.parametrize("share", [0.5, 0.999])
def test_an_older_recording_that_was_cut_off_is_read_and_recovered(tmp_path: Path, share: float) -> None:
    (broken := tmp_path / "broken.mcap").write_bytes(OLD.read_bytes()[: int(share * OLD.stat().st_size)])
    whole, found = counted(Recording(OLD)), counted(Recording(broken))
    assert found
    assert found == whole[: len(found)]
    recover(broken, tmp_path / "whole.mcap")
    assert counted(Recording(tmp_path / "whole.mcap")) == found


def test_a_channel_that_only_the_metadata_still_name_is_read_by_the_present_names(tmp_path: Path) -> None:
    """The chunk that the channel and its schema were in is lost; later messages have its number alone."""
    recording = Recording(OLD)
    recording.channels.clear()
    (before,) = (k for k, names in Recording(OLD).channels.items() if names == PRESENT)
    known = {"id": str(before), "topic": FORMER[0], "schema": FORMER[1]}
    recording.note_metadata([Metadata(name=topics.CHANNEL_METADATA, metadata=known)])
    assert recording.channels == {before: PRESENT}


def test_an_older_recording_is_followed_while_it_grows(tmp_path: Path) -> None:
    shutil.copyfile(OLD, tmp_path / "a.mcap")
    growing = GrowingRecording(tmp_path / "a.mcap", lambda: None)
    assert [each.message for each in growing.messages(topics.CONNECTION)] == counted(Recording(OLD))


def test_side_files_made_before_still_belong_to_an_older_recording_without_an_index(tmp_path: Path) -> None:
    """The digest that they name has the topics' names in the file. This one was made before the names were changed."""
    (broken := tmp_path / "broken.mcap").write_bytes(OLD.read_bytes()[: OLD.stat().st_size // 2])
    recording = Recording(broken)
    assert topics.CONNECTION in recording.counts
    assert recording.digest == "a4904e2d0ca4546ee5cd0e394b6a19330bd9b507c6914b8a8fca68d42a9402d6"


def test_a_topic_of_other_software_by_a_former_name_keeps_it() -> None:
    assert present_names(*FORMER) == present_names("/link", PRESENT[1]) == present_names(*PRESENT) == PRESENT
    assert present_names("/link", "other.Link") == ("/link", "other.Link")
    assert present_names("/link", "") == ("/link", "")
    assert present_names("/else", FORMER[1]) == ("/else", PRESENT[1])
