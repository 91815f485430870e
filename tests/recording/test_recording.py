"""Recordings: read by stock tools, whole after a crash, lossless."""

from __future__ import annotations

import fcntl
import itertools
import os
import subprocess
import sys
import threading
import time
import tracemalloc
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf import descriptor_pb2
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

import aolink
from aolink.assembly import Frame
from aolink.errors import RecordingError
from aolink.estimation import exposure_model
from aolink.recording import convert, topics
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.recording.writer import RecordingWriter, begin_recording
from aolink.rig import load_rig
from aolink.timeouts import Timeouts
from tests.conftest import ESTIMATORS, EXPOSURES, Session


def test_the_mcap_reader_with_stock_decoders_reads_it(recorded: Session) -> None:
    """The file needs nothing but itself: the schemas inside it decode every message."""
    by_topic: dict[str, list[Any]] = {}
    with recorded.path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        for decoded in reader.iter_decoded_messages():
            by_topic.setdefault(decoded.channel.topic, []).append(decoded.decoded_message)
    assert sum(map(len, by_topic.values())) == summary.statistics.message_count
    image, info, truth = (by_topic[t][3] for t in (topics.IMAGE, topics.EXPOSURE, topics.TRUTH))
    exposure = list(Recording(recorded.path).exposures())[3]
    assert (image.encoding, image.width, image.height) == ("mono16", 40, 1)
    assert np.array_equal(np.frombuffer(image.data, "<u2"), exposure.pixels[0])
    assert info.frame_id == exposure.frame_id == 4
    assert exposure.truth is not None
    assert np.array_equal(np.array(truth.path), exposure.truth.path[0])
    assert attachments["rig.toml"].decode() == load_rig("section-vi-lively").toml
    assert metadata["aolink"]["rig_digest"] == load_rig("section-vi-lively").digest
    assert metadata["aolink/end"]["ended"] == "complete"


def test_the_recorded_basis_expands_the_recorded_coefficients(recorded: Session) -> None:
    """Whoever reads the file without aolink can expand a path with NumPy alone."""
    with recorded.path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        (data,) = [a.data for a in reader.iter_attachments() if a.name == "exposure_basis.npy"]
        estimates = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/estimate/open-loop"])]
    (tmp := recorded.path.with_suffix(".npy")).write_bytes(data)
    basis = np.load(tmp)
    rig, recording = load_rig("section-vi-lively"), Recording(recorded.path)
    ours, exposure = recording.estimates("open-loop")[5], list(recording.exposures())[5]
    inputs = exposure_model(rig.plant, 200).response(exposure.inputs).path[0, 0]
    path = basis[0] @ np.array(estimates[5].coefficients) + inputs
    np.testing.assert_allclose(path, ours.path[0], rtol=0, atol=1e-12)


def test_reruns_own_importer_reads_it(recorded: Session, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    target = tmp_path / "converted.rrd"
    rerun = Path(sys.executable).parent / "rerun"
    result = subprocess.run(
        [rerun, "mcap", "convert", recorded.path, "-o", target], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    columns: dict[str, int] = {}
    for chunk in RrdReader(target).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            columns[f"{chunk.entity_path} {name}"] = columns.get(f"{chunk.entity_path} {name}", 0) + batch.num_rows
    pictures = {name: rows for name, rows in columns.items() if name.startswith("/camera/image ") and "buffer" in name}
    assert set(pictures.values()) == {EXPOSURES}, columns
    assert any(name.startswith("/estimate/o3 ") and rows == EXPOSURES for name, rows in columns.items()), columns


def test_a_recording_cut_anywhere_gives_what_is_whole(recorded: Session, tmp_path: Path) -> None:
    data, whole = recorded.path.read_bytes(), list(Recording(recorded.path).exposures())
    counts = []
    for size in np.linspace(len(data) * 0.4, len(data) - 1, 25).astype(int):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:size])
        recording = Recording(path)
        assert not recording.complete
        exposures = list(recording.exposures())
        for ours, theirs in zip(exposures, whole, strict=False):
            assert np.array_equal(ours.pixels, theirs.pixels)
        counts.append(len(exposures))
    assert counts == sorted(counts)
    assert counts[0] < counts[-1] == EXPOSURES


