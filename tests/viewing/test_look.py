"""A part of a recording, one of many spots, side files: the command and what it draws."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from aolink.viewing import save_rrd
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
    assert aolink("report", "a.mcap", side, "--figure", "exposure", "-o", "a.png").returncode == 0
    assert aolink("report", "a.mcap", side, "-o", "a.html").returncode == 0
    alone = aolink("report", side, "-o", "b.html")
    assert alone.returncode != 0
    assert "side file" in alone.stderr


@pytest.mark.slow
def test_a_closed_loop_is_shown(tmp_path: Path) -> None:
    rig = load_rig("loop")
    with simulated_rig("loop") as ports:
        record(rig, *ports, tmp_path / "loop.mcap", estimators=["o1"], exposures=8, control="lqg")
    entities = read_rrd(save_rrd(Recording(tmp_path / "loop.mcap"), tmp_path / "loop.rrd"))
    left = scalars(entities["/control/slope_rms"])
    assert np.isfinite(left).any()
    assert (scalars(entities["/control/delay_steps"]) > 0).all()
    assert next(state for (state,) in entities["/status/loop"]["StateChange:state"]).startswith("CLOSED")
    assert "Loop: residual (slope units)" in str(read_blueprint(tmp_path / "loop.rrd"))
