"""What a notebook does with a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.errors import ExportError, RecordingError
from aolink.recording.reader import Recording
from tests.needs import needed
from tests.recording.small import write_small

pandas = needed("pandas")
xarray = needed("xarray")


def test_a_table_has_a_row_for_each_exposure_and_axis(series: Recording) -> None:
    table = series.to_pandas()
    axes = series.rig.plant.axes
    assert len(table) == axes * len(series)
    assert table.index.name == "time"
    assert str(table.index.tz) == "UTC"
    first = table[table["axis"] == 0]
    np.testing.assert_array_equal(first.index.as_unit("ns").asi8, [e.host_start_ns for e in series])
    for name in series.estimators:
        estimates = series.estimates(name)
        np.testing.assert_array_equal(first[f"{name}_start_x2"], [e.start_state[0, 1] for e in estimates])
        sd = [np.sqrt(e.end_covariance[0, 0, 0]) for e in estimates]
        np.testing.assert_array_equal(first[f"{name}_end_x1_sd"], sd)
        assert first[f"{name}_status"].tolist() == [e.status.name for e in estimates]
        outputs = series.rig.plant.n_outputs
        error = [
            np.sqrt(np.mean((e.path[:outputs] - x.truth.path[:outputs]) ** 2))
            for e, x in zip(estimates, series, strict=True)
            if x.truth
        ]
        np.testing.assert_allclose(first[f"{name}_path_error_rms"], error)
    np.testing.assert_allclose(first["input_1_mean"], [e.inputs[:, 0].mean() for e in series])


def test_a_table_of_some_exposures_and_one_estimator(lively: Recording) -> None:
    table = lively[5:8].to_pandas(["o3"])
    assert table["frame_id"].tolist() == [each.frame_id for each in lively[5:8]]
    assert [name for name in table if name.endswith("_nis")] == ["o3_nis"]
    assert table["o3_nis"].tolist() == [each.nis[0] for each in lively[5:8].estimates("o3")]


def test_a_slice_of_a_slice_has_tables_and_an_exposure_by_its_number(lively: Recording) -> None:
    part = lively[2:12][1:5]
    assert part.to_pandas(["o3"])["frame_id"].tolist() == [each.frame_id for each in lively[3:7]]
    assert part.to_xarray(["o3"]).sizes["time"] == 4
    assert part[-1].frame_id == lively[6].frame_id
    assert repr(part).startswith("<Series section-vi-lively.mcap[3:7]: 4 exposures")


def test_a_dataset_is_taken_apart_by_time_and_estimator(lively: Recording) -> None:
    dataset = lively.to_xarray()
    estimate = lively.estimates("moments")[3]
    one = dataset.sel(estimator="moments").isel(time=3)
    np.testing.assert_array_equal(one["path"], estimate.path)
    assert one["status"] == "OK"
    assert one["frame_id"] == estimate.frame_id
    begin = dataset["time"][5].values
    assert dataset.sel(time=slice(begin, None)).sizes["time"] == len(lively) - 5
    np.testing.assert_allclose(dataset["step"][[0, -1]], [0, 0.199])
    assert dataset["path"].attrs == {"long_name": "output at each fast step", "units": "slope unit"}
    assert dataset.attrs["rig_digest"] == lively.rig.digest
    assert dataset["rig_toml"].item() == lively.rig.toml


@pytest.mark.slow
@pytest.mark.parametrize("name", ["section-vi-lively", "single-lenslet"])
def test_a_plot_on_axes_of_its_own_or_on_those_given(name: str) -> None:
    matplotlib = needed("matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    series = aolink.read(Path(__file__).parents[2] / "recordings" / f"{name}.mcap")
    output = series.rig.n_outputs - 1
    paths, nis = series.plot(output=output)
    lines = {line.get_label(): line.get_xydata() for line in paths.get_lines()}
    assert set(lines) == {"truth", *series.estimators}
    truth = series[0].truth
    assert truth is not None
    np.testing.assert_array_equal(np.asarray(lines["truth"])[[0, 16], 1], truth.path[output, [0, -1]])
    assert len(paths.collections) == 1  # the blur
    drawn = {line.get_label(): line.get_ydata() for line in nis.get_lines()}
    np.testing.assert_allclose(
        np.asarray(drawn["o3"]), [each.nis.mean() for each in series.estimates("o3")]
    )  # over the axes
    assert "open-loop" not in drawn
    _, mine = pyplot.subplots(1, 2)
    assert series[2:5].plot(["o3"], axes=tuple(mine)) == tuple(mine)
    assert {line.get_label() for line in mine[0].get_lines()} == {"truth", "o3"}
    pyplot.close("all")
    with pytest.raises(ExportError, match="output"):
        series.plot(output=output + 1)


def test_dark_and_empty_recordings(tmp_path: Path) -> None:
    needed("matplotlib").use("agg")
    dark = aolink.read(write_small(tmp_path / "dark.mcap", 2, "nothing", missing=True))
    assert dark.to_xarray().sizes["time"] == len(dark.to_pandas()) == 2
    assert not dark.plot()[1].get_lines()
    empty = aolink.read(write_small(tmp_path / "empty.mcap", 0))
    for give in (empty.to_xarray, empty.to_pandas, empty.plot):
        with pytest.raises(ExportError, match="exposure"):
            give()
    with pytest.raises(RecordingError, match="o3"):
        empty.to_pandas(["o3"])
