"""Recordings that are meant badly: impossible fields, files that grow when read, texts that steer a terminal."""

from __future__ import annotations

import contextlib
import os
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap.opcode import Opcode
from mcap.writer import Writer

from aolink.errors import RecordingError, RigError
from aolink.recording import schemas_pb2 as pb
from aolink.recording import topics
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.sound import what_is_wrong
from aolink.recording.writer import begin_recording
from aolink.rig import load_rig, parse_rig
from aolink.simulation.scene import SceneCamera
from aolink.wire import messages_pb2 as wire
from tests.conftest import Session

Run = Callable[..., subprocess.CompletedProcess[str]]
MOST = 2**64 - 1
FIELDS: list[tuple[type[Message], dict[str, Any], str]] = [
    (wire.Applied, {"first_step": 2**63}, "first_step is beyond all times"),
    (wire.Applied, {"first_step": MOST, "n_steps": 1, "u": [0.0]}, "first_step is beyond all times"),
    (wire.Applied, {"n_steps": 999_999}, "u has not the inputs of its steps"),
    (wire.CommandBlock, {"n_steps": 2**32 - 1, "u": []}, "u has not the inputs of its steps"),
    (wire.Applied, {"n_steps": 1, "u": [float("nan")]}, "u has an input that is no number, or beyond all"),
    (wire.CommandBlock, {"n_steps": 1, "u": [1e300]}, "u has an input that is no number, or beyond all"),
    (pb.ExposureInfo, {"frame_id": MOST}, "frame_id is beyond all counts"),
    (pb.ExposureInfo, {"first_step": 2**63, "last_step": 2**63 + 199}, "first_step is beyond all times"),
    (pb.ExposureInfo, {"last_step": 999_998}, "last_step is beyond the end of an exposure"),
    (pb.ExposureInfo, {"last_step": 2**40}, "last_step is beyond the end of an exposure"),
    (pb.ExposureInfo, {"exposure_offset_ns": 2**32 - 1}, "exposure_offset_ns is not below a fast step"),
    (pb.ExposureInfo, {"device_end_ns": -(2**63)}, "a time is beyond the calendar"),
    (pb.ExposureInfo, {"clock_sigma_ns": -1.0}, "a standard deviation is impossible"),
    (pb.ExposureInfo, {"alignment_sigma_ns": 1e300}, "a standard deviation is impossible"),
    (RawImage, {"width": 2**31, "height": 0, "data": b""}, "a picture without pixels"),
    (wire.Truth, {"axes": 2**32 - 1}, "its states do not fit its axes"),
    (wire.Truth, {"path": [0.0] * 201}, "its path is not that of an exposure"),
    (pb.Estimate, {"axes": 2**32 - 1}, "the states are not the rig's"),
    (pb.Estimate, {"n_coefficients": 2**32 - 1}, "it has not as many numbers as it says"),
    (pb.Estimate, {"n_steps": 2**32 - 1}, "n_steps is beyond the end of an exposure"),
    (pb.Estimate, {"estimator": "o3\x1b[2J"}, "its estimator's name is no text"),
    (pb.Estimate, {"status": 77}, "its status is none that this aolink knows"),
]


def rewritten(source: Path, target: Path, change: Callable[[Message], None]) -> Path:
    """A recording with each message changed in place."""
    recording = Recording(source)
    file = McapFile(target, WriteOptions())
    begin_recording(file, recording.rig, {}, 0, {})
    for raw in recording.raw_messages():
        message = topics.SCHEMAS[raw.schema].FromString(raw.data)
        change(message)
        file.add(raw.topic, schema_of(type(message)), message.SerializeToString(), raw.log_time_ns, raw.sequence)
    file.finish()
    return target


@pytest.mark.parametrize(("kind", "values", "said"), FIELDS, ids=lambda each: "" if isinstance(each, dict) else None)
def test_an_impossible_field_is_a_loss_and_nothing_is_computed_with_it(
    recorded: Session, tmp_path: Path, kind: type[Message], values: dict[str, Any], said: str
) -> None:
    def change(message: Message) -> None:
        if isinstance(message, kind):
            for name, value in values.items():
                message.ClearField(name)
                if isinstance(value, list):
                    getattr(message, name).extend(value)
                else:
                    setattr(message, name, value)

    recording = Recording(rewritten(recorded.path, tmp_path / "a.mcap", change))
    for exposure in recording.exposures():
        assert exposure.n_steps <= 200
    for name in recording.estimators:
        recording.estimates(name)
    assert [loss.what for loss in recording.losses if said in loss.what]


