"""Files cut off, damaged, foreign or hostile: what is whole comes back, and nothing hangs or fills the memory."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message as Message_
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import IndexType, Writer

from aolink.errors import AolinkError, RecordingError
from aolink.limits import CHUNK_BYTES, Budget
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.editing import recover
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.messages import RawMessage
from aolink.recording.reader import Recording
from aolink.recording.scan import Loss, broken_up, scan
from aolink.recording.writer import begin_recording
from aolink.rig import load_rig
from aolink.wire import messages_pb2 as wire
from tests.conftest import Session
from tests.kinds import must_be

Chunks = tuple[bytes, list[tuple[int, int]]]


def summary_of(path: Path) -> Summary:
    with path.open("rb") as file:
        return must_be(Summary, make_reader(file).get_summary())


@pytest.fixture(scope="module")
def many_chunks(recorded: Session, tmp_path_factory: pytest.TempPathFactory) -> Chunks:
    """A recording in many small chunks, and where each chunk is: first byte, byte after the last."""
    recording = Recording(recorded.path)
    path = tmp_path_factory.mktemp("chunks") / "a.mcap"
    file = McapFile(path, WriteOptions(chunk_bytes=4096))
    begin_recording(file, recording.rig, {}, 0, {})
    for raw in recording.raw_messages():
        file.add(raw.topic, schema_of(topics.SCHEMAS[raw.schema]), raw.data, raw.log_time_ns, raw.sequence)
    file.finish()
    summary = summary_of(path)
    chunks = [(each.chunk_start_offset, each.chunk_start_offset + each.chunk_length) for each in summary.chunk_indexes]
    return path.read_bytes(), sorted(chunks)


def sequences(path: Path) -> set[int]:
    return {each.sequence for each in Recording(path, check=True).messages()}


def by_chunk(data: bytes, chunks: list[tuple[int, int]]) -> list[set[int]]:
    """The messages of each chunk, by the stock reader."""
    found = []
    for start, end in chunks:
        records = StreamReader(io.BytesIO(data[start:end]), skip_magic=True).records
        messages = set[int]()
        with contextlib.suppress(Exception):  # the stream ends after its chunk
            messages.update(record.sequence for record in records if isinstance(record, Message))
        found.append(messages)
    return found


@pytest.mark.slow
def test_cut_off_at_any_byte_all_whole_chunks_come_back(many_chunks: Chunks, tmp_path: Path) -> None:
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


@pytest.mark.parametrize("bit", [27, 31, 40, 63])
def test_an_impossible_size_of_a_chunk_costs_no_other_one(many_chunks: Chunks, tmp_path: Path, bit: int) -> None:
    """Its size without compression is not believed, and not held against the file."""
    data, chunks = many_chunks
    damaged = bytearray(data)
    damaged[chunks[2][0] + struct.calcsize("<BQQQ") + bit // 8] ^= 1 << bit % 8
    (path := tmp_path / "a.mcap").write_bytes(damaged)
    assert sequences(path) == set().union(*(m for k, m in enumerate(by_chunk(data, chunks)) if k != 2))
    assert [loss.offset for loss in Recording(path, check=True).losses] == [chunks[2][0]]


@pytest.mark.slow
def test_flipped_bits_cost_no_more_than_their_chunks(many_chunks: Chunks, tmp_path: Path) -> None:
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


@pytest.mark.slow
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_garbage_anywhere_is_one_error_or_less_to_read(
    many_chunks: Chunks, tmp_path: Path, choice: st.DataObject
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


@pytest.mark.parametrize("length", [1 << 63, (1 << 64) - 1])
def test_a_chunk_that_says_it_holds_more_than_can_be_costs_itself(
    many_chunks: Chunks, tmp_path: Path, length: int
) -> None:
    data, chunks = bytearray(many_chunks[0]), many_chunks[1]
    start = chunks[2][0]
    held = start + 9 + 32 + data[start + 9 + 28]  # behind the name of the compression
    data[held : held + 8] = length.to_bytes(8, "little")
    (path := tmp_path / "a.mcap").write_bytes(data)
    whole = set().union(*(m for k, m in enumerate(by_chunk(many_chunks[0], chunks)) if k != 2))
    assert sequences(path) == whole
    assert len(Recording(path, check=True).losses) == 1


def test_a_file_of_another_kind_with_private_records_is_refused_with_one_error(tmp_path: Path) -> None:
    with (path := tmp_path / "foreign.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("/x", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(RecordingError, match="aolink"):
        Recording(path)


def test_an_index_that_lies_costs_no_memory(recorded: Session, tmp_path: Path) -> None:
    """Chunks that point at themselves, at the end, at other records."""
    data = bytearray(recorded.path.read_bytes())
    summary = summary_of(recorded.path)
    rng = np.random.default_rng(3)
    for each in summary.chunk_indexes:
        known = (each.message_start_time, each.message_end_time, each.chunk_start_offset)
        at = bytes(data).rindex(struct.pack("<QQQ", *known)) + 16
        struct.pack_into("<Q", data, at, int(rng.integers(0, len(data) // 2)))
    # Without a checksum of the summary, which a hostile writer leaves out, it is believed until it fails.
    struct.pack_into("<I", data, len(data) - 12, 0)
    (path := tmp_path / "lies.mcap").write_bytes(data)
    tracemalloc.start()
    recording = Recording(path)
    assert list(recording.exposures()) == []
    # Places that overlap are one loss.
    assert len(summary.chunk_indexes) / 2 < len(recording.losses) <= len(summary.chunk_indexes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 << 20
    assert "its index is damaged" in Recording(path, check=True).damage


def test_only_the_chunks_of_the_asked_time_and_topics_are_read(many_chunks: Chunks, tmp_path: Path) -> None:
    """All others are made unreadable: whoever looks at them loses them."""
    data, chunks = bytearray(many_chunks[0]), many_chunks[1]
    (path := tmp_path / "a.mcap").write_bytes(data)
    everything = [(each.log_time_ns, each.sequence) for each in Recording(path).messages()]
    summary = summary_of(path)
    middle = summary.chunk_indexes[len(summary.chunk_indexes) // 2].message_start_time
    for index in summary.chunk_indexes:
        if index.message_start_time >= middle:
            data[index.chunk_start_offset + 60] ^= 0xFF
    path.write_bytes(data)
    recording = Recording(path)
    early = [each.sequence for each in recording.messages(end_ns=middle)]
    assert early == [sequence for time, sequence in everything if time < middle]
    assert not recording.losses
    late = {each.sequence for each in recording.messages(start_ns=middle)}  # chunks that begin earlier may hold some
    assert late < {sequence for time, sequence in everything if time >= middle}
    assert recording.losses
    assert len(chunks) > len(recording.losses)


def test_a_channel_whose_chunk_is_lost_is_known_from_elsewhere(recorded: Session, tmp_path: Path) -> None:
    """The recording is of a killed session, without the index at the end: the first chunk names all the channels."""
    data = bytearray(recorded.path.read_bytes())
    summary = summary_of(recorded.path)
    first, last = (sorted(each.chunk_start_offset for each in summary.chunk_indexes)[k] for k in (0, -1))
    data[first + 80] ^= 1
    (path := tmp_path / "killed.mcap").write_bytes(data[:last])
    recording = Recording(path)
    assert len(recording.losses) == 2
    assert set(recording.counts) == set(Recording(recorded.path).counts)
    assert len(list(recording.exposures())) >= len(list(Recording(recorded.path).exposures())) - 3


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    for path in (tmp_path / "pipe.mcap", Path("/dev/zero")):
        with pytest.raises(RecordingError, match="pipe"):
            Recording(path)


class Counting(io.BytesIO):
    """A file that counts what is read of it."""

    count = 0

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        self.count += len(data)
        return data


@pytest.mark.parametrize("kind", ["chunks", "metadata", "ends"])
def test_records_inside_each_other_cost_a_few_readings_of_the_file(kind: str) -> None:
    """Each says that it reaches to the end of the file, and is none."""
    size, step = 600_000, 60
    data = bytearray(b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, 8) + bytes(8))
    data += bytes([0xEE]) * (size - len(data))
    for at in range(100, size - 200, step):
        length = size - at - 9
        if kind == "chunks":
            head = struct.pack("<BQQQQII", 6, length, 1, 2, 1 << 20, 7, 0) + struct.pack("<Q", length - 40)
        elif kind == "metadata":
            head = struct.pack("<BQI", 12, length, 6) + b"aolink" + struct.pack("<I", length - 14)
        else:
            head = struct.pack("<BQI", 15, 4, 0)
        data[at : at + len(head)] = head
    file, losses = Counting(bytes(data)), list[Loss]()
    list(scan(file, losses.append))
    assert losses
    assert file.count < 8 * size + (len(losses) + 100) * 64


@pytest.mark.rare
def test_small_messages_in_a_large_chunk_cost_no_memory() -> None:
    message = struct.pack("<BQHIQQ", 5, 22, 1, 1, 1, 1)
    data = message * ((8 << 20) // len(message))
    chunk = Chunk("zstd", zstandard.compress(data), 1, 1, 0, len(data))
    losses: list[Loss] = []
    tracemalloc.start()
    count = sum(1 for _ in broken_up(chunk, 0, losses.append, Budget("a", 8 << 20)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (count, losses) == (len(data) // len(message), [])
    assert peak < 4 * len(data)
    huge = Chunk("zstd", b"", 1, 1, 0, CHUNK_BYTES + 1)
    assert list(broken_up(huge, 0, losses.append, Budget("a", 8 << 20))) == []
    assert len(losses) == 1


def other_writer(
    source: Recording, path: Path, change: Callable[[RawMessage], RawMessage] = lambda raw: raw, **options: Any
) -> None:
    """A recording by the stock writer, as other software may set it up."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        writer.add_attachment(0, 0, topics.RIG_ATTACHMENT, "application/toml", source.rig.toml.encode())
        channels: dict[str, int] = {}
        for raw in map(change, source.raw_messages()):
            if raw.topic not in channels:
                schema = schema_of(topics.SCHEMAS[raw.schema])
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[raw.topic] = writer.register_channel(raw.topic, "protobuf", known)
            writer.add_message(channels[raw.topic], raw.log_time_ns, raw.data, raw.log_time_ns, raw.sequence)
        writer.finish()


