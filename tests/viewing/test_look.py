"""A part of a recording, one of many spots, two recordings beside each other: the command and what it draws."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.optics.kernel import exposure_density
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.rig import load_rig
from aolink.session import record
from aolink.viewing import Look, save_rrd
from tests.commands import simulated_rig
from tests.needs import needed
from tests.viewing.rrd import read_blueprint, read_rrd, scalars

RECORDINGS = Path(__file__).parents[2] / "recordings"
LIVELY = RECORDINGS / "section-vi-lively.mcap"
Aolink = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.slow
def test_one_exposure_has_every_step_of_its_paths_and_nothing_of_others(aolink: Aolink, tmp_path: Path) -> None:
    done = aolink("view", LIVELY, "--frame", "7", "-o", "one.rrd")
    assert done.returncode == 0, done.stderr
    entities, recording = read_rrd(tmp_path / "one.rrd"), Recording(LIVELY)
    estimate = recording.estimates("o3")[7]
    np.testing.assert_array_equal(scalars(entities["/path/o3/mean"])[:, 0], estimate.path[0])
    assert entities["/camera/image"]["frame"] == [estimate.frame_id]
    applied = entities["/mirror/applied"]["fast_step"]
    assert applied[0] <= estimate.first_step < applied[-1] < estimate.first_step + 2 * estimate.n_steps
    layout = str(read_blueprint(tmp_path / "one.rrd"))
    assert "Path; time at a position; intensity" in layout
    assert "Latency" not in layout


@pytest.mark.slow
def test_a_layout_about_an_exposure_has_a_few_views_of_it_and_all_exposures_are_there(tmp_path: Path) -> None:
    recording = Recording(RECORDINGS / "moving-scene.mcap")
    path = save_rrd(recording, tmp_path / "about.rrd", look=Look(about=9))
    entities, layout = read_rrd(path), read_blueprint(path)
    assert len(entities["/camera/image"]["frame"]) == len(recording)
    estimates = recording.estimates("o1")
    np.testing.assert_array_equal(
        scalars(entities["/path/o1/mean"])[:, 0], np.concatenate([e.path[0] for e in estimates])
    )
    assert "/profile/path/o1" not in entities
    drawn = np.array(entities["/profile/predicted/o1"]["LineStrips2D:strips"][-len(recording) :][9][0])
    kernel, sensor = recording.rig.sensor.profile.kernel, recording.rig.sensor.profile
    expected = exposure_density(kernel, sensor.edges, estimates[9].path[0])
    np.testing.assert_allclose(-drawn[:, 1] / -drawn[:, 1].min(), expected / expected.max(), atol=1e-3)
    names = [str(name) for view in layout.values() for name in view.get("ViewBlueprint:display_name", [])]
    assert sorted(names) == [
        "['Camera: 8 exposures (pixels), paths in their blur']",
        "['Intensity (1/slope unit) over slope: measured, and predicted']",
        *[f"['Path, {name}, 95 % band (slope units)']" for name in ("moments", "o1", "o2", "o3", "open-loop")],
        "['Scene as it came (pixels)']",
        "['Scene at rest (truth) (pixels)']",
    ]
    truth = recording[9].truth
    assert truth is not None
    columns = (truth.path[0] - sensor.field[0]) / sensor.pixel_width
    bounds = [each for view in layout.values() for row in view.get("VisualBounds2D:range", []) for each in row]
    near = [each for each in bounds if each["y_range"] == [5.0, 13.0]]  # rows of the page
    assert len(near) == 1
    assert near[0]["x_range"][0] <= columns.min() < columns.max() <= near[0]["x_range"][1] < sensor.pixels


@pytest.mark.slow
def test_a_lenslet_has_its_own_lines_as_x_and_y(tmp_path: Path, aolink: Aolink) -> None:
    recording = Recording(RECORDINGS / "tip-tilt.mcap")
    done = aolink("view", recording.path, "--lenslet", "0,0", "-o", "spot.rrd")
    assert done.returncode == 0, done.stderr
    entities = read_rrd(tmp_path / "spot.rrd")
    truth = entities["/path/truth"]
    assert scalars(truth).shape[1] == 2
    assert [name for names in truth["SeriesLines:names"] for name in names or []] == ["truth x", "truth y"]
    assert "/path/truth/axes" not in entities
    assert scalars(entities["/mirror/command"]).shape[1] == 2
    for options, why in ((("--lenslet", "4,4"), "the grid has"), (("--lenslet", "one"), "row and column")):
        assert why in " ".join(aolink("view", recording.path, *options, "-o", "x.rrd").stderr.split())


@pytest.mark.slow
def test_two_estimates_and_two_recordings_are_drawn_in_the_same_plots(tmp_path: Path) -> None:
    """The second in fainter lines, from its own first exposure on."""
    recording = Recording(LIVELY)
    again = tmp_path / "again.mcap"
    write_reestimated(recording, ["o1"], again)
    path = save_rrd(recording, tmp_path / "both.rrd", look=Look(compared=Recording(again)))
    entities = read_rrd(path)
    first, second = (entities[f"{root}/path/o1/mean"] for root in ("", "/compared"))
    np.testing.assert_allclose(scalars(first), scalars(second), rtol=1e-9)
    assert first["time"] == second["time"]
    opacities = [
        [colour & 255 for row in each["SeriesLines:colors"] for colour in row or []] for each in (first, second)
    ]
    assert opacities[0] == [255]
    assert opacities[1][0] < 200
    layout = str(read_blueprint(path))
    assert "+ /compared/path/o1/**" in layout
    assert "Compared" in layout


def test_an_exposure_that_is_not_there_is_one_clear_error(aolink: Aolink, tmp_path: Path) -> None:
    done = aolink("view", LIVELY, "--frame", "20", "-o", "x.rrd")
    assert done.returncode == 7
    assert "there is no exposure 20" in done.stderr
    assert not (tmp_path / "x.rrd").exists()


@pytest.mark.slow
def test_side_files_are_drawn_and_reported(aolink: Aolink, tmp_path: Path) -> None:
    needed("matplotlib")
    shutil.copy(LIVELY, tmp_path / "a.mcap")
    assert aolink("estimate", "a.mcap", "-e", "o1", "-o", "sides/").returncode == 0
    (side,) = (tmp_path / "sides").glob("*.mcap")
    assert aolink("report", "a.mcap", side, "--figure", "nis", "-o", "a.png").returncode == 0
    assert aolink("report", "a.mcap", side, "-o", "a.html").returncode == 0
    alone = aolink("report", side, "-o", "b.html")
    assert alone.returncode != 0
    assert "is a side file" in alone.stderr


@pytest.mark.slow
def test_a_closed_loop_is_shown(tmp_path: Path) -> None:
    rig = load_rig("loop")
    with simulated_rig("loop") as ports:
        record(rig, *ports, tmp_path / "loop.mcap", estimators=["o1"], exposures=8, control="lqg")
    entities = read_rrd(save_rrd(Recording(tmp_path / "loop.mcap"), tmp_path / "loop.rrd"))
    left = scalars(entities["/control/slope_rms"])
    assert np.isfinite(left).any()
    assert (scalars(entities["/control/delay"]) > 0).all()
    assert next(state for (state,) in entities["/status/loop"]["StateChange:state"]).startswith("CLOSED")
    assert "Loop: residual (slope units)" in str(read_blueprint(tmp_path / "loop.rrd"))
