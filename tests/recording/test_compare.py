"""Where two recordings differ first is said topic by topic, and nothing else is."""

from __future__ import annotations

import resource
import subprocess
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aolink.recording import compare as compare_module
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import Reestimated
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.wire.messages_pb2 import Truth
from tests.conftest import EXPOSURES, Session
from tests.kinds import messages_of
from tests.recording.small import copied

Run = Callable[..., subprocess.CompletedProcess[str]]


def rewritten(source: Path, target: Path, change: Callable[[str, Message], list[Message]]) -> Recording:
    """A copy whose messages went through ``change``."""
    return Recording(copied(source, target, change)[0])


def test_a_recording_is_the_same_as_itself(recorded: Session) -> None:
    found = compare(Recording(recorded.path), Recording(recorded.path))
    assert set(found) == set(Recording(recorded.path).counts)
    assert all(each.same and each.compared for each in found.values())


def test_one_number_is_found_with_its_frame_and_field(recorded: Session, tmp_path: Path) -> None:
    def change(topic: str, message: Message) -> list[Message]:
        if topic == "/estimate/o3" and isinstance(message, pb.Estimate) and message.frame_id == 5:
            message.coefficients[1] += 1e-6
        return [message]

    one, two = Recording(recorded.path), rewritten(recorded.path, tmp_path / "b.mcap", change)
    found = compare(one, two)
    differing = found["/estimate/o3"]
    assert (differing.differ, differing.frame_id) == (1, 5)
    was, now = (messages_of(pb.Estimate, each, "/estimate/o3")[4].coefficients[1] for each in (one, two))
    assert differing.first == f"frame 5: coefficients[1]: {was} against {now}"
    assert all(each.same for topic, each in found.items() if topic != "/estimate/o3")
    assert all(each.same for each in compare(one, two, absolute=2e-6).values())
    assert not compare(one, two, only=["/camera/"]).keys() - {topics.IMAGE, topics.EXPOSURE}


def test_one_pixel_is_found(recorded: Session, tmp_path: Path) -> None:
    def change(topic: str, message: Message) -> list[Message]:
        if isinstance(message, RawImage):
            message.data = message.data[:10] + bytes([message.data[10] ^ 1]) + message.data[11:]
        return [message]

    found = compare(Recording(recorded.path), rewritten(recorded.path, tmp_path / "b.mcap", change))
    assert (found[topics.IMAGE].frame_id, found[topics.IMAGE].differ) == (1, EXPOSURES)
    assert "data[10]: " in found[topics.IMAGE].first


def test_missing_and_added_messages_are_named_and_shift_nothing(recorded: Session, tmp_path: Path) -> None:
    def without_frame_3(topic: str, message: Message) -> list[Message]:
        return [] if isinstance(message, Truth) and message.frame_id == 3 else [message]

    one, two = Recording(recorded.path), rewritten(recorded.path, tmp_path / "b.mcap", without_frame_3)
    for pair, where in (((one, two), "first"), ((two, one), "second")):
        found = compare(*pair)[topics.TRUTH]
        assert (found.compared, found.differ) == (EXPOSURES - 1, 1)
        assert found.first == f"frame 3: only in the {where}"


numbers = st.lists(st.floats(width=64), min_size=1, max_size=6)


def with_numbers(path: Path, rows: list[list[float]]) -> Recording:
    """A recording in which each row stands in a topic of its own."""
    with RecordingWriter(path, load_rig("section-vi"), {}, 0, deterministic=True) as writer:
        for k, row in enumerate(rows):
            writer.take(f"{topics.ESTIMATE}{k}", k, pb.Estimate(nis=row))
    return Recording(path)


def differ(pairs: list[tuple[list[float], list[float]]], relative: float, absolute: float) -> list[bool]:
    """Whether the numbers of each pair are different ones to `compare`."""
    with TemporaryDirectory() as folder:
        one, two = (
            with_numbers(Path(folder) / name, list(rows))
            for name, rows in zip(("a.mcap", "b.mcap"), zip(*pairs, strict=True), strict=True)
        )
        found = compare(one, two, relative=relative, absolute=absolute)
    return [not found[f"{topics.ESTIMATE}{k}"].same for k in range(len(pairs))]


@settings(max_examples=20)
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=20))
@example([([1e308], [-1e308])])  # further apart than a double holds
@example([([np.nan, 1.0], [np.nan, 1.0]), ([np.nan], [1.0])])
def test_numbers_differ_as_numpy_says(pairs: list[tuple[list[float], list[float]]]) -> None:
    pairs = [(x[: len(y)], y[: len(x)]) for x, y in pairs]
    expected = []
    for a, b in (map(np.array, pair) for pair in pairs):
        with np.errstate(invalid="ignore", over="ignore"):
            close = np.abs(a - b) <= 1e-12 + 1e-9 * np.maximum(abs(a), abs(b))
        same = (a == b) | (np.isnan(a) & np.isnan(b)) | (np.isfinite(a) & np.isfinite(b) & close)
        expected.append(not same.all())
    assert differ(pairs, 1e-9, 1e-12) == expected


@pytest.mark.slow
def test_a_recording_is_compared_with_itself_without_a_copy(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    def change(topic: str, message: Message) -> list[Message]:
        if topic == "/estimate/o1" and isinstance(message, pb.Estimate):
            message.nis[0] *= 2
        return [message]

    path = rewritten(recorded.path, tmp_path / "wrong.mcap", change).path
    before = path.read_bytes()
    assert aolink("compare", recorded.path).returncode == 0
    assert aolink("compare", "wrong.mcap", "-t", "/estimate/o3").returncode == 0

    def no_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))

    differs = aolink("compare", "wrong.mcap", preexec_fn=no_files)
    assert differs.returncode == 1, differs.stderr
    assert aolink("compare", "wrong.mcap", "--tolerance", "0.6").returncode == 0
    assert "/estimate/o1" in differs.stdout
    assert "frame 1: nis" in differs.stdout
    refused = aolink("compare", "wrong.mcap", "-t", "/camera/")
    assert refused.returncode == 5
    assert "no such estimates" in refused.stderr
    assert path.read_bytes() == before