@pytest.mark.parametrize(
    "options",
    [
        {}, {"use_chunking": False}, {"use_statistics": False}, {"repeat_channels": False}, {"repeat_schemas": False},
        {"index_types": IndexType.NONE}, {"index_types": IndexType.ATTACHMENT}, {"index_types": IndexType.CHUNK},
        {"use_summary_offsets": False},
        {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False, "index_types": IndexType.NONE,
         "use_summary_offsets": False},
    ],
)  # fmt: skip
def test_what_other_writers_leave_out_is_no_damage(recorded: Session, tmp_path: Path, options: dict[str, Any]) -> None:
    source = Recording(recorded.path)
    other_writer(source, tmp_path / "a.mcap", **options)
    for check in (False, True):
        found = Recording(tmp_path / "a.mcap", check=check)
        assert list(found.raw_messages()) == list(source.raw_messages())
        assert (found.counts, found.damage) == (source.counts, "")
        assert len(list(found.exposures())) == len(list(source.exposures()))


def write_messages(path: Path, *messages: tuple[str, Message_, int] | tuple[str, bytes, int]) -> Recording:
    file = McapFile(path, WriteOptions())
    begin_recording(file, load_rig("section-vi"), {}, 0, {})
    for k, (topic, message, time_ns) in enumerate(messages, 1):
        data = message if isinstance(message, bytes) else message.SerializeToString()
        kind = pb.ExposureInfo if isinstance(message, bytes) else type(message)
        file.add(topic, schema_of(kind), data, time_ns, k)
    file.finish()
    return Recording(path)