def rig_only(path: Path, text: str = "", add: Callable[[Writer], None] = lambda writer: None) -> Path:
    """A recording with a rig file and no messages, by the stock writer."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("aolink", "aolink")
        writer.add_attachment(0, 0, topics.RIG_ATTACHMENT, "", (text or load_rig("section-vi").toml).encode())
        add(writer)
        writer.finish()
    return path


def zstd_chunk(data: bytes) -> bytes:
    """A record of a chunk that holds these bytes, compressed."""
    packed = zstandard.compress(data)
    chunk = struct.pack("<QQQII", 1, 1, len(data), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", Opcode.CHUNK, len(chunk)) + chunk


def with_records(path: Path, records: bytes) -> Path:
    """A recording with a rig file, and these records before the end of its data."""
    whole, end = in_place_of_the_end(rig_only(path))
    path.write_bytes(whole[:end] + records)
    return path


def in_place_of_the_end(path: Path) -> tuple[bytes, int]:
    data = path.read_bytes()
    return data, data.rindex(struct.pack("<BQ", Opcode.DATA_END, 4))


@pytest.mark.slow
def test_a_small_file_with_millions_of_messages_is_refused_at_once(aolink: Run, tmp_path: Path) -> None:
    message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22, 1, 1, 1, 1)
    data = message * ((16 << 20) // len(message))
    path = with_records(tmp_path / "a.mcap", zstd_chunk(data))
    for command in (["info", path], ["copy", path, "-o", tmp_path / "b.mcap"]):
        done = aolink(*command)
        assert done.returncode == 5
        assert "very many tiny records" in done.stderr
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.slow
def test_chunks_that_grow_without_end_are_refused(tmp_path: Path) -> None:
    """Twenty chunks of one message of zeros: together more than what is free, and than LZ4 could come to."""
    data = struct.pack("<BQHIQQ", Opcode.MESSAGE, 127 << 20, 1, 1, 1, 1) + bytes((127 << 20) - 22)
    with pytest.raises(RecordingError, match="compression"):
        Recording(with_records(tmp_path / "a.mcap", 20 * zstd_chunk(data)))


def add_holes(path: Path, count: int, opcode: int, head: Callable[[int], bytes], size: int, tail: int = 0) -> None:
    """Records of zeros that take no room on the disk, before the end of a recording's data."""
    _, end = in_place_of_the_end(rig_only(path))
    with path.open("r+b") as file:
        file.truncate(end)
        for k in range(count):
            file.seek(0, os.SEEK_END)
            file.write(struct.pack("<BQ", opcode, len(head(k)) + size + tail) + head(k))
            file.truncate(file.tell() + size + tail)


@pytest.mark.slow
def test_attachments_and_metadata_that_are_holes_are_refused(tmp_path: Path) -> None:
    """Each record is below the limit for one; all would be kept in memory."""
    path, size = tmp_path / "a.mcap", 200 << 20
    add_holes(
        path, 60, Opcode.ATTACHMENT, lambda k: struct.pack("<QQI2sI1sQ", 0, 0, 2, b"%02d" % k, 1, b"x", size), size, 4
    )
    assert path.stat().st_size > 12e9
    with pytest.raises(RecordingError, match="attachments"):
        Recording(path)
    path, size = tmp_path / "b.mcap", 20 << 20
    add_holes(path, 4, Opcode.METADATA, lambda k: struct.pack("<I1sII1sI", 1, b"%d" % k, 9 + size, 1, b"k", size), size)
    with pytest.raises(RecordingError, match="metadata"):
        Recording(path)


@pytest.mark.parametrize("in_chunk", [False, True])
def test_very_many_channels_are_refused(tmp_path: Path, in_chunk: bool) -> None:
    head = struct.pack("<HHI1sI4sI", 1, 0, 1, b"t", 4, b"json", 0)
    data = 20_000 * (struct.pack("<BQ", Opcode.CHANNEL, len(head)) + head)
    with pytest.raises(RecordingError, match="tiny"):
        Recording(with_records(tmp_path / "a.mcap", zstd_chunk(data) if in_chunk else data))


