"""Figures: what is drawn in them, on axes given or made, and what is said where there is nothing to draw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink import plotting
from aolink.errors import ExportError, RecordingError
from aolink.gathered import Blur, extremes, hides_swings, nis_bounds, some_rows
from aolink.optics.kernel import exposure_density
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from tests.needs import needed
from tests.recording.small import write_small
from tests.simulation.rolling import rolling

Figure = needed("matplotlib.figure").Figure
StepPatch = needed("matplotlib.patches").StepPatch

RECORDINGS = Path(__file__).parents[2] / "recordings"


def reference(name: str) -> Recording:
    return aolink.read(RECORDINGS / f"{name}.mcap")


def test_the_overview_has_what_the_series_has() -> None:
    series = reference("section-vi-lively")
    view = plotting.overview(series)
    assert view.names == ["open-loop", "o1", "o2", "o3", "moments"]
    assert view.frame_ids.tolist() == [each.frame_id for each in series]
    assert set(view.nis) == {"o1", "o2", "o3", "moments"}
    for name in view.names:
        errors = [
            np.sqrt(np.mean((estimate.path - exposure.truth.path) ** 2))
            for exposure, estimate in zip(series, series.estimates(name), strict=True)
            if exposure.truth is not None
        ]
        np.testing.assert_allclose(view.errors[name], errors)
        np.testing.assert_allclose(view.scores[name].path_rmse, np.sqrt(np.mean(np.square(errors))))
    moved = [np.std(each.truth.path) for each in series if each.truth is not None]
    np.testing.assert_allclose(view.moved, moved)
    assert view.most_blurred == np.argmax(moved)


def test_the_overview_is_of_a_slice_and_of_some_estimators() -> None:
    view = plotting.overview(reference("tip-tilt")[3:7], ["o3", "o1"], output=1)
    assert (len(view), view.names, set(view.paths)) == (4, ["o1", "o3"], {"truth", "o1", "o3"})
    with pytest.raises(ExportError, match="output 2"):
        plotting.overview(reference("tip-tilt"), output=2)
    with pytest.raises(RecordingError, match="mixture"):
        plotting.overview(reference("tip-tilt"), ["mixture"])


def test_nis_over_time_has_the_bounds_of_each_number_of_measurements() -> None:
    axes = plotting.plot_nis(plotting.overview(reference("section-vi-lively")), Figure().subplots())
    (line,) = [each for each in axes.get_lines() if each.get_label() == "o3"]
    np.testing.assert_allclose(np.asarray(line.get_xdata(), float), 0.2 * np.arange(20))
    dashed = [each for each in axes.get_lines() if each.get_linestyle() == "--"]
    heights = sorted(float(np.ravel(each.get_ydata())[0]) for each in dashed)
    np.testing.assert_allclose(heights, sorted(bound for degrees in (1, 2, 4) for bound in nis_bounds(degrees)))


def test_a_path_that_swings_faster_than_its_points_show_is_drawn_as_its_range() -> None:
    steps = np.arange(200)
    for path, hidden in ((np.sin(steps * 2.9), True), (np.sin(steps * 0.03), False), (np.zeros(200), False)):
        low, high = extremes(path, 9)
        assert hides_swings(path, 9) == hidden
        assert (low.min(), high.max()) == (path.min(), path.max())
    slow = plotting.plot_blur(plotting.overview(reference("jitter")), Figure().subplots())
    assert {each.get_label() for each in slow.get_lines()} == {"truth", "moments"}


@pytest.mark.parametrize(("rows", "curves", "count"), [(1000, 1, 64), (37, 2, 5), (100, 3, 10), (7, 1, 8)])
def test_a_curve_keeps_the_extremes_of_each_part_and_its_ends(rows: int, curves: int, count: int) -> None:
    values = np.random.default_rng(rows).normal(size=(rows, curves))
    values[3] = np.nan
    kept = some_rows(values, count)
    if rows <= count:
        assert kept.tolist() == list(range(rows))
        return
    size = -(-rows // max(1, count // (2 * curves)))
    expected = {0, rows - 1}
    for first in range(0, rows, size):
        part = values[first : first + size]
        expected |= {first + int(find(curve)) for curve in part.T for find in (np.nanargmin, np.nanargmax)}
    assert set(kept.tolist()) == expected


def test_a_path_predicts_what_the_kernel_makes_of_it() -> None:
    series = reference("tip-tilt")
    step = next(series[4:5].steps(["o3"]))
    blur = Blur.of(series.rig, step, 1)
    line, path = series.rig.sensor.profile, step.estimates["o3"].path[1]
    expected = exposure_density(line.kernel, line.edges, path)
    np.testing.assert_allclose(blur.predicted("o3"), expected, atol=1e-4 * line.peak_density)
    density, edges = blur.histogram("o3", 0.01)
    counts = np.histogram(path, edges)[0]
    np.testing.assert_allclose(density, counts / (0.01 * len(path)))


def test_one_exposure_shows_path_histogram_and_profile_on_one_axis_of_position() -> None:
    series = reference("section-vi-lively")
    figure = plotting.plot_exposure(series, 9, Figure(), estimators=["o3"])
    over_time, histogram, intensity = figure.axes
    truth = series[9].truth
    assert truth is not None
    lines = {each.get_label(): each.get_ydata() for each in over_time.get_lines()}
    np.testing.assert_array_equal(lines["truth"], truth.path[0])
    np.testing.assert_array_equal(lines["o3, ±2 sd"], series[9:10].estimates("o3")[0].path[0])
    assert over_time.get_ylim() == histogram.get_ylim() == intensity.get_ylim()
    shares = [each.get_data() for each in histogram.patches if isinstance(each, StepPatch)]
    assert len(shares) == 2
    for share in shares:  # of the time, all of it
        assert np.sum(share.values * np.diff(share.edges)) == pytest.approx(1)
    assert over_time.get_xlim() == (0, 200)


def test_a_spot_on_a_plane_has_a_line_for_x_and_one_for_y() -> None:
    series = reference("tip-tilt")
    axes = plotting.plot_exposure(series, 2, Figure()).axes
    truth = series[2].truth
    assert truth is not None
    drawn = [
        np.asarray(line.get_ydata()) for each in axes for line in each.get_lines()
        if line.get_label() == "truth" and np.size(line.get_ydata()) == 100
    ]  # fmt: skip
    assert any(np.array_equal(each, truth.path[0]) for each in drawn)
    assert any(np.array_equal(each, truth.path[1]) for each in drawn)


@pytest.mark.parametrize(
    ("draw", "text"),
    [
        (lambda series: plotting.plot_exposure(series, 20, Figure()), "exposure 20"),
        (lambda series: plotting.plot_exposure(series, 0, Figure(), spot=1), "spot 1"),
        (lambda series: plotting.plot_pupil(series, Figure()), "lenslets"),
        (lambda series: plotting.plot_scene(series, 0, Figure()), "picture"),
        (lambda series: plotting.plot_latency(plotting.overview(series), Figure().subplots()), "latencies"),
        (lambda series: plotting.save_figure(series, "scene", "x.jpeg"), "svg"),
        (lambda series: plotting.save_figure(series, "moon", "x.png"), "moon"),
    ],
)
def test_what_is_not_there_is_one_clear_error(draw: Callable[..., object], text: str) -> None:
    with pytest.raises(ExportError, match=text):
        draw(reference("section-vi-lively"))


@pytest.fixture(scope="module")
def pupil(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording of 16 lenslets without estimates, and the same with them."""
    folder = tmp_path_factory.mktemp("pupil")
    bare = write_small(folder / "bare.mcap", 3, rig="sh-4x4", truth=True)
    write_reestimated(aolink.read(bare), ["o1"], folder / "estimated.mcap")
    return bare, folder / "estimated.mcap"