def test_a_message_of_another_kind_is_a_loss(tmp_path: Path) -> None:
    good = pb.ExposureInfo(frame_id=1, last_step=199)
    path = tmp_path / "a.mcap"
    recording = write_messages(
        path, (topics.EXPOSURE, good, 0), (topics.EXPOSURE, b"\xff", 5), (topics.EXPOSURE, good, 9)
    )
    for _ in range(2):
        assert [each.log_time_ns for each in recording.messages()] == [0, 9]
    (loss,) = recording.losses
    assert loss.what == f"1 message(s) on {topics.EXPOSURE} cannot be decoded"
    path.write_bytes(path.read_bytes()[:-40])
    assert (Recording(path).start_ns, Recording(path).end_ns) == (0, 9)


def test_a_report_without_the_inputs_of_its_steps_is_a_loss(recorded: Session, tmp_path: Path) -> None:
    """It does not stand for the steps that it names: all other exposures keep their inputs."""
    source = Recording(recorded.path)
    seen = count()

    def spoil(raw: RawMessage) -> RawMessage:
        if raw.topic != topics.APPLIED or next(seen) != 6:
            return raw
        report = wire.Applied.FromString(raw.data)
        report.n_steps = 2**32 - 1
        return raw._replace(data=report.SerializeToString())

    other_writer(source, tmp_path / "a.mcap", spoil)
    found = Recording(tmp_path / "a.mcap")
    assumed = [exposure.inputs_assumed for exposure in found.exposures()]
    assert len(assumed) == len(list(source.exposures()))
    assert sorted(assumed)[:-1] == [0] * (len(assumed) - 1)
    assert max(assumed) == 50
    assert found.damage == f"1 message(s) on {topics.APPLIED} cannot be used: u has not the inputs of its steps"