def header(shape: str, descr: str = "<f8") -> bytes:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize("data", [header("(10000000000000,)"), header("(10,)", "|O"), b"", b"\x93NUMPY"])
def test_a_true_scene_that_is_none_is_one_error(tmp_path: Path, data: bytes) -> None:
    text = load_rig("moving-scene").toml
    path = rig_only(
        tmp_path / "a.mcap", text, lambda to: to.add_attachment(0, 0, topics.TRUE_SCENE_ATTACHMENT, "", data)
    )
    with pytest.raises(RecordingError, match="scene"):
        _ = Recording(path).true_scene


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 10_000 + "]" * 10_000, ".".join("a" * 10_000) + " = 1", " . ".join("a" * 10_000) + " = 1"]
)
def test_a_rig_file_of_ten_thousand_levels_is_one_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(RecordingError, match=r"TOML|longer"):
        Recording(rig_only(tmp_path / "a.mcap", text))


def test_a_rig_file_out_of_a_recording_names_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(1)
    np.save(tmp_path / "moving-scene.npy", np.ones((999, 999)))
    for name in ("moving-scene.npy", str(tmp_path / "moving-scene.npy"), "../rigs/moving-scene.png"):
        text = load_rig("moving-scene").toml.replace("moving-scene.png", name)
        recording = Recording(rig_only(tmp_path / "a.mcap", text))
        with pytest.raises(RigError, match=r"scene\.picture"):
            SceneCamera(recording.rig, random)
    SceneCamera(parse_rig(load_rig("moving-scene").toml), random)  # the picture that comes with aolink


def test_no_text_of_a_file_steers_the_terminal(aolink: Run, tmp_path: Path) -> None:
    bad = "\x1b[2J\x1b]0;owned\x07\x9b31m"
    path = rig_only(tmp_path / "a.mcap", "", lambda to: to.add_metadata(topics.SESSION_METADATA, {"note": bad}))
    done = aolink("info", path)
    assert done.returncode == 0
    assert "owned" in done.stdout
    assert not {"\x1b", "\x07", "\x9b"} & set(done.stdout + done.stderr)


@pytest.mark.parametrize("what", ["attachment", "metadata"])
def test_damage_outside_the_chunks_is_said_without_a_check(recorded: Session, tmp_path: Path, what: str) -> None:
    """Any byte of an attachment and of metadata, its head as well."""
    data = recorded.path.read_bytes()
    facts = Recording(recorded.path)
    wanted = facts.attachments[topics.BASIS_ATTACHMENT] if what == "attachment" else topics.SESSION_METADATA.encode()
    start = data.index(wanted) - (80 if what == "attachment" else 13)
    path = tmp_path / "a.mcap"
    for at in range(start, start + 600, 7):
        changed = bytearray(data)
        changed[at] ^= 1 << at % 8
        path.write_bytes(changed)
        found = Recording(path)
        same = found.metadata == facts.metadata and found.attachments == facts.attachments
        assert same or not found.complete


@pytest.mark.slow
def test_no_flip_is_silent_to_a_check(recorded: Session, tmp_path: Path) -> None:
    """The checksum of all data is written, and compared with `check`: a flip anywhere is said, or changed nothing."""
    data = recorded.path.read_bytes()
    path = tmp_path / "a.mcap"
    random = np.random.default_rng(20)
    for at in random.integers(len(data), size=150):
        changed = bytearray(data)
        changed[at] ^= 1 << int(random.integers(8))
        path.write_bytes(changed)
        with contextlib.suppress(RecordingError):
            assert not Recording(path, check=True).complete, f"byte {at}"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, -1e300])
@pytest.mark.parametrize("count", [100, 20_000])
def test_an_impossible_input_is_found_among_few_and_among_many(count: int, value: float) -> None:
    rig, u = load_rig("section-vi"), np.zeros(count)
    run = wire.Applied(n_steps=count, u=u)
    assert what_is_wrong(run, rig) == ""
    run.u[count // 2] = value
    assert "no number, or beyond all" in what_is_wrong(run, rig)
