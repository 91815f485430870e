"""Files of other programs, read back with these programs' own readers."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap_protobuf.writer import Writer

import aolink
from aolink.errors import ExportError
from aolink.exporting.arrays import arrays
from aolink.exporting.files import WRITERS, export
from aolink.files import write_csv
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


def test_python_reads_the_table(series: Series, tmp_path: Path) -> None:
    export(series, tmp_path / "out.csv", ["o3"])
    with (tmp_path / "out.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    estimates, axes = series.estimates("o3"), series.rig.plant.axes
    assert len(table) == axes * len(series)
    for k, (exposure, estimate) in enumerate(zip(series, estimates, strict=True)):
        for axis in range(axes):
            row = table[axes * k + axis]
            assert (int(row["frame_id"]), int(row["axis"])) == (exposure.frame_id, axis)
            assert int(row["host_start_ns"]) == exposure.host_start_ns
            assert np.datetime64(row["time"].removesuffix("Z")).astype(np.int64) == exposure.host_start_ns
            assert float(row["o3_end_x1"]) == estimate.end_state[axis, 0]
            assert float(row["o3_start_x1_sd"]) == math.sqrt(estimate.start_covariance[axis, 0, 0])
            assert float(row["o3_nis"]) == estimate.nis[axis]
            assert row["o3_status"] == estimate.status.name
            assert float(row["truth_start_x1"]) == exposure.truth.start_state[axis, 0]  # type: ignore[union-attr]
            assert row["recording"] == series.path.name
    assert not [name for name in table[0] if name.startswith("o1_")]


def test_a_spreadsheet_runs_nothing_of_a_table(tmp_path: Path) -> None:
    """The file's name, the rig's and the estimators' are other people's texts; numbers stay numbers."""
    shutil.copy(RECORDINGS / "section-vi.mcap", path := tmp_path / "=1+1.mcap")
    series = aolink.read(path)
    export(series, tmp_path / "out.csv", ["o3"])
    with (tmp_path / "out.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert {row["recording"] for row in table} == {"'=1+1.mcap"}
    assert any(float(row["truth_end_x2"]) < 0 for row in table)
    names = ["=a", "@b", "+c", "-d", "\t=e", "\uff1df", "g=1", "'h"]
    with (tmp_path / "all.csv").open("w+", newline="") as file:
        write_csv(file, names, [dict.fromkeys(names, -1.5), {"g=1": "-2+3"}])
        file.seek(0)
        head, numbers, texts = csv.reader(file)
    assert head == ["'=a", "'@b", "'+c", "'-d", "'\t=e", "'\uff1df", "g=1", "'h"]
    assert numbers == ["-1.5"] * len(names)
    assert texts == ["", "", "", "", "", "", "'-2+3", ""]


def test_pandas_reads_the_same_of_csv_and_parquet_as_a_notebook_has(series: Recording, tmp_path: Path) -> None:
    pandas = needed("pandas")
    needed("pyarrow")
    expected = series.to_pandas()
    export(series, tmp_path / "out.csv")
    found = pandas.read_csv(tmp_path / "out.csv", parse_dates=["time"], index_col="time", keep_default_na=False)
    numbers = expected.select_dtypes("number")
    np.testing.assert_array_equal(found[numbers.columns].replace("", "nan").astype(float), numbers.astype(float))
    assert (found.index == expected.index).all()
    export(series, tmp_path / "out.parquet")
    found = pandas.read_parquet(tmp_path / "out.parquet").set_index("time")
    assert (found.index == expected.index).all()
    for name in expected:
        if name in numbers:
            np.testing.assert_array_equal(found[name], expected[name])
        else:
            assert found[name].tolist() == expected[name].tolist()


def test_pyarrow_reads_paths_inputs_and_where_they_come_from(series: Series, tmp_path: Path) -> None:
    parquet = needed("pyarrow.parquet")
    export(series, tmp_path / "out.parquet", ["moments"])
    table, plant = parquet.read_table(tmp_path / "out.parquet"), series.rig.plant
    shape = (len(series), plant.axes * plant.n_outputs, -1)
    for column, values in (
        ("moments_path", [e.path for e in series.estimates("moments")]),
        ("moments_path_sd", [e.path_sd for e in series.estimates("moments")]),
        ("truth_path", [e.truth.path for e in series if e.truth]),
    ):
        np.testing.assert_array_equal(np.array(table[column].to_pylist()).reshape(shape), values)
    inputs = np.array(table["inputs"].to_pylist()).reshape(len(series), plant.axes, -1, plant.n_inputs)
    np.testing.assert_array_equal(inputs.transpose(0, 2, 1, 3).reshape(len(series), -1, series.rig.n_inputs),
                                  [e.inputs for e in series])  # fmt: skip
    facts = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert parse_rig(facts["rig_toml"]).digest == series.rig.digest
    assert json.loads(facts["session"]) == series.metadata
    assert str(table.schema.field("time").type) == "timestamp[ns, tz=UTC]"


def test_a_file_is_written_by_its_suffix_and_needs_one_that_is_known(lively: Series, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"must end with one of \.npz, \.csv, \.parquet, \.nc, \.fits"):
        export(lively, tmp_path / "out.xlsx")
    export(lively, tmp_path / "OUT.CSV", [])
    assert (tmp_path / "OUT.CSV").read_text().startswith("recording,rig,frame_id,time,axis")


@pytest.mark.parametrize("suffix", WRITERS)
def test_nothing_is_left_where_nothing_can_be_written(suffix: str, tmp_path: Path) -> None:
    empty = aolink.read(write_small(tmp_path / "empty.mcap", 0))
    with pytest.raises(ExportError, match=r"empty\.mcap holds no exposure to export"):
        export(empty, tmp_path / f"out{suffix}")
    assert [each.name for each in tmp_path.iterdir()] == ["empty.mcap"]


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_target_that_exists_is_replaced_only_if_told_so(lively: Series, suffix: str, tmp_path: Path) -> None:
    target = tmp_path / f"out{suffix}"
    target.write_text("mine")
    with pytest.raises(ExportError, match="exists and is not overwritten"):
        export(lively[:2], target, ["o1"])
    assert target.read_text() == "mine"
    export(lively[:2], target, ["o1"], overwrite=True)
    assert target.read_bytes()[:4] != b"mine"


def test_frames_of_other_sizes_go_into_a_table_only(tmp_path: Path, recording_with_a_shorter_exposure: Path) -> None:
    recording = aolink.read(recording_with_a_shorter_exposure)
    with pytest.raises(ExportError, match=r"frame 3 .* they make no array; a table \(\.csv, \.parquet\) takes both"):
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
    with pytest.raises(
        ExportError,
        match=r"would take \d+ GiB of memory, at most [\d.]+ are allowed here.* \(`aolink copy`\), or a table",
    ):
        export(recording, tmp_path / "out.npz")
    with pytest.raises(ExportError, match="holds no exposure to export"):
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
    with pytest.raises(ExportError, match=r"a true path of \(1, 150\) output x step, where .* have \(1, 200\)"):
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
