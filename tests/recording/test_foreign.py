"""Others read our recordings, and we read those of others."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.records import Schema

from aolink.recording import topics
from aolink.recording.editing import cut, recover
from aolink.recording.mcap_file import McapFile, WriteOptions, schema_of
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate, write_reestimated
from aolink.recording.writer import begin_recording
from aolink.wire.messages_pb2 import Applied, CommandBlock
from aolink.wire.runs_pb2 import Run
from tests.conftest import Session

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "aolink" / "pages" / "recording_format.md"
RERUN = Path(sys.executable).parent / "rerun"


def rerun_check(path: Path) -> str:
    """What an MCAP reader in another language, Rerun's, says of a file; it is asked to decode everything."""
    result = subprocess.run([RERUN, "mcap", "check", "--full", path], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_another_reader_finds_nothing_wrong(recorded: Session, tmp_path: Path) -> None:
    write_reestimated(Recording(recorded.path), ["moments"], tmp_path / "again.mcap")
    for path in (recorded.path, tmp_path / "again.mcap"):
        said = rerun_check(path)
        rows = [line for line in said.splitlines() if re.search(r" /\w", line)]
        assert len(rows) == len(Recording(path).counts)
        assert all(line.split()[0] == "ok" for line in rows), said


def split(data: bytes) -> bytes:
    """The same message with its row in two pieces, as protobuf allows."""
    message = Applied.FromString(data)
    first, rest = Applied(u=message.u[:70]), Applied(u=message.u[70:])
    del message.u[:]
    return b"".join(part.SerializeToString() for part in (first, message, rest))


def one_by_one(data: bytes) -> bytes:
    """The same message with each number by itself."""
    message = Applied.FromString(data)
    numbers = b"".join(b"\x21" + struct.pack("<d", value) for value in message.u)  # field 4, eight bytes
    del message.u[:]
    return message.SerializeToString() + numbers


@pytest.mark.parametrize("written", [split, one_by_one])
def test_rows_of_inputs_are_read_however_they_are_written(
    recorded: Session, tmp_path: Path, written: Callable[[bytes], bytes]
) -> None:
    source = Recording(recorded.path)
    file = McapFile(tmp_path / "a.mcap", WriteOptions())
    begin_recording(file, source.rig, source.metadata, source.start_ns, {})
    for number, raw in enumerate(source.raw_messages(), 1):
        data = written(raw.data) if raw.topic == topics.APPLIED else raw.data
        file.add(raw.topic, schema_of(topics.SCHEMAS[raw.schema]), data, raw.log_time_ns, number)
    file.finish()
    other = Recording(tmp_path / "a.mcap")
    for ours, theirs in zip(other.exposures(), source.exposures(), strict=True):
        assert ours.inputs.tobytes() == theirs.inputs.tobytes()
        assert ours.inputs_assumed == theirs.inputs_assumed == 0


def test_a_run_has_the_fields_of_commands_and_reports() -> None:
    for field in Run.DESCRIPTOR.fields:
        for kind in (CommandBlock, Applied):
            assert kind.DESCRIPTOR.fields_by_name[field.name].number == field.number


def test_messages_of_other_software_come_along(recorded: Session, tmp_path: Path) -> None:
    """Into new estimates and into a part, in their own encoding."""
    source, other = Recording(recorded.path), Schema(id=0, name="weather", encoding="jsonschema", data=b"{}")
    file = McapFile(tmp_path / "a.mcap", WriteOptions())
    begin_recording(file, source.rig, source.metadata, source.start_ns, {})
    for number, raw in enumerate(source.raw_messages(), 1):
        if number % 50 == 1:
            file.add("/weather", other, b'{"wind": %d}' % number, raw.log_time_ns, 2 * number, "json")
        file.add(raw.topic, schema_of(topics.SCHEMAS[raw.schema]), raw.data, raw.log_time_ns, 2 * number + 1)
    file.finish()
    before = Recording(tmp_path / "a.mcap")
    write_reestimated(before, ["o3"], tmp_path / "b.mcap")
    cut(tmp_path / "a.mcap", tmp_path / "c.mcap", 0, 1e6)
    for name in ("b", "c"):
        after = Recording(tmp_path / f"{name}.mcap")
        said = [(raw.log_time_ns, raw.data) for raw in after.raw_messages("/weather")]
        theirs = [(raw.log_time_ns, raw.data) for raw in before.raw_messages("/weather")]
        assert said == (theirs if name == "b" else theirs[-len(said) :])
        assert len(said) > 1
        assert (after.encodings["/weather"], after.encodings[topics.IMAGE]) == ("json", "protobuf")
        assert after.schemas["weather"].encoding == "jsonschema"
    assert first_difference(Recording(tmp_path / "b.mcap").estimates("o3"), source.estimates("o3")) is None


def test_a_topic_may_have_two_kinds_of_messages(recorded: Session, tmp_path: Path) -> None:
    """Each is counted, and copied with its own schema."""
    source, kinds = Recording(recorded.path), ("weather", "forecast")
    file = McapFile(tmp_path / "a.mcap", WriteOptions())
    begin_recording(file, source.rig, source.metadata, source.start_ns, {})
    for number in range(5):
        schema = Schema(id=0, name=kinds[number % 2], encoding="jsonschema", data=b"{}")
        file.add("/weather", schema, b"{}", source.start_ns + number, number + 1, "json")
    file.finish()
    recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    for name in ("a", "b"):
        for check in (False, True):
            found = Recording(tmp_path / f"{name}.mcap", check=check)
            assert found.counts["/weather"] == 5
            assert [raw.schema for raw in found.raw_messages("/weather")] == [kinds[k % 2] for k in range(5)]


def test_the_page_for_other_software_is_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example runs as it stands, and what it writes can be estimated."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    shutil.copytree(ROOT / "aolink" / "rigs", tmp_path / "aolink" / "rigs")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, PAGE.name, "exec"), {})
    recording = Recording(tmp_path / "mine.mcap")
    assert len(reestimate(recording, ["o3"])["o3"]) == 10
    rerun_check(tmp_path / "mine.mcap")
