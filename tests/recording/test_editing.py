"""Recordings salvaged, cut, merged, written in parts: nothing is lost but what was damaged."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import RecordingError
from aolink.recording import topics
from aolink.recording.compare import compare
from aolink.recording.editing import cut, merge, recover
from aolink.recording.mcap_file import WriteOptions
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.recording.writer import RecordingWriter
from tests.conftest import EXPOSURES, Session
from tests.recording.small import copied

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.parametrize("options", [WriteOptions(split_s=0.5), WriteOptions(split_bytes=20_000, compression="zstd")])
def test_each_part_can_be_read_by_itself_and_all_together_are_the_session(
    recorded: Session, tmp_path: Path, options: WriteOptions
) -> None:
    whole = {each.frame_id: each for each in Recording(recorded.path).exposures()}
    parts = copied(recorded.path, tmp_path / "s.mcap", options=options)
    assert len(parts) > 2
    assert parts[0].name == "s-001.mcap"
    seen = []
    for path in parts:
        part = Recording(path, check=True)
        assert part.complete
        for exposure in part.exposures():
            seen.append(exposure.frame_id)
            assert exposure.inputs_assumed == 0
            assert np.array_equal(exposure.inputs, whole[exposure.frame_id].inputs)
            assert np.array_equal(exposure.pixels, whole[exposure.frame_id].pixels)
    assert seen == list(whole)
    merged = merge(list(reversed(parts)), tmp_path / "merged.mcap")
    assert merged.exposures == EXPOSURES
    assert all(each.same for each in compare(Recording(recorded.path), Recording(merged.path)).values())


def test_a_cut_gives_the_same_exposures_as_the_whole(recorded: Session, tmp_path: Path) -> None:
    source = Recording(recorded.path)
    result = cut(recorded.path, tmp_path / "cut.mcap", 1.0, 2.0)
    times = [each.log_time_ns for each in source.messages(topics.EXPOSURE)]
    inside = [k + 1 for k, time in enumerate(times) if 1e9 <= time - source.start_ns < 2e9]
    part = Recording(result.path)
    assert [each.frame_id for each in part.exposures()] == inside
    whole = {each.frame_id: each for each in source.exposures()}
    for exposure in part.exposures():
        assert np.array_equal(exposure.inputs, whole[exposure.frame_id].inputs)
        assert exposure.inputs_assumed == 0
        assert exposure.truth is not None
    assert [each.frame_id for each in part.estimates("o3")] == inside
    write_reestimated(part, ["o3"], tmp_path / "again.mcap")


def test_cuts_that_overlap_merge_into_what_they_were_cut_from(recorded: Session, tmp_path: Path) -> None:
    cut(recorded.path, tmp_path / "a.mcap", 0.0, 1.7)
    cut(recorded.path, tmp_path / "b.mcap", 1.0, 99.0)
    merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "m.mcap")
    found = compare(Recording(recorded.path), Recording(tmp_path / "m.mcap"))
    for topic in (topics.IMAGE, topics.EXPOSURE, topics.APPLIED, topics.TRUTH, "/estimate/o3"):
        assert found[topic].same, (topic, found[topic])


def test_sessions_that_are_not_one_are_not_merged(recorded: Session, tmp_path: Path) -> None:
    other = Recording(recorded.path)
    with RecordingWriter(tmp_path / "other.mcap", other.rig, {"session": "another"}, 0, deterministic=True):
        pass
    with pytest.raises(RecordingError, match="same session"):
        merge([recorded.path, tmp_path / "other.mcap"], tmp_path / "m.mcap")
    assert not (tmp_path / "m.mcap").exists()
    with pytest.raises(RecordingError, match="give two or more"):
        merge([recorded.path], tmp_path / "m.mcap")


@pytest.mark.parametrize(
    ("start_s", "end_s", "message"), [(5.0, 5.0, "the end must be after"), (100.0, 200.0, "it is .* s long")]
)
def test_a_cut_without_an_exposure_is_refused(
    recorded: Session, tmp_path: Path, start_s: float, end_s: float, message: str
) -> None:
    with pytest.raises(RecordingError, match=message):
        cut(recorded.path, tmp_path / "c.mcap", start_s, end_s)
    assert not (tmp_path / "c.mcap").exists()


def test_the_source_is_never_the_target(recorded: Session) -> None:
    before = recorded.path.read_bytes()
    with pytest.raises(RecordingError, match="made from"):
        recover(recorded.path, recorded.path, overwrite=True)
    assert recorded.path.read_bytes() == before


@pytest.mark.slow
def test_the_editing_commands_say_what_they_did_and_lost(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    data = recorded.path.read_bytes()
    (tmp_path / "broken.mcap").write_bytes(data[: len(data) * 2 // 3])
    result = aolink("copy", "broken.mcap", "-o", "whole.mcap")
    assert result.returncode == 1
    assert "lost: it was cut off" in result.stdout
    assert aolink("info", "whole.mcap").returncode == 0
    assert aolink("info", "broken.mcap").returncode == 1
    assert aolink("copy", recorded.path, "-o", "copy.mcap").returncode == 0
    again = aolink("copy", recorded.path, "-o", "copy.mcap")
    assert again.returncode == 5
    assert "exists" in again.stderr
    assert aolink("compare", recorded.path, "copy.mcap").returncode == 0
    assert aolink("copy", "copy.mcap", "--start", "1", "--end", "2", "-o", "c1.mcap").returncode == 0
    assert aolink("copy", "copy.mcap", "--start", "1.5", "-o", "c2.mcap").returncode == 0
    assert aolink("copy", "c1.mcap", "c2.mcap", "-o", "m.mcap").returncode == 0


@pytest.mark.slow
def test_no_command_writes_over_what_it_reads(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    """By whatever name: a second source, a hard link, with --overwrite."""
    data = recorded.path.read_bytes()
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(data)
    (tmp_path / "link.mcap").hardlink_to(tmp_path / "a.mcap")
    for arguments in (
        ("estimate", "a.mcap", "-e", "o1", "-o", "a.mcap"),
        ("copy", "a.mcap", "-o", "link.mcap"),
        ("copy", "a.mcap", "--end", "1", "-o", "a.mcap"),
        ("copy", "a.mcap", "b.mcap", "-o", "b.mcap"),
        ("deblur", "a.mcap", "-e", "o1", "-o", "a.mcap"),
    ):
        result = aolink(*arguments, "--overwrite")
        assert "made from" in result.stderr, arguments
        assert result.returncode == 5
    assert {(tmp_path / name).read_bytes() for name in ("a.mcap", "b.mcap", "link.mcap")} == {data}


@pytest.mark.slow
def test_a_command_that_fails_leaves_the_target_as_it_was(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    import resource

    (tmp_path / "kept.mcap").write_bytes(b"something of mine")
    failed = aolink("copy", recorded.path, "--start", "100", "-o", "kept.mcap", "--overwrite")
    assert failed.returncode == 5

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))

    for command in (("copy",), ("copy", "--end", "99"), ("estimate", "-e", "o1")):
        full = aolink(command[0], recorded.path, *command[1:], "-o", "kept.mcap", "--overwrite", preexec_fn=small_files)
        assert full.returncode == 5
        assert "(ulimit -f)" in full.stderr
        assert full.stderr.count("\n") == 1
    assert [each.name for each in tmp_path.iterdir()] == ["kept.mcap"]
    assert (tmp_path / "kept.mcap").read_bytes() == b"something of mine"


def test_parts_and_merged_files_say_what_they_are(recorded: Session, tmp_path: Path) -> None:
    parts = copied(recorded.path, tmp_path / "s.mcap", options=WriteOptions(split_s=0.9))
    whole = Recording(recorded.path)
    part = Recording(cut(recorded.path, tmp_path / "cut.mcap", 0.0, 1.0).path)
    assert "exposures" in whole.metadata
    assert not {"exposures", "ended"} & part.metadata.keys()
    assert part.metadata["session"] == whole.metadata["session"]
    merged = Recording(merge(parts, tmp_path / "m.mcap").path)
    assert "part" not in merged.metadata
    assert merged.end_metadata == Recording(parts[-1]).end_metadata


def test_nothing_is_recovered_from_nothing(recorded: Session, tmp_path: Path) -> None:
    (path := tmp_path / "a.mcap").write_bytes(recorded.path.read_bytes()[:30_000])
    if not Recording(path).counts:
        with pytest.raises(RecordingError, match="holds no whole message"):
            recover(path, tmp_path / "b.mcap")
        assert not (tmp_path / "b.mcap").exists()
    else:
        pytest.fail("the first chunk is in the first 30 kB: cut earlier")


@pytest.mark.slow
def test_a_start_after_the_end_of_a_recording_is_said(aolink: Run, recorded: Session) -> None:
    refused = aolink("copy", recorded.path, "-o", "c.mcap", "--start", "100")
    assert refused.returncode == 5
    assert "no exposure between" in refused.stderr
