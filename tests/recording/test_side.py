"""Side files: a recording with one is what a copy with the same estimates would be, and no other recording takes it."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

import aolink
from aolink.batch import Model, estimate_file
from aolink.errors import RecordingError
from aolink.recording.compare import compare
from aolink.recording.editing import recover
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from tests.conftest import EXPOSURES, Session
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]
OTHER = Model(name="noise", changes=(("plant.process_noise", 3.0),))


@pytest.mark.parametrize("estimator", ["o3", "moments"])
@pytest.mark.parametrize("model", [Model(), OTHER], ids=["own", "other"])
def test_a_recording_with_a_side_file_is_the_copy_with_these_estimates(
    recorded: Session, tmp_path: Path, model: Model, estimator: str
) -> None:
    """In place of the estimates that were there; with another rig, in place of all of them."""
    row = estimate_file(recorded.path, tmp_path / "s.mcap", estimator, model=model)
    assert row["exposures"] == EXPOSURES
    beside = Recording(recorded.path, side=[tmp_path / "s.mcap"])
    write_reestimated(model.applied_to(Recording(recorded.path)), [estimator], tmp_path / "copy.mcap")
    copy = Recording(tmp_path / "copy.mcap")
    assert beside.counts == copy.counts
    assert beside.rig.toml == copy.rig.toml
    assert all(each.same for each in compare(beside, copy, relative=0, absolute=0).values())
    for mine, theirs in zip(beside.estimates(estimator), copy.estimates(estimator), strict=True):
        assert mine.path.tobytes() == theirs.path.tobytes()


def test_a_side_file_holds_no_frames_and_says_what_it_belongs_to(recorded: Session, tmp_path: Path) -> None:
    estimate_file(recorded.path, tmp_path / "s.mcap")
    side = Recording(tmp_path / "s.mcap", check=True)
    assert side.counts == {"/estimate/moments": EXPOSURES}
    assert side.side_of == Recording(recorded.path).digest == Recording(recorded.path, check=True).digest
    assert side.metadata["estimated_from"] == recorded.path.name


def test_a_recording_of_the_same_schedule_does_not_take_it(tmp_path: Path) -> None:
    """Their indexes are the same: that of an uncompressed file has lengths and times alone."""
    for name, pixels in (("a.mcap", "black"), ("b.mcap", "full")):
        plain = write_small(tmp_path / name, 3, pixels)  # type: ignore[arg-type]
        with (tmp_path / f"uncompressed-{name}").open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE)
            writer.add_attachment(0, 0, "rig.toml", "application/toml", Recording(plain).rig.toml.encode())
            for each in Recording(plain).messages():
                writer.write_message(each.topic, each.message, each.log_time_ns, each.log_time_ns, each.sequence)
            writer.finish()
    estimate_file(tmp_path / "uncompressed-a.mcap", side := tmp_path / "side.mcap", "o1")
    assert (tmp_path / "uncompressed-a.mcap").stat().st_size == (tmp_path / "uncompressed-b.mcap").stat().st_size
    with pytest.raises(RecordingError, match="belong"):
        Recording(tmp_path / "uncompressed-b.mcap", side=[side])


def test_two_side_files_of_one_recording_stand_side_by_side(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 5)
    sides = [tmp_path / f"{name}.mcap" for name in ("o1", "o3")]
    for side in sides:
        estimate_file(source, side, side.stem)
    assert Recording(source, side=sides).estimators == ["o1", "o3"]
    estimate_file(source, other := tmp_path / "other.mcap", model=OTHER)
    with pytest.raises(RecordingError, match="different rig files"):
        Recording(source, side=[sides[0], other])
    with pytest.raises(RecordingError, match="asked for"):
        Recording(source, side=[other], rig=Recording(source).rig)


def test_what_is_between_two_times_has_its_estimates(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 10)
    estimate_file(source, tmp_path / "side.mcap")
    recording = Recording(source, side=[tmp_path / "side.mcap"])
    first, last = recording.start_ns + 400_000_000, recording.start_ns + 1_000_000_000
    found = [each.topic for each in recording.raw_messages(start_ns=first, end_ns=last)]
    assert found == ["/camera/exposure", "/camera/image", "/mirror/applied", "/estimate/moments"] * 3


def test_a_damaged_recording_has_side_files_too(recorded: Session, tmp_path: Path) -> None:
    """They know it as it is: what `aolink copy` makes of it is another file."""
    (cut := tmp_path / "cut.mcap").write_bytes(recorded.path.read_bytes()[:-3000])
    row = estimate_file(cut, side := tmp_path / "side.mcap")
    assert row["damage"] == Recording(cut).damage
    assert len(Recording(cut, side=[side]).estimates("moments")) == row["exposures"]
    recover(cut, tmp_path / "whole.mcap")
    with pytest.raises(RecordingError, match="does not belong to"):
        Recording(tmp_path / "whole.mcap", side=[side])


@pytest.mark.slow
def test_what_does_not_belong_together_is_one_clear_error(aolink: Run, tmp_path: Path) -> None:
    for name, exposures in (("a", 3), ("b", 4)):
        source = write_small(tmp_path / f"{name}.mcap", exposures)
        estimate_file(source, tmp_path / f"{name}.o3.mcap")
    for arguments, expected in (
        (("view", "a.mcap", "b.o3.mcap", "-o", "x.rrd"), "b.o3.mcap does not belong to a.mcap: its estimates are"),
        (("view", "a.mcap", "b.mcap", "-o", "x.rrd"), "b.mcap is a recording of its own and no side file"),
        (("view", "a.o3.mcap", "-o", "x.rrd"), "a.o3.mcap is a side file with the estimates of a.mcap alone"),
        (("estimate", "a.o3.mcap"), "a.o3.mcap is a side file with the estimates of a.mcap alone"),
        (("compare", "a.mcap", "b.o3.mcap"), "b.o3.mcap does not belong to a.mcap"),
    ):
        result = aolink(*arguments)
        assert result.returncode in (2, 5), arguments
        assert expected in " ".join(result.stderr.replace("│", " ").split()), arguments
        assert not (tmp_path / "x.rrd").exists()


@pytest.mark.slow
def test_view_and_compare_take_a_recording_and_its_side_file(aolink: Run, recorded: Session, tmp_path: Path) -> None:
    shutil.copy(recorded.path, source := tmp_path / "s.mcap")
    for name, model in (("same", Model()), ("other", OTHER)):
        estimate_file(source, tmp_path / f"{name}.mcap", "o3", model=model)
    same = aolink("compare", "s.mcap", "same.mcap", "--json")
    assert same.returncode == 0, same.stdout
    assert list(json.loads(same.stdout)["topics"]) == ["/estimate/o3"]
    other = aolink("compare", "s.mcap", "other.mcap")
    assert other.returncode == 1
    assert "the rig files differ" in other.stdout
    seen = aolink("view", "s.mcap", "same.mcap", "-o", "s.rrd")
    assert seen.returncode == 0, seen.stderr
    assert (tmp_path / "s.rrd").exists()
    refused = aolink("view", "s.mcap", "same.mcap", "-o", "same.mcap", "--overwrite")
    assert refused.returncode != 0


def test_read_takes_side_files(tmp_path: Path) -> None:
    source = write_small(tmp_path / "s.mcap", 3)
    estimate_file(source, tmp_path / "side.mcap")
    assert aolink.read(source, side=[tmp_path / "side.mcap"]).estimators == ["moments"]