def test_lists_of_missing_pixels_that_do_not_fit_are_a_loss(tmp_path: Path) -> None:
    info = pb.ExposureInfo(frame_id=1, last_step=199, missing_offset=[0, 4], missing_length=[2])
    image = RawImage(width=40, height=1, encoding="mono16", data=bytes(80))
    recording = write_messages(tmp_path / "a.mcap", (topics.EXPOSURE, info, 0), (topics.IMAGE, image, 1))
    assert list(recording.exposures()) == []
    assert "missing_length" in recording.damage


PICTURE: dict[str, Any] = {"width": 40, "height": 1, "step": 80, "encoding": "mono16", "data": bytes(80)}


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"step": 79}, "its step is not that of its width"),
        ({"encoding": "mono8"}, "its encoding is not mono16"),
        ({"data": bytes(10)}, "its data are not as long as its size says"),
        ({"width": 20, "step": 40, "data": bytes(40)}, "its size is not that of the rig's sensor, 1 x 40 pixels"),
    ],
)
def test_a_picture_that_lies_is_one_loss_everywhere(tmp_path: Path, change: dict[str, Any], what: str) -> None:
    """The exposures before and after it are read, with the numbers that they have when it is counted."""
    messages: list[tuple[str, Message_, int]] = []
    for k in range(3):
        info = pb.ExposureInfo(frame_id=k, first_step=200 * k, last_step=200 * k + 199)
        picture = RawImage(**PICTURE | (change if k == 1 else {}))
        messages += [(topics.EXPOSURE, info, 10 * k), (topics.IMAGE, picture, 10 * k + 1)]
    recording = write_messages(path := tmp_path / "a.mcap", *messages)
    assert [each.frame_id for each in recording.exposures()] == [0, 2]
    assert [each.frame_id for each in recording[2:]] == [2]
    said = f"1 message(s) on {topics.IMAGE} cannot be used: {what}"
    assert recording.damage == said
    assert [each.what for each in Recording(path, check=True).losses] == [said]
    edited = recover(path, tmp_path / "b.mcap")
    assert ([each.what for each in edited.losses], edited.exposures) == ([said], 2)
    assert not Recording(tmp_path / "b.mcap", check=True).losses


