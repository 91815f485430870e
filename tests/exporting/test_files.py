"""Files of other programs, read back with these programs' own readers."""

from __future__ import annotations

import csv
import json
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap_protobuf.writer import Writer

import aolink
from aolink.errors import ExportError, ViewerError
from aolink.exporting.arrays import arrays
from aolink.exporting.files import WRITERS, export, no_formula
from aolink.recording import topics
from aolink.recording.editing import RecordingCopy
from aolink.recording.reader import Recording
from aolink.recording.schemas_pb2 import ExposureInfo
from aolink.rig import load_rig, parse_rig
from aolink.series import Series
from aolink.wire.messages_pb2 import Truth
from tests.exporting.conftest import RECORDINGS
from tests.needs import needed
from tests.recording.small import write_small


def test_numpy_reads_every_array(series: Series, tmp_path: Path) -> None:
    export(series, tmp_path / "out.npz")
    expected = arrays(series)
    with np.load(tmp_path / "out.npz", allow_pickle=False) as found:
        for name, each in expected.items():
            assert found[name].dtype == each.values.dtype
            np.testing.assert_array_equal(found[name], each.values)
        assert parse_rig(str(found["rig_toml"])).digest == str(found["rig_digest"]) == series.rig.digest
        assert json.loads(str(found["session"])) == series.metadata
        assert set(found) - set(expected) == {
            "rig_toml", "recording", "rig", "rig_digest", "session", "exported_by",
        }  # fmt: skip


@pytest.mark.slow
def test_xarray_reads_the_dataset(series: Recording, tmp_path: Path) -> None:
    needed("h5netcdf")
    import xarray

    export(series, tmp_path / "out.nc")
    with xarray.open_dataset(tmp_path / "out.nc", engine="h5netcdf") as found:
        assert found.load().identical(series.to_xarray())


def test_a_spreadsheet_runs_nothing_of_a_table(tmp_path: Path) -> None:
    """The file's name, the rig's and the estimators' are other people's texts; numbers stay numbers."""
    shutil.copy(RECORDINGS / "section-vi.mcap", path := tmp_path / "=1+1.mcap")
    series = aolink.read(path)
    export(series, tmp_path / "out.csv", ["o3"])
    with (tmp_path / "out.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert {row["recording"] for row in table} == {"'=1+1.mcap"}
    assert any(float(row["truth_end_x2"]) < 0 for row in table)
    assert [no_formula(each) for each in ("=a", "@b", "+c", "-d", "\t=e", "\uff1df", "g=1", "'h", -1.5)] == [
        "'=a", "'@b", "'+c", "'-d", "'\t=e", "'\uff1df", "g=1", "'h", -1.5,
    ]  # fmt: skip


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_pandas_reads_the_table_that_a_notebook_has(series: Recording, tmp_path: Path, suffix: str) -> None:
    pandas = needed("pandas")
    path, expected = tmp_path / f"out{suffix}", series.to_pandas(["o3", "open-loop"])
    export(series, path, ["o3", "open-loop"])
    if suffix == ".csv":
        found = pandas.read_csv(
            path, index_col="time", parse_dates=["time"], keep_default_na=False, na_values={"open-loop_nis": [""]}
        )
    else:
        found = pandas.read_parquet(path)
        assert parse_rig(found.attrs["rig_toml"]).digest == found.attrs["rig_digest"] == series.rig.digest
        assert json.loads(found.attrs["session"]) == series.metadata
    found.index = found.index.as_unit("ns")
    # pandas' reader of texts is exact to the last bit but one.
    pandas.testing.assert_frame_equal(found, expected, check_index_type=False, rtol=1e-14, atol=0)


def test_a_file_is_written_by_its_suffix_and_needs_one_that_is_known(lively: Series, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="xlsx"):
        export(lively, tmp_path / "out.xlsx")
    export(lively, tmp_path / "OUT.CSV", [])
    assert (tmp_path / "OUT.CSV").read_text().startswith("time,recording,rig")


@pytest.mark.parametrize("suffix", WRITERS)
def test_nothing_is_left_where_nothing_can_be_written(suffix: str, tmp_path: Path) -> None:
    empty = aolink.read(write_small(tmp_path / "empty.mcap", 0))
    with pytest.raises(ExportError, match="no exposure"):
        export(empty, tmp_path / f"out{suffix}")
    assert [each.name for each in tmp_path.iterdir()] == ["empty.mcap"]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [*WRITERS, ".rrd"])