def test_exposures_that_were_skipped_are_skipped_again(recorded: Session, tmp_path: Path) -> None:
    def change(topic: str, message: Message) -> list[Message]:
        if topic == "/estimate/o1" and isinstance(message, pb.Estimate) and message.frame_id == 5:
            return []
        if topic == topics.EXPOSURE and isinstance(message, pb.ExposureInfo) and message.frame_id == 5:
            return [message, pb.Estimation(frame_id=5, skipped=True)]
        return [message]

    def write(target: Path) -> Recording:
        recording = Recording(recorded.path)
        with RecordingWriter(target, recording.rig, {}, recording.start_ns, deterministic=True) as writer:
            for each in recording.messages():
                for message in change(each.topic, each.message):
                    topic = topics.estimation_topic("o1") if isinstance(message, pb.Estimation) else each.topic
                    writer.take(topic, each.log_time_ns, message)
        return Recording(target)

    recording = write(tmp_path / "skipped.mcap")
    found = compare(recording, Reestimated(recording, ["o1"]), only=["/estimate/o1"])["/estimate/o1"]
    # From the next exposure on they differ: in the session it was not skipped.
    assert (found.compared, found.frame_id) == (EXPOSURES - 1, 6)


def test_a_topic_that_nobody_has_is_an_error_not_the_same(aolink: Run, recorded: Session) -> None:
    result = aolink("compare", recorded.path, recorded.path, "--topic", "/estimat/")
    assert result.returncode == 5
    assert "/estimat/" in result.stderr


@pytest.mark.parametrize("tolerance", ["close", "", "1e-9,", "1,2,3", "-1", "1e-9,-1", "nan"])
def test_a_tolerance_that_is_none_is_refused(aolink: Run, recorded: Session, tolerance: str) -> None:
    result = aolink("compare", recorded.path, recorded.path, "--tolerance", tolerance)
    assert result.returncode == 2
    assert "--tolerance" in result.stderr


def test_messages_of_unknown_kinds_are_compared_as_bytes(recorded: Session, tmp_path: Path) -> None:
    from mcap.records import Schema

    from aolink.recording.mcap_file import McapFile, WriteOptions
    from aolink.recording.writer import begin_recording

    for name, data in (("a", b"one"), ("b", b"two")):
        recording = Recording(recorded.path)
        file = McapFile(tmp_path / f"{name}.mcap", WriteOptions())
        begin_recording(file, recording.rig, {}, 0, {})
        file.add("/mine", Schema(id=0, name="mine.Own", encoding="protobuf", data=b""), data, 1, 1)
        file.finish()
    one, two = Recording(tmp_path / "a.mcap"), Recording(tmp_path / "b.mcap")
    assert one.counts == {"/mine": 1}
    assert compare(one, one)["/mine"].same
    assert compare(one, two)["/mine"].first == "message 1: value[0]: 111 against 116"


def test_messages_far_from_their_counterparts_are_found(recorded: Session, tmp_path: Path) -> None:
    """Frames of one recording are far behind those of the other."""
    one = Recording(recorded.path)
    with RecordingWriter(tmp_path / "b.mcap", one.rig, {}, one.start_ns, deterministic=True) as writer:
        for kept in (False, True):
            for each in one.messages():
                if (each.topic == topics.IMAGE) is kept and not each.topic.startswith(topics.ESTIMATE):
                    writer.take(each.topic, each.log_time_ns, each.message)
    found = compare(one, Recording(tmp_path / "b.mcap"))
    assert found[topics.EXPOSURE].same
    assert found[topics.COMMAND].same
    # A picture does not say its exposure: all of them come after the last one.
    assert found[topics.IMAGE].compared == 1
    assert found["/estimate/o3"].differ == one.counts["/estimate/o3"]


def test_what_waits_for_its_counterpart_has_a_limit(recorded: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond it the oldest message counts as one without a counterpart; what comes soon is still found."""
    recording = Recording(recorded.path)
    monkeypatch.setattr(compare_module, "_WAITING_BYTES", 20_000)
    assert all(each.same for each in compare(recording, recording).values())
    monkeypatch.setattr(compare_module, "_WAITING_BYTES", 0)
    assert not any(each.compared for each in compare(recording, recording).values())


def test_what_has_no_counterpart_is_counted(recorded: Session, tmp_path: Path) -> None:
    """In the second every frame is twice, first as in the first recording, and the odd ones have other numbers."""

    def change(topic: str, message: Message) -> list[Message]:
        if topic != topics.EXPOSURE or not isinstance(message, pb.ExposureInfo):
            return [message] if topic == topics.IMAGE else []
        other = pb.ExposureInfo.FromString(message.SerializeToString())
        other.chunks_lost += 1
        if message.frame_id % 2:
            message.frame_id = other.frame_id = 2**63 + message.frame_id
        return [message, other]

    one, two = Recording(recorded.path), rewritten(recorded.path, tmp_path / "b.mcap", change)
    found = compare(one, two, only=["/camera/"])
    of = found[topics.EXPOSURE]
    odd = sum(message.frame_id % 2 for message in messages_of(pb.ExposureInfo, one, topics.EXPOSURE))
    alone = odd + (EXPOSURES + odd)
    assert (of.compared, of.differ) == (EXPOSURES - odd, alone), "the first of each name is compared with the first"
    assert of.first == "frame 1: only in the first"