def test_the_pupil_s_maps_have_a_value_for_each_lenslet(pupil: tuple[Path, Path]) -> None:
    bare, estimated = map(aolink.read, pupil)
    true = np.mean([each.truth.path.mean(axis=1) for each in bare if each.truth is not None], axis=0)
    for series, by, more in ((bare, "centroid", []), (estimated, "o1", ["blur (o1)", "NIS (o1)"])):
        axes = [each for each in plotting.plot_pupil(series, Figure()).axes if each.get_title()]
        maps = {each.get_title(): np.asarray(each.get_images()[0].get_array()) for each in axes}
        assert list(maps) == ["light", f"mean slope x ({by})", f"mean slope y ({by})", *more]
        np.testing.assert_allclose(maps["light"], np.ones((4, 4)), atol=0.3)
        np.testing.assert_allclose(maps[f"mean slope x ({by})"].ravel(), true[::2], atol=0.1)
    nis = np.mean([each.nis.reshape(-1, 2).mean(axis=1) for each in estimated.estimates("o1")], axis=0)
    np.testing.assert_allclose(maps["NIS (o1)"].ravel(), nis)
    bars = {each.get_ylabel() for each in axes[0].figure.axes} - {""}
    assert bars == {"1 = a lenslet wholly lit", "slope units", "RMS of the path, slope units", "no unit"}


def test_a_dark_recording_and_an_empty_one(tmp_path: Path) -> None:
    dark = aolink.read(write_small(tmp_path / "dark.mcap", 2, "nothing", missing=True))
    view = plotting.overview(dark)
    assert view.incidents["frames incomplete"].tolist() == [0, 200]
    plotting.plot_blur(view, Figure().subplots())
    plotting.plot_losses(view, Figure().subplots())
    plotting.plot_exposure(dark, 0, Figure())
    with pytest.raises(ExportError, match="NIS"):
        plotting.plot_nis(view, Figure().subplots())
    empty = plotting.overview(aolink.read(write_small(tmp_path / "empty.mcap", 0)))
    assert len(empty) == 0
    for draw in (plotting.plot_blur, plotting.plot_nis, plotting.plot_errors, plotting.plot_losses):
        with pytest.raises(ExportError, match="exposure"):
            draw(empty, Figure().subplots())


def test_the_picture_of_a_spot_shows_when_each_of_its_rows_is_exposed() -> None:
    rig = rolling("sh-4x4", -2e-4)
    series = aolink.simulate(rig, 2)
    spot = 5
    figure = plotting.plot_exposure(series, 1, Figure(), spot=spot, estimators=[])
    (beside,) = (each for axes in figure.axes for each in axes.child_axes)
    assert beside.get_ylabel() == "start of a row's exposure (ms)"
    rows = rig.sensor.window_of(spot)[0]
    start = vars(beside)["_functions"][0]
    centres = rig.sensor.profile.centres
    np.testing.assert_allclose(start(centres), 1e3 * rig.sensor.row_starts_s[rows])
    assert all(not each.child_axes for each in plotting.plot_exposure(aolink.simulate("sh-4x4", 2), 1, Figure()).axes)
