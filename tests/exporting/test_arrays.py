from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.errors import ExportError, RecordingError
from aolink.exporting.arrays import arrays
from aolink.recording import topics
from aolink.recording.editing import RecordingCopy
from aolink.recording.schemas_pb2 import Estimate
from aolink.series import Series
from tests.recording.small import write_small


def test_exposures_are_stacked_along_time(series: Series) -> None:
    found, exposures = arrays(series), list(series)
    for name in ("frame_id", "first_step", "n_steps", "device_start_ns", "host_receive_ns", "pixels", "mask", "inputs"):
        assert found[name].dims[0] == "time"
        np.testing.assert_array_equal(found[name].values, [getattr(each, name) for each in exposures])
    assert found["pixels"].values.dtype == np.uint16
    np.testing.assert_array_equal(found["time"].values.astype(np.int64), [e.host_start_ns for e in exposures])


def test_truth_and_scene_are_there_where_they_are_known(series: Series) -> None:
    found, exposures = arrays(series), list(series)
    np.testing.assert_array_equal(found["truth_path"].values, [e.truth.path for e in exposures if e.truth])
    np.testing.assert_array_equal(found["truth_end_state"].values, [e.truth.end_state for e in exposures if e.truth])
    assert ("scene" in found) == (series.rig.scene is not None)
    if "scene" in found:
        np.testing.assert_array_equal(found["scene"].values, [e.scene.pixels for e in exposures if e.scene])


def test_estimates_are_stacked_along_estimator_and_time(series: Series) -> None:
    found = arrays(series, ["o3", "open-loop"])
    assert found["estimator"].values.tolist() == ["o3", "open-loop"]
    for k, name in enumerate(["o3", "open-loop"]):
        estimates = series.estimates(name)
        for field in ("start_state", "end_state", "path", "path_sd"):
            np.testing.assert_array_equal(found[field].values[k], [getattr(e, field) for e in estimates])
        sd = [np.sqrt(np.diagonal(e.end_covariance, axis1=1, axis2=2)) for e in estimates]
        np.testing.assert_array_equal(found["end_state_sd"].values[k], sd)
        assert found["status"].values[k].tolist() == [e.status.name for e in estimates]
        assert found["reason"].values[k].tolist() == [e.reason for e in estimates]
    np.testing.assert_array_equal(found["nis"].values[0], [e.nis for e in series.estimates("o3")])
    assert np.isnan(found["nis"].values[1]).all()
    axes = series.rig.plant.axes
    spread = [np.sqrt(e.path.reshape(axes, -1, e.n_steps).var(axis=2).mean(axis=1)) for e in series.estimates("o3")]
    np.testing.assert_allclose(found["path_rms"].values[0], spread)


def test_every_dimension_has_one_length(series: Series) -> None:
    lengths: dict[str, set[int]] = {}
    for each in arrays(series).values():
        assert each.text
        for dim, length in zip(each.dims, each.values.shape, strict=True):
            lengths.setdefault(dim, set()).add(length)
    assert all(len(known) == 1 for known in lengths.values())


def test_inputs_between_exposures_are_end_to_end(tmp_path: Path) -> None:
    recording = aolink.read(write_small(tmp_path / "small.mcap", 5))[::2]  # exposures 0, 2 and 4
    found = arrays(recording)
    leads = [each.lead_inputs for each in recording]
    assert found["lead_steps"].values.tolist() == [len(lead) for lead in leads]
    np.testing.assert_array_equal(found["lead_inputs"].values, np.concatenate(leads))


def test_an_exposure_without_its_estimate_has_gaps(lively: Series, tmp_path: Path) -> None:
    """A part whose estimates begin late, as where an estimator was started in the middle."""
    target = tmp_path / "late.mcap"
    target.touch()
    recording = aolink.read(lively.path)
    copy = RecordingCopy(recording, target, {})
    for raw in recording.raw_messages():
        if raw.topic != topics.estimate_topic("o3") or Estimate.FromString(raw.data).frame_id > 5:
            copy.add(raw)
    copy.finish([])
    late = aolink.read(target)
    found = arrays(late, ["o3"])
    assert found["status"].values[0, :5].tolist() == [""] * 5
    assert np.isnan(found["path"].values[0, :5]).all()
    np.testing.assert_array_equal(found["path"].values[0, 5:], arrays(lively, ["o3"])["path"].values[0, 5:])
    none = arrays(late[:3], ["o3"])
    assert none["path"].values.shape == (1, 3, 1, 200)
    table = late.to_pandas(["o3"])
    assert table["o3_nis"].isna().tolist() == [True] * 5 + [False] * 15
    assert table["o3_status"].isna().tolist() == [True] * 5 + [False] * 15


@pytest.mark.parametrize("applied", [True, False])
def test_times_of_recordings_by_other_software(tmp_path: Path, applied: bool) -> None:
    recording = aolink.read(write_small(tmp_path / "small.mcap", 3, applied=applied))
    times = arrays(recording)["time"].values
    assert times[0] == np.datetime64("2023-11-14T22:13:20")
    np.testing.assert_array_equal(np.diff(times), np.timedelta64(200, "ms"))


def test_what_is_not_there_is_said(lively: Series, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="o9"):
        arrays(lively, ["o9"])
    empty = aolink.read(write_small(tmp_path / "empty.mcap", 0))
    with pytest.raises(ExportError, match="no exposure"):
        arrays(empty)