class Unreadable(io.FileIO):
    """A file that the disk cannot read from a byte on: as of a disk's, less comes of a read that reaches it."""

    first = 0

    def readinto(self, buffer: Any) -> int:
        left = self.first - self.tell()
        if left <= 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().readinto(memoryview(buffer).cast("B")[:left]) or 0


@pytest.fixture
def unreadable_from(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path, int], None]:
    """A function that makes a file unreadable from a byte on, in this process."""

    def make(path: Path, first: int) -> None:
        plain = Path.open

        def opened(self: Path, *arguments: Any, **options: Any) -> Any:
            if self != path:
                return plain(self, *arguments, **options)
            (raw := Unreadable(path)).first = first
            return io.BufferedReader(raw)

        monkeypatch.setattr(Path, "open", opened)

    return make


@pytest.mark.parametrize("chunk", [3, 20, None])
def test_what_the_disk_cannot_read_is_damage_from_there_on(
    many_chunks: Chunks, tmp_path: Path, unreadable_from: Callable[[Path, int], None], chunk: int | None
) -> None:
    """In the middle of a chunk, or the last four bytes of the file."""
    data, chunks = many_chunks
    (path := tmp_path / "a.mcap").write_bytes(data)
    first = len(data) - 4 if chunk is None else sum(chunks[chunk]) // 2
    whole = set().union(*(m for m, (_, end) in zip(by_chunk(data, chunks), chunks, strict=True) if end <= first))
    unreadable_from(path, first)
    for check in (False, True):
        recording = Recording(path, check=check)
        assert {each.sequence for each in recording.messages()} == whole
        assert f"byte {first} on" in "; ".join(loss.what for loss in recording.losses)
        assert len(recording.digest) == 64
    edited = recover(path, tmp_path / "b.mcap")
    assert (edited.messages, bool(edited.losses)) == (len(whole), True)
    assert not Recording(tmp_path / "b.mcap", check=True).losses


def test_of_a_disk_that_reads_the_index_only_what_it_names_is_lost(
    many_chunks: Chunks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, chunks = many_chunks
    (path := tmp_path / "a.mcap").write_bytes(data)
    recording = Recording(path)
    unreadable = Unreadable(path)
    unreadable.first = chunks[1][1]
    monkeypatch.setattr(Path, "open", lambda *_: io.BufferedReader(unreadable))
    assert {each.sequence for each in recording.messages()} == set().union(*by_chunk(data, chunks)[:2])
    assert [loss.offset for loss in recording.losses] == [start for start, _ in chunks[2:]]


@pytest.mark.parametrize("place", [1 << 63, (1 << 64) - 1, 1000, "another chunk"])
def test_an_index_that_leads_elsewhere_is_damage_for_the_reader_and_the_check(
    many_chunks: Chunks, tmp_path: Path, place: int | str
) -> None:
    """Its checksum is right: other software may have written it so."""
    written, chunks = many_chunks
    data, named = bytearray(written), chunks[0][0] if isinstance(place, str) else place
    footer = len(data) - 8 - 29
    (start,) = struct.unpack_from("<Q", data, footer + 9)
    at = start
    while data[at] != 0x08 or struct.unpack_from("<Q", data, at + 9 + 16)[0] != chunks[4][0]:  # its index of chunks
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    struct.pack_into("<Q", data, at + 9 + 16, named)
    struct.pack_into("<I", data, footer + 25, zlib.crc32(data[start : footer + 25]))
    (path := tmp_path / "a.mcap").write_bytes(data)
    for check in (False, True):
        recording = Recording(path, check=check)
        lost = set().union(*by_chunk(written, chunks)) - {each.sequence for each in recording.messages()}
        assert lost in (set(), by_chunk(written, chunks)[4])
        assert not (check and lost)
        assert "damaged" in recording.damage
