"""Files cut off, damaged, foreign or hostile: what is whole comes back, and nothing hangs or fills the memory."""

from __future__ import annotations

import contextlib
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from aolink.errors import AolinkError, RecordingError
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.editing import recover
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.writer import begin_recording
from aolink.rig import load_rig
from tests.conftest import Session


@pytest.fixture(scope="module")
def many_chunks(recorded: Session, tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[tuple[int, int]]]:
    """A recording in many small chunks, and where each chunk is: first byte, byte after the last."""
    recording = Recording(recorded.path)
    path = tmp_path_factory.mktemp("chunks") / "a.mcap"
    file = McapFile(path, WriteOptions(chunk_bytes=4096))
    begin_recording(file, recording.rig, {}, 0, {})
    for raw in recording.raw_messages():
        file.add(raw.topic, schema_of(topics.SCHEMAS[raw.schema]), raw.data, raw.log_time_ns, raw.sequence)
    file.finish()
    with path.open("rb") as opened:
        from mcap.reader import make_reader

        summary = make_reader(opened).get_summary()
    assert summary is not None
    chunks = [(each.chunk_start_offset, each.chunk_start_offset + each.chunk_length) for each in summary.chunk_indexes]
    return path.read_bytes(), sorted(chunks)


def sequences(path: Path) -> set[int]:
    return {each.sequence for each in Recording(path, check=True).messages()}


def by_chunk(data: bytes, chunks: list[tuple[int, int]]) -> list[set[int]]:
    """The messages of each chunk, by the stock reader."""
    from io import BytesIO

    found = []
    for start, end in chunks:
        records = StreamReader(BytesIO(data[start:end]), skip_magic=True).records
        messages = set[int]()
        try:
            for record in records:
                if isinstance(record, Message):
                    messages.add(record.sequence)
        except Exception:  # the stream ends after its chunk
            pass
        found.append(messages)
    return found


def test_cut_off_at_any_byte_all_whole_chunks_come_back(
    many_chunks: tuple[bytes, list[tuple[int, int]]], tmp_path: Path
) -> None:
    data, chunks = many_chunks
    messages = by_chunk(data, chunks)
    assert len(chunks) > 30
    rng = np.random.default_rng(1)
    edges = [edge + by for edge in (chunks[5][1], chunks[20][0], len(data)) for by in (-1, 0, 1)]
    for size in [*map(int, rng.integers(chunks[0][1], len(data), 25)), *edges]:
        (path := tmp_path / "cut.mcap").write_bytes(data[:size])
        whole = set().union(*(m for m, (_, end) in zip(messages, chunks, strict=True) if end <= size))
        assert sequences(path) == whole
        result = recover(path, tmp_path / "whole.mcap", overwrite=True)
        assert result.messages == len(whole)
        assert bool(result.losses) is (size < len(data))
        assert not Recording(result.path, check=True).damage


def test_flipped_bits_cost_no_more_than_their_chunks(
    many_chunks: tuple[bytes, list[tuple[int, int]]], tmp_path: Path
) -> None:
    """Anywhere behind the first 16 bytes: lengths, checksums, attachments, index."""
    data, chunks = many_chunks
    messages = by_chunk(data, chunks)
    rng = np.random.default_rng(2)
    heads = [start + k for start, _ in chunks[:6] for k in range(9)]  # what a record is, and how long
    for flips in [*([each] for each in heads), *rng.integers(16, len(data), (60, 3))]:
        damaged = bytearray(data)
        for byte in flips:
            damaged[byte] ^= 1 << int(rng.integers(8))
        (path := tmp_path / "flipped.mcap").write_bytes(damaged)
        hit = [any(start <= byte < end for byte in flips) for start, end in chunks]
        whole = set().union(*(m for m, is_hit in zip(messages, hit, strict=True) if not is_hit))
        found = sequences(path)
        assert found >= whole, flips
        if any(hit) and found == set().union(*messages):
            # A flip in the log times of a chunk's head, or its name, costs nothing.
            continue
        assert bool(Recording(path, check=True).losses) is (any(hit) or found != whole) or not any(hit)
        assert recover(path, tmp_path / "whole.mcap", overwrite=True).messages == len(found)
        assert sequences(tmp_path / "whole.mcap") == set(range(1, len(found) + 1))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.data())