def test_a_recording_that_is_being_written_reads_as_far_as_it_is_whole(recorded: Session, tmp_path: Path) -> None:
    whole, counts = Recording(recorded.path), []
    estimated = list(whole.walk())
    file = McapFile(tmp_path / "a.mcap", WriteOptions())
    begin_recording(file, whole.rig, {"session": "again"}, whole.start_ns, {})
    for number, each in enumerate(whole.raw_messages(), 1):
        file.add(each.topic, schema_of(topics.SCHEMAS[each.schema]), each.data, each.log_time_ns, number)
        if number % 25 == 0:
            file.flush()
            reading = Recording(tmp_path / "a.mcap")
            assert "cut off" in reading.damage
            counts.append(len(came := list(reading.walk())))
            for (ours, made), (theirs, known) in zip(came[:-1], estimated, strict=False):
                assert np.array_equal(ours.pixels, theirs.pixels)
                assert np.array_equal(ours.inputs, theirs.inputs)
                assert made.keys() == known.keys()
    file.finish()
    assert counts == sorted(counts)
    assert 0 < counts[len(counts) // 2] < counts[-1] <= EXPOSURES
    assert len(Recording(tmp_path / "a.mcap")) == EXPOSURES


def test_the_file_is_flushed_by_the_messages_own_time(recorded: Session, tmp_path: Path) -> None:
    """What is older than 100 ms of session time is in the file, whether or not more comes."""
    rig, path = load_rig("section-vi"), tmp_path / "a.mcap"
    messages = [m for m in Recording(recorded.path).messages() if not m.topic.startswith("/estimate")]
    writer = RecordingWriter(path, rig, {}, 0, deterministic=True)
    for each in messages:
        writer.take(each.topic, each.log_time_ns, each.message)
    newest = messages[-1].log_time_ns
    due = sum(m.log_time_ns < newest - 200_000_000 for m in messages)
    written = 0
    for _ in range(1000):  # the writer's thread takes its time; its file must get there without more messages
        written = sum(1 for _ in Recording(path).messages())
        if written >= due:
            break
        time.sleep(0.01)
    assert written >= due > 0
    assert not Recording(path).complete
    writer.close()
    assert sum(1 for _ in Recording(path).messages()) == len(messages)


masks = st.lists(st.booleans(), min_size=40, max_size=40)


@pytest.mark.slow
@given(masks, st.lists(st.integers(0, 65535), min_size=40, max_size=40))
def test_frames_survive_the_recording(mask: list[bool], counts: list[int]) -> None:
    pixels = np.where(mask, np.array(counts), 0).astype(np.uint16).reshape(4, 10)
    frame = Frame(
        frame_id=2**40, first_step=2**33, last_step=2**33 + 199, pixels=pixels, mask=np.array(mask).reshape(4, 10),
        chunks_lost=3, frames_lost_before=1, device_start_ns=-5, device_end_ns=5, host_first_byte_ns=10**18,
        host_receive_ns=10**18 + 1, host_start_ns=10**18 - 1, clock_sigma_ns=1.5, exposure_offset_ns=999_999,
    )  # fmt: skip
    info, image = convert.frame_messages(frame)
    again = convert.frame_from_messages(info, image)
    for name, value in vars(frame).items():
        assert np.array_equal(getattr(again, name), value), name


def test_estimates_survive_the_recording(recorded: Session) -> None:
    """The driver's own estimates, not recorded ones, against what is read back."""
    recording = Recording(recorded.path)
    for name in ESTIMATORS:
        for ours, theirs in zip(
            aolink.estimate(recording, name).estimates(name), recording.estimates(name), strict=True
        ):
            assert np.array_equal(ours.path_sd, theirs.path_sd)
            assert ours.status == theirs.status


@pytest.mark.parametrize("schema", ["wire/messages", "wire/runs", "recording/schemas"])
def test_the_generated_classes_are_those_of_the_proto_files(schema: str, tmp_path: Path) -> None:
    import importlib

    from grpc_tools import protoc

    root, target = Path(aolink.__file__).parent.parent, tmp_path / "set"
    assert protoc.main(["", f"-I{root}", f"--descriptor_set_out={target}", f"{root}/aolink/{schema}.proto"]) == 0
    (compiled,) = descriptor_pb2.FileDescriptorSet.FromString(target.read_bytes()).file
    generated = descriptor_pb2.FileDescriptorProto()
    importlib.import_module(f"aolink.{schema.replace('/', '.')}_pb2").DESCRIPTOR.CopyToProto(generated)
    compiled.ClearField("source_code_info")
    for message in (*compiled.message_type, *generated.message_type):
        for field in message.field:
            field.ClearField("json_name")
    assert generated == compiled, "run tools/protocol"


def test_one_flipped_bit_costs_its_chunk_and_is_said(recorded: Session, tmp_path: Path) -> None:
    data = bytearray(recorded.path.read_bytes())
    with recorded.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (image,) = (each.id for each in summary.channels.values() if each.topic == topics.IMAGE)
    chunk = [each for each in summary.chunk_indexes if image in each.message_index_offsets][3]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0x10
    (path := tmp_path / "flipped.mcap").write_bytes(data)
    recording = Recording(path)
    assert recording.complete, "its index is whole"
    whole = {each.frame_id: each for each in Recording(recorded.path).exposures()}
    exposures = list(recording.exposures())
    assert "is damaged" in recording.damage
    assert "is damaged" in Recording(path, check=True).damage
    assert EXPOSURES - 4 < len(exposures) < EXPOSURES
    for exposure in exposures:
        assert np.array_equal(exposure.pixels, whole[exposure.frame_id].pixels)
    write_reestimated(recording, ["o3"], tmp_path / "again.mcap")
    assert Recording(tmp_path / "again.mcap").metadata["damage"] == recording.damage


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_chunk_that_would_fill_the_memory_is_refused(tmp_path: Path, compression: str) -> None:
    """300 MB of zeros in a few kB: as said, and behind a size that is a lie."""
    zeros = bytes(300 << 20)
    data = lz4.frame.compress(zeros) if compression == "lz4" else zstandard.compress(zeros)
    for said in (len(zeros), 1000):
        with (path := tmp_path / f"{said}.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            builder = RecordBuilder()
            Chunk(compression, data, 0, 0, 0, said).write(builder)
            file.write(builder.end())
            writer.finish()
        tracemalloc.start()
        with pytest.raises(RecordingError, match="no rig file"):
            Recording(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20 << 20, peak


def test_a_file_without_text_where_the_rig_should_be(tmp_path: Path) -> None:
    with (path := tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, "rig.toml", "application/toml", b"\xff\xfe")
        writer.finish()
    with pytest.raises(RecordingError, match="TOML"):
        Recording(path)


def test_whatever_goes_wrong_in_the_writers_thread_reaches_the_session(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", load_rig("section-vi"), {}, 0)
    writer.take(topics.LOG, -1, Log(message="before the epoch"))  # not a time that the format knows
    with pytest.raises(RecordingError, match="cannot write"):
        writer.close({"ended": "complete"})
    assert Recording(tmp_path / "a.mcap").metadata.get("ended") is None


@pytest.mark.slow
def test_a_disk_that_does_not_answer_is_an_error_when_the_queue_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A write that blocks: a pipe whose reader has stopped reading stands for the disk."""
    monkeypatch.setattr("aolink.recording.writer._QUEUE_BYTES", 4 << 20)
    reader, disk = os.pipe()
    fcntl.fcntl(disk, fcntl.F_SETPIPE_SZ, 1 << 20)  # for what a recording begins with
    path, open_file = tmp_path / "a.mcap", os.open

    def of_a_slow_disk(name: Any, *rest: Any) -> int:
        return disk if name == path else open_file(name, *rest)

    monkeypatch.setattr(os, "open", of_a_slow_disk)
    monkeypatch.setattr(os, "ftruncate", lambda *_: None)  # which no pipe has
    monkeypatch.setattr("aolink.recording.mcap_file._File.check_size", lambda _: None)
    monkeypatch.setattr(os.path, "samestat", lambda *_: True)  # nor is it the file that its path names
    writer = RecordingWriter(path, load_rig("section-vi"), {}, 0)
    os.read(reader, 1 << 20)

    def record_much() -> None:
        for k in range(1_000_000):
            writer.take(topics.LOG, k * 200_000_000, Log(message=os.urandom(50_000).hex()))

    with pytest.raises(RecordingError, match="slow"):
        record_much()
    monkeypatch.setattr("aolink.recording.writer.TIMEOUTS", Timeouts(disk_end_s=0.5))
    with pytest.raises(RecordingError, match="answer"):
        writer.close()
    assert writer.held_up_s > 0.5
    os.close(reader)  # lets the thread go


def test_a_writer_that_is_never_idle_synchronises_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second of its clock, while messages wait: a power cut must not cost more because there is much to do."""
    may_write, seconds, sizes = threading.Event(), itertools.count(), list[int]()
    path, sync, session, begin = tmp_path / "a.mcap", os.fsync, threading.current_thread(), time.monotonic()

    def monotonic() -> float:
        """For the writer's thread, each look at the clock is a fifth of a second later than the one before."""
        if threading.current_thread() is session:
            return begin
        may_write.wait()
        return begin + next(seconds) / 5

    def watched(descriptor: int) -> None:
        if threading.current_thread() is not session:
            sizes.append(path.stat().st_size)
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    monkeypatch.setattr(time, "monotonic", monotonic)
    writer = RecordingWriter(path, load_rig("section-vi"), {}, 0)
    for k in range(2000):  # 8 MB, in 500 portions
        writer.take(topics.LOG, k, Log(message="x" * 4000))
    may_write.set()
    writer.close()
    assert sizes == sorted(sizes)
    assert len(set(sizes)) > 50
    assert all(later - sooner < 200_000 for sooner, later in itertools.pairwise(sizes))
    assert Recording(path).counts == {topics.LOG: 2000}


def test_no_schema_has_a_map() -> None:
    """Only maps are written in an order that may change: without them the same messages give the same bytes."""
    waiting, seen = [kind.DESCRIPTOR for kind in topics.SCHEMAS.values()], set()
    while waiting:
        kind = waiting.pop()
        seen.add(kind.full_name)
        assert not kind.GetOptions().map_entry, kind.full_name
        inner = [each.message_type for each in kind.fields if each.message_type is not None]
        waiting += [each for each in inner if each.full_name not in seen]
    assert "foxglove.RawImage" in seen


def test_a_recording_is_used_as_simulated_exposures_are(recorded: Session) -> None:
    recording = Recording(recorded.path)
    first = [exposure.frame_id for exposure in recording]
    assert first == [exposure.frame_id for exposure in recording.exposures()]
    assert first == [exposure.frame_id for exposure in recording]  # it begins anew each time
    estimates = aolink.estimate(recording, "o3").estimates("o3")
    assert [each.frame_id for _, each in zip(recording, estimates, strict=True)] == first