@pytest.mark.parametrize("size", [0, 4000])
def test_a_full_disk_is_one_line(suffix: str, size: int, tmp_path: Path) -> None:
    """A library may end the process itself. The limit of a file's size is to a program what a full disk is."""
    source = write_small(tmp_path / "a.mcap", 3)
    write = "view" if suffix == ".rrd" else "export"
    done = subprocess.run(
        [sys.executable, "-m", "aolink", write, source, "-o", f"out{suffix}"], cwd=tmp_path, capture_output=True,
        text=True, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )  # fmt: skip
    if done.returncode:  # a short table may go in
        assert done.returncode in (ExportError.exit_code, ViewerError.exit_code)
        assert re.search(r"^aolink: cannot write out.* (limit|disk|temporary)", done.stderr, re.MULTILINE), done.stderr
        assert "Traceback" not in done.stderr
    assert (tmp_path / f"out{suffix}").exists() is not bool(done.returncode)


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_target_that_exists_is_replaced_only_if_told_so(lively: Series, suffix: str, tmp_path: Path) -> None:
    target = tmp_path / f"out{suffix}"
    target.write_text("mine")
    with pytest.raises(ExportError, match="exists"):
        export(lively[:2], target, ["o1"])
    assert target.read_text() == "mine"
    export(lively[:2], target, ["o1"], overwrite=True)
    assert target.read_bytes()[:4] != b"mine"


def test_frames_of_other_sizes_go_into_a_table_only(tmp_path: Path, recording_with_a_shorter_exposure: Path) -> None:
    recording = aolink.read(recording_with_a_shorter_exposure)
    with pytest.raises(ExportError, match="frame 3"):
        export(recording, tmp_path / "out.npz")
    export(recording, tmp_path / "out.csv")
    with (tmp_path / "out.csv").open() as file:
        assert [row["n_steps"] for row in csv.DictReader(file)] == ["200", "200", "100"]


@pytest.mark.slow
def test_what_would_fill_the_memory_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """A recording of 20,000 frames of 900 spots, as far as the check sees it: its pictures have one pixel each."""
    large = tmp_path / "large.mcap"
    rig = load_rig("sh-30x30")
    with large.open("wb") as file:
        writer = Writer(file)
        writer.add_attachment(0, 0, "rig.toml", "application/toml", rig.toml.encode())
        image = RawImage(width=1, height=1, encoding="mono16", step=2, data=bytes(2))
        for number in range(1, 20_001):
            writer.write_message("/camera/exposure", ExposureInfo(frame_id=number), number, number)
            writer.write_message("/camera/image", image, number, number)
        writer.finish()
    recording = aolink.read(large)
    with pytest.raises(ExportError, match="memory"):
        export(recording, tmp_path / "out.npz")
    with pytest.raises(ExportError, match="no exposure"):
        export(recording[:2], tmp_path / "out.fits")


def test_a_truth_of_another_length_is_said(tmp_path: Path) -> None:
    source, target = aolink.read(write_small(tmp_path / "small.mcap", 3, truth=True)), tmp_path / "other.mcap"
    target.touch()
    copy = RecordingCopy(source, target, {})
    for raw in source.raw_messages():
        truth = Truth.FromString(raw.data) if raw.topic == topics.TRUTH else None
        if truth is not None and truth.frame_id == 2:
            del truth.path[150:]
        copy.add(raw if truth is None else raw._replace(data=truth.SerializeToString()))
    copy.finish([])
    with pytest.raises(ExportError, match="true path"):
        export(aolink.read(target), tmp_path / "out.nc")


@pytest.fixture
def recording_with_a_shorter_exposure(tmp_path: Path) -> Path:
    """Three exposures, the last of which ends in its middle."""
    source, target = aolink.read(write_small(tmp_path / "small.mcap", 3)), tmp_path / "other.mcap"
    target.touch()
    copy = RecordingCopy(source, target, {})
    for raw in source.raw_messages():
        info = ExposureInfo.FromString(raw.data) if raw.topic == topics.EXPOSURE else None
        if info is not None and info.frame_id == 3:
            info.last_step -= 100
            raw = raw._replace(data=info.SerializeToString())
        copy.add(raw)
    copy.finish([])
    return target