def test_garbage_anywhere_is_one_error_or_less_to_read(
    many_chunks: tuple[bytes, list[tuple[int, int]]], tmp_path: Path, choice: st.DataObject
) -> None:
    data = bytearray(many_chunks[0])
    for _ in range(choice.draw(st.integers(1, 4))):
        at = choice.draw(st.integers(0, len(data) - 1))
        data[at : at + 40] = choice.draw(st.binary(min_size=0, max_size=200))
    (path := tmp_path / "garbage.mcap").write_bytes(data)
    with contextlib.suppress(AolinkError):  # nothing else may come out
        recording = Recording(path)
        list(recording.exposures())
        for name in recording.estimators:
            recording.estimates(name)


def test_a_file_of_another_kind_with_private_records_is_refused_with_one_error(tmp_path: Path) -> None:
    with (path := tmp_path / "foreign.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("/x", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(RecordingError, match="not a recording of aolink"):
        Recording(path)


def test_an_index_that_lies_costs_no_memory(recorded: Session, tmp_path: Path) -> None:
    """Chunks that point at themselves, at the end, at other records."""
    data = bytearray(recorded.path.read_bytes())
    with recorded.path.open("rb") as file:
        from mcap.reader import make_reader

        summary = make_reader(file).get_summary()
    assert summary is not None
    rng = np.random.default_rng(3)
    for each in summary.chunk_indexes:
        known = (each.message_start_time, each.message_end_time, each.chunk_start_offset)
        at = bytes(data).rindex(struct.pack("<QQQ", *known)) + 16
        struct.pack_into("<Q", data, at, int(rng.integers(0, 2 * len(data))))
    # Without a checksum of the summary, which a hostile writer leaves out, it is believed until it fails.
    struct.pack_into("<I", data, len(data) - 12, 0)
    (path := tmp_path / "lies.mcap").write_bytes(data)
    tracemalloc.start()
    recording = Recording(path)
    assert list(recording.exposures()) == []
    assert len(recording.losses) == len(summary.chunk_indexes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 << 20
    assert not Recording(path, check=True).damage


def test_an_exposure_of_a_billion_steps_is_refused(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "a.mcap", WriteOptions())
    begin_recording(file, load_rig("section-vi"), {}, 0, {})
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    info = pb.ExposureInfo(frame_id=1, first_step=0, last_step=2**40)
    image = RawImage(width=40, height=1, encoding="mono16", data=bytes(80))
    for topic, message in ((topics.EXPOSURE, info), (topics.IMAGE, image)):
        file.add(topic, schema_of(type(message)), message.SerializeToString(), 1, 1)
    file.finish()
    with pytest.raises(RecordingError, match="the picture of frame 1 is damaged"):
        list(Recording(tmp_path / "a.mcap").exposures())


def test_only_the_chunks_of_the_asked_time_and_topics_are_read(
    many_chunks: tuple[bytes, list[tuple[int, int]]], tmp_path: Path
) -> None:
    """All others are made unreadable: whoever looks at them loses them."""
    data, chunks = bytearray(many_chunks[0]), many_chunks[1]
    (path := tmp_path / "a.mcap").write_bytes(data)
    everything = [(each.log_time_ns, each.sequence) for each in Recording(path).messages()]
    middle = sorted(time for time, _ in everything)[len(everything) // 2]
    recording = Recording(path)
    assert recording._index is not None
    for index in recording._index:
        if index.message_start_time >= middle:
            data[index.chunk_start_offset + 60] ^= 0xFF
    path.write_bytes(data)
    recording = Recording(path)
    early = [each.sequence for each in recording.messages(end_ns=middle)]
    assert early == [sequence for time, sequence in everything if time < middle]
    assert not recording.losses
    assert list(recording.messages(start_ns=middle)) == []
    assert recording.losses
    assert len(chunks) > len(recording.losses)


def test_a_channel_whose_chunk_is_lost_is_known_from_elsewhere(recorded: Session, tmp_path: Path) -> None:
    """Of a killed session, without the index at the end: the first chunk names all the channels."""
    data = bytearray(recorded.path.read_bytes())
    with recorded.path.open("rb") as file:
        from mcap.reader import make_reader

        summary = make_reader(file).get_summary()
    assert summary is not None
    first, last = (sorted(each.chunk_start_offset for each in summary.chunk_indexes)[k] for k in (0, -1))
    data[first + 80] ^= 1
    (path := tmp_path / "killed.mcap").write_bytes(data[:last])
    recording = Recording(path)
    assert len(recording.losses) == 2
    assert set(recording.counts) == set(Recording(recorded.path).counts)
    assert len(list(recording.exposures())) >= len(list(Recording(recorded.path).exposures())) - 3
